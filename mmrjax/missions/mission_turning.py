"""A mission of a robot with independently driven sides, the counterpart of `mission_straight`.

A demanded speed and yaw rate give the speed of each side, V_s = v - ω y_s, which its own controller follows. Equal
sides give a mission of straight travel.
"""

from __future__ import annotations

import functools
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array

from mmrjax.compile.compiling import compiled
from mmrjax.fidelities.rest import smallest_of
from mmrjax.missions import mission_straight
from mmrjax.missions.mission_steps import SegmentInputs
from mmrjax.missions.profile import SPEED, VOLTAGE, Profile
from mmrjax.model import balances, channels, energy
from mmrjax.model.conditions import Conditions
from mmrjax.model.params import Scalar, Scalars
from mmrjax.model.robot import Robot
from mmrjax.model.signals import PlaneMotion, Signals
from mmrjax.numerics import rosenbrock
from mmrjax.numerics.rosenbrock import Unknowns
from mmrjax.turning import circling
from mmrjax.turning.two_sides import SIDES, sum_of_sides

#: Units of the unknowns. Of each side: current, motor speed, temperatures of winding and housing, integral of the
#: controller. Of the robot: speed, lateral speed, yaw rate, heading, discharge, time in the segment. The memories of
#: effects of each side follow.
_SIDE_UNITS = tuple(mission_straight.UNITS[k] for k in (
    mission_straight.CURRENT, mission_straight.MOTOR, mission_straight.WINDING, mission_straight.HOUSING,
    mission_straight.INTEGRAL,
))  # fmt: skip
UNITS = (
    *(unit for unit in _SIDE_UNITS for _ in SIDES),
    1.0,
    1.0,
    1.0,
    1.0,
    mission_straight.UNITS[mission_straight.DISCHARGE],
    1.0,
)
CURRENT, MOTOR, WINDING, HOUSING, INTEGRAL = (slice(2 * k, 2 * k + 2) for k in range(len(_SIDE_UNITS)))
GROUND, LATERAL, YAW, HEADING, DISCHARGE, CLOCK = range(2 * len(_SIDE_UNITS), len(UNITS))

STOPS = (MOTOR, GROUND, LATERAL, YAW)
LONG, AT_REST, RESULT = True, circling, circling.result_of_turn

#: Integrated quantities: name, and unit of a total; of current and torque the mean over both sides.
OF_SIDES = tuple(f"current_squared_{side}" for side in channels.SIDES)
TOTALS: dict[str, str] = {
    **mission_straight.TOTALS, "place_x": "m", "place_y": "m", "turned": "rad", **dict.fromkeys(OF_SIDES, "A²·s"),
}  # fmt: skip

#: Largest values of a mission over all instants: of each side, and of one motor of each.
PEAKS: dict[str, str] = {
    **mission_straight.PEAKS,
    "yaw_rate": "rad/s", "current_left": "A", "current_right": "A", "temperature_left": "°C",
    "temperature_right": "°C",
}  # fmt: skip


class TurningInstant(balances.Travel):
    """One instant of a turning robot: signals of both sides, and its motion."""

    motion: PlaneMotion


def units(robot: Robot) -> Unknowns:
    return jnp.asarray((*UNITS, *(size for e in robot.remembering for size in (e.memory_size or 1.0,) * 2)))


def state_of(robot: Robot, y: Unknowns, stands: Array) -> PlaneMotion:
    x = y * units(robot).astype(y.dtype)
    memory = {e.name: x[len(UNITS) + 2 * k :][:2] for k, e in enumerate(robot.remembering)}
    motor, ahead, aside, yaw = (jnp.where(stands, 0.0, x[k]) for k in (MOTOR, GROUND, LATERAL, YAW))
    zero = jnp.zeros_like(ahead)
    return PlaneMotion(x[CURRENT], motor, ahead, aside, yaw, x[HEADING], zero, zero, x[DISCHARGE], memory, x[WINDING])


def demanded(robot: Robot, otherwise: Conditions, segment: Profile) -> Array:
    """Demanded speed of each side in each row [rad/s or m/s], shape (rows, 2)."""
    demand = jnp.stack([segment.demand, segment.demand], -1)
    if segment.yaw_rate is None:
        return demand
    y = SIDES * robot.chassis(otherwise.configuration).turning.width
    yaw_rate = jnp.where(segment.mode == SPEED, segment.yaw_rate, 0.0)
    return demand - yaw_rate[..., None] * y


