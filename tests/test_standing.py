"""Names stand where they explain better than a curve would. Evidence against marginal likelihoods written out."""

import dataclasses
import functools
import itertools
import math
from types import SimpleNamespace

import jax.numpy as jnp
import numpy as np
import pytest
from numpy.polynomial import legendre
from numpy.testing import assert_allclose
from synthetic import SETTLED, table
from worlds import laws, settled, tables

from calibration.discovery import findings, stages, standing
from calibration.discovery.candidates import Candidate, fill_slots
from calibration.discovery.discrepancy import BaseCurve, locate_discrepancy
from calibration.discovery.location import DiscrepancyLocation
from calibration.discovery.loop_notes import NameSupport, NameTest, PlacedCurve
from calibration.discovery.projection import Projection
from calibration.discovery.score_tests import augment_with_columns
from calibration.discovery.search import SearchResult
from calibration.discovery.settings import WITHOUT_NAME, settings_for
from calibration.discovery.smooth import FALL, LENGTHS, PRODUCT, SIZES, WIDE, fit_smooth_curve, fit_smooth_surface
from calibration.discovery.standing import (
    _curve_evidence,
    _deficient_equations,
    _largest_variation,
    _most_influential_row,
    _recurrence,
    cost_of_names,
    equation_of_place,
    evidence_of_names,
    evidence_over_curves,
)
from calibration.inference import bases
from calibration.inference.linearization import PROBED
from calibration.inference.observers import SettledRuns
from calibration.inference.observers.settled import SettledLinearization
from mmrjax.effects import BY_NAME
from mmrjax.model import channels

# --- evidence, on a linear problem ----------------------------------------------------------------------


class Turning(SettledLinearization):
    """Rows at which a shaft has turned by `signals.angle`."""

    def variable(self, name):
        order, _ = bases.ORDERS.get(name, (0, 0))
        return order * self.signals.angle if order else super().variable(name)


class Library(dict):
    """Effects by name, each of one column."""

    names = property(list)
    of = property(lambda self: np.arange(len(self)))


def library(*balances, **families):
    """A library of effects e0, e1 ... of these balances, or of named effects of these families."""
    effects = {f"e{k}": SimpleNamespace(channel="", balance=balance) for k, balance in enumerate(balances)}
    return Library(
        effects | {name: SimpleNamespace(family=lambda word=word: word) for name, word in families.items()}
    )


def fit(readings, columns):
    """Least squares with standard normal priors: what minimises readings + columns z, half of its χ², and its posterior."""
    long = np.concatenate([columns, np.eye(columns.shape[1])])
    e = np.append(readings, np.zeros(columns.shape[1]))
    z = -np.linalg.lstsq(long, e, rcond=None)[0]
    return z, 0.5 * float(np.sum((e + long @ z) ** 2)), np.linalg.inv(long.T @ long)


def linear_about_fit(readings, slopes, defects, signals):
    """Rows of three readings, linear about the best coordinates."""
    (count, p), z = slopes.shape, fit(readings, slopes)[0]
    rows = count // 3
    residual = np.concatenate([readings + slopes @ z, np.zeros(rows), z])
    jacobian = np.concatenate([slopes, np.zeros((rows, p)), np.eye(p)])
    arrays = (jnp.asarray(x) for x in (residual, jacobian, np.zeros((count, 1)), defects, np.ones((rows, 3))))
    return Turning(*arrays, signals, channels=channels.USUAL)


@pytest.fixture(scope="module")
def toy():
    """Twenty rows, four coordinates with standard normal priors, defects of every balance. What is missing is a
    wave over the speed in the balance `track`."""
    rng = np.random.default_rng(11)
    rows, p = 20, 4
    speed, slope = rng.uniform(100, 900, rows), rng.uniform(-0.1, 0.35, rows)
    slopes = rng.standard_normal((3 * rows, p))
    defects = rng.standard_normal((len(PROBED), rows, 3))
    missing = defects[PROBED.index("track")] * 3 * np.sin(speed / 120)[:, None]
    readings = missing.ravel() + rng.standard_normal(3 * rows)
    signals = SimpleNamespace(speed_motor=speed, slope=slope, direction=np.ones(rows))
    linear = linear_about_fit(readings, slopes, defects, signals)
    return SimpleNamespace(linear=linear, readings=readings, slopes=slopes, rows=rows, counts=np.ones(rows, bool))


