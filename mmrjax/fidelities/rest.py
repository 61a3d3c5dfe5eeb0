"""Robots at rest: the friction that holds them, their current at rest, and the status at the end of a run."""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
from jaxtyping import Array

from mmrjax.fidelities.base import movers_slip, travel_status
from mmrjax.model import balances
from mmrjax.model.conditions import Conditions
from mmrjax.model.driver import STEEPNESS
from mmrjax.model.params import Scalar
from mmrjax.model.robot import Robot
from mmrjax.model.signals import NOT_SETTLED, SLIDES, STALLED, Signals, State
from mmrjax.numerics import elementary
from mmrjax.numerics.batch_flow import compute_if_needed

#: Torque at the driving wheel equivalent to the whole weight of a side [N·m].
TORQUE = 1.0
#: A run has not settled if its speed would change by more than this share within `TIME` [-], [s].
SHARE, TIME = 1e-3, 0.1
#: Least acceleration that counts, of a robot with sliding movers, and of a robot that starts from rest [m/s²].
GAIN, STARTS = 1e-3, 1e-2


#: Direction value of shafts that friction holds, in addition to ±1 and 0.
HELD = 2.0


def smallest_of(*values: Scalar) -> Array:
    """The smallest of some numbers, with the derivative of that number.

    The derivative of `jnp.minimum` is 0 if XLA computes an argument twice with different rounding, because it
    compares each argument with the result.
    """
    smallest = jnp.asarray(values[0])
    for value in values[1:]:
        smallest = jnp.where(value < smallest, value, smallest)
    return smallest


def travel_direction(robot: Robot, conditions: Conditions) -> Array:
    """Direction in which a robot can travel, 1 forward or -1 backward, from the torque on its shafts at rest.

    The torque is that of the motors at stall current, within the driver's limit, less gravity's. Friction can hold
    the robot but not reverse it. With an imposed motor speed, the direction of that speed. At speed 0, that in which
    the motors push against the load torque.
    """
    if conditions.motor_speed is not None:
        reference = jnp.asarray(conditions.motor_speed)
        reference = (
            reference
            if conditions.load_torque is None
            else jnp.where(reference == 0, conditions.load_torque, reference)
        )
        return jax.lax.stop_gradient(jnp.where(reference >= 0, 1.0, -1.0))
    chassis = robot.chassis(conditions.configuration)
    mass = chassis.mass + conditions.payload if conditions.total_mass is None else conditions.total_mass
    current = robot.motor.current_stall(voltage_at_rest(robot, conditions))
    if not conditions.voltage_follows:
        largest = robot.driver.current_limit * (
            1 + jnp.abs(balances.bridge_duty(robot, conditions)) * (1 / STEEPNESS)
        )
        current = elementary.clip(current, -largest, largest)
    stall = robot.motor.torque_electromagnetic(current)
    load_torque = chassis.torque_weight(mass * (1 / robot.sides), conditions.slope)
    load_torque = load_torque if conditions.load_torque is None else load_torque + conditions.load_torque
    return jax.lax.stop_gradient(jnp.where(robot.gearbox.ratio * stall >= load_torque, 1.0, -1.0))


def output_is_held(conditions: Conditions) -> Array:
    """True where a clamp holds the output, or an imposed speed of 0 holds it against a load torque."""
    if conditions.motor_speed is not None and conditions.load_torque is not None:
        return (conditions.motor_speed == 0) & (conditions.load_torque != 0)
    return jnp.asarray(0.0 if conditions.held is None else conditions.held) > 0.5


def voltage_at_rest(robot: Robot, conditions: Conditions) -> Array:
    """Voltage of the driver at the start [V].

    That of a standing motor without current, or what an imposed speed or current needs.
    """
    if conditions.motor_speed is not None:  # the voltage of the imposed speed
        return jnp.asarray(robot.motor.voltage_back(conditions.motor_speed))
    if conditions.motor_current is not None:  # an amplifier's, see `balances.electrical`
        return robot.motor.resistance * conditions.motor_current
    return balances.bridge_duty(robot, conditions) * jnp.where(
        conditions.open > 0.5, 0.0, _source_at_rest(robot, conditions)
    )


def _source_at_rest(robot: Robot, conditions: Conditions) -> Array:
    battery = robot.battery.voltage(0.0, conditions.discharge)
    return jnp.where(conditions.battery > 0.5, battery, conditions.voltage)


