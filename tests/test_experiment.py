"""The next experiment: what the menu foresees, which experiment is chosen, and what its readings say."""

import dataclasses
from types import SimpleNamespace

import equinox as eqx
import generator as g
import jax.numpy as jnp
import numpy as np
import pytest
from test_generator import SHAPES

from calibration.inference import noise
from calibration.data import runs as records
from calibration.discovery import experiments as experiment
from calibration.discovery import loop, menu
from mmrjax import params, robots
from mmrjax.effects import BY_NAME

PAIRS = {
    ("series_resistance", "supply_sag"): {"one motor, 6T2A", "one motor, 4W2T", "stall, one motor"},
    ("ammeter_offset", "brush_drop"): {"zero current", "shunt"},
    ("rolling_radius", "speed_gain"): {"timing"},
    ("mass_error", "tension_friction"): {"weigh"},
}
STATED = {f"{c}.ground.friction.static": (0.6, 0.09) for c in ("tracked", "wheeled")}


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
    for experiment_name, at in menu.spans().items():
        theirs, sound = g.carried_out(experiment_name, p, [] if term is None else [term])
        np.testing.assert_array_equal(there[at], sound, err_msg=experiment_name)
        np.testing.assert_allclose(value[at][sound], theirs[sound], rtol=1e-6, atol=1e-9, err_msg=experiment_name)


def test_agreement_can_fail(shown):
    value, _ = shown(g.CLIMBING)
    theirs, _ = g.carried_out("bare motor", g.CLIMBING | {"motor.resistance": 0.6117})
    with pytest.raises(AssertionError):
        np.testing.assert_allclose(value[menu.spans()["bare motor"]], theirs, rtol=1e-6)


def test_menu_and_generator_hold_the_same_experiments():
    ran = [f"{n}, {c}" for n, r in g.RUNS.items() for c in ("6T2A", "4W2T") if r[1]]
    alone = [n for n, r in g.RUNS.items() if not r[1]]
    assert {e.name for e in menu.MENU} == {*g.ACTS, *ran, *alone}
    case = g.Case({}, {}, g.conditions(0, 1, 0, 0), g.CLIMBING, (), g.Instruments())
    sd = menu.sds(case.instruments.stated * [1.0, np.pi / 30, 1e-3])
    for name, at in menu.spans().items():
        np.testing.assert_allclose(case.carry_out(name, 0)["sd"], sd[at], err_msg=name)


def test_reverse_travel_turns_the_sign_of_a_biased_slope_alone(shown):
    at = menu.spans()
    plain, biased = (shown(g.CLIMBING, g.Term("slope_bias", a))[0] for a in (0.0, 0.02))
    change = biased - plain
    assert change[at["reverse, 6T2A"]][0] < 0 < change[at["downhill, 6T2A"]][0]  # of the current


# --- the choice -------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def engine():
    names = sorted({n for pair in PAIRS for n in pair})
    return loop.Engine(robots.nominal(), {n: BY_NAME[n] for n in names}, size=1)


@pytest.fixture(scope="module")
def seen(engine, tmp_path_factory):
    """For each pair: a sealed case of its first, and what both foresee once fitted to its table."""
    folder = tmp_path_factory.mktemp("sealed")
    answers = {}
    for pair in PAIRS:
        case = g.case([pair[0]], 12.0, seed=3)
        case.write(folder / "runs.csv", folder / "label.json")
        runs = records.read(folder / "runs.csv")
        looped = loop.Loop(engine, runs, noise.of(runs).sd, stated=STATED)
        which = [(engine.names.index(n),) for n in pair]
        fitted = looped.fit_all([(w, np.zeros(len(looped.coordinates))) for w in which])
        answers[pair] = case, looped, dict(zip(pair, fitted, strict=True))
    return {p: (c, looped, h, experiment.prospect(looped, h)) for p, (c, looped, h) in answers.items()}


@pytest.mark.parametrize("pair", PAIRS)
def test_proposal_is_what_an_engineer_would_do(pair, seen):
    proposal = experiment.choose(seen[pair][3])
    assert proposal.name in PAIRS[pair]
    assert proposal.settles and proposal.separates == (pair[1],) and proposal.expected_sigma > 3
    assert len(proposal.table) == len(menu.MENU) and proposal.table[0].experiments == proposal.experiments


@pytest.mark.parametrize("pair", PAIRS)
def test_proposal_carried_out_resolves_the_class(pair, seen):
    case, _, _, foreseen = seen[pair]
    name = experiment.choose(foreseen).name
    verdicts = [experiment.supported(foreseen, {name: case.carry_out(name, seed)}) for seed in range(10)]
    assert sum(v.resolved and v.best == pair[0] for v in verdicts) >= 8
    assert all(pair[0] in v.left for v in verdicts)


def foreseeing(sigma):
    """A prospect in which each experiment of the menu shows alternative k `sigma[name][k]` sds off, without doubt."""
    spans = menu.spans()
    readings = spans[menu.MENU[-1].name].stop
    members = len(next(iter(sigma.values())))
    value = np.zeros((members, readings))
    for name, at in sigma.items():
        value[:, spans[name].start] = at
    names = tuple("abcdefgh"[:members])
    return experiment.Prospect(
        names, value, np.zeros((members, readings, 1)), np.ones(readings), np.ones(readings, bool)
    )


def test_less_effort_is_preferred_where_more_sigmas_are_no_gain():
    assert experiment.choose(foreseeing({"weigh": [0, 6.0], "stall": [0, 40.0]})).experiments == ("weigh",)
    assert experiment.choose(foreseeing({"weigh": [0, 3.0], "stall": [0, 40.0]})).experiments == ("stall",)