def log_likelihood(toy, columns):
    """Twice the log marginal likelihood of the readings: normal, of the noise, coordinates and columns of sd 1."""
    covariance = np.eye(len(toy.readings)) + toy.slopes @ toy.slopes.T + columns @ columns.T
    return -np.linalg.slogdet(covariance)[1] - toy.readings @ np.linalg.solve(covariance, toy.readings)


def gained(toy, columns):
    return log_likelihood(toy, columns) - log_likelihood(toy, 0 * columns)


def test_evidence_of_a_curve_is_the_largest_marginal_likelihood(toy):
    found = fit_smooth_curve(toy.linear, "track", "speed_motor", toy.counts)
    raw = bases.place_signature(toy.linear, "track", found.basis(toy.linear.variable("speed_motor")))
    assert found.evidence == pytest.approx(gained(toy, found.scale * raw @ found.root), rel=1e-6)
    # no other prior that is tried makes the readings more likely
    distance = np.subtract.outer(np.arange(6), np.arange(6))
    across = np.linspace(-1, 1, 6)
    a, _ = Projection.of(toy.linear)(raw)
    for length, size in itertools.product(LENGTHS, SIZES[::4]):
        prior = np.exp(-0.5 * (distance / length) ** 2) + WIDE**2 * (1 + np.outer(across, across))
        root = np.linalg.cholesky(prior + 1e-6 * np.eye(6))
        scale = size / np.sqrt(np.diag(a).max())
        assert gained(toy, scale * raw @ root) < found.evidence + 1e-6
    others = [fit_smooth_curve(toy.linear, *at, toy.counts) for at in (("slip", "slope"), ("track", "slope"))]
    assert found.evidence > 1.5 * max(o.evidence for o in others) > 0  # what is missing is where it is


def test_a_curve_of_rows_in_mirror_image_is_the_same(toy):
    way = np.where(np.arange(toy.rows) % 2, 1.0, -1.0)
    signals = SimpleNamespace(speed_motor=way * toy.linear.signals.speed_motor, direction=way)
    turned = dataclasses.replace(toy.linear, defects=toy.linear.defects * way[:, None], signals=signals)
    found, wanted = (fit_smooth_curve(linear, "track", "speed_motor", toy.counts) for linear in (turned, toy.linear))
    assert (found.low, found.high) == (wanted.low, wanted.high) and wanted.evidence > 10
    assert found.evidence == pytest.approx(wanted.evidence, rel=1e-9)


def test_a_wave_is_weighed_as_curves_are_and_said_where_it_is_the_better_one(toy):
    """With sine and cosine alone it explains what five terms over the speed take for it by chance."""
    order, angle = "order 2 of the driving shaft", np.linspace(0.0, 30.0, toy.rows)
    signals = SimpleNamespace(**vars(toy.linear.signals), angle=angle)
    of_track = np.asarray(toy.linear.defects)[PROBED.index("track")]
    missing = (3 * np.sin(2 * angle + 0.4)[:, None] * of_track).ravel()
    residual = np.concatenate([missing, np.asarray(toy.linear.residual)[len(missing) :]])
    linear = dataclasses.replace(toy.linear, signals=signals, residual=residual)
    offered = (("track", "speed_motor"), ("track", "slope"), ("track", order))
    every, space = (*offered, ("electrical", "slope")), SimpleNamespace(included=toy.counts)
    found = _curve_evidence(space, linear, (SimpleNamespace(names=offered),), set())
    assert len(found) == 3 and max(found)[1].variables == (order,)
    of_track = _curve_evidence(space, linear, (SimpleNamespace(names=every),), set(), "track")
    assert [str(x[1]) for x in of_track] == [str(x[1]) for x in found]
    where = located(toy, offered, [9.0, 5.0, 8.5], signals=signals, residual=residual)
    assert (where.place, where.variable) == ("track", order)


def located(toy, offered, scores, **changes):
    """Location of a discrepancy on the toy problem among curves with these scores."""
    scores = SimpleNamespace(curve=np.array(scores), explained=10 * np.array(scores))
    left = SimpleNamespace(scores=scores, linear=dataclasses.replace(toy.linear, **changes))
    return locate_discrepancy(left, (SimpleNamespace(names=offered),), toy.counts)


