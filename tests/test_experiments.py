"""The next experiment: what the menu foresees, which experiment is chosen, and what its readings say."""

import types
from dataclasses import replace

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from loop_experiments import supported
from numpy.random import default_rng
from numpy.testing import assert_allclose, assert_array_equal
from synthetic import SETTLED, table
from test_worlds_tables import SHAPES
from worlds import laws, settled, tables

from calibration.data.robot_file import change_robot
from calibration.described import describe
from calibration.discovery import assembly, experiments, menu
from calibration.discovery.candidates import Candidate, fill_slots, fit_candidates
from calibration.discovery.classes import Classes, Shift
from calibration.discovery.location import DiscrepancyLocation
from calibration.discovery.predicted import (
    batch_experiments,
    map_over_runs,
    predict_readings,
    reading_count,
    reading_sds,
    reading_spans,
)
from calibration.discovery.reach import reach_of_table
from calibration.inference.fit_notes import Remark
from mmrjax.effects import BY_NAME, OF_CHANNELS
from mmrjax.fidelities.steady import IMPLICIT
from mmrjax.model import channels, paper_robots, params
from mmrjax.model.conditions import Conditions
from mmrjax.model.rig import Rig
from sweeps.stage_files import read_stage, write_stage
from tests.commands import read_rig

PAIRS = {
    ("series_resistance", "supply_sag"): {"one motor, 6T2A", "one motor, 4W2T", "stall, one motor"},
    ("ammeter_offset", "brush_drop"): {"zero current", "shunt"},
    ("rolling_radius", "speed_gain"): {"timing"},
    ("mass_error", "tension_friction"): {"weigh"},
}


def conditions(made):
    """Conditions of a table of the generator, for the simulator."""
    c = made.conditions if isinstance(made, tables.Case) else made
    return Conditions(c.wheeled.astype(int), c.U, np.degrees(c.slope), c.payload, total_mass=c.mass)


CLIMBING = params.replace(paper_robots.nominal(), settled.CLIMBING)
REACH = reach_of_table(CLIMBING, conditions(settled.table8()), channels.USUAL)
MENU = menu.experiment_menu(REACH)
SPANS, BY = reading_spans(MENU), {e.name: e for e in MENU}
SETTINGS = SETTLED.settings


def foreseen(robot, batch):
    return predict_readings(robot, batch, *map_over_runs(IMPLICIT.solve, robot, batch))[1]


# --- what the menu foresees -------------------------------------------------------------------------


@pytest.fixture(scope="module")
def shown():
    """Readings of the whole menu, and which exist, for constants and a term of the generator."""
    full = replace(CLIMBING, effects=tuple(BY_NAME[name]() for name in laws.LIBRARY))
    read, batch = eqx.filter_jit(foreseen), batch_experiments(MENU, channels.USUAL)

    def of(p, term=None):
        values = dict(p)
        if term is not None:
            values[f"effects.{term.name}.amplitude"] = term.amplitude
            values |= {f"effects.{term.name}.{SHAPES[k]}": v for k, v in term.shapes.items()}
        robot = params.replace(full, {k: jnp.asarray(np.float64(v)) for k, v in values.items()})
        found = read(robot, batch)
        return np.asarray(found.value), np.asarray(found.exists)

    return of


@pytest.mark.slow
@pytest.mark.parametrize("name", [None, *laws.LIBRARY])
def test_menu_agrees_with_the_generators_own_physics(name, shown):
    p, term = settled.perturbed(default_rng(5), scale=0.5), None
    if name is not None:
        term = laws.draw(name, default_rng(1))
        term = replace(term, amplitude=term.amplitude * term.law.size)
    value, there = shown(p, term)
    for experiment_name, at in SPANS.items():
        theirs, sound = settled.carried_out(BY[experiment_name], p, [] if term is None else [term])
        assert_array_equal(there[at], sound, err_msg=experiment_name)
        assert_allclose(value[at][sound], theirs[sound], rtol=1e-6, atol=1e-9, err_msg=experiment_name)