def admitted_current(robot: Robot, conditions: Conditions, unlimited_current: Scalar) -> tuple[Scalar, Scalar]:
    """Current that limit and diode of the driver allow [A], and the voltage that blocks the rest [V].

    See `Driver.admitted`, with the resistance of a motor and its share of the battery's. An amplifier that imposes
    speed or current has neither limit nor diode.
    """
    if conditions.voltage_follows:
        return unlimited_current, jnp.zeros_like(unlimited_current)
    battery = robot.battery
    duty = balances.bridge_duty(robot, conditions)
    battery_resistance = robot.sides * battery.cells * battery.resistance * duty * robot.driver.share_drawn(duty)
    resistance = robot.motor.resistance + jnp.where(conditions.battery > 0.5, battery_resistance, 0.0)
    resistance, source = jax.lax.stop_gradient((resistance, _source_at_rest(robot, conditions)))
    current, blocked_current = robot.driver.admitted(
        unlimited_current, conditions.polarity * duty, jnp.abs(source) / resistance
    )
    return current, resistance * blocked_current


def without_diode(robot: Robot) -> Robot:
    """Same robot on a supply that takes current back, for balances at an `admitted_current`."""
    return replace(robot, driver=replace(robot.driver, returns_current=True))


def _signals_about_to_turn(robot: Robot, conditions: Conditions, state: State, direction: Scalar) -> Signals:
    """Signals of a standing robot whose shafts turn, or are about to turn, in `direction`.

    Traction equals the robot's demand, clipped to the adhesion limit.
    """
    signals = balances.settled_signals(robot, conditions, state, direction)[0]
    limit = signals.adhesion_limit
    loaded = replace(signals, traction=jnp.clip(signals.demand, -limit, limit))
    return balances.gearbox(robot, robot.chassis(conditions.configuration), loaded, settled=True)


def standing_signals(robot: Robot, conditions: Conditions, state: State) -> Signals:
    """All signals of a robot that friction holds at rest, in static equilibrium.

    The loads alone do not determine static friction. Traction is the pull of gravity along the slope. Rolling
    resistance takes the part that neither shafts nor adhesion hold. The output torque is the smallest that keeps
    both motor side and track side at rest: friction acts as near as possible to the load it balances. A clamp of the
    output carries what the friction of motor and gearbox does not hold.

    Args:
        conditions: voltage or current imposed, no speed.
        state: state with the current that flows at rest.
    """
    robot = robot.within(conditions.configuration)
    conditions = balances.with_controller_duty(robot, conditions, state)
    chassis = robot.chassis(conditions.configuration)
    gear = robot.gearbox
    still_state = _without_motion(state)
    # About to turn forward and backward: the two limits of friction.
    limits = [balances.settled_signals(robot, conditions, still_state, direction)[0] for direction in (1.0, -1.0)]
    forward, backward = limits
    # Least and greatest torque through the gearbox, and least and greatest friction of the track.
    input_torques = [
        gear.torque_output(limit.torque_motor - limit.torque_idle, limit.direction)
        - (limit.torque_load - limit.torque_track_loss - chassis.radius * limit.traction)
        for limit in limits
    ]
    track_losses = [limit.torque_track_loss for limit in (backward, forward)]
    traction = forward.gravity
    if robot.has_ground:
        least_traction, most_traction = ((input_torques[k] - track_losses[1 - k]) / chassis.radius for k in range(2))
        traction = elementary.clip(
            elementary.clip(traction, least_traction, most_traction), -forward.adhesion_limit, forward.adhesion_limit
        )
    traction_torque = chassis.radius * traction
    load_torques = [traction_torque + track_loss for track_loss in track_losses]
    if conditions.held is not None:
        load_torques = [
            jnp.where(conditions.held > 0.5, *both) for both in zip(input_torques, load_torques, strict=True)
        ]
    torque = elementary.clip(
        0.0, jnp.maximum(load_torques[0], input_torques[0]), jnp.minimum(load_torques[1], input_torques[1])
    )
    zero = jnp.zeros_like(traction_torque)
    return replace(
        forward,
        direction=zero,
        direction_travel=zero,
        resistance=traction - forward.gravity,
        demand=traction,
        traction=traction,
        torque_track_loss=torque - traction_torque,
        torque_load=torque,
        torque_gear=torque,
        torque_output=torque,
        torque_carried=torque,
        torque_input=torque / gear.ratio,
        torque_net=zero,
        speed_sliding=zero,
        acceleration_wheel=zero,
        acceleration=zero,
    )


def _without_motion(state: State) -> State:
    return replace(state, speed_motor=jnp.zeros_like(state.speed), speed=jnp.zeros_like(state.speed))


def holds(robot: Robot, conditions: Conditions) -> Array:
    """True if friction at rest holds a standing robot.

    The ground grips, and motors and gravity cannot turn the shafts at the motors' current at rest, which
    flows a millisecond after the start.
    """
    zero = jnp.zeros_like(conditions.voltage)
    memory = {effect.name: zero for effect in robot.remembering}
    rest = State(zero, zero, zero, conditions.discharge, memory, distance=zero, gap=zero if robot.loose else None)
    settled = replace(rest, current=current_at_rest(robot, conditions, rest))
    return jax.lax.stop_gradient(holding_margin(robot, conditions, settled)) >= 0


