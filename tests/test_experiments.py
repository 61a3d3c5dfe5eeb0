"""The next experiment: what the menu foresees, which experiment is chosen, and what its readings say."""

import dataclasses

import equinox as eqx
import generator as g
import jax.numpy as jnp
import numpy as np
import pytest
from synthetic import SETTLED, table
from test_generator import SHAPES

from calibration.discovery import experiments, menu
from calibration.discovery.candidates import Candidate, filled, fit_candidates
from calibration.discovery.classes import Classes
from calibration.discovery.discrepancy import Location
from mmrjax import params, robots
from mmrjax.effects import BY_NAME
from mmrjax.tables import CONFIGURATIONS

PAIRS = {
    ("series_resistance", "supply_sag"): {"one motor, 6T2A", "one motor, 4W2T", "stall, one motor"},
    ("ammeter_offset", "brush_drop"): {"zero current", "shunt"},
    ("rolling_radius", "speed_gain"): {"timing"},
    ("mass_error", "tension_friction"): {"weigh"},
}
MENU = menu.menu(CONFIGURATIONS)
SPANS = menu.spans(MENU)
SETTINGS = SETTLED.settings


# --- what the menu foresees -------------------------------------------------------------------------


@pytest.fixture(scope="module")
def shown():
    """Readings of the whole menu, and which exist, for constants and a term of the generator."""
    base = params.replace(robots.nominal(), g.CLIMBING)
    full = dataclasses.replace(base, effects=tuple(BY_NAME[name]() for name in g.LIBRARY))
    read = eqx.filter_jit(menu.readings)

    def of(p, term=None):
        values = dict(p)
        if term is not None:
            values[f"effects.{term.name}.amplitude"] = term.amplitude
            values |= {f"effects.{term.name}.{SHAPES[k]}": v for k, v in term.shapes.items()}
        robot = params.replace(full, {k: jnp.asarray(np.float64(v)) for k, v in values.items()})
        return [np.asarray(x) for x in read(robot)]

    return of


@pytest.mark.parametrize("name", [None, *g.LIBRARY])
def test_menu_agrees_with_the_generators_own_physics(name, shown):
    p, term = g.perturbed(np.random.default_rng(5), scale=0.5), None
    if name is not None:
        term = g.draw(name, np.random.default_rng(1))
        term = dataclasses.replace(term, amplitude=term.amplitude * term.form.size)
    value, there = shown(p, term)
    for experiment_name, at in SPANS.items():
        theirs, sound = g.carried_out(experiment_name, p, [] if term is None else [term])
        np.testing.assert_array_equal(there[at], sound, err_msg=experiment_name)
        np.testing.assert_allclose(value[at][sound], theirs[sound], rtol=1e-6, atol=1e-9, err_msg=experiment_name)


def test_agreement_can_fail(shown):
    value, _ = shown(g.CLIMBING)
    theirs, _ = g.carried_out("bare motor", g.CLIMBING | {"motor.resistance": 0.6117})
    with pytest.raises(AssertionError):
        np.testing.assert_allclose(value[SPANS["bare motor"]], theirs, rtol=1e-6)


def test_menu_and_generator_hold_the_same_experiments():
    ran = [f"{n}, {c}" for n, r in g.RUNS.items() for c in ("6T2A", "4W2T") if r[1]]
    alone = [n for n, r in g.RUNS.items() if not r[1]]
    assert {e.name for e in MENU} == {*g.ACTS, *ran, *alone}
    case = g.Case({}, {}, g.conditions(0, 1, 0, 0), g.CLIMBING, (), g.Instruments())
    sd = menu.sds(MENU, case.instruments.stated * [1.0, np.pi / 30, 1e-3])
    for name, at in SPANS.items():
        np.testing.assert_allclose(case.carry_out(name, 0)["sd"], sd[at], err_msg=name)


def test_reverse_travel_turns_the_sign_of_a_biased_slope_alone(shown):
    at = SPANS
    plain, biased = (shown(g.CLIMBING, g.Term("slope_bias", a))[0] for a in (0.0, 0.02))
    change = biased - plain
    assert change[at["reverse, 6T2A"]][0] < 0 < change[at["downhill, 6T2A"]][0]  # of the current


