"""A mechanism stands by what it explains, predicts and is found again by, whatever its exact law."""

import dataclasses
import functools
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.stats import t

from calibration.discovery import candidates
from calibration.discovery import gains as gains_room
from calibration.discovery import mechanism as room
from calibration.discovery.candidates import Candidate
from calibration.discovery.classes import errors_of_ammeters
from calibration.discovery.location import DiscrepancyLocation
from calibration.discovery.loop_notes import Mechanism
from calibration.discovery.prediction import Gain, HeldOutScore
from calibration.discovery.settings import settings_for
from calibration.inference.observers import SettledRuns
from mmrjax.model.channels import channels_named

ROWS, BASE = 30, 1000.0
FAMILIES = {
    "stribeck": "loss torque that changes with speed", "churning": "loss torque that changes with speed",
    "leads": "voltage drop that changes with current", "creep": "slip that changes with demand",
}  # fmt: skip
SPEED = DiscrepancyLocation("track", "speed_motor", ("track", "gearbox", "motor"), (), 0.0, 0.0)


def test_a_mechanism_needs_each_of_its_tests():
    stands = Mechanism(("a",), (), share=0.5, gain=0.21, se=0.1, again=0.8)
    assert stands.fails == ()
    worse = {
        "share": {"share": 0.49},
        "gain": {"gain": 0.2},
        "again": {"again": 0.79},
        "many": {"families": tuple(f"loss torque that changes with {x}" for x in "abcd")},
        "run": {"run": 2},
    }
    assert {name: dataclasses.replace(stands, **change).fails for name, change in worse.items()} == {
        name: (name,) for name in worse
    }
    assert dataclasses.replace(stands, se=np.inf).fails == ("gain",)  # nothing could be held out
    places = "loss torque", "resistance to travel", "mass", "reading of total current", "reading of motor voltage"
    families = tuple(f"{x} that changes with slope" for x in places)
    space = SimpleNamespace(bare=SimpleNamespace(channels=channels_named(["total_current", "motor_speed"])))
    ammeter = errors_of_ammeters(space, families)
    assert ammeter == families[3:4] and errors_of_ammeters(space, families[3:]) == ()
    everywhere = dataclasses.replace(stands, families=families, ammeter=ammeter)
    assert everywhere.fails == ("many",)  # as of a table in which nothing was missing
    assert dataclasses.replace(everywhere, families=families[:-1]).fails == ()  # an ammeter as a loss


def fitted(*effects, explains, plausible=True):
    """A candidate that lowers χ² by so much."""
    nothing = np.zeros(len(effects))
    return Candidate(effects, nothing, nothing, BASE - explains / 2, nothing, nothing, plausible, plausible, True)


@pytest.fixture
def found(monkeypatch):
    """What `mechanism` finds of such candidates and of a curve over a speed that explains so much."""
    library = {n: SimpleNamespace(family=lambda f=f: f) for n, f in FAMILIES.items()}
    space = SimpleNamespace(
        weight=np.ones((ROWS, 1)), library=library, included=np.ones(ROWS, bool),
        bare=SimpleNamespace(channels=(), observe=SimpleNamespace(long=False, reads=True, over_time=False, blocks=("speed",), noise_misfit=lambda off, counts: counts.sum())),
    )  # fmt: skip
    score = HeldOutScore({}, {})
    monkeypatch.setattr(room.blocks_room, "predictable_blocks", lambda *_: {})
    monkeypatch.setattr(gains_room, "cached_hold_out_score", lambda *_: score)
    monkeypatch.setattr(gains_room.prediction, "score_predictions", lambda *_: score)
    monkeypatch.setattr(gains_room, "simulated_reading", lambda *_: None)
    monkeypatch.setattr(gains_room, "_changed_readings", lambda *_: None)
    monkeypatch.setattr(room, "_curves_without_blocks", lambda *_: ((), None))
    monkeypatch.setattr(room, "_curve_recurrence", lambda *_: 0.9)
    monkeypatch.setattr(room, "_with_ammeter_families", lambda beside, found: found)
    monkeypatch.setattr(gains_room, "linear_gain_of_curve", lambda *_: Gain(1.0, 0.1))
    differs = [(None, "", 0.0)]
    monkeypatch.setattr(room.standing, "changed_run", lambda *_: differs[0])
    left = SimpleNamespace(linear=SimpleNamespace(jacobian=0.0, residual=0.0))
    monkeypatch.setattr(room.standing, "evidence_over_curves", lambda *_: 0.0)
    monkeypatch.setattr(room.standing, "recurrence_of_families", lambda *_: 1.0)

    def of(*ladder, curve, where=SPEED, long=False, reads=True, run=(None, "", 0.0)):
        space.bare.observe.long = space.bare.observe.over_time = long
        space.bare.observe.reads, differs[0] = reads, run
        drawn = SimpleNamespace(chi2=(2 * BASE, 2 * BASE - curve), problem=None, z=None, reading=None)
        beside = SimpleNamespace(
            where=where, fitted=drawn, space=space, base=fitted(explains=0.0), left=left, bases=(),
            settings=settings_for(SettledRuns),
        )  # fmt: skip
        return room.find_mechanism(beside, None, ladder, {})

    return of


