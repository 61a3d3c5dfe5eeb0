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

#: Units of the unknowns current, motor speed, speed, discharge, temperatures of winding and housing, integral of the
#: controller and time in the segment, which scale them to the order of one. The memories of effects follow.
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


def with_consumers(robot: Robot, asked: Profile) -> Robot:
    """Robot with the current of its other consumers at an instant."""
    if asked.current_other is None:
        return robot
    battery = replace(robot.battery, current_other=asked.current_other)
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
    per_speed = robot.gearbox.ratio / robot.chassis(conditions.configuration).radius
    on_ground = mode == SPEED
    demanded = demand * jnp.where(on_ground, per_speed, 1.0)
    error = demanded - jnp.where(on_ground, state.speed * per_speed, state.speed_motor)
    controlled = (mode == MOTOR_SPEED) | (mode == SPEED)
    voltage_source = source_voltage(robot, conditions, state.discharge)
    voltage = robot.driver.demand(error, integral, demanded, robot.motor.torque_constant)
    duty_wanted = voltage / jnp.maximum(voltage_source, 1e-3)
    limited = robot.driver.duty_limited(clip(duty_wanted, -1.0, 1.0), state.current)
    # Anti-windup: the part of the demand beyond the limits is taken off the integral.
    excess = (duty_wanted - limited) * voltage_source / (robot.driver.gain * robot.motor.torque_constant + 1e-12)
    duty = clip(jnp.where(controlled, conditions.polarity * duty_wanted, conditions.duty), -1.0, 1.0)
    return duty, jnp.where(controlled, error - excess, 0.0), jnp.where(controlled, error, 0.0)


def asked_at(robot: Robot, otherwise: Conditions, segment: Profile, y: Array, stands: Array) -> SegmentInputs:
    """Inputs of the robot at an instant."""
    demand = segment.at(y[CLOCK])
    robot, conditions = with_consumers(robot, demand), demand.conditions(otherwise)
    state, integral = state_of(robot, y, stands), y[INTEGRAL] * UNITS[INTEGRAL]
    duty, rate, error = controlled_duty(robot, demand.mode, demand.demand, conditions, state, integral)
    return SegmentInputs(robot, replace(conditions, duty=duty), rate, error)


@compiled
def instant(
    robot: Robot, otherwise: Conditions, segment: Profile, y: Array, stands: Array
) -> tuple[Signals, Array, Array, SegmentInputs]:
    """Signals of an instant, rates of the unknowns in their units, and of the totals [1/s]."""
    demand = asked_at(robot, otherwise, segment, y, stands)
    state = state_of(robot, y, stands)
    signals = balances.moving_signals(demand.robot, demand.conditions, state)
    winding, housing = (y[k] * UNITS[k] for k in (WINDING, HOUSING))
    copper = robot.motor.voltage_winding(signals.current, winding) * signals.current
    copper = copper * robot.driver.ripple(signals.duty)
    heating = robot.heating(copper, winding, housing)
    moves = jnp.where(stands, 0.0, 1.0)
    rates = [
        signals.voltage_left / signals.inductance,
        moves * signals.acceleration_wheel * robot.gearbox.ratio,
        moves * signals.acceleration,
        balances.charge_drawn(demand.robot, demand.conditions, signals.total_current),
        *heating,
        demand.integral_rate,
        1.0,
        *(effect.rate(robot, signals) for effect in robot.remembering),
    ]
    power = energy.source_power(demand.robot, demand.conditions, signals)
    current, torque = robot.sides * signals.current, signals.torque_gear
    goes = energy.sink_powers(demand.robot, demand.conditions, signals)
    totals = [
        signals.speed, jnp.abs(signals.speed), jnp.maximum(power, 0.0), jnp.maximum(-power, 0.0), current**2,
        torque**2, *goes.values(),
    ]  # fmt: skip
    dtype = y.dtype
    return (
        signals,
        jnp.stack([jnp.asarray(r, dtype) for r in rates]) / units(robot).astype(dtype),
        jnp.stack([jnp.asarray(x, dtype) for x in totals]),
        demand,
    )


def slowness(asked: SegmentInputs, y: Array, stands: Array) -> tuple[Scalar, Scalar]:
    """Slowness of the shafts and of the sliding contacts [-]: 1 - |v| / limit.

    The limit is the speed that resolves friction. Slowness is 1 at rest, and negative above the limit.
    """
    load, state = asked.robot.chassis(asked.conditions.configuration), state_of(asked.robot, y, stands)
    rolling = load.radius * state.speed_motor / asked.robot.gearbox.ratio
    return 1 - jnp.abs(rolling) / load.speed_still, 1 - jnp.abs(rolling - state.speed) / load.speed_grip


def supply_current_and_charge(asked: SegmentInputs, y: Array, stands: Array) -> tuple[Scalar, Scalar]:
    """Current that the motors take from the source [A], and the charge taken [C]."""
    robot, state = asked.robot, state_of(asked.robot, y, stands)
    duty = robot.driver.duty_limited(balances.bridge_duty(robot, asked.conditions), state.current)
    motors = robot.sides * state.current * robot.driver.share_drawn(duty)
    return motors, state.discharge


def stored(robot: Robot, found: Signals) -> Scalar:
    """Kinetic energy [J]."""
    return energy.stored_energy(robot, found)


def peaks(robot: Robot, found: Signals) -> Scalars:
    """Values at an instant whose largest values are recorded. The cell voltage is negated."""
    cell = jnp.where(found.battery > 0.5, found.voltage_source / robot.battery.cells, jnp.inf)
    assert found.temperature is not None
    return {
        "current": jnp.abs(robot.sides * found.current),
        "torque": jnp.abs(found.torque_gear),
        "temperature": found.temperature,
        "motor_speed": jnp.abs(found.speed_motor),
        "speed": jnp.abs(found.speed),
        "cell_low": -cell,
    }


def peaks_within(robot: Robot, y: Array, tops: Array) -> Scalars:
    """Peaks of currents and temperatures from the largest unknowns within a step.

    A current counts only up to the driver's limit. Above it, only the ends of a step are exact.
    """
    return {
        "current": robot.sides * jnp.minimum(UNITS[CURRENT] * tops[CURRENT], robot.driver.current_limit),
        "temperature": jnp.where(y[WINDING] > 0, UNITS[WINDING] * tops[WINDING], -jnp.inf),
    }


def exceeded(robot: Robot, found: Signals) -> Scalars:
    """Limits exceeded at an instant."""
    is_too_hot = jnp.asarray(found.temperature) > robot.motor.temperature_limit
    return {**base.exceeded_limits(robot, found), "too_hot": is_too_hot}


def limited(robot: Robot, y: Array) -> Array:
    """True for each motor at its driver's current limit."""
    return robot.driver.limits(UNITS[CURRENT] * y[CURRENT])


#: Norm of an error of the unknowns, relative to the tolerance [-].
norm = functools.partial(rosenbrock.error_norm, own=len(UNITS))


def demanded(robot: Robot, otherwise: Conditions, segment: Profile) -> Array:
    """Demanded speed of each row [rad/s or m/s]."""
    return segment.demand


def status(robot: Robot, conditions: Conditions, found: Signals) -> Array:
    """Status of a moving robot at its last instant."""
    conditions_now = replace(conditions, discharge=found.discharge)
    return rest.status_moving(robot, conditions_now, found, found.duty * found.voltage_source)


def at_places(signals: Signals, so_far: dict[str, jax.Array]) -> Signals:
    """Signals over time, completed by quantities that follow from the totals so far."""
    return signals