def _ground_margin(forward: Signals, backward: Signals) -> Array:
    """Adhesion minus the pull of gravity that rolling resistance does not carry [-]. Negative if a robot slides
    down.
    """
    pull = -smallest_of(-backward.demand, forward.demand)
    return (forward.adhesion_limit - pull) / forward.normal


def holding_margin(robot: Robot, conditions: Conditions, state: State) -> Array:
    """Margin of the friction that holds a robot at rest, negative if it cannot hold it [-].

    Its shafts rest if motors and gravity together cannot turn them against static friction, either by moving the
    robot or by sliding its movers under it. Its movers rest if gravity along the slope less rolling resistance is
    below the ground's adhesion.
    """
    forward, backward = _signals_both_ways(robot, conditions, state)
    shafts = smallest_of(-forward.torque_net, backward.torque_net) / TORQUE
    return smallest_of(shafts, _ground_margin(forward, backward)) if robot.has_ground else shafts


def _signals_both_ways(robot: Robot, conditions: Conditions, state: State) -> tuple[Signals, Signals]:
    """Signals of resting shafts that are about to turn forward, and backward."""
    still = _without_motion(state)
    return _signals_about_to_turn(robot, conditions, still, 1.0), _signals_about_to_turn(
        robot, conditions, still, -1.0
    )


def shaft_direction(robot: Robot, conditions: Conditions, state: State) -> tuple[Array, Array]:
    """Direction in which shafts and a load that move as one turn, or leave rest, ±1 [-], and time until then [s].

    `HELD` if they rest and friction holds them (`holding_margin`), both now and at the later current at rest. If
    friction holds them only now, they leave rest when the current, which lags exponentially, exceeds it. A clamp
    always holds them. With an imposed speed it is the direction of that speed, 0 at rest, whatever holds them.
    """
    conditions = balances.with_controller_duty(robot, conditions, state)
    motor_speed, load = jnp.asarray(state.speed_motor), robot.chassis(conditions.configuration)
    slow = jnp.abs(motor_speed) * load.radius / robot.gearbox.ratio < load.speed_still
    no_wait = jnp.zeros_like(motor_speed)
    if conditions.motor_speed is not None:
        acceleration = jnp.asarray(0.0 if conditions.motor_acceleration is None else conditions.motor_acceleration)
        direction = jnp.where(
            slow & (acceleration == 0), 0.0, jnp.sign(jnp.where(motor_speed == 0, acceleration, motor_speed))
        )
        return direction, no_wait

    def leave_rest(robot: Robot, conditions: Conditions, state: State) -> tuple[Array, Array]:
        settled = replace(state, current=current_at_rest(robot, conditions, state))
        signals_now, signals_settled = (
            _signals_both_ways(robot, conditions, instant) for instant in (state, settled)
        )
        direction_now, direction_settled = (
            1.0 * (forward.torque_net > 0) - 1.0 * (backward.torque_net < 0)
            for forward, backward in (signals_now, signals_settled)
        )
        torque_now, torque_settled = (
            jnp.where(direction_settled > 0, forward.torque_net, -backward.torque_net)
            for forward, backward in (signals_now, signals_settled)
        )
        driven_signals = balances.driven_signals(robot, conditions, _without_motion(state), None)
        current_rate, missing_current = (
            driven_signals.voltage_left / driven_signals.inductance,
            settled.current - state.current,
        )
        waits = (direction_now == 0) & (direction_settled != 0) & (current_rate * missing_current > 0)
        share = jnp.where(waits, -torque_now / jnp.where(waits, torque_settled - torque_now, 1.0), 0.0)
        wait = -jnp.log1p(-share) * missing_current / jnp.where(waits, current_rate, 1.0)
        direction = jnp.where(
            direction_now != 0, direction_now, jnp.where(direction_settled != 0, direction_settled, HELD)
        )
        stands = state.speed_motor == 0
        return jnp.where(stands, direction, jnp.sign(state.speed_motor)), jnp.where(stands & waits, wait, 0.0)

    direction, wait = compute_if_needed(
        slow, leave_rest, (robot, conditions, state), (jnp.sign(motor_speed), no_wait)
    )
    is_clamped = output_is_held(conditions)
    return jnp.where(is_clamped, HELD, direction), jnp.where(is_clamped, 0.0, wait)