def test_it_is_that_of_the_family_that_explains_most(found):
    stribeck, leads = fitted("stribeck", explains=1800.0), fitted("leads", explains=900.0)
    got = found(leads, stribeck, curve=1900.0)
    assert got.families == (FAMILIES["stribeck"],) and got.effects == ("stribeck",)
    assert got.share == pytest.approx((1900 - room.OF_CURVE) / (2 * BASE - ROWS))  # its curve explains more of it
    assert got.again == 1.0


def test_two_laws_of_one_mechanism_are_one(found):
    both, one = fitted("stribeck", "churning", explains=1900.0), fitted("stribeck", explains=1500.0)
    # (that of one effect predicts as well, so that the one that explains more is taken)
    twice = fitted("stribeck", "stribeck", explains=1940.0)  # which is no law of the library
    got = found(one, both, twice, fitted("stribeck", "leads", explains=1950.0), curve=1000.0)
    assert got.families == (FAMILIES["stribeck"],) and set(got.effects) == {"stribeck", "churning"}


def test_share_of_the_excess_is_no_more_than_all_where_noise_is_stated_too_large():
    bare = SimpleNamespace(observe=SimpleNamespace(noise_misfit=lambda off, counts: counts.sum()))
    space, base = SimpleNamespace(weight=np.ones((ROWS, 1)), bare=bare), fitted(explains=0.0)
    assert candidates.share_of_excess(candidates.excess_misfit(space, base), 985.0) == pytest.approx(0.5)
    assert (
        candidates.share_of_excess(candidates.excess_misfit(space, dataclasses.replace(base, cost=ROWS / 2)), 20.0)
        == 1.0
    )


def test_mechanisms_that_explain_as_much_are_both_listed(found):
    got = found(fitted("stribeck", explains=1800.0), fitted("creep", explains=1740.0), curve=0.0)
    assert got.families == (FAMILIES["stribeck"], FAMILIES["creep"])
    got = found(fitted("stribeck", explains=1800.0), fitted("creep", explains=1700.0), curve=0.0)
    assert got.families == (FAMILIES["stribeck"],)


def test_a_curve_that_explains_more_takes_the_place_of_effects_of_another_mechanism(found):
    """As those of the library imitate a law that it lacks."""
    got = found(fitted("leads", explains=1500.0), curve=1900.0)
    assert got.families == (SPEED.family,) and got.effects == () and got.again == 0.9
    got = found(fitted("leads", explains=1500.0), fitted("stribeck", explains=1400.0), curve=1900.0)
    assert got.families == (SPEED.family,) and got.effects == ("stribeck",)  # which has the curve's mechanism
    assert found(fitted("stribeck", explains=900.0), curve=1900.0).effects == ()
    assert found(fitted("leads", explains=1880.0), curve=1900.0).effects == ("leads",)
    large = fitted("stribeck", explains=1900.0, plausible=False)
    assert found(large, curve=1900.0).effects == ("stribeck",)  # a mechanism claims no size
    assert found(dataclasses.replace(large, supplying=("stribeck",)), curve=1900.0).effects == ()
    where = dataclasses.replace(SPEED, explained=1900.0)  # histories: by what it explains linearly
    of_log = functools.partial(found, curve=np.nan, where=where, long=True)
    leads, stribeck = fitted("leads", explains=1500.0), fitted("stribeck", explains=1500.0)
    assert of_log(leads).families == (SPEED.family,) and of_log(leads).fails == ()
    assert of_log(leads, reads=False) is None  # no simulation confirms a curve of windows
    assert of_log(stribeck, reads=False).effects == ("stribeck",)
    assert of_log(stribeck).families == (SPEED.family,) and of_log(stribeck).effects == ()  # only the curve predicts
    # a constant that differs in one run explains more
    assert of_log(leads, run=(2, "motor.inertia", 44.0)).fails == ("run",)
    assert of_log(leads, run=(2, "motor.inertia", 43.0)).fails == ()


