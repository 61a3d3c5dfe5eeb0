"""A mission in straight travel with equal sides: its unknowns, inputs, rates and integrals, a `MotionLaw`."""

from __future__ import annotations

import functools
from dataclasses import replace

import jax
import jax.numpy as jnp
from jaxtyping import Array

from mmrjax.compile.compiling import compiled
from mmrjax.fidelities import base, rest
from mmrjax.missions.mission_steps import SegmentInputs
from mmrjax.missions.profile import MOTOR_SPEED, SPEED, Profile
from mmrjax.model import balances, energy
from mmrjax.model.conditions import Conditions
from mmrjax.model.params import Scalar, Scalars
from mmrjax.model.robot import Robot
from mmrjax.model.signals import Signals, State
from mmrjax.numerics import rosenbrock
from mmrjax.numerics.elementary import clip
from mmrjax.numerics.rosenbrock import Unknowns

#: Units that scale the unknowns to the order of one: current, motor speed, speed, discharge, temperatures of winding
#: and housing, integral of the controller, time in the segment. The memories of effects follow.
UNITS = (10.0, 1000.0, 1.0, 100.0, 50.0, 50.0, 10.0, 1.0)
CURRENT, MOTOR, GROUND, DISCHARGE, WINDING, HOUSING, INTEGRAL, CLOCK = range(len(UNITS))

#: Unknowns that are 0 at rest; position of the heading: none.
STOPS, HEADING = (MOTOR, GROUND), slice(0)
LONG, AT_REST, RESULT = False, rest, base.result_of_signals

#: Integrated quantities: name, and unit of a total.
TOTALS: dict[str, str] = {
    "distance": "m", "path": "m", "drawn": "J", "returned": "J", "current_squared": "A²·s",
    "torque_squared": "N²·m²·s", **dict.fromkeys(energy.SINKS, "J"),
}  # fmt: skip

#: Largest values of a mission over all instants: name, and unit.
PEAKS: dict[str, str] = {
    "current": "A", "torque": "N·m", "temperature": "°C", "motor_speed": "rad/s", "speed": "m/s", "cell_low": "V",
}  # fmt: skip


def units(robot: Robot) -> Unknowns:
    """Units of the unknowns."""
    return jnp.asarray(UNITS + tuple(effect.memory_size or 1.0 for effect in robot.remembering))


def state_of(robot: Robot, y: Unknowns, stands: Array) -> State:
    """State that the unknowns describe."""
    x = y * units(robot).astype(y.dtype)
    memory = {effect.name: x[len(UNITS) + k] for k, effect in enumerate(robot.remembering)}
    motor, speed = (jnp.where(stands, 0.0, x[k]) for k in (MOTOR, GROUND))
    return State(x[CURRENT], motor, speed, x[DISCHARGE], memory, x[WINDING])


def with_consumers(robot: Robot, row: Profile) -> Robot:
    """Robot with the current of its other consumers at an instant."""
    if row.current_other is None:
        return robot
    battery = replace(robot.battery, current_other=row.current_other)
    return replace(robot, battery=battery)


def source_voltage(robot: Robot, conditions: Conditions, discharge: Scalar) -> Scalar:
    """Source voltage, which the duty multiplies [V]. For a battery, the no-load voltage."""
    battery = robot.battery.voltage(0.0, discharge)
    return jnp.where(conditions.battery > 0.5, battery, jnp.abs(conditions.voltage))


def controlled_duty(
    robot: Robot, mode: Array, demand: Scalar, conditions: Conditions, state: State, integral: Scalar
) -> tuple[Array, Array, Array]:
    """Duty of a motor at an instant, and the state of its controller.

    Args:
        mode: mode of the profile, index into `MODES`.
        demand: demanded speed of this side [rad/s or m/s].
        conditions: conditions of this side.
        state: state of this side.
        integral: integral of the controller of this side [rad].

    Returns:
        The duty [-], the rate of the controller's integral, and the error of the demand [rad/s]. For a ground speed,
        in terms of the motor speed that it needs.
    """
    motor_angle_per_travel = robot.gearbox.ratio / robot.chassis(conditions.configuration).radius
    on_ground = mode == SPEED
    demanded_motor_speed = demand * jnp.where(on_ground, motor_angle_per_travel, 1.0)
    error = demanded_motor_speed - jnp.where(on_ground, state.speed * motor_angle_per_travel, state.speed_motor)
    controlled = (mode == MOTOR_SPEED) | (mode == SPEED)
    voltage_source = source_voltage(robot, conditions, state.discharge)
    voltage = robot.driver.demand(error, integral, demanded_motor_speed, robot.motor.torque_constant)
    duty_wanted = voltage / jnp.maximum(voltage_source, 1e-3)
    limited_duty = robot.driver.duty_limited(clip(duty_wanted, -1.0, 1.0), state.current)
    # Anti-windup: the part of the demand beyond the limits is taken off the integral.
    excess = (duty_wanted - limited_duty) * voltage_source / (robot.driver.gain * robot.motor.torque_constant + 1e-12)
    duty = clip(jnp.where(controlled, conditions.polarity * duty_wanted, conditions.duty), -1.0, 1.0)
    return duty, jnp.where(controlled, error - excess, 0.0), jnp.where(controlled, error, 0.0)


def inputs_at(robot: Robot, otherwise: Conditions, segment: Profile, y: Array, stands: Array) -> SegmentInputs:
    """Inputs of the robot at an instant."""
    row = segment.at(y[CLOCK])
    robot = with_consumers(robot, row)
    conditions = row.conditions(otherwise)
    state = state_of(robot, y, stands)
    integral = y[INTEGRAL] * UNITS[INTEGRAL]
    duty, rate, error = controlled_duty(robot, row.mode, row.demand, conditions, state, integral)
    return SegmentInputs(robot, replace(conditions, duty=duty), rate, error)


