"""Loads on a shaft and imposed motor speed: against plain formulas, each other, and a pendulum's textbook."""

import dataclasses
import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from mmrjax.effects import BY_NAME
from mmrjax.fidelities.drive import drive_batch
from mmrjax.fidelities.histories import history_signals, time_grid
from mmrjax.fidelities.steady import steady_batch, steady_outputs
from mmrjax.model import balances, paper_robots, params
from mmrjax.model.conditions import Conditions
from mmrjax.model.rig import Instrument, Rig, RunStart, RunStarts
from mmrjax.model.robot import Configurations
from mmrjax.model.shaft import Shaft
from mmrjax.model.signals import STATUSES, Signals, State

DRIVE = {
    "gearbox.ratio": 16.0, "gearbox.efficiency_load": 0.8, "motor.torque_constant": 0.05, "motor.resistance": 3.0,
    "motor.friction_coulomb": 2e-3, "motor.friction_viscous": 1e-6, "motor.inertia": 2e-6, "motor.inductance": 1e-3,
}  # fmt: skip
SPEEDS = np.array([-300.0, -40.0, 25.0, 180.0])


def bench(rig=None, **load):
    shaft = Shaft(**{"inertia": 0.01, "loss_coulomb": 0.2, "loss_viscous": 0.01, **load})
    return params.replace(paper_robots.blank_robot(Configurations({"bench": shaft}), sides=2.0, rig=rig), DRIVE)


def current_of(w, load=0.0, coulomb=0.2, viscous=0.01):
    """Current [A] of one motor that turns at w [rad/s], from torque: an implementation of its own."""
    sign, out = np.sign(w), w / 16
    torque = coulomb * sign + viscous * out + load
    transmitted = torque / 16 / np.where(torque * sign > 0, 0.8, 1 / 0.8)
    return (transmitted + 2e-3 * sign + 1e-6 * w) / 0.05


@pytest.mark.parametrize("load", [0.0, 0.1, 0.5])
def test_current_at_an_imposed_speed_follows_from_torque(load):
    answer = steady_batch(bench(torque_constant=load), Conditions(motor_speed=SPEEDS))
    expected = current_of(SPEEDS, load)
    assert_allclose(answer.motor_current, expected, rtol=1e-9)
    assert_allclose(answer.total_current, 2 * expected, rtol=1e-9)
    assert_allclose(answer.motor_voltage, 0.05 * SPEEDS + 3.0 * expected, rtol=1e-9)
    assert_allclose(answer.output_speed, SPEEDS / 16, rtol=1e-12)
    assert [STATUSES[s] for s in np.asarray(answer.status)] == ["reverses"] * 2 + ["converged"] * 2


def test_a_load_that_drives_the_motor_loses_in_the_gearbox_the_other_way():
    """Lowering a winch of 1 N·m: the torque at the motor is the load's times the efficiency, less its friction."""
    answer = steady_batch(bench(torque_constant=1.0), Conditions(motor_speed=np.full(4, -100.0)))
    net = 1.0 - 0.2 - 0.01 * 100 / 16
    expected = (net / 16 * 0.8 - 2e-3 - 1e-6 * 100) / 0.05
    assert_allclose(answer.motor_current, expected, rtol=1e-9)


@pytest.mark.slow
def test_voltage_and_speed_impose_the_same_point():
    for robot, more in ((bench(), {}), (paper_robots.nominal(), {"slope_deg": 5.0, "payload": 3.0})):
        speeds = np.array([150.0, 300.0, 400.0, 500.0])  # four, here and elsewhere: one program
        by_speed = steady_batch(robot, Conditions(motor_speed=speeds, **more))
        by_voltage = steady_batch(robot, Conditions(voltage=np.asarray(by_speed.motor_voltage), **more))
        for name in by_speed.reading:
            a, b = by_speed.reading[name], by_voltage.reading[name]
            assert_allclose(a, b, rtol=1e-9, atol=1e-12, err_msg=name)


@pytest.mark.slow
def test_friction_holds_a_shaft_that_its_motors_cannot_turn():
    robot, conditions = bench(loss_coulomb=5.0), Conditions(voltage=np.array([1.0, -1.0, 0.5, -0.5]))
    run = drive_batch(robot, conditions, jnp.asarray([0.0, 0.5, 1.0])).result
    assert [STATUSES[s] for s in np.asarray(run.status)] == ["stalled"] * 4
    assert_array_equal(run.motor_speed, 0.0)
    assert_allclose(run.motor_current, [1 / 3, -1 / 3, 1 / 6, -1 / 6], rtol=1e-6)