def test_a_voltage_leads_no_loss_torque(toy):
    """It acts there only through current and speed: a friction that steps with the speed was one over the voltage."""
    known = vars(toy.linear.signals)
    speed = np.random.default_rng(1).uniform(100, 900, toy.rows)
    signals = SimpleNamespace(**known | {"voltage": known["speed_motor"], "speed_motor": speed})
    where = located(toy, (("track", "voltage"), ("track", "speed_motor")), [9.0, 8.5], signals=signals)
    assert (where.variable, where.variables_alike) == ("speed_motor", ("voltage",))
    known_defects = np.array(toy.linear.defects)
    known_defects[PROBED.index("electrical")] = known_defects[PROBED.index("track")]
    offered = ("electrical", "voltage"), ("electrical", "slope")
    where = located(toy, offered, [9.0, 5.0], signals=signals, defects=known_defects)
    assert where.variable == "voltage"


def test_balances_are_alike_where_they_change_the_readings_alike(toy):
    """A loss before the sensor of the torque is an ammeter's error, not a loss of the load, if the speed is imposed."""
    defects = np.array(toy.linear.defects)
    defects[PROBED.index("gearbox")] = 1.1 * defects[PROBED.index("track")]
    defects[PROBED.index("motor")] = [2.0, 0.0, 0.0]
    offered = ("track", "speed_motor"), ("total_current", "speed_motor")
    where = located(toy, offered, [9.0, 8.5], defects=defects)
    assert where.alike == ("track", "gearbox", channels.USUAL[0], "motor")


@pytest.mark.parametrize(
    "law, named",
    [(lambda a: np.ones_like(a), True), (lambda a: np.sin(2 * a + 0.5), False)],
    ids=["same", "wave"],
)
def test_a_constant_is_weighed_against_waves_of_which_runs_show_a_piece(law, named):
    """Runs that come back before a quarter turn: over these an order of the shaft is a constant and some more."""
    rng, samples, p = np.random.default_rng(5), 60, 2
    t = np.linspace(0.0, 1.0, samples)
    angle = np.concatenate([(0.6 + 0.4 * k) * np.sin(np.pi * t) ** 2 for k in range(3)])
    speed = np.concatenate([(0.6 + 0.4 * k) * np.pi * np.sin(2 * np.pi * t) for k in range(3)])
    rows, n = np.arange(3 * samples).reshape(3, samples), 3 * samples
    waves = bases.wave_families(np.zeros(n, bool), angle, rows, rows, bases.BALANCES)
    only = np.array([1.0, 0.0, 0.0])
    defects = np.zeros((len(PROBED), n, 3))
    defects[PROBED.index("track")] = only
    slopes = (np.stack([np.tanh(speed), speed], 1)[:, None] * only[:, None]).reshape(3 * n, p)
    constant = np.outer(np.ones(n), only).ravel()
    readings = np.outer(1.5 * law(angle) + rng.standard_normal(n), only).ravel()

    _, cost, _ = fit(readings, slopes)
    whole, least, posterior = fit(readings, np.concatenate([slopes, constant[:, None]], 1))
    signals = SimpleNamespace(speed_motor=speed, direction=np.tanh(speed), angle=angle)
    linear = linear_about_fit(readings, slopes, defects, signals)
    without = dataclasses.replace(names_of(np.eye(0), p), cost=cost)
    best = dataclasses.replace(names_of(posterior[p:, p:], p), cost=least, z=np.append(whole, np.zeros(7)))
    assert 2 * (cost - least) > 20.0  # the constant explains much either way
    space = SimpleNamespace(free=p, library=library("track"), included=np.ones(n, bool))
    offered = (*waves, SimpleNamespace(names=(("track", "speed_motor"),)))
    found = evidence_over_curves(SimpleNamespace(space=space, bases=offered), best, without, ("e0",), linear)
    assert NameTest("e0", 9.0, 3.3, (), found).established == named