def test_chance_is_the_share_of_draws_in_which_the_false_one_is_refuted():
    seen = foreseeing({"stall": [0, 2.5]})
    at, rng = menu.spans()["stall"], np.random.default_rng(0)
    refuted = [
        "b"
        in experiment.supported(
            seen, {"stall": {"value": rng.standard_normal(at.stop - at.start), "sd": np.ones(2)}}
        ).refuted
        for _ in range(4000)
    ]
    one = next(r for r in experiment.ranked(seen) if r.experiments == ("stall",))
    assert np.mean(refuted) == pytest.approx(one.chances[0], abs=0.025)  # three sds of the draws


def test_every_two_alternatives_count_not_only_those_with_the_best_fit():
    # `shunt`, the lesser effort, tells both others from the best fit but not from one another; `stall` all three
    proposal = experiment.choose(foreseeing({"shunt": [0, 9.0, 9.0], "stall": [0, 6.0, 12.0]}))
    assert proposal.experiments == ("stall",) and proposal.settles


def test_less_effort_is_preferred_also_beside_a_pair_that_nothing_tells():
    assert experiment.choose(foreseeing({"weigh": [0, 6.0, 6.0], "stall": [0, 40.0, 40.0]})).experiments == ("weigh",)


def test_one_pair_of_many_alternatives_counts():
    far = [9.0 * k for k in range(1, 6)]
    proposal = experiment.choose(foreseeing({"weigh": [0, 0.0, *far], "stall": [0, *(9.0 * k for k in range(1, 7))]}))
    assert proposal.experiments == ("stall",) and proposal.settles


def test_pair_that_one_experiment_tells_is_worth_more_than_three_that_none_does():
    # three pairs 1.9 sigma apart at most by `stall`; `weigh` tells one of them by 3
    proposal = experiment.choose(foreseeing({"stall": [0, 1.9, 0.95], "weigh": [0, 1.5, 3.0]}))
    assert "weigh" in proposal.experiments and proposal.expected_sigma >= 2.0


def test_two_weak_experiments_are_proposed_together():
    proposal = experiment.choose(foreseeing({"stall": [0, 1.9], "weigh": [0, 1.9]}))
    assert set(proposal.experiments) == {"stall", "weigh"} and proposal.expected_sigma == pytest.approx(1.9 * 2**0.5)


def test_a_second_experiment_is_proposed_where_one_leaves_two_together():
    proposal = experiment.choose(
        foreseeing({"stall": [0, 9.0, 9.0], "weigh": [0, 0.0, 7.0], "timing": [0, 0.0, 1.0]})
    )
    assert set(proposal.experiments) == {"stall", "weigh"} and proposal.settles
    assert proposal.expected_sigma == pytest.approx(7.0) and proposal.separates == ("b", "c")
    assert "scales" in proposal.description and "vice" in proposal.description and proposal.name.count(" and ") == 1


def test_a_second_experiment_that_adds_nothing_is_not():
    proposal = experiment.choose(foreseeing({"stall": [0, 9.0, 9.0], "weigh": [0, 0.0, 0.5]}))
    assert (
        proposal.experiments == ("stall",) and not proposal.settles and proposal.expected_sigma == pytest.approx(9.0)
    )


def test_alternatives_that_agree_give_none(seen):
    _, looped, fitted, _ = seen["series_resistance", "supply_sag"]
    same = next(iter(fitted.values()))
    proposal = experiment.choose(experiment.prospect(looped, {"one": same, "the other": same}))
    assert proposal.name == experiment.NONE
    assert proposal.expected_sigma == 0 and proposal.separates == ()


def test_unaffected_experiment_separates_nothing(seen):
    foreseen = seen["series_resistance", "supply_sag"][3]
    assert foreseen.apart(0, 1, "weigh") == 0 and foreseen.apart(0, 1, "zero current") == 0


def test_alternatives_are_the_class_best_first(engine):
    made = [loop.Hypothesis((k,), np.zeros(1), np.zeros(1), float(k), np.zeros(1), True, True) for k in range(4)]
    found = SimpleNamespace(after=SimpleNamespace(hypothesis=made[2]), ladder=tuple(made), classes=((2, 0),))
    left = experiment.alternatives(SimpleNamespace(engine=engine), found)
    assert list(left) == [engine.names[2], engine.names[0]] and list(left.values()) == [made[2], made[0]]


def test_nothing_is_proposed_where_nothing_is_missing(seen):
    looped = seen["mass_error", "tension_friction"][1]
    best = SimpleNamespace(hypothesis=SimpleNamespace(which=(-1,), effects=()))
    assert experiment.propose(looped, SimpleNamespace(verdict="none", classes=(), ladder=(), after=best)) is None


def test_unnamed_asks_for_finer_steps_in_its_variable():
    scores = SimpleNamespace(curve=np.array([1.0, 5.0]), explained=np.array([2.0, 60.0]))
    found = SimpleNamespace(
        verdict="unnamed", unnamed=("track", "speed", ("track",)), base=SimpleNamespace(scores=scores)
    )
    proposal = experiment.propose(SimpleNamespace(engine=SimpleNamespace(series=False), counts=np.ones(90)), found)
    assert "speed" in proposal.name and "track" in proposal.description
    assert proposal.expected_sigma == pytest.approx(np.sqrt(60 * 45 / 90))