def test_derivatives_at_an_imposed_speed_are_those_of_the_formula():
    robot = bench()
    names = ("bench.loss_coulomb", "bench.loss_viscous", "gearbox.efficiency_load", "motor.resistance")
    at = {p.name: p.value for p in params.walk_parameters(robot) if p.name in names}

    def current(values):
        return steady_outputs(params.replace(robot, values), Conditions(motor_speed=SPEEDS), ("motor_current",))

    found = jax.jit(jax.jacrev(current))(at)["motor_current"]
    sign, out = np.sign(SPEEDS), SPEEDS / 16
    assert_allclose(found["bench.loss_coulomb"], sign / (16 * 0.8 * 0.05), rtol=1e-9)
    assert_allclose(found["bench.loss_viscous"], out / (16 * 0.8 * 0.05), rtol=1e-9)
    torque = 0.2 * sign + 0.01 * out
    assert_allclose(found["gearbox.efficiency_load"], -torque / (16 * 0.8**2 * 0.05), rtol=1e-9)
    assert_array_equal(found["motor.resistance"], 0.0)


@pytest.mark.slow
def test_a_pendulum_swings_as_the_textbook_says():
    """Motors open, no friction: small swings with ω² = m g l / (J + i² J_d)."""
    load = {"inertia": 0.02, "loss_coulomb": 0.0, "loss_viscous": 0.0, "torque_gravity": 0.5}
    robot = bench(rig=Rig(begins=RunStarts({"begin": RunStart(angle=0.05)})), **load)
    robot = params.replace(
        robot,
        {"gearbox.efficiency_load": 1.0, "motor.friction_coulomb": 0.0, "motor.friction_viscous": 0.0},
    )
    times = time_grid(np.linspace(0, 2, 201))
    conditions = dataclasses.replace(Conditions(voltage=0.0, open=1.0), begin=jnp.asarray(0))
    angle = np.asarray(jax.jit(history_signals)(robot, conditions, jnp.asarray(times)).angle)
    omega = np.sqrt(0.5 / (0.02 + 16**2 * 2e-6))
    period = 2 * np.pi / omega * (1 + 0.05**2 / 16)
    assert_allclose(angle, 0.05 * np.cos(2 * np.pi / period * times), atol=5e-4)


def test_an_imposed_history_takes_the_torque_of_its_acceleration():
    """I = (M(ω) + (J / i² η + J_d) i ... α) / C by hand, at instants between which the speed is linear."""
    robot = bench()
    times = np.linspace(0, 1, 21)
    speed = 100 + 80 * times  # rad/s, so that power flows to the load throughout
    conditions = dataclasses.replace(
        Conditions(), motor_speed=jnp.asarray(speed), motor_acceleration=jnp.full(21, 80.0)
    )
    seen = jax.jit(history_signals)(robot, conditions, jnp.asarray(times))
    assert_allclose(seen.speed_motor, speed, rtol=1e-9)
    expected = current_of(speed) + (0.01 * 80 / 16 / (16 * 0.8) + 2e-6 * 80) / 0.05
    assert_allclose(seen.current, expected, rtol=1e-6)
    assert_allclose(np.asarray(seen.angle)[-1], (100 + 40) / 16, rtol=1e-6)


def test_an_instrument_without_sign_shows_magnitude():
    rig = Rig(instruments=(Instrument("total_current", signed=False),))
    signed, plain = (steady_batch(r, Conditions(motor_speed=SPEEDS)).total_current for r in (bench(), bench(rig)))
    assert_allclose(plain, np.abs(signed), rtol=1e-12)
    assert (signed < 0).any()