def test_the_curve_of_a_log_is_that_of_bayesian_least_squares_at_its_base(toy, monkeypatch):
    monkeypatch.setattr("calibration.discovery.discrepancy.propose_formula", lambda *_, **__: None)
    where = DiscrepancyLocation("track", "speed_motor", ("track",), (), 0.0, 0.0)
    rig = SimpleNamespace(shows_voltage=True)
    space = SimpleNamespace(included=toy.counts, bare=SimpleNamespace(base=SimpleNamespace(rig=rig)))
    beside = BaseCurve(space, None, SimpleNamespace(linear=toy.linear), ())
    vars(beside)["where"] = where  # in place of a search
    found = findings.unnamed_discrepancy(beside, where, 0.01, 0, True)
    curve, unit = beside.at_base, beside.unit
    raw = bases.place_signature(toy.linear, "track", curve.basis(toy.linear.variable("speed_motor")))
    design = np.hstack([toy.slopes, curve.scale * raw @ curve.root])
    covariance = np.linalg.inv(np.eye(design.shape[1]) + design.T @ design)
    shape = curve.scale * curve.basis(found.at) @ curve.root
    assert_allclose(found.value, -shape @ (covariance @ design.T @ toy.readings)[4:], rtol=1e-6)
    assert_allclose(found.sd, np.sqrt(np.diag(shape @ covariance[4:, 4:] @ shape.T)), rtol=1e-6)
    assert (found.unit, found.family, found.over) == (unit, where.family, None)
    wave = dataclasses.replace(where, variable=next(iter(bases.ORDERS)))
    assert findings.unnamed_discrepancy(beside, wave, 0.01, 0, True) is None


def test_evidence_of_a_surface_is_the_largest_marginal_likelihood(toy):
    evidence, columns = fit_smooth_surface(
        toy.linear, "track", ("speed_motor", "slope"), toy.counts, Projection.of(toy.linear)
    )
    assert evidence == pytest.approx(gained(toy, columns), rel=1e-6)
    sides = []
    for name in ("speed_motor", "slope"):
        x = toy.linear.variable(name)
        x = 2 * (x - x.min()) / np.ptp(x) - 1
        sides.append(legendre.legvander(x, PRODUCT - 1) * np.exp(-FALL * np.arange(PRODUCT)))
    raw = bases.place_signature(toy.linear, "track", np.einsum("ri,rj->rij", *sides).reshape(toy.rows, -1))
    ratio = columns[:, 0] / raw[:, 0]
    assert_allclose(columns, ratio[0] * raw, rtol=1e-9)
    for factor in (0.3, 0.6, 1.7, 3.0):
        assert gained(toy, factor * columns) < evidence + 0.2  # of a grid, so nearly the largest


def names_of(posterior, free):
    """A candidate whose amplitudes, in the first slots behind `free` coordinates, have this posterior."""
    slots, k = 4, len(posterior)
    sd = np.ones(free + 2 * slots)
    sd[free : free + k] = np.sqrt(np.diag(posterior))
    active = tuple(f"e{i}" for i in range(k)) + ("",) * (slots - k)
    return Candidate(active, np.zeros(free + 2 * slots), sd, 0.0, np.zeros(slots), np.zeros(slots), True, True, True)


@pytest.mark.parametrize("scale", [1.0, 30.0], ids=["of the prior's size", "far smaller"])
def test_evidence_of_a_name_is_its_marginal_likelihood_less_what_was_searched(toy, scale):
    """Of one effect among a library of twelve. The prior of its amplitude is standard normal, or where the data have
    it far smaller, of the size that they find most likely."""
    over = np.sin(toy.linear.variable("speed_motor") / 120)[:, None]
    column = scale * bases.place_signature(toy.linear, "track", over)
    space = SimpleNamespace(free=4, library=range(12))
    base = dataclasses.replace(names_of(np.eye(0), 4), cost=fit(toy.readings, toy.slopes)[1])
    z, cost, posterior = fit(toy.readings, np.concatenate([toy.slopes, column], 1))
    best = dataclasses.replace(names_of(posterior[4:, 4:], 4), cost=cost, z=np.append(z, np.zeros(7)))
    unit = gained(toy, column) - 2 * math.log(12)
    likeliest = max(gained(toy, s * column) for s in np.geomspace(1e-3, 1.0, 60)) - 2 * math.log(12)
    got = evidence_of_names(space, base, best)
    if scale == 1.0:
        assert got == pytest.approx(unit, rel=1e-6)
    else:
        assert got == pytest.approx(likeliest, abs=0.3) and got > unit + 1.0