def inputs_at(robot: Robot, otherwise: Conditions, segment: Profile, y: Array, stands: Array) -> SegmentInputs:
    row = segment.at(y[CLOCK])
    robot = mission_straight.with_consumers(robot, row)
    conditions = row.conditions(otherwise)
    motion = state_of(robot, y, stands)
    side_conditions = conditions.of_sides()
    state = balances.states_of_sides(robot, conditions, motion)
    if row.voltage_left is not None and row.voltage_right is not None:
        voltages = jnp.stack([row.voltage_left, row.voltage_right])
        share = (
            side_conditions.polarity
            * voltages
            / jnp.maximum(mission_straight.source_voltage(robot, side_conditions, state.discharge), 1e-3)
        )
        side_conditions = replace(side_conditions, duty=jnp.where(row.mode == VOLTAGE, share, side_conditions.duty))
    demand = demanded(robot, conditions, row)
    controlled_duty = jax.vmap(functools.partial(mission_straight.controlled_duty, robot, row.mode))
    duty, rate, error = controlled_duty(demand, side_conditions, state, y[INTEGRAL] * _SIDE_UNITS[-1])
    return SegmentInputs(robot, replace(conditions, duty_left=duty[0], duty_right=duty[1]), rate, error)


@compiled
def instant(
    robot: Robot, otherwise: Conditions, segment: Profile, y: Array, stands: Array
) -> tuple[TurningInstant, Array, Array, SegmentInputs]:
    """Signals and motion, rates of the unknowns in their units and of the totals [1/s], and inputs of an instant."""
    inputs = inputs_at(robot, otherwise, segment, y, stands)
    motion = state_of(robot, y, stands)
    travel = balances.turning_signals(inputs.robot, inputs.conditions, motion)
    signals = travel.signals
    winding, housing = (y[k] * _SIDE_UNITS[2] for k in (WINDING, HOUSING))
    winding_loss = robot.motor.voltage_winding(signals.current, winding) * signals.current
    winding_loss = winding_loss * robot.driver.ripple(signals.duty)
    motion_factor = jnp.where(stands, 0.0, 1.0)
    rates = [
        signals.voltage_left / signals.inductance,
        motion_factor * signals.acceleration_wheel * robot.gearbox.ratio,
        *robot.heating(winding_loss, winding, housing),
        inputs.integral_rate,
        motion_factor * travel.acceleration,
        motion_factor * travel.acceleration_lateral,
        motion_factor * travel.acceleration_yaw,
        motion.yaw_rate,
        balances.charge_drawn(inputs.robot, inputs.conditions, signals.total_current[0]),
        1.0,
        *(jax.vmap(lambda s, effect=effect: effect.rate(robot, s))(signals) for effect in robot.remembering),
    ]
    source_power = jnp.mean(energy.source_power(inputs.robot, inputs.conditions, signals))
    current_squared, torque_squared = (x**2 for x in (signals.current, signals.torque_gear))
    sinks = energy.sink_powers_turning(inputs.robot, inputs.conditions, travel)
    cos, sin = jnp.cos(motion.heading), jnp.sin(motion.heading)
    totals = [
        motion.speed, _ground_speed(motion), jnp.maximum(source_power, 0.0), jnp.maximum(-source_power, 0.0),
        robot.sides**2 * sum_of_sides(current_squared) / 2, sum_of_sides(torque_squared) / 2,
        *(sinks[name] for name in energy.SINKS),
        motion.speed * cos - motion.speed_lateral * sin, motion.speed * sin + motion.speed_lateral * cos,
        motion.yaw_rate, *current_squared,
    ]  # fmt: skip
    return (
        TurningInstant(**vars(travel), motion=motion),
        jnp.concatenate([jnp.atleast_1d(jnp.asarray(r, y.dtype)) for r in rates]) / units(robot).astype(y.dtype),
        jnp.stack([jnp.asarray(x, y.dtype) for x in totals]),
        inputs,
    )