# --- the choice -------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def seen():
    """For each pair: a synthetic case of its first, and what both foresee once fitted to its table."""
    answers = {}
    for pair in PAIRS:
        case = tables.narrow([pair[0]], 12.0, seed=3)
        space = SETTLED.space(table(case))
        start = np.zeros(len(space.coordinates))
        fitted = fit_candidates(space, [(fill_slots([name], SETTINGS), start) for name in pair])
        answers[pair] = case, space, dict(zip(pair, fitted, strict=True))
    return {p: (c, space, f, experiments.predict_menu(space, f)) for p, (c, space, f) in answers.items()}


@pytest.mark.nightly
@pytest.mark.parametrize("pair", PAIRS)
def test_proposal_is_what_an_engineer_would_do(pair, seen):
    proposal = experiments.choose_experiment(seen[pair][3])
    assert proposal.name in PAIRS[pair]
    assert proposal.settles and proposal.separates == (pair[1],) and proposal.expected_sigma > 3
    assert (
        len(proposal.table) == len(seen[pair][3].experiments)
        and proposal.table[0].experiments == proposal.experiments
    )


@pytest.mark.slow
@pytest.mark.parametrize("pair", PAIRS)
def test_proposal_carried_out_resolves_the_class(pair, seen):
    case, _, _, foreseen = seen[pair]
    name = experiments.choose_experiment(foreseen).name
    done = next(e for e in foreseen.experiments if e.name == name)
    verdicts = [supported(foreseen, {name: case.carry_out(done, seed)}) for seed in range(10)]
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
    return experiments.PredictedReadings(
        names, MENU, value, half, np.ones(readings), np.ones(readings, bool), SETTINGS
    )


def test_chance_is_the_share_of_draws_in_which_the_false_one_is_refuted():
    seen = foreseeing({"stall": [0, 2.5]})
    at, rng = SPANS["stall"], default_rng(0)
    refuted = [
        "b"
        in supported(seen, {"stall": {"value": rng.standard_normal(at.stop - at.start), "sd": np.ones(2)}}).refuted
        for _ in range(4000)
    ]
    one = next(r for r in experiments.rank_experiments(seen) if r.experiments == ("stall",))
    assert np.mean(refuted) == pytest.approx(one.chances[0], abs=0.025)  # three sds of the draws


FAR = [9.0 * k for k in range(1, 7)]


@pytest.mark.parametrize("sigma, chosen, settles, expected", [
    ({"weigh": [0, 6.0], "stall": [0, 40.0]}, {"weigh"}, True, 6.0),  # more sigmas are no gain, less effort is one
    ({"weigh": [0, 3.0], "stall": [0, 40.0]}, {"stall"}, True, 40.0),
    # `shunt`, the lesser effort, tells both others from the best fit but not from one another; `stall` all three
    ({"shunt": [0, 9.0, 9.0], "stall": [0, 6.0, 12.0]}, {"stall"}, True, 6.0),
    ({"weigh": [0, 6.0, 6.0], "stall": [0, 40.0, 40.0]}, {"weigh"}, False, 6.0),  # beside a pair that nothing tells
    ({"weigh": [0, 0.0, *FAR[:5]], "stall": [0, *FAR]}, {"stall"}, True, 9.0),  # one pair of many counts
    # three pairs 1.9 sigma apart at most by `stall`; `weigh` tells one of them by 3
    ({"stall": [0, 1.9, 0.95], "weigh": [0, 1.5, 3.0]}, {"stall", "weigh"}, False, (1.9**2 + 1.5**2) ** 0.5),
    ({"stall": [0, 1.9], "weigh": [0, 1.9]}, {"stall", "weigh"}, False, 1.9 * 2**0.5),  # weak ones together
    ({"stall": [0, 9.0, 9.0], "weigh": [0, 0.0, 0.5]}, {"stall"}, False, 9.0),  # a second one that adds nothing
    # where one leaves two together a second one is proposed
    ({"stall": [0, 9.0, 9.0], "weigh": [0, 0.0, 7.0], "timing": [0, 0.0, 1.0]}, {"stall", "weigh"}, True, 7.0),
])  # fmt: skip
def test_the_experiment_is_the_one_of_least_effort_that_tells_most(sigma, chosen, settles, expected):
    proposal = experiments.choose_experiment(foreseeing(sigma))
    assert set(proposal.experiments) == chosen and proposal.settles == settles
    assert proposal.expected_sigma == pytest.approx(expected)
    assert proposal.name.count(" and ") == len(chosen) - 1
    if len(chosen) > 1:
        assert [e.name for e in proposal.instruction.experiments] == list(proposal.experiments)
    if "timing" in sigma:
        assert proposal.separates == ("b", "c")