def test_cost_of_names_grows_with_the_library_and_their_number():

    def cost(size, posterior):
        return cost_of_names(SimpleNamespace(free=2, library=range(size)), names_of(posterior, 2))

    costs = [[cost(size, 0.01 * np.eye(k)) for k in (1, 2, 3)] for size in (10, 40)]
    assert np.all(np.diff(costs, axis=0) > 0) and np.all(np.diff(costs, axis=1) > 0)
    # an amplitude that the data do not tell costs nothing but its place in the library
    assert cost(10, np.eye(1)) == pytest.approx(2 * math.log(10))


def test_effect_and_curve_pay_for_what_was_searched_in_their_equation(monkeypatch):
    """Of a library of twelve effects three are of the track's equation, of seven curves two."""
    places = ["track"] * 2 + ["gearbox", "motor"] + ["electrical"] * 8
    assert [equation_of_place(p) for p in places[:4]] == [equation_of_place("track")] * 4
    space = SimpleNamespace(free=2, library=library(*places))
    best = names_of(0.01 * np.eye(1), 2)
    best.z[2] = 5.0  # fifty sds
    curves = [(4.0, PlacedCurve("track", ("speed",))), (7.0, PlacedCurve("track", ("slope",)))]
    only = lambda space, linear, bases, crowded, equation: curves if equation == "track" else []  # noqa: E731
    monkeypatch.setattr("calibration.discovery.standing._curve_evidence", only)
    without = dataclasses.replace(best, cost=best.cost + 20.0)
    evidence = evidence_over_curves(SimpleNamespace(space=space, bases=()), best, without, ("e0",), None)
    own = sum(equation_of_place(p) == equation_of_place("track") for p in places)
    of_effect = 2 * 20.0 + 2 * math.log(0.1) - 2 * math.log(own)
    assert evidence == pytest.approx(of_effect - (7.0 - 2 * math.log(2)), rel=1e-12)
    assert equation_of_place("duty") == "electrical"  # an equation without curves would pass by itself


def test_root_is_that_of_what_a_column_explains_beside_others(toy):
    """Against the fall of χ² of least squares with the column and without, and without each row in turn."""
    rng = np.random.default_rng(4)
    readings = len(toy.readings)
    columns, signature = rng.standard_normal((readings, 3)), rng.standard_normal((readings, 1))
    jacobian, residual = augment_with_columns(toy.linear, columns)

    def fall(counts):
        known = np.append(counts, np.ones(len(residual) - readings))[:, None]
        whole = np.concatenate([jacobian, np.pad(signature, ((0, len(residual) - readings), (0, 0)))], 1)
        left = [np.linalg.lstsq(known * a, -known[:, 0] * residual, rcond=None)[0] for a in (jacobian, whole)]
        each = [known[:, 0] * (residual + a @ z) for a, z in zip((jacobian, whole), left, strict=True)]
        return np.sum(each[0] ** 2) - np.sum(each[1] ** 2)

    fit = Projection(jacobian, residual)
    assert fit.roots(signature)[0] ** 2 == pytest.approx(fall(np.ones(readings)), rel=1e-8)
    space, rows = SimpleNamespace(included=toy.counts), np.arange(toy.rows)
    row, least = _most_influential_row(space, fit, signature)
    falls = [fall(np.repeat(rows != k, 3)) for k in rows]
    assert row == 1 + int(np.argmin(falls)) and least**2 == pytest.approx(min(falls), rel=1e-8)