def test_an_effect_that_a_curve_refutes_is_listed_with_the_drivers_of_curves(found, monkeypatch):
    """As a saturated duty that imitates a bump of a loss torque over the speed."""
    effect = fitted("leads", explains=1880.0)
    assert found(effect, curve=1700.0).families == (FAMILIES["leads"],)
    monkeypatch.setattr(room.standing, "evidence_over_curves", lambda *_: -room.BETTER - 1)
    refuted = found(effect, curve=1700.0)
    assert refuted.families == (FAMILIES["leads"], SPEED.family) and refuted.effects == ("leads",)


def test_what_it_explains_next_to_others_counts(found):
    """As on the paper's runs, whose slip hides half of what the leads explain."""
    leads, creep = fitted("leads", explains=800.0), fitted("creep", explains=500.0)
    alone = found(leads, creep, curve=0.0)
    assert alone.share == pytest.approx(800 / (2 * BASE - ROWS)) and alone.fails[0] == "share"
    joint = fitted("leads", "creep", explains=1700.0)
    both = found(leads, creep, fitted("creep", "stribeck", explains=1000.0), joint, curve=0.0)
    assert both.families == (FAMILIES["leads"],) and both.share == pytest.approx(1200 / (2 * BASE - ROWS))


def test_of_mechanisms_that_cannot_be_told_apart_one_that_predicts_is_stated(found, monkeypatch):
    """A curve has more to fit with, and may predict nothing."""
    where = dataclasses.replace(SPEED, place="electrical", alike=("electrical",), variables_alike=("current",))
    gains = iter([-1.0, 1.0])
    monkeypatch.setattr(gains_room, "_gain_over_changed", lambda *_: Gain(next(gains), 0.1))
    got = found(fitted("leads", explains=1500.0), curve=1900.0, where=where)
    assert got.families == (where.family, FAMILIES["leads"]) and got.effects == () and got.gain == 1.0
    # that other curves are as improbable does not count against an effect
    many = dataclasses.replace(where, variables_alike=("current", "voltage", "slope", "payload"))
    gains = iter([1.0])
    got = found(fitted("leads", explains=1500.0), curve=1900.0, where=many)
    assert got.families == (FAMILIES["leads"], where.family) and got.fails == ()
    gains = iter([1.0])
    got = found(fitted("leads", explains=1500.0), curve=1900.0, where=where)
    assert got.families == (FAMILIES["leads"], where.family) and got.effects == ("leads",)


def test_readings_that_it_changes_are_those_it_moves_by_half_of_the_most_moved_channel():
    sd = np.tile([0.1, 10.0], (ROWS, 1))
    space = SimpleNamespace(bare=SimpleNamespace(data=SimpleNamespace(sd=sd)), weight=np.ones((ROWS, 2)))
    before = np.zeros((ROWS, 2))
    after = np.stack([np.where(np.arange(ROWS) < 20, 1.0, 0.2), np.full(ROWS, 5.0)], 1)
    changed = gains_room._changed_readings(space, np.zeros(ROWS), before, after)
    assert changed[:, 0].tolist() == [True] * 20 + [False] * 10 and not changed[:, 1].any()


def test_the_error_of_a_gain_is_the_mean_of_its_kinds():
    """Kinds leave out the same readings: two of them are no more sure than one."""
    rows = np.repeat(np.arange(6), 2)
    gains = np.random.default_rng(0).normal(1.0, 1.0, (12, 1))
    blocks = {"slope": rows, "voltage": np.tile(np.arange(3), 4)}
    after = HeldOutScore({k: gains for k in blocks}, blocks)
    before = HeldOutScore({k: np.zeros((12, 1)) for k in blocks}, blocks)
    changed = np.ones((12, 1), bool)
    gain = gains_room._gain_over_changed(after, before, changed)
    assert gain.mean == pytest.approx(gains.mean())
    assert gain.se == pytest.approx(np.mean(list(gain.errors.values()))) and set(gain.errors) == set(blocks)
    assert gains_room._gain_over_changed(HeldOutScore({}, {}), HeldOutScore({}, {}), changed).se == np.inf


