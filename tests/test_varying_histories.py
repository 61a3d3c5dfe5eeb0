"""Time histories whose conditions change within a run: followed as missions are, calibrated, traced, refused."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from synthetic import Analyst

from calibration.data.clock import applied_drive, course_of_each_row, intervals_by_run, rows_of_varying_runs
from calibration.data.columns import DRIVEN
from calibration.data.runs import Runs
from calibration.discovery.reach import reach_of_table
from calibration.discovery.settings import settings_for
from calibration.inference import checks
from calibration.inference.blocks import blocks_of_kind, distinct_held_out_blocks
from calibration.inference.linearization import balance_probe
from calibration.inference.noise import Noise
from calibration.inference.observers import Histories, settled_ends
from mmrjax.effects import BY_NAME
from mmrjax.fidelities.histories import CHANGE, LONGEST, START, history_signals, time_grid
from mmrjax.missions.mission import mission
from mmrjax.missions.profile import MODES, profile
from mmrjax.model import paper_robots, params
from mmrjax.model.conditions import Conditions
from mmrjax.model.quantities import MM, RPM
from tests.commands import read_table, refused, with_columns

#: Four segments a run: supply voltage [V] and mode; and the slope [deg] of the run.
SEGMENTS = (0.0, 0.42, 0.84, 1.26, 1.6)
STAIR = ((12.0, "voltage"), (24.0, "voltage"), (33.0, "voltage"), (18.0, "voltage")), 0.0
REVERSAL = ((24.0, "voltage"), (24.0, "brake"), (-24.0, "voltage"), (15.0, "voltage")), 4.0
COASTING = ((33.0, "voltage"), (33.0, "coast"), (-15.0, "voltage"), (24.0, "voltage")), -3.0
COURSES = {"stair": STAIR, "reversal": REVERSAL, "coasting": COASTING}
TIMES = np.arange(1, 80) * 0.02
SD = {"total_current_A": 0.05, "motor_speed_rpm": 15.0, "speed_mm_s": 4.0}
#: What the robot that is measured has in place of the nominal values.
TRUTH = {"motor.resistance": 0.68, "6T2A.track.loss_coulomb": 0.30, "6T2A.ground.rolling_resistance": 0.05}
NOMINAL = {p.name: float(p.value) for p in params.walk_parameters(paper_robots.nominal()) if p.name in TRUTH}
UNDECLARED = "series_resistance"
#: Largest difference of a derivative from differences of runs, over its largest.
DERIVATIVES, DIFFERENCE = 1e-6, 3e-6


def table_of(names, readings):
    """Histories of courses, with the readings that a function of segments, slope, and voltage and mode in time gives."""
    parts, at = [], np.searchsorted(SEGMENTS, TIMES + 1e-9, side="right") - 1
    for name in names:
        rows, slope = COURSES[name]
        volts, modes = (np.array([row[k] for row in rows])[at] for k in (0, 1))
        constant = {"run_id": name, "configuration": "6T2A", "slope_deg": slope, "payload_kg": 2.0}
        shown = dict(zip(SD, readings(rows, slope, volts, modes), strict=True))
        parts.append(
            {c: np.full(len(TIMES), x) for c, x in constant.items()}
            | {"time_s": TIMES, "supply_voltage_V": volts, "mode": modes, **shown}
        )
    columns = {c: np.concatenate([p[c] for p in parts]) for c in parts[0]}
    sds = zip(("total_current_sd_A", "motor_speed_sd_rpm", "speed_sd_mm_s"), SD.values(), strict=True)
    return Runs("synthetic", columns | {c: np.full(len(columns["time_s"]), sd) for c, sd in sds})


@pytest.fixture(scope="module")
def engine():
    """(robot's changes, names of runs, noise's seed) → table of histories made by `mission`, without its heat."""

    @jax.jit
    def course(values, modes, voltage, slope):
        known = {p.name: p for p in params.walk_parameters(paper_robots.nominal())}
        cold = {"motor.time_constant_winding": jnp.asarray(known["motor.time_constant_winding"].spec.bounds[1])}
        robot = dataclasses.replace(paper_robots.nominal(), effects=(BY_NAME[UNDECLARED](),))
        robot = params.replace(robot, {f"effects.{UNDECLARED}.amplitude": 0.0, **cold, **values})
        asked = profile(np.asarray(SEGMENTS), voltage=np.zeros(5))
        asked = dataclasses.replace(asked, mode=modes, voltage=voltage)
        return mission(robot, Conditions(0, 24.0, slope, 2.0), asked, tolerance=1e-7, keep=2000).course

    def table(changes, names, seed=0):
        rng = np.random.default_rng(seed)
        values = {**TRUTH, f"effects.{UNDECLARED}.amplitude": 0.0, **changes}

        def readings(rows, slope, volts, modes):
            segments = jnp.asarray([MODES.index(m) for _, m in rows] + [0]), jnp.asarray([v for v, _ in rows] + [0.0])
            kept = course({k: jnp.asarray(v) for k, v in values.items()}, *segments, slope)
            there = np.isfinite(kept.time)
            signals = kept.signals
            shown = [
                scale * np.interp(TIMES, np.asarray(kept.time)[there], np.asarray(x)[there])
                for x, scale in ((signals.current, 2.0), (signals.speed_motor, 1 / RPM), (signals.speed, 1 / MM))
            ]
            shown[0] *= modes == "voltage"
            return [x + sd * rng.standard_normal(len(TIMES)) for x, sd in zip(shown, SD.values(), strict=True)]

        return table_of(names, readings)

    return table


@pytest.fixture(scope="module")
def simulated(engine):
    """The three courses as the engine shows them."""
    return engine({}, COURSES)


@pytest.fixture(scope="module")
def runs():
    """The three courses with readings that approach those of their voltage within 50 ms, which no engine has to make."""

    def readings(rows, slope, volts, modes):
        level, lag = np.where(modes == "voltage", volts, 0.0), np.zeros(len(TIMES))
        for k in range(1, len(TIMES)):
            lag[k] = lag[k - 1] + (level[k] - lag[k - 1]) * (1 - np.exp(-0.02 / 0.05))
        return 2 + 0.1 * (level - lag) + 0.02 * level, 320.0 * lag, 27.0 * lag

    return table_of(COURSES, readings)


@pytest.fixture(scope="module")
def observer(runs):
    return Histories.of(runs, paper_robots.nominal())


NOTHING = Noise(*(None for _ in dataclasses.fields(Noise)))


def changed(runs, **columns):
    return with_columns(runs, **columns)


# --- a run


def test_grid_is_fine_after_every_change_and_bounded():
    times, changes, sizes = (
        np.round(np.arange(0.05, 2.0, 0.05), 2),
        np.array([0.5, 1.2, 1.21]),
        np.array([2.0, 1.0, 1e-3]),
    )
    found = time_grid(times, changes, sizes)
    step = np.diff(found)
    assert np.isin(times, found).all() and np.isin(changes, found).all() and (step > 0).all()
    assert step.max() <= LONGEST * (1 + 1e-9)
    for begin, first in ((0.0, START[0]), (0.5, CHANGE[0] / 2), (1.2, CHANGE[0])):
        assert 0.5 * first < step[np.searchsorted(found, begin)] <= 1.5 * first
    assert step[np.searchsorted(found, 1.21)] > 0.8 * LONGEST  # after a small one they are long at once
    assert_array_equal(time_grid(times), time_grid(times, np.array([0.0, 2.5]), np.ones(2)))  # no change within
    before = time_grid(times)
    assert_array_equal(found[found < 0.5], before[before < 0.5])
    # one small change a sample takes no more steps than none
    often = np.arange(1, 4000) * 0.005
    assert len(time_grid(often, often, np.full(len(often), 0.01))) <= len(time_grid(often)) + 3


@pytest.mark.slow
def test_runs_are_those_of_missions(simulated, robot):
    """Of an engine with steps, events and friction at rest of its own. Its noise is all that remains."""
    runs, observer = simulated, Histories.of(simulated, robot)
    truth = params.replace(robot, {k: jnp.asarray(v) for k, v in TRUTH.items()})
    seen = np.asarray(eqx.filter_jit(observer)(truth).reading)
    sigma = (seen - runs.measured()) / runs.deviations()
    assert np.sum(sigma**2) < sigma.size + 4 * np.sqrt(2 * sigma.size)
    assert np.abs(sigma).max() < 5
    assert (runs["speed_mm_s"] < -100).any() and (runs["total_current_A"] < -1).any()


@pytest.fixture(scope="module")
def of_values(observer):
    """Names of parameters, their values, the readings by values, and those of several values, compiled."""
    known = {p.name: float(p.value) for p in params.walk_parameters(paper_robots.nominal())}
    names = [*TRUTH, "motor.inertia", "motor.inductance", "6T2A.ground.friction.static"]

    def readings(x):
        return observer(params.replace(paper_robots.nominal(), dict(zip(names, x, strict=True)))).reading

    several = jax.jit(lambda xs: jax.lax.map(readings, xs))
    return names, jnp.asarray([TRUTH.get(n, known[n]) for n in names]), readings, several


@pytest.fixture
def solved(monkeypatch):
    """Steps solved further: differences of runs are no finer than 1e-5 else."""
    monkeypatch.setattr("mmrjax.fidelities.histories.SOLVED", 1e-12)


@pytest.mark.slow
def test_derivatives_of_a_varying_run_are_differences(of_values, solved):
    names, theta, readings, several = of_values
    slopes = np.asarray(jax.jit(jax.jacfwd(readings))(theta))
    step = DIFFERENCE * theta
    up, down = (np.asarray(several(theta + s * jnp.diag(step))) for s in (1, -1))
    for k, name in enumerate(names):
        expected = (up[k] - down[k]) / (2 * float(step[k]))
        scale = np.abs(expected).max(0)
        assert (scale > 0).all(), name
        error = np.abs(slopes[..., k] - expected).max(0) / scale
        assert (error < DERIVATIVES).all(), (name, error)


# --- what inference makes of it


def test_only_what_changes_has_a_value_an_instant(observer, runs):
    c = observer.conditions
    instants = observer.times.shape
    assert c.voltage.shape == c.duty.shape == c.open.shape == instants
    assert c.slope_deg.shape == c.payload.shape == c.configuration.shape == instants[:1]
    rows = observer.of_rows
    assert_array_equal(rows.voltage, runs["supply_voltage_V"])
    assert_array_equal(rows.slope_deg, runs["slope_deg"])
    assert_array_equal(rows.duty, runs["mode"] == "voltage")
    assert_array_equal(rows.open, 1.0 * (runs["mode"] == "coast") - (runs["mode"] == "brake"))
    # held from its sample on, also between samples
    k = int(np.unique(runs["run_id"]).tolist().index("stair"))
    t = np.asarray(observer.times[k])
    expected = np.array([12.0, 24.0, 33.0, 18.0])[np.clip(np.searchsorted(SEGMENTS, t + 1e-9, "right") - 1, 0, 3)]
    assert_array_equal(c.voltage[k], expected)


@pytest.mark.slow
def test_defects_of_all_knots_are_a_constant_defect(observer):
    """Their linear response, through changes of conditions, against the derivative by an amplitude."""
    robot, effects = paper_robots.nominal(), tuple(balance_probe(balance) for balance in ("electrical", "track"))

    def readings(amplitudes):
        put = tuple(dataclasses.replace(e, amplitude=a) for e, a in zip(effects, amplitudes, strict=True))
        return observer(dataclasses.replace(robot, effects=put)).reading

    derivative = np.asarray(jax.jit(jax.jacfwd(readings))(jnp.zeros(len(effects))))
    defects = np.asarray(jax.jit(lambda r: observer.changes(r, effects, ())[0])(robot))
    rows = np.asarray(observer.rows_of)
    for k in range(len(effects)):
        found, expected = defects[k].sum(1), derivative[..., k]
        got = np.zeros_like(expected)
        got[rows[rows >= 0]] = found[rows >= 0]
        assert_allclose(got, expected, rtol=1e-7, atol=1e-9 * np.abs(expected).max())
        assert (np.abs(expected).max(0) > 0).all()


def test_one_supply_voltage_is_said_only_where_the_duty_is_one_too(runs):
    steady = changed(runs, supply_voltage_V=np.full(len(runs), 24.0), mode=np.full(len(runs), "voltage"))
    assert "voltage" in {note.alike for note in checks._constant_conditions(steady)}
    pulsed = changed(steady, duty=np.where(runs["time_s"] < 0.5, 0.4, 1.0))
    assert "voltage" not in {note.alike for note in checks._constant_conditions(pulsed)}


def test_stretches_are_the_segments(runs, observer):
    for found in (intervals_by_run(runs), observer.constant_intervals()):
        assert [len(run) for run in found] == [4, 4, 4]
        for run in found:
            assert_allclose([s.begin for s in run], SEGMENTS[:4], atol=1e-12)
            assert [len(s.rows) for s in run] == [20, 21, 21, 17] and not any(s.whole for s in run)
        assert [s.driven for s in found[1]] == [True, False, False, True]
    assert applied_drive(runs)[runs["mode"] == "brake"].tolist() == [0.0] * 21


def test_blocks_of_runs_that_vary_are_whole_runs(runs):
    level = {k: np.concatenate([v, v[:5]]) for k, v in runs.columns.items()}
    level["run_id"] = np.concatenate([runs["run_id"], np.full(5, "level")])
    level["supply_voltage_V"][-5:], level["mode"][-5:] = 24.0, "voltage"
    more = Runs("more", level)
    assert set(blocks_of_kind(more, "voltage")) == {"run stair", "run reversal", "run coasting", "24.0"}
    for mask in blocks_of_kind(more, "voltage").values():
        assert len(np.unique(more["run_id"][mask])) == 1
    assert blocks_of_kind(runs, "voltage") == {} and set(blocks_of_kind(runs, "slope")) == {"0.0", "4.0", "-3.0"}
    assert "voltage" not in distinct_held_out_blocks(runs, Histories.blocks)
    assert (
        rows_of_varying_runs(more).sum() == len(runs)
        and len(set(course_of_each_row(more))) == 4
        and course_of_each_row(more)[-1] == ""
    )
    assert course_of_each_row(more).itemsize <= 40  # 4 GB on 3554 rows of one run whose current changes in each


def test_ends_are_those_of_stretches_driven_forwards(runs):
    analyst = Analyst(settings_for(Histories, 300), {"windage": BY_NAME["windage"]}, {})
    ends = settled_ends.settled_ends_of_runs(analyst.space(runs).bare)
    volts = np.asarray(ends.conditions.voltage)
    assert sorted(volts.tolist()) == [12.0, 15.0, 18.0, 24.0, 24.0, 24.0, 33.0, 33.0]  # none that brakes or reverses
    assert np.isfinite(ends.mean).any(1).sum() >= 4


def test_reach_takes_what_the_motors_were_given(observer, robot):
    driven = observer.driven
    assert driven.shape[0] > 4 and (driven.voltage > 0).all() and (driven.duty == 1).all()
    found = reach_of_table(robot, driven, ("speed",))
    assert found.voltages == (12.0, 15.0, 18.0, 24.0, 33.0) and found.used[0].slopes == (-4.0, -3.0, 0.0, 3.0, 4.0)


def test_conditions_that_change_between_many_levels_are_few(observer, runs, robot):
    noisy = changed(runs, supply_voltage_V=runs["supply_voltage_V"] + 0.001 * np.arange(len(runs)))
    varying = Histories.of(noisy, robot)
    assert len(np.unique(varying.driven.voltage)) <= 6
    assert varying.times.shape[1] < 1.5 * observer.times.shape[1]  # changes of a thousandth need no short steps


@pytest.mark.nightly
def test_loop_finds_what_was_not_declared_on_a_stair(engine):
    stairs = engine({**NOMINAL, f"effects.{UNDECLARED}.amplitude": 0.4}, ("stair", "reversal"))
    analyst = Analyst(
        dataclasses.replace(settings_for(Histories, 300), slots=1),
        {n: BY_NAME[n] for n in ("rotating_inertia", UNDECLARED, "churning", "windage")},
        {"6T2A.ground.friction.static": (0.32, 0.05)},
    )
    found = analyst.discover(stairs)
    # nothing tells it from a winding's resistance that is not what its sheet says
    assert found.verdict == "class" and [list(e.members) for e in found.effects] == [[UNDECLARED]]
    assert list(found.effects[0].stated) == ["motor.resistance"]
    amplitude = found.effects[0].parameters["amplitude"]
    assert abs(amplitude.value - 0.4) < 4 * amplitude.sd and amplitude.sd < 0.05
    assert {"mode", "supply_voltage_V"} <= set(found.rows_table())


# --- files

HEADER = "run_id,time_s,configuration,supply_voltage_V,payload_kg,slope_deg,speed_mm_s,total_mass_kg"


def test_columns_of_the_driver_are_read(tmp_path, robot):
    rows = ("a,0,6T2A,24,0,0,0,11,0.5,voltage", "a,1,6T2A,-12,0,0,5,11,-1,voltage", "a,2,6T2A,0,0,0,5,11,,brake",
            "a,3,6T2A,24,0,0,5,11,,coast")  # fmt: skip
    read = read_table(tmp_path, "\n".join([f"{HEADER},duty,mode", *rows]))
    found = read.conditions(robot)
    assert found.duty.tolist() == [0.5, -1.0, 0.0, 0.0] and found.open.tolist() == [0, 0, -1, 1]
    assert found.voltage.tolist() == [24, -12, 0, 24] and applied_drive(read).tolist() == [12, 12, 0, 0]
    assert set(DRIVEN) <= set(MODES)


def test_what_cannot_change_within_a_run_is_refused(runs):
    other = np.where(np.arange(len(runs)) % 2, "6T2A", "4W2T")
    with refused(r"configuration: run coasting has several values; give each its own run_id"):
        Histories.check(changed(runs, configuration=other), NOTHING)
    mass = 11.5 + runs["payload_kg"] + 0.5 * (runs["time_s"] > 1)
    with refused(r"total_mass_kg: run coasting changes by 0.5 kg apart from its payload"):
        Histories.check(changed(runs, total_mass_kg=mass), NOTHING)
    payload = runs["payload_kg"] + 3.0 * (runs["time_s"] > 1)
    Histories.check(changed(runs, payload_kg=payload, total_mass_kg=11.5 + payload), NOTHING)


def test_a_rig_may_turn_on_forward_while_it_is_driven_backward(runs):
    """Its inertia carries it through one stretch. Another shows that its speeds have a sign."""
    back = np.flatnonzero(runs["supply_voltage_V"] * (runs["mode"] == "voltage") < 0)
    speed = runs["motor_speed_rpm"].copy()
    assert len(back) > 20 and speed[back].min() < -0.5 * speed.max()
    speed[back[5:]] = np.abs(speed[back[5:]])
    Histories.check(changed(runs, motor_speed_rpm=speed), NOTHING)


@pytest.mark.slow
def test_constant_values_at_every_instant_are_those_of_a_constant_run():
    robot, g = paper_robots.nominal(), jnp.asarray(time_grid(np.arange(0.02, 0.3, 0.02)))
    one = Conditions(0, 24.0, 5.0, 2.0)
    many = Conditions(0, jnp.full(len(g), 24.0), 5.0, 2.0)
    a, b = (history_signals(robot, c, g) for c in (one, many))
    for name in ("current", "speed_motor", "speed"):
        assert_allclose(getattr(b, name), getattr(a, name), rtol=1e-12, atol=1e-15)


@pytest.mark.slow
def test_payload_that_changes_acts_from_its_sample_on(runs, robot):
    payload = runs["payload_kg"] + 6.0 * (runs["time_s"] >= 1.25)
    heavier = Histories.of(changed(runs, payload_kg=payload), robot)
    assert heavier.conditions.payload.shape == heavier.times.shape
    seen, before = (np.asarray(eqx.filter_jit(o)(robot).reading[:, 0]) for o in (heavier, Histories.of(runs, robot)))
    early = runs["time_s"] <= 1.25
    assert_allclose(seen[early], before[early], rtol=1e-9, atol=1e-12)
    assert np.abs(seen - before)[runs["time_s"] > 1.4].max() > 0.1  # [A]