@compiled
def instant(
    robot: Robot, otherwise: Conditions, segment: Profile, y: Array, stands: Array
) -> tuple[Signals, Array, Array, SegmentInputs]:
    """Signals of an instant, rates of the unknowns in their units, and of the totals [1/s]."""
    inputs = inputs_at(robot, otherwise, segment, y, stands)
    state = state_of(robot, y, stands)
    signals = balances.moving_signals(inputs.robot, inputs.conditions, state)
    winding, housing = (y[k] * UNITS[k] for k in (WINDING, HOUSING))
    winding_loss = robot.motor.voltage_winding(signals.current, winding) * signals.current
    winding_loss = winding_loss * robot.driver.ripple(signals.duty)
    heating = robot.heating(winding_loss, winding, housing)
    motion_factor = jnp.where(stands, 0.0, 1.0)
    rates = [
        signals.voltage_left / signals.inductance,
        motion_factor * signals.acceleration_wheel * robot.gearbox.ratio,
        motion_factor * signals.acceleration,
        balances.charge_drawn(inputs.robot, inputs.conditions, signals.total_current),
        *heating,
        inputs.integral_rate,
        1.0,
        *(effect.rate(robot, signals) for effect in robot.remembering),
    ]
    source_power = energy.source_power(inputs.robot, inputs.conditions, signals)
    current = robot.sides * signals.current
    torque = signals.torque_gear
    sinks = energy.sink_powers(inputs.robot, inputs.conditions, signals)
    totals = [
        signals.speed, jnp.abs(signals.speed), jnp.maximum(source_power, 0.0), jnp.maximum(-source_power, 0.0),
        current**2, torque**2, *sinks.values(),
    ]  # fmt: skip
    dtype = y.dtype
    return (
        signals,
        jnp.stack([jnp.asarray(r, dtype) for r in rates]) / units(robot).astype(dtype),
        jnp.stack([jnp.asarray(x, dtype) for x in totals]),
        inputs,
    )


def slowness(inputs: SegmentInputs, y: Array, stands: Array) -> tuple[Scalar, Scalar]:
    """Slowness of the shafts and of the sliding contacts [-]: 1 - |v| / limit.

    The limit is the speed that resolves friction. Slowness is 1 at rest, and negative above the limit.
    """
    load = inputs.robot.chassis(inputs.conditions.configuration)
    state = state_of(inputs.robot, y, stands)
    rolling_speed = load.radius * state.speed_motor / inputs.robot.gearbox.ratio
    return 1 - jnp.abs(rolling_speed) / load.speed_still, 1 - jnp.abs(rolling_speed - state.speed) / load.speed_grip


def supply_current_and_charge(inputs: SegmentInputs, y: Array, stands: Array) -> tuple[Scalar, Scalar]:
    """Current that the motors take from the source [A], and the charge taken [C]."""
    robot = inputs.robot
    state = state_of(inputs.robot, y, stands)
    duty = robot.driver.duty_limited(balances.bridge_duty(robot, inputs.conditions), state.current)
    current = robot.sides * state.current * robot.driver.share_drawn(duty)
    return current, state.discharge


def stored(robot: Robot, signals: Signals) -> Scalar:
    """Kinetic energy [J]."""
    return energy.stored_energy(robot, signals)


def peaks(robot: Robot, signals: Signals) -> Scalars:
    """Values at an instant whose largest values are recorded. The cell voltage is negated."""
    cell_voltage = jnp.where(signals.battery > 0.5, signals.voltage_source / robot.battery.cells, jnp.inf)
    assert signals.temperature is not None
    return {
        "current": jnp.abs(robot.sides * signals.current),
        "torque": jnp.abs(signals.torque_gear),
        "temperature": signals.temperature,
        "motor_speed": jnp.abs(signals.speed_motor),
        "speed": jnp.abs(signals.speed),
        "cell_low": -cell_voltage,
    }


def peaks_within(robot: Robot, y: Array, tops: Array) -> Scalars:
    """Peaks of currents and temperatures from the largest unknowns within a step.

    A current counts only up to the driver's limit. Above it, only the ends of a step are exact.
    """
    return {
        "current": robot.sides * jnp.minimum(UNITS[CURRENT] * tops[CURRENT], robot.driver.current_limit),
        "temperature": jnp.where(y[WINDING] > 0, UNITS[WINDING] * tops[WINDING], -jnp.inf),
    }


def exceeded(robot: Robot, signals: Signals) -> Scalars:
    """Limits exceeded at an instant."""
    is_too_hot = jnp.asarray(signals.temperature) > robot.motor.temperature_limit
    return {**base.exceeded_limits(robot, signals), "too_hot": is_too_hot}


def limited(robot: Robot, y: Array) -> Array:
    """True for each motor at its driver's current limit."""
    return robot.driver.limits(UNITS[CURRENT] * y[CURRENT])


#: Norm of an error of the unknowns, relative to the tolerance [-].
norm = functools.partial(rosenbrock.error_norm, count=len(UNITS))


def demanded(robot: Robot, otherwise: Conditions, segment: Profile) -> Array:
    """Demanded speed of each row [rad/s or m/s]."""
    return segment.demand


def status(robot: Robot, conditions: Conditions, signals: Signals) -> Array:
    """Status of a moving robot at its last instant."""
    end_conditions = replace(conditions, discharge=signals.discharge)
    return rest.status_moving(robot, end_conditions, signals, signals.duty * signals.voltage_source)


def at_places(signals: Signals, so_far: dict[str, jax.Array]) -> Signals:
    """Signals over time, completed by quantities that follow from the totals so far."""
    return signals
