"""Runs through rest, backlash and a current limit beside SciPy's integration with events of its own."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from worlds.events import STEEP, Bench, through

from calibration.data import runs
from calibration.inference.preparation import prepare_input
from mmrjax.fidelities.drive import drive_batch
from mmrjax.fidelities.histories import CHANGE, history_signals, time_grid
from mmrjax.model import paper_robots, params
from mmrjax.model.conditions import Conditions
from mmrjax.model.rig import Rig
from mmrjax.model.robot import Configurations
from mmrjax.model.shaft import Shaft
from sweeps.points.run import simulate_histories

#: Forward, braked to rest, held by friction, back from rest, and forward through rest [V].
VOLTS, CHANGES = np.array([6.0, 0.0, 1.0, -6.0, 6.0]), np.array([0.0, 0.4, 0.6, 0.8, 1.1])
SAMPLES = np.linspace(0, 1.5, 151)
#: Fields of a bench, and the parameters that they are.
NAMES = {
    "resistance": "motor.resistance", "inductance": "motor.inductance", "torque_constant": "motor.torque_constant",
    "inertia_motor": "motor.inertia", "friction_motor": "motor.friction_coulomb", "ratio": "gearbox.ratio",
    "efficiency": "gearbox.efficiency_load", "inertia": "bench.inertia", "loss_coulomb": "bench.loss_coulomb",
    "loss_viscous": "bench.loss_viscous", "current_limit": "driver.current_limit", "backlash": "bench.backlash",
}  # fmt: skip
#: Of derivatives: one of each balance.
MOVED = ("resistance", "inertia", "loss_coulomb", "current_limit")
BENCHES = {"rest": Bench(), "limit": Bench(current_limit=1.2), "backlash": Bench(backlash=0.05)}
SHARE = 1e-3


def robot_of(bench):
    loose = bench.backlash > 0
    shaft = Shaft(inertia=1.0, loss_coulomb=1.0, backlash=float(loose))
    robot = paper_robots.blank_robot(Configurations({"bench": shaft}), rig=Rig(loose=loose))
    return params.replace(robot, {p: getattr(bench, f) for f, p in NAMES.items() if loose or f != "backlash"})


@pytest.fixture(scope="module")
def simulated():
    """Signals of a bench without a backlash at the samples, and derivatives of current [A] and motor speed [rad/s] by
    shares of its parameters `MOVED`. One program serves all."""
    times = time_grid(SAMPLES, CHANGES[1:], start=CHANGE)
    run = Conditions(voltage=VOLTS[np.searchsorted(CHANGES, times, side="right") - 1])
    at = np.searchsorted(times, SAMPLES)

    def of(shares, robot, values):
        moved = dict(zip((NAMES[f] for f in MOVED), values * shares, strict=True))
        signals = history_signals(params.replace(robot, moved), run, jnp.asarray(times), indices=at)
        return jnp.stack([signals.current, signals.speed_motor], -1), signals

    program = jax.jit(jax.jacfwd(of, has_aux=True))

    def found(bench):
        values = jnp.asarray([getattr(bench, f) for f in MOVED])
        return program(jnp.ones(len(MOVED)), params.without_weak_types(robot_of(bench)), values)

    return found


def expected(bench, shares=None):
    shares = np.ones(len(MOVED)) if shares is None else shares
    moved = {f: getattr(bench, f) * share for f, share in zip(MOVED, shares, strict=True)}
    return through(dataclasses.replace(bench, **moved), VOLTS, CHANGES, SAMPLES)


#: Largest errors of readings, in sds of 1 % of the largest, and of derivatives, over the largest, away from an event and
#: within a sample after one. The current lags by 0.33 ms; a step is 2.5 ms.
ALLOWED = {"rest": ((0.03, 0.005), (0.05, 0.02)), "limit": ((0.04, 0.01), (0.05, 0.15))}


@pytest.mark.parametrize("name", list(ALLOWED))
def test_histories_through_rest_and_a_current_limit_are_those_of_scipy(simulated, name):
    bench = BENCHES[name]
    slopes, signals = simulated(bench)
    shown, slopes = np.stack([signals.current, signals.speed_motor], -1), np.asarray(slopes)
    exact, happened = expected(bench)
    words, near = list(happened.values()), np.zeros(len(SAMPLES), bool)
    assert words.count("rest") == words.count("start") == 2 and ("limit" in words) is (name == "limit")
    for at in happened:
        near |= (at <= SAMPLES) & (at + SAMPLES[1] > SAMPLES)
    away_by, near_by = ALLOWED[name]
    off = np.abs(shown - exact) / (0.01 * np.abs(exact).max(0))
    assert off[~near].max() < away_by[0] and off[near].max() < near_by[0]
    for k, moved in enumerate(MOVED[: 3 if name == "rest" else 4]):
        step = SHARE * np.eye(len(MOVED))[k]
        slope = (expected(bench, 1 + step)[0] - expected(bench, 1 - step)[0]) / (2 * SHARE)
        error = np.abs(slopes[..., k] - slope) / np.abs(slope).max(0)
        assert error[~near].max() < away_by[1] and error[near].max() < near_by[1], moved


def test_a_load_that_friction_holds_stands(simulated):
    """In the third stretch 1 V does not overcome friction: nothing moves, and all is in equilibrium."""
    bench = BENCHES["rest"]
    found, held = simulated(bench)[1], (SAMPLES > 0.7) & (SAMPLES < 0.8)
    for still in (found.speed_motor, found.speed, found.acceleration, found.torque_net):
        assert_array_equal(np.asarray(still)[held], 0.0)
    torque = np.asarray(found.torque_output)[held]
    assert (torque > 0).all() and (torque <= bench.loss_coulomb).all()
    assert_allclose(np.asarray(found.current)[held], 1 / bench.resistance, rtol=1e-9)


def test_compare_follows_reversals_within_a_thousandth_of_scipys_rms():
    """The steps of a fit would be off by 0.5 % of the second bench's current."""
    every, volts, changes = np.arange(0, 2, 0.01), np.array([12.0, -12.0, 12.0, -12.0]), np.arange(0, 2, 0.5)
    imposed = volts[np.searchsorted(changes, every + 1e-9, side="right") - 1]
    for bench in (Bench(), Bench(inductance=1e-4, inertia=0.002), Bench(current_limit=2.0)):
        (current, motor), robot = through(bench, volts, changes, every)[0].T, robot_of(bench)
        over = np.maximum(np.abs(current) / bench.current_limit - 1, 0) * np.sign(current * imposed)
        exact = {"total_current_A": current * (1 - STEEP * over), "motor_speed_rpm": motor * 30 / np.pi}
        log = runs.read_runs({"time_s": every, "supply_voltage_V": imposed, **exact}, robot=robot)
        shown = simulate_histories(prepare_input(log, robot).robot, log, None)
        for column, readings in exact.items():
            assert np.abs(shown[column] - readings).max() < 1e-3 * np.sqrt(np.mean(readings**2)), (bench, column)


@pytest.mark.slow
def test_drive_through_a_backlash_is_that_of_scipy():
    bench, times = BENCHES["backlash"], SAMPLES[:40]
    signals = drive_batch(robot_of(bench), Conditions(voltage=VOLTS[:1]), jnp.asarray(times)).signals
    exact, happened = through(bench, VOLTS[:1], CHANGES[:1], times)
    assert list(happened.values()).count("flank") >= 1
    shown = np.stack([signals.current[0], signals.speed_motor[0]], -1)
    assert (np.abs(shown - exact).max(0) < 1e-3 * 0.01 * np.abs(exact).max(0)).all()