def candidates(*names):
    return tuple(
        Candidate((n,), np.zeros(1), np.zeros(1), float(k), np.zeros(1), np.zeros(1), True, True, True)
        for k, n in enumerate(names)
    )


def of_members(*members, ladder, stated=None):
    """Classes of these members, all of one family."""
    return Classes(members, stated or ((),) * len(members), (("family",),) * len(members), ladder)


def test_alternatives_are_the_class_best_first():
    made = candidates("a", "b", "c", "d")
    left = experiments.alternatives_of_class(made[2], of_members(("c", "a"), ladder=made))
    assert list(left.items()) == [("c", made[2]), ("a", made[0])]


def test_stated_value_that_may_be_wrong_is_an_alternative():
    made = candidates("a", "b", "")
    alike = of_members(("a", "b"), ladder=made, stated=((Shift("motor.resistance", 1.9, 1.0, "ohm", 9.0, made[2]),),))
    left = experiments.alternatives_of_class(made[0], alike)
    assert list(left) == ["a", "b", "motor.resistance"] and left["motor.resistance"] is made[2]


def test_alternatives_of_two_classes_differ_in_one_effect():
    made = tuple(
        replace(c, active=(*pair,)) for c, pair in zip(candidates(*[""] * 4), ("ab", "cb", "da", "cd"), strict=True)
    )
    left = experiments.alternatives_of_class(made[0], of_members(("a", "c"), ("b", "d"), ladder=made))
    assert list(left) == ["a + b", "c + b", "d + a"]


# --- what is within reach ---------------------------------------------------------------------------

#: A robot of somebody else: wheels only, 12 V, 3 kg.
ROVER = """
configurations = ["rover"]
[motor]
resistance = 1.2
torque_constant = 0.012
[gearbox]
ratio = 30.0
[rover]
like = "4W2T"
mass = 3.0
[rover.ground.friction]
static = 0.6
"""


@pytest.fixture
def rover(tmp_path):
    return read_rig(tmp_path, ROVER, "rover.toml")


def grid(voltages, slopes, payloads):
    u, s, m = (x.ravel() for x in np.meshgrid(voltages, slopes, payloads, indexing="ij"))
    return Conditions(0, u, s, m)


ROVERS_TABLE, LEVEL = grid([6.0, 9.0, 12.0], [0.0, 8.0], [0.0, 1.0]), grid([12.0], [0.0], [0.0])


def runs_of(table):
    return [e for e in table if isinstance(e, menu.ProposedRuns)]


def reach(robot, table=ROVERS_TABLE, shown=channels.USUAL):
    return reach_of_table(robot, table, shown)


def named(experiments, name):
    return next(e for e in experiments if e.name == name)


@pytest.mark.slow
def test_menu_stays_within_the_reach_of_a_small_robot(rover):
    made = menu.experiment_menu(reach(rover))
    runs = runs_of(made)
    assert {r.configuration for r in runs} == {0} and {r.used and r.used.configuration for r in runs} == {
        None,
        "rover",
    }
    voltages, payloads, slopes = (
        np.concatenate([getattr(r, n) for r in runs]) for n in ("voltage", "payload", "slope")
    )
    assert voltages.min() > 0 and voltages.max() <= 12.0
    assert payloads.max() == 1.5 and slopes.max() <= 9.5 and slopes.min() == -8.0
    assert named(made, "weigh").at == ((0.0, 0.0), (0.0, 1.0))
    assert max(named(runs, "stall").voltage) / 1.2 < 3.0  # of the current of steady travel, not of 12 V / 1.2 ohm