def slides_in_place(robot: Robot, conditions: Conditions) -> Array:
    """For a robot whose demand exceeds the limit of the ground: True if it slides, False if it stands.

    It slides down if gravity less rolling resistance exceeds the adhesion. It slides in place if the motors turn the
    movers faster than V_s. Up to V_s the traction of the ground increases with sliding speed.
    """
    chassis = robot.chassis(conditions.configuration)
    sense = travel_direction(robot, conditions)
    zero = jnp.zeros_like(conditions.voltage)
    still_state = State(zero, zero, zero, conditions.discharge)
    motor_speed_at_grip = sense * chassis.ground.friction.speed_static * robot.gearbox.ratio / chassis.radius
    spun_state = replace(still_state, speed_motor=motor_speed_at_grip * jnp.ones_like(still_state.speed))
    if conditions.motor_speed is not None:
        spins = sense * conditions.motor_speed > sense * motor_speed_at_grip
    else:
        spun_state = replace(spun_state, current=current_settled(robot, conditions, spun_state))
        spins = sense * _signals_about_to_turn(robot, conditions, spun_state, sense).torque_net > 0
    forward, backward = (
        balances.demanded_signals(robot, conditions, still_state, direction + zero) for direction in (1.0, -1.0)
    )
    return (_ground_margin(forward, backward) < 0) | spins


def current_settled(robot: Robot, conditions: Conditions, state: State) -> Scalar:
    """Current that settles at the motor speed of `state` [A], by one secant step on its voltage balance."""

    def voltage_left(unlimited_current: Scalar) -> Scalar:
        current, blocked_voltage = admitted_current(robot, conditions, unlimited_current)
        state_at_current = replace(state, current=current)
        direction = jnp.zeros_like(state.speed)
        return (
            balances.driven_signals(without_diode(robot), conditions, state_at_current, direction).voltage_left
            - blocked_voltage
        )

    guess = robot.motor.current_stall(voltage_left(jnp.zeros_like(state.current)))
    first, second = voltage_left(0.5 * guess), voltage_left(guess)
    slope = (second - first) / jnp.where(guess == 0, 1.0, 0.5 * guess)
    secant_guess = guess - jnp.where(guess == 0, 0.0, second / jnp.where(guess == 0, 1.0, slope))
    return admitted_current(robot, conditions, secant_guess)[0]


def current_at_rest(robot: Robot, conditions: Conditions, state: State) -> Scalar:
    """Current that settles in a standing robot [A]."""
    return current_settled(robot, conditions, _without_motion(state))


def is_at_rest(sense: Array, voltage: Scalar, theoretical: Scalar, speed: Scalar, speed_rest: Scalar) -> Array:
    """True if a robot counts as at rest: slower than the resolution of static friction.

    A robot driven by its motors travels if both shafts and robot move in the motors' direction. On a slope the creep
    of the contact can cancel slow shafts. A robot driven by gravity travels if either of them moves.

    Args:
        sense: direction of possible travel, 1 or -1.
        voltage: voltage at the motors at rest [V].
        theoretical: r_k ω_k [m/s].
        speed_rest: speed below which friction at rest is not resolved [m/s].
    """
    shafts, travel = sense * theoretical, sense * speed
    driven = sense * voltage > 0
    return jnp.where(driven, jnp.minimum(shafts, travel), jnp.maximum(shafts, travel)) < speed_rest


def status_moving(robot: Robot, conditions: Conditions, end: Signals, voltage: Scalar) -> Array:
    """Status of a run over time from its last instant, if friction does not hold the robot.

    Args:
        conditions: conditions at that instant.
        voltage: voltage of the driver at that instant [V].

    Returns:
        `not_settled` if the speed changes, or if the robot gains speed with movers sliding beyond V_s. `slides` if it
        then loses speed or stands. `stalled` if it creeps. Else the status of steady travel.
    """
    is_changing = jnp.abs(end.acceleration) * TIME > SHARE * jnp.abs(end.speed)
    status = jnp.where(is_changing, NOT_SETTLED, travel_status(end.speed, voltage))
    sense = travel_direction(robot, conditions)
    speed_still = robot.chassis(conditions.configuration).speed_still
    is_still = is_at_rest(sense, voltage_at_rest(robot, conditions), end.speed_theoretical, end.speed, speed_still)
    status = jnp.where(is_still & (sense * end.acceleration < STARTS), STALLED, status)
    gain = end.acceleration * jnp.sign(end.speed_sliding)
    return status_with_slip(status, robot, end, gain, GAIN, is_still)


def status_with_slip(
    status: Array, robot: Robot, signals: Signals, gain: Scalar, least_gain: float, stands: Array | bool
) -> Array:
    """Status of a run with slip taken into account, else `status`.

    A slipping robot is `not_settled` if it gains speed, and `slides` if it loses speed or stands.

    Args:
        gain: acceleration of the robot [m/s²].
        least_gain: smallest that counts.
        stands: True if it does not travel.
    """
    slip_status = jnp.where(
        gain > least_gain, NOT_SETTLED, jnp.where(jnp.asarray(gain < -least_gain) | stands, SLIDES, status)
    )
    return jnp.where(movers_slip(robot, signals), slip_status, status)