# --- the choice -------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def seen():
    """For each pair: a synthetic case of its first, and what both foresee once fitted to its table."""
    answers = {}
    for pair in PAIRS:
        case = g.case([pair[0]], 12.0, seed=3)
        space = SETTLED.space(table(case))
        start = np.zeros(len(space.coordinates))
        fitted = fit_candidates(space, [(filled([name], SETTINGS), start) for name in pair], SETTINGS)
        answers[pair] = case, space, dict(zip(pair, fitted, strict=True))
    return {p: (c, space, f, experiments.prospect(space, f, SETTINGS)) for p, (c, space, f) in answers.items()}


@pytest.mark.slow
@pytest.mark.parametrize("pair", PAIRS)
def test_proposal_is_what_an_engineer_would_do(pair, seen):
    proposal = experiments.choose(seen[pair][3])
    assert proposal.name in PAIRS[pair]
    assert proposal.settles and proposal.separates == (pair[1],) and proposal.expected_sigma > 3
    assert len(proposal.table) == len(MENU) and proposal.table[0].experiments == proposal.experiments


@pytest.mark.slow
@pytest.mark.parametrize("pair", PAIRS)
def test_proposal_carried_out_resolves_the_class(pair, seen):
    case, _, _, foreseen = seen[pair]
    name = experiments.choose(foreseen).name
    verdicts = [experiments.supported(foreseen, {name: case.carry_out(name, seed)}) for seed in range(10)]
    assert sum(v.resolved and v.best == pair[0] for v in verdicts) >= 8
    assert all(pair[0] in v.left for v in verdicts)


def foreseeing(sigma):
    """A prospect in which each experiment of the menu shows alternative k `sigma[name][k]` sds off, without doubt."""
    readings = SPANS[MENU[-1].name].stop
    members = len(next(iter(sigma.values())))
    value = np.zeros((members, readings))
    for name, at in sigma.items():
        value[:, SPANS[name].start] = at
    names = tuple("abcdefgh"[:members])
    half = np.zeros((members, readings, 1))
    return experiments.Prospect(names, MENU, value, half, np.ones(readings), np.ones(readings, bool), SETTINGS)


def test_less_effort_is_preferred_where_more_sigmas_are_no_gain():
    assert experiments.choose(foreseeing({"weigh": [0, 6.0], "stall": [0, 40.0]})).experiments == ("weigh",)
    assert experiments.choose(foreseeing({"weigh": [0, 3.0], "stall": [0, 40.0]})).experiments == ("stall",)


def test_chance_is_the_share_of_draws_in_which_the_false_one_is_refuted():
    seen = foreseeing({"stall": [0, 2.5]})
    at, rng = SPANS["stall"], np.random.default_rng(0)
    refuted = [
        "b"
        in experiments.supported(
            seen, {"stall": {"value": rng.standard_normal(at.stop - at.start), "sd": np.ones(2)}}
        ).refuted
        for _ in range(4000)
    ]
    one = next(r for r in experiments.ranked(seen) if r.experiments == ("stall",))
    assert np.mean(refuted) == pytest.approx(one.chances[0], abs=0.025)  # three sds of the draws


def test_every_two_alternatives_count_not_only_those_with_the_best_fit():
    # `shunt`, the lesser effort, tells both others from the best fit but not from one another; `stall` all three
    proposal = experiments.choose(foreseeing({"shunt": [0, 9.0, 9.0], "stall": [0, 6.0, 12.0]}))
    assert proposal.experiments == ("stall",) and proposal.settles


def test_less_effort_is_preferred_also_beside_a_pair_that_nothing_tells():
    assert experiments.choose(foreseeing({"weigh": [0, 6.0, 6.0], "stall": [0, 40.0, 40.0]})).experiments == (
        "weigh",
    )


def test_one_pair_of_many_alternatives_counts():
    far = [9.0 * k for k in range(1, 6)]
    proposal = experiments.choose(
        foreseeing({"weigh": [0, 0.0, *far], "stall": [0, *(9.0 * k for k in range(1, 7))]})
    )
    assert proposal.experiments == ("stall",) and proposal.settles