@pytest.mark.parametrize(
    "imposed, limits, highest",
    [
        ("voltage", {"voltage": 24.0}, 24.0),
        ("voltage", {"voltage": 28.6}, 28.0),
        ("voltage", {"voltage": 48.0}, 31.0),
        ("motor_speed", {"geared": 27.5}, 27.0),
        ("motor_current", {}, 31.0),
    ],
)
def test_levels_of_a_shaft_stay_within_those_of_the_table_or_the_makers_limit(imposed, limits, highest):
    levels = (6.0, 12.0, 24.0)
    used = replace(REACH.used[0], voltages=levels)
    reach = replace(REACH, used=(used,), imposed=imposed, levels=levels, has_ground=False, **limits)
    other, *rest = menu._shaft_runs(reach, used)
    assert max(other.voltage) == highest and len(set(other.voltage) - set(levels)) >= 2
    assert all(abs(v) <= 24.0 for r in rest for v in r.voltage)


def plain(run, temperature=40.0, speed=100.0):
    """All of a run kept, with one temperature and speed."""
    rows = len(run.voltage)
    return np.ones(rows, bool), np.full(rows, temperature), np.full(rows, speed)


def test_channels_that_the_bench_lacks_are_not_read(rover):
    made = menu.experiment_menu(reach(rover, shown=("speed",)))
    assert {c for r in runs_of(made) for c in r.channels} == {"speed"}
    names = {e.name for e in made}
    assert "timing" in names and not names & {"shunt", "strobe", "zero current", "stall", "lifted, rover"}


def test_the_zero_of_a_meter_is_read_at_rest_as_well_as_its_table_is(rover):
    off = OF_CHANNELS["motor_current_offset"](amplitude=0.18), OF_CHANNELS["motor_current_gain"](amplitude=0.05)
    made = menu.experiment_menu(reach(rover, shown=("motor_current",)))
    (zero,) = (e for e in made if "zero reading" in e.kinds)
    read = zero.reading(replace(rover, effects=off), jnp.asarray(zero.at))
    assert np.asarray(read) == pytest.approx([0.18])
    assert reading_sds([zero], {"motor_current": 0.1}) == pytest.approx([0.1 / np.sqrt(zero.repeats)])


def test_robot_with_one_motor_is_not_told_to_disconnect_the_other(rover):
    made = menu.experiment_menu(reach(replace(rover, sides=jnp.asarray(1.0))))
    assert not any("one motor" in e.kinds for e in made)
    assert {r.reach.motors for r in runs_of(made)} == {1}


@pytest.mark.slow
def test_voltages_without_load_stay_below_the_permissible_speed():
    slow = change_robot(CLIMBING, {"motor.speed_limit": 900.0, "gearbox.speed_limit": 500.0}, where="test")
    within = reach(slow, conditions(settled.table8(voltages=(12.0,))))
    made = menu.experiment_menu(within)
    assert max(named(made, "bare motor").voltage) <= 0.0259 * 900.0
    # the table went to its own speed itself
    assert max(named(made, "lifted, 6T2A").voltage) <= 0.0259 * max(500.0, within.motor_speed)


def test_other_voltages_are_those_that_the_table_lacks():
    made = menu.other_voltages(REACH, (15.0, 24.0, 33.0))
    assert len(made) == 4 and made[0] < 15 and made[-1] < 33 and not set(made) & {15.0, 24.0, 33.0}
    assert all(v <= 12.0 for v in menu.other_voltages(replace(REACH, voltage=12.0), (12.0,)))


