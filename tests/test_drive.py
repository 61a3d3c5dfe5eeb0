"""Fidelity `drive` against SciPy on the reference ODE, its end on `steady`, its statuses."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.random import default_rng
from numpy.testing import assert_allclose, assert_array_equal
from worlds import paper

from mmrjax.effects.voltage_effects import ThermalDrift
from mmrjax.fidelities.base import movers_slip
from mmrjax.fidelities.drive import _status_of_run, drive, drive_batch
from mmrjax.fidelities.steady import steady, steady_batch
from mmrjax.model import params
from mmrjax.model.balances import moving_signals
from mmrjax.model.conditions import Conditions
from mmrjax.model.signals import CONVERGED, STATUSES, State

STATES = ("current", "speed_motor", "speed", "discharge")


def names(answer):
    return [STATUSES[k] for k in np.ravel(answer.status)]


# --- against the reference --------------------------------------------------------------------------


def test_rates_match_reference_at_random_states(robot, grid):
    """Backwards, braking, spinning, at rest, on battery: the ODE itself to 1e-9 of its largest terms."""
    rng = default_rng(2)
    n = 400
    rows = grid[rng.integers(0, len(grid), n)]
    states = rng.uniform((-8, -1300, -1.3, 0), (50, 1300, 1.3, 7000), (n, 4)) * rng.choice([0, 1e-3, 1], (n, 1))
    on_battery = rng.integers(0, 2, n)
    slopes = np.radians(rows[:, 1]) * rng.choice([-1, 1], n)
    runs = Conditions(
        voltage=rows[:, 3],
        slope_deg=np.degrees(slopes),
        payload=rows[:, 2],
        configuration=rows[:, 0],
        battery=on_battery,
    )
    moving = jax.jit(jax.vmap(moving_signals, in_axes=(None, 0, 0)))
    s = moving(robot, runs, State(*jnp.asarray(states.T), distance=jnp.zeros(n)))
    inductance, ratio = 0.000119, 48.0
    for k in range(n):
        side = paper.Side(rows[k, 3], slopes[k], rows[k, 2], bool(rows[k, 0]), bool(on_battery[k]))
        current, w, speed, charge = states[k]
        expected = side.rates(0.0, [current, w, speed, 0.0, charge])
        volts = abs(float(s.voltage[k])) + abs(0.611 * current) + abs(0.0259 * w)
        assert_allclose(s.voltage_left[k] / inductance, expected[0], atol=1e-9 * volts / inductance)
        assert_allclose(s.acceleration_wheel[k] * ratio, expected[1], rtol=1e-9, atol=1e-7)
        assert_allclose(s.acceleration[k], expected[2], rtol=1e-9, atol=1e-9)
    assert_allclose(s.total_current, 2 * states[:, 0], rtol=1e-15)


ROWS = (0, 5, 38, 89, 92, 107, 145, 161)  # both configurations, all slopes, slipping starts, sliding
INSTANTS = np.concatenate([[0.0], np.geomspace(1e-4, 2.0, 40)])


@pytest.fixture(scope="module")
def expected_runs(grid):
    runs = [paper.Side(v, np.radians(s), p, bool(w)).drive(INSTANTS) for w, s, p, v in grid[list(ROWS)]]
    runs.append(paper.Side(0.0, 0.05, 2.0, battery=True, discharge=1000.0).drive(INSTANTS))
    return np.stack(runs)


@pytest.mark.slow
@pytest.mark.parametrize("tolerance, error", [(1e-6, 2e-6), pytest.param(1e-9, 5e-9, marks=pytest.mark.slow)])
def test_drive_matches_solve_ivp(robot, grid, expected_runs, tolerance, error):
    """To `error` of each state's largest value in the run, at every instant. SciPy's Radau at 1e-10."""
    w, s, p, v = grid[list(ROWS)].T
    runs = Conditions(
        voltage=np.append(v, 0.0),
        slope_deg=np.degrees(np.append(np.radians(s), 0.05)),
        payload=np.append(p, 2.0),
        configuration=np.append(w, 0.0),
        battery=np.append(0 * w, 1.0),
        discharge=np.append(0 * w, 1000.0),
    )
    answer = drive_batch(robot, runs, jnp.asarray(INSTANTS), tolerance)
    got = [getattr(answer.signals, name) for name in STATES]
    got = np.stack([*got[:3], answer.distance, got[3]], -1)
    scale = np.abs(expected_runs).max(1, keepdims=True) + 1e-300
    assert (np.abs(got - expected_runs) / scale).max() < error


# --- the end of a run -------------------------------------------------------------------------------


def check_settled(run, point, where):
    for channel in ("total_current", "motor_speed", "speed"):
        end, root = run.result.reading[channel], point.reading[channel]
        assert_allclose(np.asarray(end)[where], np.asarray(root)[where], rtol=1e-3, err_msg=channel)


@pytest.mark.slow
def test_drive_settles_on_steady_over_table8(robot, table8, drive_table8, steady_table8, times_fine):
    """Within 2 s wherever it grips. The rest of what `steady` can hold after 60 s.

    A run that breaks away by spinning its movers is pushed by μ_d only, and what that leaves over the
    demand can be little: 0.001-0.02 of the weight on 10 degrees (6T2A) and 15 degrees (4W2T).
    """
    status, point = np.asarray(drive_table8.result.status), np.asarray(steady_table8.status)
    both = (status == CONVERGED) & (point == CONVERGED)
    assert both.sum() == 96
    check_settled(drive_table8, steady_table8, both)
    assert set(np.asarray(names(drive_table8.result))[(point == CONVERGED) & ~both]) == {"not_settled"}
    assert set(np.asarray(names(drive_table8.result))[point != CONVERGED]) == {"slides"}

    longer = drive_batch(robot, table8, times_fine * 30)
    status = np.asarray(longer.result.status)
    assert ((status == CONVERGED) == (point == CONVERGED)).all()
    check_settled(longer, steady_table8, point == CONVERGED)


@pytest.mark.slow
def test_drive_that_breaks_away_between_static_and_dynamic_friction_never_regains_grip(small):
    """6T2A on 12 degrees needs μ = 0.27, between μ_d = 0.256 and μ_s = 0.32: `steady` travels, `drive` spins.

    Both are right: the operating point exists and is stable, but a start at full voltage throws it away.
    The same run on a surface that holds 5 % more than it needs even when sliding regains its grip.
    """
    need = np.tan(np.radians(12.0)) + 0.06
    grip = 1.05 * need / (0.8 * 0.32)
    slope = np.radians(12.0)
    robot, go = small
    runs = Conditions(
        voltage=24.0, slope_deg=np.degrees(slope), adhesion=[1.0, grip, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0]
    )
    run, point = go(runs, 60.0), steady_batch(robot, runs)
    assert names(point)[:2] == ["converged", "converged"]
    assert names(run.result)[:2] == ["slides", "converged"]
    check_settled(run, point, [1])


@pytest.mark.nightly
def test_drive_that_starts_rolling_stays_at_the_operating_point(robot):
    """Also on the slope where a start from standstill slides. Above the limit it slides all the same."""
    runs = Conditions(voltage=[24.0, 24.0, 24.0], slope_deg=[5.0, 12.0, 20.0], configuration=[1.0, 0.0, 0.0])
    go = jax.jit(lambda r: jax.vmap(lambda c: drive(r, c, jnp.asarray([0.0, 4.0]), rolling=True).result)(runs))
    models = go, lambda r: steady_batch(r, runs)
    answer, point = (model(robot) for model in models)
    assert names(answer) == names(point) == ["converged", "converged", "slides"]
    for name in ("total_current", "motor_speed", "speed"):
        assert_allclose(answer.reading[name][:2], point.reading[name][:2], rtol=1e-6)

    def slope(model):
        def speed(static):
            return model(params.replace(robot, {"6T2A.ground.friction.static": static})).reading["speed"][1]

        return jax.jvp(speed, (jnp.asarray(0.32),), (jnp.ones(()),))[1]

    rolling, settled = map(slope, models)
    assert settled > 0.01
    assert_allclose(rolling, settled, rtol=1e-4)


@pytest.mark.slow
def test_drive_that_starts_rolling_remembers_as_if_it_had_long_been(robot):
    warm = replace(robot, effects=(ThermalDrift(amplitude=jnp.asarray(1.0)),))
    run = Conditions(voltage=24.0, slope_deg=np.degrees(0.1))
    answer = jax.jit(lambda r: drive(r, run, jnp.asarray([0.0, 1.0]), rolling=True))(warm)
    here, point, bare = (x.reading["motor_speed"] for x in (answer.result, steady(warm, run), steady(robot, run)))
    assert abs(point / bare - 1) > 1e-4
    assert_allclose(here, point, rtol=1e-6)
    memory = answer.signals.memory["thermal_drift"]
    assert_allclose(memory[1], memory[0], rtol=1e-6)


# --- statuses, flags, battery -----------------------------------------------------------------------


@pytest.fixture(scope="module")
def small(robot):
    """Nine runs at once to a given time, so that every small case shares one compilation, that of `ROWS` too."""

    def go(runs, end, other=None):
        return drive_batch(other or robot, runs, jnp.linspace(0.0, end, len(INSTANTS)), 1e-6)

    return robot, go


@pytest.mark.parametrize(
    "gain, sliding, status",
    [
        (0.0, 0.03, "converged"),
        (-0.1, 0.03, "slides"),
        (0.1, 0.03, "not_settled"),
        (0.0, 0.01, "converged"),
        # gaining 0.5 % of its speed in a second: settled if it gripped
        (0.0035, 0.01, "converged"),
        (0.0035, 0.03, "not_settled"),
        (-0.0035, 0.03, "slides"),
        (0.0005, 0.03, "converged"),
    ],
)
def test_status_follows_from_what_the_robot_does(robot, gain, sliding, status):
    """One that slips beyond V_s on average and holds its speed has settled, with a flag that it slips."""
    run = Conditions()
    end = moving_signals(robot, run, State(1.0, 900.0, 0.7, 0.0))
    end = replace(end, speed_sliding=jnp.asarray(sliding), acceleration=jnp.asarray(gain))
    assert STATUSES[int(_status_of_run(robot, run, end, jnp.asarray(False), jnp.asarray(True)))] == status
    assert bool(movers_slip(robot, end)) is (sliding > 0.02)


@pytest.mark.slow
def test_a_robot_that_stands_ends_as_steady_says(small):
    """Parked, held on slopes either way, and stalled."""
    robot, go = small
    volts = [0.0, 0.0, 0.0, 0.0, 0.5, 0.5, -0.02, 0.3, -0.3]
    slope, payload = [0.0, 5.0, -5.0, 8.0, 5.0, 17.0, 10.0, -2.0, 0.0], [0.0, 60.0, 60.0, 60.0, 0, 0, 0, 0, 0]
    runs = Conditions(np.zeros(9), volts, slope, payload, battery=np.zeros(9), discharge=np.zeros(9))
    driven, still = go(runs, 0.05).result, steady_batch(robot, runs)
    assert names(driven) == names(still) == ["stalled"] * 9
    for name in ("traction", "adhesion_used", "output_torque", "total_current", "power_supply", "winding_settled"):
        assert_allclose(getattr(driven, name), getattr(still, name), rtol=1e-6, atol=1e-9, err_msg=name)


@pytest.mark.slow
def test_drive_out_of_steps_has_failed(robot):
    run = drive_batch(robot, Conditions(voltage=[24.0]), jnp.linspace(0.0, 1.0, 3), 1e-6, 5)
    assert names(run.result) == ["failed"]


# --- batches ----------------------------------------------------------------------------------------


@pytest.mark.slow
def test_drive_batch_equals_loop(robot, table8, drive_table8, times_fine):
    single = jax.jit(drive)
    for k in (0, 64, 131, 179):
        alone = single(robot, jax.tree.map(lambda x, k=k: x[k], table8), times_fine)
        for name in STATES[:3]:
            a, b = np.asarray(getattr(alone.signals, name)), np.asarray(getattr(drive_table8.signals, name)[k])
            assert_allclose(a, b, atol=1e-7 * np.abs(b).max())  # step sizes may differ in the last bit
        assert int(alone.result.status) == int(drive_table8.result.status[k])


def test_drive_compiles_once_for_other_numbers(robot, small, compilations):
    _, go = small
    runs = Conditions(voltage=np.linspace(10, 30, 9))
    jax.block_until_ready(go(runs, 1.0))
    other = params.replace(robot, {"motor.resistance": 0.9, "6T2A.mass": 14})
    runs, later = (
        Conditions(voltage=np.linspace(12, 33, 9), slope_deg=np.degrees(0.02)),
        jnp.linspace(0.0, 1.5, len(INSTANTS)),
    )
    compilations.clear()
    jax.block_until_ready(drive_batch(other, runs, later, 1e-6))
    assert not compilations


def test_drive_bad_members_leave_neighbours_alone(small):
    _, go = small
    clean = dict(voltage=np.full(9, 24.0), slope_deg=np.degrees(np.linspace(0, 0.1, 9)), payload=np.zeros(9))
    bad = {k: v.copy() for k, v in clean.items()}
    bad["voltage"][[1, 3]] = [np.nan, 0.0]
    bad["slope_deg"][5] = np.degrees(0.6)
    bad["payload"][7] = np.nan
    mixed, alone = go(Conditions(**bad), 1.0), go(Conditions(**clean), 1.0)
    assert names(mixed.result)[1] == names(mixed.result)[7] == "failed"
    jax.tree.map(lambda a, b: assert_array_equal(a[::2], b[::2]), mixed.signals, alone.signals)