def _ground_speed(motion: PlaneMotion) -> Scalar:
    """Speed of the robot over the ground [m/s], with a derivative at rest."""
    square = motion.speed**2 + motion.speed_lateral**2
    return jnp.where(square > 0, jnp.sqrt(jnp.where(square > 0, square, 1.0)), 0.0)


def slowness(inputs: SegmentInputs, y: Array, stands: Array) -> tuple[Scalar, Scalar]:
    robot, conditions = inputs.robot, inputs.conditions
    load = robot.chassis(conditions.configuration)
    motion = state_of(robot, y, stands)
    rolling_speeds = load.radius * motion.speed_motor / robot.gearbox.ratio
    sliding_speeds = jnp.abs(rolling_speeds - balances.states_of_sides(robot, conditions, motion).speed)
    lateral_speed = jnp.abs(motion.speed_lateral) + jnp.abs(motion.yaw_rate) * robot.running_gear.wheelbase / 2
    shaft_slowness, grip_slowness = (
        1 - jnp.abs(rolling_speeds) / load.speed_still,
        1 - sliding_speeds / load.speed_grip,
    )
    return smallest_of(*shaft_slowness), smallest_of(*grip_slowness, 1 - lateral_speed / load.speed_grip)


def supply_current_and_charge(inputs: SegmentInputs, y: Array, stands: Array) -> tuple[Scalar, Scalar]:
    robot = inputs.robot
    motion = state_of(inputs.robot, y, stands)
    duty = robot.driver.duty_limited(balances.bridge_duty(robot, inputs.conditions.of_sides()), motion.current)
    return robot.sides * sum_of_sides(motion.current * robot.driver.share_drawn(duty)) / 2, motion.discharge


def stored(robot: Robot, travel: TurningInstant) -> Scalar:
    return energy.stored_energy_turning(robot, travel, travel.motion)


def peaks(robot: Robot, travel: TurningInstant) -> Scalars:
    peaks_of_sides = jax.vmap(lambda s: mission_straight.peaks(robot, s))(travel.signals)
    largest: Scalars = {name: jnp.max(x) for name, x in peaks_of_sides.items()}
    largest |= {
        "current": sum_of_sides(jnp.asarray(peaks_of_sides["current"])) / 2,
        "speed": _ground_speed(travel.motion),
    }
    return {**largest, "yaw_rate": jnp.abs(travel.motion.yaw_rate), **_peaks_of_sides(robot, peaks_of_sides)}


def peaks_within(robot: Robot, y: Array, tops: Array) -> Scalars:
    current = robot.sides * jnp.minimum(_SIDE_UNITS[0] * tops[CURRENT], robot.driver.current_limit)
    temperature = jnp.where(y[WINDING] > 0, _SIDE_UNITS[2] * tops[WINDING], -jnp.inf)
    of_sides = _peaks_of_sides(robot, {"current": current, "temperature": temperature})
    return {"current": sum_of_sides(current) / 2, "temperature": jnp.max(temperature), **of_sides}


def _peaks_of_sides(robot: Robot, peaks: dict[str, Any]) -> Scalars:
    """Peaks of one motor of each side."""
    current = peaks["current"] / robot.sides
    quantities = (("current", current), ("temperature", peaks["temperature"]))
    return {f"{name}_{side}": x[k] for name, x in quantities for k, side in enumerate(channels.SIDES)}


def exceeded(robot: Robot, travel: TurningInstant) -> Scalars:
    exceeded_by_side = jax.vmap(lambda s: mission_straight.exceeded(robot, s))(travel.signals)
    return {name: jnp.any(x) for name, x in exceeded_by_side.items()}


def limited(robot: Robot, y: Array) -> Array:
    return robot.driver.limits(_SIDE_UNITS[0] * y[CURRENT])


norm = functools.partial(
    rosenbrock.error_norm_of_sides, of_robot=slice(GROUND, CLOCK + 1), count=len(mission_straight.UNITS)
)


def status(robot: Robot, conditions: Conditions, travel: TurningInstant) -> Array:
    return circling.status_after_run(robot, conditions, travel, travel.motion)


def at_places(signals: Signals, so_far: dict[str, jax.Array]) -> Signals:
    """Signals over time, with the position of the robot."""
    x, y = (jnp.stack([so_far[name]] * 2, -1) for name in ("place_x", "place_y"))
    return replace(signals, place_x=x, place_y=y)