def test_equations_that_act_alike_are_listed(found):
    """A drag of the payload on the ground loads the motors as one on the tracks does."""
    where = dataclasses.replace(SPEED, alike=("track", "gearbox", "motor", "ground"))
    got = found(fitted("stribeck", explains=1800.0), curve=1000.0, where=where)
    assert got.families == (FAMILIES["stribeck"], "resistance to travel that changes with speed")
    assert got.drivers == ("changes with speed",) and "many" not in got.fails


def test_a_curve_is_asked_within_the_range_that_its_fit_has_seen():
    speed = np.array([1.0, 2.0, 3.0, 4.0, 2.5, 5.0])
    linear = SimpleNamespace(curve_variable=lambda place, variable: (speed, 1.0))
    space = SimpleNamespace(included=np.ones(6, bool))
    beside = SimpleNamespace(where=SPEED, left=SimpleNamespace(linear=linear), space=space)
    masks = [np.isin(np.arange(6), rows) for rows in ((0, 4), (1, 2), (3, 5))]
    np.testing.assert_array_equal(gains_room._rows_in_range(beside, masks), [False, True, True, False, True, False])


def test_the_linear_gain_of_a_curve_is_that_of_least_squares_without_each_block(monkeypatch):
    rng = np.random.default_rng(7)
    rows, free = 40, 3
    columns, jacobian = rng.standard_normal((rows, 2)), rng.standard_normal((rows, free))
    jacobian = np.concatenate([jacobian, np.eye(free)])
    residual = np.append(2.0 * columns[:, 0] + 0.3 * rng.standard_normal(rows), np.zeros(free))
    points = lambda *_: (np.ones(rows), np.ones(rows))  # noqa: E731
    linear = SimpleNamespace(jacobian=jacobian, residual=residual, readings=rows, curve_variable=points)
    seen = []

    def curve_of(linear, place, variable, included):
        seen.append(included)
        return SimpleNamespace(scale=2.0, root=np.eye(2), basis=lambda x: columns / 2)

    monkeypatch.setattr(gains_room, "fit_smooth_curve", curve_of)
    monkeypatch.setattr(gains_room, "place_signature", lambda linear, place, shapes: shapes)
    monkeypatch.setattr(gains_room, "location_columns", lambda *_: columns)
    kinds = {"run": {name: np.arange(rows) // 10 == k for k, name in enumerate("abcd")}}
    monkeypatch.setattr(room.blocks_room, "predictable_blocks", lambda *_: kinds)
    monkeypatch.setattr(room.blocks_room, "parts_of_runs", lambda _: {"half": np.arange(rows) % 4 < 2})
    data = SimpleNamespace(sd=np.full((rows, 1), 0.5))
    space = SimpleNamespace(weight=np.ones((rows, 1)), included=np.ones(rows, bool), bare=SimpleNamespace(data=data))
    beside = SimpleNamespace(left=SimpleNamespace(linear=linear), where=SPEED, bases=(), space=space)
    got = gains_room.linear_gain_of_curve(beside, range(rows), {})

    def errors(design, out):
        kept = np.append(~out, np.ones(len(design) - rows, bool))
        e = np.append(residual, np.zeros(len(design) - len(residual)))
        return (e + design @ np.linalg.lstsq(design[kept], -e[kept], rcond=None)[0])[:rows]

    wide = np.block([[jacobian, np.append(columns, np.zeros((free, 2)), 0)], [np.zeros((2, free)), np.eye(2)]])
    density = [
        sum(np.where(out, t.logpdf(errors(x, out), 4), 0.0) for out in kinds["run"].values())
        for x in (wide, jacobian)
    ]
    none = np.zeros(rows, bool)
    change = np.abs(errors(wide, none) - errors(jacobian, none))
    counts = change >= gains_room.CHANGED * np.sqrt(np.mean(change**2))
    assert 4 < counts.sum() < rows and got.mean == pytest.approx((density[0] - density[1])[counts].mean(), rel=1e-9)
    assert got.mean > 5 * got.se > 0
    assert all(any((included == ~out).all() for included in seen) for out in kinds["run"].values())
    wave = SimpleNamespace(
        **vars(beside) | {"where": dataclasses.replace(SPEED, variable="order 2 of the driving shaft")}
    )
    assert list(gains_room.linear_gain_of_curve(wave, range(rows), {}).errors) == ["part"]