def test_only_levels_that_the_robot_manages_are_left():
    run = menu._combined_runs(REACH, "x", "travel", voltages=(5.0, 10.0), slopes=(0.0, 10.0, 20.0))
    does = np.array([1, 1, 0, 1, 0, 0], bool)  # at 5 V the slopes are too steep, and 20 deg at 10 V too
    kept = menu.possible_runs(run, does)
    assert [(run.slope[k], run.voltage[k]) for k in np.flatnonzero(kept)] == [(0.0, 5.0), (0.0, 10.0)]
    assert (
        not menu.possible_runs(run, np.zeros_like(does)).any() and menu.possible_runs(run, np.ones_like(does)).all()
    )
    steepest = menu._combined_runs(REACH, "x", "travel", voltages=(5.0,), slopes=(23.0, 21.5, 20.0), steepest=True)
    assert menu.possible_runs(steepest, np.array([False, True, True])).tolist() == [False, True, False]


@pytest.mark.parametrize("name, temperature, speed, watch", [
    ("stall", 90.0, 0.0, Remark("held_motor", temperature=90.0, allowed=125.0,
                                current=max(BY["stall"].voltage) / REACH.resistance)),
    ("braked motor", 90.0, 900.0, Remark("braked_motor", temperature=90.0, allowed=125.0)),
    ("lifted, 6T2A", 40.0, 1250.0, Remark("overspeed", speed=1250.0, limit=REACH.limit_geared,
                                          voltage=max(BY["lifted, 6T2A"].voltage))),
    ("payload 12 kg, 6T2A", 118.0, 500.0, Remark("hot_motor", temperature=118.0, allowed=125.0)),
    ("crawl, 6T2A", 40.0, 100.0, None),
])  # fmt: skip
def test_what_can_do_damage_is_to_be_watched(name, temperature, speed, watch):
    run = BY[name]
    found = menu.restrict_run(run, *plain(run, temperature, speed)).watch
    assert watch in found if watch else found == ()


def test_runs_against_a_brake_have_its_torque():
    within = replace(REACH, has_ground=False, measured=("motor_speed",), torques=(0.0, 0.1, 0.5))

    def conditions_of(made):
        return batch_experiments(made, within.measured).conditions

    made = menu.experiment_menu(within)
    torque = np.asarray(conditions_of(made).load_torque)
    assert torque.tolist() == [m for r in runs_of(made) for m in r.torque]
    assert torque.max() == 0.5 and (torque * conditions_of(made).voltage >= 0).all()  # it brakes either way
    run = next(r for r in made if "other torques" in r.kinds)
    done = np.asarray(run.torque) < 0.5  # it stalls the motor
    kept = menu.restrict_run(run, menu.possible_runs(run, done), *plain(run)[1:])
    assert set(kept.torque) == set(run.torque) - {0.5} and len(kept.voltage) == len(kept.torque)
    assert conditions_of(menu.experiment_menu(replace(within, torques=()))).load_torque is None


@pytest.mark.slow
def test_forbidden_and_impossible_experiments_are_not_proposed(seen):
    _, space, fitted, free = seen["series_resistance", "supply_sag"]
    barred = ("stall", "one motor", "4W2T")
    left = experiments.predict_menu(replace(space, settings=replace(SETTINGS, forbidden=barred)), fitted)
    assert not {*barred} & {k for e in left.experiments for k in e.kinds}
    assert {e.name for e in left.experiments} < {e.name for e in free.experiments}
    assert left.value.shape[1] == sum(reading_count(e) for e in left.experiments) == len(left.sd)
    none = experiments.predict_menu(replace(space, settings=replace(SETTINGS, forbidden=menu.KINDS)), fitted)
    nothing = experiments.choose_experiment(none)
    assert nothing.name == experiments.NONE and nothing.instruction == Remark("nothing_possible")


@pytest.mark.parametrize("variable, table, ranges", [
    ("voltage", ROVERS_TABLE, (6.0, 12.0, 8.0, 1.0)), ("current", LEVEL, (6.0, 12.0, 0.0, 0.0)),
])  # fmt: skip
def test_finer_steps_are_within_the_tables_ranges(rover, variable, table, ranges):
    series = experiments.denser_runs_instruction("slip", variable, reach(rover, table))
    assert (series.low, series.high, series.slope, series.payload) == ranges
    assert series.steps == (0.5, 0.5, 0.1) or variable != "voltage"