def test_loads_state_what_they_can_do(robot):
    """Each says of the other's what it has none of, so that nobody has to ask which it is."""
    shaft, vehicle = bench(torque_constant=0.3, torque_gravity=0.2, angle_zero=-np.pi / 2), robot
    load, chassis = shaft.configurations["bench"], vehicle.configurations["6T2A"]
    assert (
        not shaft.has_ground and vehicle.has_ground and balances.absent_balances(shaft) >= {"ground", "slip", "mass"}
    )
    assert load.mass == 0 and load.on_tracks == 0 and load.speed_grip == np.inf  # nothing slides
    assert chassis.torque_constant == chassis.torque_gravity == 0 and not chassis.has_two_bodies
    assert load.torque_weight(5.0, 0.1) == pytest.approx(0.5)  # whatever a vehicle's mass and slope
    assert chassis.torque_weight(5.0, 0.1) == pytest.approx(5.0 * 9.80665 * np.sin(0.1) * float(chassis.radius))
    assert vehicle.shows_travel and not bench(Rig(channels=("total_current",))).shows_travel


def test_an_effect_of_the_ground_adds_nothing_to_a_shaft():
    slipping = dataclasses.replace(bench(), effects=(dataclasses.replace(BY_NAME["load_slip"](), amplitude=0.1),))
    assert balances.effects_sum(slipping, Signals(), "slip") == 0.0


def test_a_gearbox_carries_the_torque_that_accelerates_the_load_without_effects_too():
    """Signatures of effects that depend on load left it out: of 4.7 sigma in a log, a score saw 1.4."""
    robot, state = bench(), State(6.0, 300.0, 300.0 / 16, 0.0)
    effect = dataclasses.replace(BY_NAME["gear_quadratic_loss"](), amplitude=jnp.asarray(0.0))
    both = [robot, dataclasses.replace(robot, effects=(effect,))]
    without, having = (balances.moving_signals(r, Conditions(voltage=24.0), state) for r in both)
    assert without.acceleration_wheel > 1.0
    assert_allclose(without.torque_carried, having.torque_carried, rtol=1e-9)


@pytest.mark.slow
def test_derivatives_of_an_imposed_history_are_differences():
    conditions = Conditions(voltage=0.0)
    times = jnp.linspace(0, 0.5, 11)
    speed = 60 * jnp.sin(8 * times)
    slope = jnp.concatenate([jnp.diff(speed) / jnp.diff(times), jnp.zeros(1)])
    conditions = dataclasses.replace(conditions, motor_speed=speed, motor_acceleration=slope)

    def current(x):
        return history_signals(params.replace(bench(), {"bench.inertia": x}), conditions, times).current

    slope = jax.jvp(current, (jnp.asarray(0.01),), (jnp.asarray(1.0),))[1]
    difference = (current(0.01 + 1e-6) - current(0.01 - 1e-6)) / 2e-6
    assert_allclose(slope, difference, rtol=1e-5, atol=1e-6)


@pytest.mark.slow
def test_the_beginning_of_a_history_has_derivatives():
    def speed(x):
        rig = Rig(begins=RunStarts({"begin": RunStart(motor_speed=x)}))
        conditions = dataclasses.replace(Conditions(voltage=6.0), begin=jnp.asarray(0))
        return history_signals(bench(rig=rig), conditions, jnp.asarray(time_grid(np.linspace(0, 0.2, 5)))).speed_motor

    both = jax.jit(lambda x: jax.jvp(speed, (x,), (1.0,)))
    slope = np.asarray(both(50.0)[1])
    difference = np.asarray(both(50.0 + 1e-3)[0] - both(50.0 - 1e-3)[0]) / 2e-3
    assert slope[0] == 1.0 and abs(slope[-1]) > 1e-3
    assert_allclose(slope, difference, rtol=1e-4, atol=1e-6)


def test_power_of_a_shaft_adds_up():
    """What the motors give goes into friction, the load's torque and the gearbox, instant by instant."""
    robot = bench(torque_constant=0.3)
    moving = jax.jit(lambda state: balances.moving_signals(robot, Conditions(voltage=12.0), state))
    for speed, current in itertools.product((120.0, -120.0), (1.0, -0.5)):
        s = moving(State(current, speed, speed / 16, 0.0))
        given = float(s.torque_motor * s.speed_motor)
        stored = float(2e-6 * s.speed_motor * s.acceleration_wheel * 16 + 0.01 * s.speed_wheel * s.acceleration_wheel)
        taken = float((s.torque_track_loss + 0.3) * s.speed_wheel)
        assert given - stored - taken > -1e-9  # the gearbox never adds power