@pytest.mark.parametrize(
    "root, without, evidence, stands, rests_on",
    [
        (6.9, 5.8, 11.6, True, None),
        (10.6, 4.3, 14.1, True, 10),  # it keeps less than 1/√3 of its root without that row
        (4.0, 3.1, 0.0, True, 10),  # and is less than chance then
        (3.2, 3.1, 50.0, False, None),  # less than chance with all, so no row decides
        (8.0, 7.0, -9.5, False, None),  # a curve in its place is the better explanation
    ],
)
def test_name_stands_by_its_score_its_curves_and_its_rows(root, without, evidence, stands, rests_on):
    test = NameTest("a", root, 3.3, (), evidence, 10, without)
    assert (not {"chance", "curve"} & {*test.fails}) == stands
    assert (test.rests_on, test.established) == (rests_on, stands and rests_on is None)
    assert not any(
        dataclasses.replace(test, **bad).established
        for bad in ({"again": 0.75}, {"larger": ("b",)}, {"remains": True}, {"varies": 3.4}, {"offset": 0.04})
    )
    assert dataclasses.replace(test, offset=0.06).established == test.established
    # a form that is known to less than a third of the amplitude costs no name
    assert dataclasses.replace(test, varies=9.0, spread=0.29).established == test.established
    assert dataclasses.replace(test, varies=9.0, spread=0.31).established is False
    # of a library of three effects chance reaches less than in a dozen looks at the amplitude
    assert dataclasses.replace(test, varies=3.4, by_chance=3.5).established == test.established
    of_log = dataclasses.replace(test, root_without=math.inf, changed="motor.inertia", root_changed=6.9)
    assert of_log.rests_on == (10 if root <= 6.9 else None)
    assert dataclasses.replace(of_log, root_changed=3.2).rests_on is None
    renumbered = NameSupport(True, tests=(test,)).with_row_numbers(np.arange(1, 21) * 2)
    assert renumbered.test_of("a").rests_on == (None if rests_on is None else 20) and renumbered.test_of("b") is None


def test_amplitude_that_changes_with_a_variable_is_seen_and_one_that_does_not_is_none():
    """A drop along the current, against one that grows half as fast again towards the largest slope."""
    rng, rows = np.random.default_rng(3), 60
    x, current = np.linspace(-1.0, 1.0, rows), rng.uniform(1.0, 3.0, rows)
    column = (20.0 * current[:, None] * [1.0, -0.5]).ravel()
    variables = {"slope": x, "current": current}
    linear = SimpleNamespace(
        readings=2 * rows, rows=rows, at_points=lambda counts: counts,
        curve_variable=lambda place, name: (variables.get(name, np.ones(rows)), np.ones(rows)),
    )  # fmt: skip
    space = SimpleNamespace(
        free=0,
        included=np.ones(rows, bool),
        bare=SimpleNamespace(observe=SimpleNamespace(long=False, reads=True, over_time=False)),
    )
    linear.jacobian = np.concatenate([column[:, None], np.eye(1)])
    noise = rng.standard_normal(2 * rows)
    sized = dataclasses.replace(candidate_of("a"), z=np.ones(12))
    for share, seen in ((0.0, False), (0.5, True)):
        linear.residual = np.append(noise + column * share * np.repeat(x, 2), 0.0)
        varies, over, by_chance, spread = _largest_variation(space, sized, "a", linear, 0.03)
        assert not seen or spread == pytest.approx(0.5, abs=0.05)  # of an amplitude of 1
        assert (varies > by_chance) == seen and (not seen or over == "slope")
        assert by_chance == pytest.approx(2.67, abs=0.01)  # two variables, along a line or bent: 0.03 / 4, both sides
        # along a straight line, by least squares with the column and without
        line = np.append(column * np.repeat(x, 2), 0.0)[:, None]
        left = [
            np.sum((linear.residual - a @ np.linalg.lstsq(a, linear.residual, rcond=None)[0]) ** 2)
            for a in (linear.jacobian, np.concatenate([linear.jacobian, line], 1))
        ]
        assert not seen or varies**2 == pytest.approx(left[0] - left[1], rel=1e-8)
    space.bare.observe.long = space.bare.observe.over_time = True  # a history's readings answer to all of its past
    assert _largest_variation(space, candidate_of("a"), "a", linear, 0.03) == (0.0, "", math.inf, math.inf)


@pytest.mark.parametrize("single, lacks", [(3.4, {"slip"}), (5.0, {"slip", "track"})])
def test_what_is_left_lies_where_its_curve_and_where_its_strongest_effect_would(monkeypatch, single, lacks):
    monkeypatch.setattr(
        "calibration.discovery.standing.locate_discrepancy", lambda *a: SimpleNamespace(place="speed")
    )

    space = SimpleNamespace(included=None, library=library("ground", "motor"))
    test = SimpleNamespace(rejected_with_margin=True, exceeds_margin=lambda kind: single > 3.7)
    seen = SimpleNamespace(test=test, scores=SimpleNamespace(single=np.array([1.0, -single])))
    assert _deficient_equations(space, seen, ()) == lacks
    test.rejected_with_margin = False
    assert _deficient_equations(space, seen, ()) == set()