def test_every_experiment_is_kept_in_a_stage(tmp_path):
    write_stage(tmp_path / "menu", MENU)
    assert read_stage(tmp_path / "menu") == MENU
    assert {type(e) for e in MENU} == {menu.CalibrationAct, menu.ProposedRuns}


def test_reverse_travel_turns_the_sign_of_a_biased_slope_alone(shown):
    at = SPANS
    plain, biased = (shown(settled.CLIMBING, laws.Term("slope_bias", a))[0] for a in (0.0, 0.02))
    change = biased - plain
    assert change[at["reverse, 6T2A"]][0] < 0 < change[at["downhill, 6T2A"]][0]  # of the current


@pytest.mark.slow
def test_unnamed_asks_for_finer_steps_in_its_variable(seen):
    space = seen["mass_error", "tension_friction"][1]
    where = DiscrepancyLocation("track", "speed", ("track",), (), 60.0, 60.0)

    def proposed(**changes):
        return experiments.propose_denser_runs(space, replace(where, **changes), SETTINGS)

    strong, weak, wave = proposed(), proposed(strongest=4.0), proposed(variable="order 2 of the driving shaft")
    assert "speed" in strong.name and strong.instruction.place == "track" and int(space.included.sum()) == 90
    assert strong.expected_sigma == pytest.approx(np.sqrt(60 * 45 / 90))
    assert (weak.instruction.variable, weak.name, weak.expected_sigma) == ("speed", experiments.NONE, 0)
    assert wave.name == "steady speeds for order 2 of the driving shaft"


@pytest.mark.slow
def test_level_table_without_payload_asks_for_neither_slope_nor_payload(rover):
    made = menu.experiment_menu(reach(rover, LEVEL))
    runs = runs_of(made)
    assert all(set(r.slope) <= {0.0, -0.0} and set(r.payload) == {0.0} and max(r.voltage) <= 12.0 for r in runs)
    assert not {"downhill", "steepest slope", "payload"} & {k for r in runs for k in r.kinds}
    assert made[0].name == "weigh" and {m for _, m in made[0].at} == {0.0}


@pytest.mark.slow
def test_higher_voltage_needs_a_rating_and_is_watched(rover):
    within = reach(change_robot(rover, {"motor.voltage_limit": 18.0}, where="test"))
    run = named(menu.experiment_menu(within), "other voltages, rover")
    assert max(run.voltage) == 18.0
    shown = menu.restrict_run(run, *plain(run))
    assert Remark("overvoltage", voltage=18.0, used=12.0) in shown.watch


@pytest.mark.slow
def test_steepest_slope_is_one_that_the_robot_climbs():
    slippery = params.replace(CLIMBING, {f"{c}.ground.friction.static": 0.40 for c in ("6T2A", "4W2T")})
    does = np.asarray(eqx.filter_jit(foreseen)(slippery, batch_experiments(MENU, channels.USUAL)).feasible)
    kept, first = {}, 0
    for run in runs_of(MENU):
        rows = slice(first, first := first + len(run.voltage))
        kept[run.name] = menu.possible_runs(run, does[rows])
    # tan 21.5 deg = 0.394 and rolling resistance: beyond the adhesion
    assert not kept["steepest slope, 6T2A"].any() and kept["lifted, 6T2A"].all()


def test_a_class_of_a_servos_log_has_no_experiment_of_the_menu():
    """The menu has no runs with a goal: the loop ended in an IndexError once effects of a servo were inseparable."""
    seen = types.SimpleNamespace(menu=True, word="sample")
    base = types.SimpleNamespace(rig=Rig(imposed="goal_angle"))
    space = types.SimpleNamespace(bare=types.SimpleNamespace(observe=seen, base=base))
    traced = types.SimpleNamespace(verdict="class", where=None, alike=object())
    proposal = assembly._next_experiment(space, traced)
    assert proposal.experiments == (experiments.NONE,)
    assert describe(proposal.instruction).endswith("no experiments for goals of a controller")