def test_pair_that_one_experiment_tells_is_worth_more_than_three_that_none_does():
    # three pairs 1.9 sigma apart at most by `stall`; `weigh` tells one of them by 3
    proposal = experiments.choose(foreseeing({"stall": [0, 1.9, 0.95], "weigh": [0, 1.5, 3.0]}))
    assert "weigh" in proposal.experiments and proposal.expected_sigma >= 2.0


def test_two_weak_experiments_are_proposed_together():
    proposal = experiments.choose(foreseeing({"stall": [0, 1.9], "weigh": [0, 1.9]}))
    assert set(proposal.experiments) == {"stall", "weigh"} and proposal.expected_sigma == pytest.approx(1.9 * 2**0.5)


def test_a_second_experiment_is_proposed_where_one_leaves_two_together():
    proposal = experiments.choose(
        foreseeing({"stall": [0, 9.0, 9.0], "weigh": [0, 0.0, 7.0], "timing": [0, 0.0, 1.0]})
    )
    assert set(proposal.experiments) == {"stall", "weigh"} and proposal.settles
    assert proposal.expected_sigma == pytest.approx(7.0) and proposal.separates == ("b", "c")
    assert "scales" in proposal.description and "vice" in proposal.description and proposal.name.count(" and ") == 1


def test_a_second_experiment_that_adds_nothing_is_not():
    proposal = experiments.choose(foreseeing({"stall": [0, 9.0, 9.0], "weigh": [0, 0.0, 0.5]}))
    assert (
        proposal.experiments == ("stall",) and not proposal.settles and proposal.expected_sigma == pytest.approx(9.0)
    )


@pytest.mark.slow
def test_alternatives_that_agree_give_none(seen):
    _, space, fitted, _ = seen["series_resistance", "supply_sag"]
    same = next(iter(fitted.values()))
    proposal = experiments.choose(experiments.prospect(space, {"one": same, "the other": same}, SETTINGS))
    assert proposal.name == experiments.NONE
    assert proposal.expected_sigma == 0 and proposal.separates == ()


@pytest.mark.slow
def test_unaffected_experiment_separates_nothing(seen):
    foreseen = seen["series_resistance", "supply_sag"][3]
    assert foreseen.apart(0, 1, "weigh") == 0 and foreseen.apart(0, 1, "zero current") == 0


def candidates(*names):
    return tuple(
        Candidate((n,), np.zeros(1), np.zeros(1), float(k), np.zeros(1), True, True) for k, n in enumerate(names)
    )


def test_alternatives_are_the_class_best_first():
    made = candidates("a", "b", "c", "d")
    left = experiments.alternatives(made[2], Classes((("c", "a"),), made))
    assert list(left) == ["c", "a"] and list(left.values()) == [made[2], made[0]]


def test_alternatives_of_two_classes_differ_in_one_effect():
    made = tuple(
        dataclasses.replace(c, active=pair)
        for c, pair in zip(candidates("", "", "", ""), [("a", "b"), ("c", "b"), ("d", "a"), ("c", "d")], strict=True)
    )
    left = experiments.alternatives(made[0], Classes((("a", "c"), ("b", "d")), made))
    assert list(left) == ["a + b", "c + b", "d + a"]


@pytest.mark.slow
def test_nothing_is_proposed_where_one_name_is_left(seen):
    space = seen["mass_error", "tension_friction"][1]
    (best,) = candidates("mass_error")
    assert experiments.separating(space, best, Classes((("mass_error",),), (best,)), SETTINGS) is None


@pytest.mark.slow
def test_unnamed_asks_for_finer_steps_in_its_variable(seen):
    space = seen["mass_error", "tension_friction"][1]
    runs = int(space.included.sum())
    where = Location("track", "speed", ("track",), 60.0, 60.0)
    proposal = experiments.denser(space, where, SETTINGS)
    assert "speed" in proposal.name and "track" in proposal.description
    assert proposal.expected_sigma == pytest.approx(np.sqrt(60 * 45 / runs)) and runs == 90
    weak = experiments.denser(space, dataclasses.replace(where, strongest=4.0), SETTINGS)
    assert weak.name == experiments.NONE and weak.expected_sigma == 0
    wave = experiments.denser(space, dataclasses.replace(where, variable="order 2 of the driving shaft"), SETTINGS)
    assert wave.name == "steady speeds for order 2 of the driving shaft" and "from the mark" in wave.description