def test_effect_has_to_be_the_strongest_again_without_blocks_that_leave_half_of_it(toy):
    """`a` is in two thirds of the rows, `b` in the last four: without a third of the rows of `a` it is still chosen.
    Where only `b` is left, `a` is not asked."""
    readings, rows = len(toy.readings), np.arange(toy.rows)
    at = np.repeat(rows, 3)
    a, b = (np.where(mine, 1.0, 0.0)[:, None] for mine in (at < 12, at >= 16))
    random = np.random.default_rng(2)
    jacobian = np.concatenate([random.standard_normal((readings, 2)), np.eye(2)])
    residual = np.append(2.0 * a[:, 0] + 2.5 * b[:, 0], np.zeros(2))

    space = SimpleNamespace(included=np.ones(toy.rows, bool), library=library(a="drop", b="slip"))
    both = np.concatenate([a, b], 1)
    few, most, others = rows < 4, rows < 11, rows >= 16
    settings, family = SETTLED.settings, ("drop",)

    def recurs(residual, signatures, *blocks, settings=settings):
        fit, linear = Projection(jacobian, residual), SimpleNamespace(signatures=signatures)
        return _recurrence(space, family, fit, a, linear, blocks, settings)

    again = functools.partial(recurs, residual, both)
    assert again(few, others) == 1.0 and again(most) == 1.0 and again() == 1.0
    b3 = np.append(2.0 * a[:, 0] * (at < 4) + 2.5 * b[:, 0], np.zeros(2))  # only the first rows show it
    assert recurs(b3, both, few, others) == 0.5
    # What data cannot tell from it, of whatever family, does not take its place.
    near = a * (1 + 0.05 * random.standard_normal(a.shape))
    of_near = np.append(2.0 * near[:, 0], np.zeros(2))  # which is the stronger of the two
    assert recurs(of_near, np.concatenate([a, near], 1), few) == 1.0
    none = dataclasses.replace(settings, same=0.0, form=0.0)
    assert recurs(of_near, np.concatenate([a, near], 1), few, settings=none) == 0.0


def candidate_of(*effects):
    return Candidate(
        fill_slots(effects, SETTLED.settings), np.zeros(12), np.ones(12), 0.0, *[np.zeros(4)] * 2, True, True, True
    )


@pytest.mark.parametrize(
    "adequate, established, predicts, model",
    [
        (True, ("a", "b"), None, ("a", "b")),  # all stand: nothing is asked of data held out
        (True, ("a",), None, ("a",)),  # the other neither stands nor predicts
        (True, ("a",), ("a", "b"), ("a", "b")),  # or predicts, and is tentative
        (True, (), ("b",), ("b",)),
        (True, (), None, None),
        (False, ("a",), ("a", "c"), ("a", "c")),
        (False, (), ("a",), ("a",)),
        (False, (), ("a", "x"), ("a",)),  # what only stands in for a curve is left to it
        (False, (), ("x",), None),
        (False, (), None, None),
    ],
)
def test_model_holds_what_is_established_and_what_predicts(monkeypatch, adequate, established, predicts, model):
    best, few = candidate_of("a", "b"), None if predicts is None else candidate_of(*predicts)
    seen = SimpleNamespace(test=SimpleNamespace(rejected_with_margin=not adequate, null=None))
    asked = []

    def judged(beside, searched, proposed=None, blocks=()):
        those = best if proposed is None else proposed[0]
        asked.append(those.effects)
        evidence = {"x": -20.0}
        tests = [NameTest(e, 9.0 if e in established else 1.0, 3.0, (), evidence.get(e, 0.0)) for e in those.effects]
        return NameSupport(bool(established), "beside", tests=tuple(tests))

    monkeypatch.setattr(stages, "judge_names", judged)
    monkeypatch.setattr(stages.prediction, "smallest_predictive_set", lambda *a: few)
    monkeypatch.setattr(stages.search, "diagnose_candidate", lambda *a: seen)
    monkeypatch.setattr(stages.candidates, "start_of_fit", lambda *a: None)
    monkeypatch.setattr(
        stages.candidates,
        "fit_candidates",
        lambda space, wanted: [candidate_of(*(n for n in w if n)) for w, _ in wanted],
    )
    monkeypatch.setattr(stages.blocks_room, "predictable_blocks", lambda *a: {"slope": {"0": np.ones(3, bool)}})
    bare = SimpleNamespace(observe=SimpleNamespace(long=False, reads=True, over_time=False, blocks=("slope",)))
    left = SimpleNamespace(test=SimpleNamespace(settings=SETTLED.settings), scores=None)
    beside = BaseCurve(SimpleNamespace(bare=bare), candidate_of(), left, ())
    searched = SearchResult((candidate_of("a"), candidate_of("b"), best), best, seen)
    given = SimpleNamespace(runs=None, settings=SETTLED.settings, progress=lambda note: None)
    found, _, stood = stages.choose_effects(given, searched, beside, {})
    assert (None if found is None else tuple(sorted(found[0].effects))) == model
    assert asked == [best.effects if adequate or few is None else few.effects]
    if found is not None:
        assert {e for e in found[0].effects if stood.established(e)} == set(established)


# --- settled runs ---------------------------------------------------------------------------------------

#: V_s of both configurations grows with speed, twofold at 0.4 m/s: creep (Fig. 7) times the speed.
V_S = settled.CLIMBING["6T2A.ground.friction.speed_static"]
GROWING = laws.Law(
    "", "slip", lambda s, q: 2 * V_S * np.sin(np.arcsin(np.clip(s.D / s.D_max, -1, 1)) / 3) * s.V, 1.0
)  # fmt: skip


def growing(monkeypatch, sigmas, seed):
    """A table of a robot whose sliding speed V_s grows with its speed."""
    for forms in (laws.FORMS, laws.OUTSIDE):
        monkeypatch.setitem(forms, "sliding_speed_grows", GROWING)
    return table(tables.narrow(["sliding_speed_grows"], sigmas, seed))


@pytest.mark.slow
def test_sliding_speed_that_grows_gets_no_name(monkeypatch):
    for sigmas, seed in ((12.0, 1), (30.0, 2)):
        found = SETTLED.trace(growing(monkeypatch, sigmas, seed))
        assert found.verdict in WITHOUT_NAME and found.members == () and not found.standing.stands
        # A mechanism lists equations too that these data cannot separate from slip, after it.
        assert found.where.balance == "slip" and found.where.family == "slip that changes with speed"
        assert found.families[0] == found.where.family


@pytest.mark.slow
@pytest.mark.parametrize(
    "pair", [("rolling_radius", "load_slip"), ("series_resistance", "brush_drop"), ("churning", "stribeck_track")]
)
def test_true_pairs_of_one_balance_keep_their_names(pair):
    """Each at its ordinary strength, and the fit with both adequate."""
    found = SETTLED.trace(table(tables.narrow(pair, 15.0, 1)))
    assert found.verdict in ("named", "class") and found.standing.stands and len(found.members) == 2
    assert all(any(name in members for members in found.members) for name in pair)
    assert not found.ends.test.rejected_with_margin


# --- histories ------------------------------------------------------------------------------------------


def test_small_offset_of_an_instrument_without_a_stated_noise_is_not_established():
    """31 mA on readings of 1 A, as of an ammeter whose noise was taken for a share of each reading."""
    current = np.array([0.5, 1.2, np.nan, 1.1])
    data = SimpleNamespace(measured=np.stack([current, 100 * current], 1))
    bare = SimpleNamespace(data=data, channels=[SimpleNamespace(name=n) for n in ("total_current", "motor_speed")])
    library = {name: BY_NAME[f"ammeter_{name}"]() for name in ("offset", "gain")}
    space = SimpleNamespace(library=library, bare=bare, included=np.ones(4, bool))
    best = SimpleNamespace(active=("offset", "gain"), amplitude=np.array([0.31, 0.5]))
    stated = settings_for(SettledRuns)
    silent = dataclasses.replace(stated, silent=("total_current",))
    share = standing._relative_zero_error(space, best, "offset", silent)
    assert share == pytest.approx(0.031 / np.sqrt(np.nanmean(current**2)))
    assert not NameTest("offset", 9.0, 3.0, (), 0.0, offset=share).established
    assert standing._relative_zero_error(space, best, "offset", stated) == math.inf
    assert standing._relative_zero_error(space, best, "gain", silent) == math.inf
