"""Rest: whether friction holds a robot that stands, the current that flows in it then, and how runs end by that."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
from jaxtyping import Array

from mmrjax.fidelities.result import slips, travels
from mmrjax.model import balances
from mmrjax.model.conditions import Conditions
from mmrjax.model.params import Scalar
from mmrjax.model.robot import Robot
from mmrjax.model.signals import NOT_SETTLED, SLIDES, STALLED, Signals, State
from mmrjax.numerics import one_sided
from mmrjax.numerics.rarely import rarely

#: Torque at the driving wheel that counts as much as the whole weight of a side [N·m].
TORQUE = 1.0
#: A run has not settled while it would change its speed by more than this share in `TIME` [-], [s].
SHARE, TIME = 1e-3, 0.1
#: From which a robot whose movers slide gains or loses speed [m/s²], and from which one that stands is starting.
GAIN, STARTS = 1e-3, 1e-2


#: Way of shafts that friction holds, beside ±1 and 0.
HELD = 2.0


def least(*values: Scalar) -> Array:
    """The smallest of some numbers, its derivative that of one of them.

    That of `jnp.minimum` is nothing wherever XLA computes an argument twice and rounds it in two ways: it asks which
    argument equals the answer.
    """
    found = jnp.asarray(values[0])
    for value in values[1:]:
        found = jnp.where(value < found, value, found)
    return found


def direction(robot: Robot, conditions: Conditions) -> Array:
    """Direction in which a robot can travel, 1 forward or -1 backward: of the torque on its shafts at rest.

    That of the motors at their stall current less gravity's; friction can hold the robot, not turn it round. That of
    the motors' speed where it is imposed.
    """
    if conditions.motor_speed is not None:
        return jax.lax.stop_gradient(jnp.where(conditions.motor_speed >= 0, 1.0, -1.0))
    chassis = robot.chassis(conditions.configuration)
    mass = chassis.mass + conditions.payload if conditions.total_mass is None else conditions.total_mass
    stall = robot.motor.torque_electromagnetic(voltage_at_rest(robot, conditions) / robot.motor.resistance)
    weight = chassis.torque_weight(mass * (1 / robot.sides), conditions.slope)
    weight = weight if conditions.load_torque is None else weight + conditions.load_torque
    return jax.lax.stop_gradient(jnp.where(robot.gearbox.ratio * stall >= weight, 1.0, -1.0))


def voltage_at_rest(robot: Robot, conditions: Conditions) -> Array:
    """Voltage that the driver gives motors at rest [V], no current flowing."""
    if conditions.motor_speed is not None:  # that which makes for the imposed speed
        return jnp.asarray(robot.motor.voltage_back(conditions.motor_speed))
    if conditions.motor_current is not None:  # an amplifier's, see `balances.electrical`
        return jnp.asarray(robot.motor.resistance * conditions.motor_current)
    battery = robot.battery.voltage(0.0, conditions.discharge)
    source = jnp.where(conditions.battery > 0.5, battery, conditions.voltage)
    return conditions.duty * jnp.where(conditions.open > 0.5, 0.0, source)


def _carried(robot: Robot, conditions: Conditions, state: State, direction: Scalar) -> Signals:
    """Signals of shafts that turn in `direction`, or are about to, under a robot that stands: movers carry what the
    robot asks for, and no more than the ground holds."""
    signals = balances.settled(robot, conditions, state, direction)[0]
    limit = signals.adhesion_limit
    carried = dataclasses.replace(signals, traction=jnp.clip(signals.demand, -limit, limit))
    return balances.gearbox(robot, robot.chassis(conditions.configuration), carried)


def standing(robot: Robot, conditions: Conditions, state: State) -> Signals:
    """All signals of a robot that friction at rest holds, in static equilibrium.

    What friction at rest carries is not determined by the loads alone. Here traction is what gravity along the slope
    asks for; rolling resistance takes what of it neither shafts nor adhesion hold. The torque at the output is the
    smallest with which motor side and track side both stand, so friction takes what it can nearest to its cause.

    Args:
        conditions: their voltage or current imposed, no speed; state: its current is that which flows at rest.
    """
    robot = robot.within(conditions.configuration)
    chassis, gear, still = robot.chassis(conditions.configuration), robot.gearbox, _still(state)
    # About to turn forward and backward: the two ends of what friction can do.
    ends = [balances.settled(robot, conditions, still, way)[0] for way in (1.0, -1.0)]
    ahead, back = ends
    # Least and most torque that comes through the gearbox, and least and most that the track's friction takes.
    given = [
        gear.torque_output(end.torque_motor - end.torque_idle, end.direction)
        - (end.torque_load - end.torque_track_loss - chassis.radius * end.traction)
        for end in ends
    ]
    lost = [end.torque_track_loss for end in (back, ahead)]
    traction = ahead.gravity
    if robot.has_ground:
        least_, most = ((given[k] - lost[1 - k]) / chassis.radius for k in range(2))
        traction = one_sided.clip(one_sided.clip(traction, least_, most), -ahead.adhesion_limit, ahead.adhesion_limit)
    carried = chassis.radius * traction
    torque = one_sided.clip(0.0, jnp.maximum(carried + lost[0], given[0]), jnp.minimum(carried + lost[1], given[1]))
    none = jnp.zeros_like(carried)
    return dataclasses.replace(
        ahead,
        direction=none,
        direction_travel=none,
        resistance=traction - ahead.gravity,
        demand=traction,
        traction=traction,
        torque_track_loss=torque - carried,
        torque_load=torque,
        torque_gear=torque,
        torque_output=torque,
        torque_input=torque / gear.ratio,
        torque_net=none,
        speed_sliding=none,
        acceleration_wheel=none,
        acceleration=none,
    )


def _still(state: State) -> State:
    return dataclasses.replace(state, speed_motor=jnp.zeros_like(state.speed), speed=jnp.zeros_like(state.speed))


def holds(robot: Robot, conditions: Conditions) -> Array:
    """Whether friction at rest holds a robot that stands.

    The ground grips, and motors and gravity can turn the shafts neither way at the motors' current at rest, which
    flows a millisecond after the start.
    """
    none = jnp.zeros_like(conditions.voltage)
    memory = {effect.name: none for effect in robot.remembering}
    rest = State(none, none, none, conditions.discharge, memory, distance=none, gap=none if robot.loose else None)
    settled = dataclasses.replace(rest, current=current_at_rest(robot, conditions, rest))
    return jnp.asarray(jax.lax.stop_gradient(firmness(robot, conditions, settled)) >= 0)


def _ground_margin(forward: Signals, backward: Signals) -> Scalar:
    """Adhesion less what gravity asks of it beyond rolling resistance [-], negative where a robot slides down."""
    along = -least(-backward.demand, forward.demand)
    return (forward.adhesion_limit - along) / forward.normal


def firmness(robot: Robot, conditions: Conditions, state: State) -> Scalar:
    """How firmly friction would hold the robot at rest, negative where it cannot [-].

    Its shafts stand where the motors and gravity together can turn them neither way against friction at rest, be it
    by moving the robot or by sliding its movers under it; its movers where gravity along the slope less rolling
    resistance is below the ground's adhesion.
    """
    forward, backward = _about_to_turn(robot, conditions, state)
    shafts = least(-forward.torque_net, backward.torque_net) / TORQUE
    return least(shafts, _ground_margin(forward, backward)) if robot.has_ground else shafts


def _about_to_turn(robot: Robot, conditions: Conditions, state: State) -> tuple[Signals, Signals]:
    """Signals of shafts that stand and are about to turn forward, and backward."""
    still = _still(state)
    return _carried(robot, conditions, still, 1.0), _carried(robot, conditions, still, -1.0)


def turning_way(robot: Robot, conditions: Conditions, state: State) -> Array:
    """Way in which shafts and a load that move as one turn, or leave rest, ±1 [-].

    `HELD` where they stand and friction holds them by the test of `firmness`, now and at the current that will flow
    then. 0 where it would hold them now alone, so that they are about to leave, and they are slower than friction at
    rest is resolved. Where a speed is imposed it turns them, whatever friction does: 0 where it stands.
    """
    motor_speed, load = jnp.asarray(state.speed_motor), robot.chassis(conditions.configuration)
    slow = jnp.abs(motor_speed) * load.radius / robot.gearbox.ratio < load.speed_still
    if conditions.motor_speed is not None:
        change = jnp.asarray(0.0 if conditions.motor_acceleration is None else conditions.motor_acceleration)
        return jnp.where(slow & (change == 0), 0.0, jnp.sign(jnp.where(motor_speed == 0, change, motor_speed)))

    def leaving(robot: Robot, conditions: Conditions, state: State) -> Array:
        settled = dataclasses.replace(state, current=current_at_rest(robot, conditions, state))
        now, then = (_about_to_turn(robot, conditions, at) for at in (state, settled))
        turned, later = (1.0 * (ahead.torque_net > 0) - 1.0 * (back.torque_net < 0) for ahead, back in (now, then))
        stands, moved = state.speed_motor == 0, jnp.sign(state.speed_motor)
        held = jnp.where(later != 0, 0.0, jnp.where(stands, HELD, moved))
        return jnp.where(turned == 0, held, jnp.where(stands, turned, moved))

    return rarely(slow, leaving, (robot, conditions, state), jnp.sign(motor_speed))


def slides_in_place(robot: Robot, conditions: Conditions) -> Array:
    """Whether a robot that cannot travel, as the demand is above what the ground holds, slides; else it stands.

    It slides down where gravity less rolling resistance is above the adhesion. It slides in its place where the
    motors turn the movers faster than V_s, up to which the ground holds more the faster they slide.
    """
    chassis, sense = robot.chassis(conditions.configuration), direction(robot, conditions)
    none = jnp.zeros_like(conditions.voltage)
    still = State(none, none, none, conditions.discharge)
    turning = sense * chassis.ground.friction.speed_static * robot.gearbox.ratio / chassis.radius
    spun = dataclasses.replace(still, speed_motor=turning * jnp.ones_like(still.speed))
    if conditions.motor_speed is not None:
        spins = sense * conditions.motor_speed > sense * turning
    else:
        spun = dataclasses.replace(spun, current=current_settled(robot, conditions, spun))
        spins = sense * _carried(robot, conditions, spun, sense).torque_net > 0
    forward, backward = (balances.demanded(robot, conditions, still, way + none) for way in (1.0, -1.0))
    return (_ground_margin(forward, backward) < 0) | spins


def current_settled(robot: Robot, conditions: Conditions, state: State) -> Scalar:
    """Current to which that of motors at the speed of `state` settles [A], on the line through two of its voltage
    balance."""

    def left(current: Scalar) -> Scalar:
        here = dataclasses.replace(state, current=current)
        return balances.driven(robot, conditions, here, jnp.zeros_like(state.speed)).voltage_left

    guess = left(jnp.zeros_like(state.current)) / robot.motor.resistance
    first, second = left(0.5 * guess), left(guess)
    slope = (second - first) / jnp.where(guess == 0, 1.0, 0.5 * guess)
    return guess - jnp.where(guess == 0, 0.0, second / jnp.where(guess == 0, 1.0, slope))


def current_at_rest(robot: Robot, conditions: Conditions, state: State) -> Scalar:
    """Current to which that of a standing robot settles [A]."""
    return current_settled(robot, conditions, _still(state))


def creeps(sense: Array, voltage: Scalar, theoretical: Scalar, speed: Scalar, rest: Scalar) -> Array:
    """Whether a robot rests, by its numbers: slower than friction at rest is resolved.

    One that its motors drive travels where both shafts and robot move their way, since on a slope the contact's creep
    takes back what slow shafts win. One that gravity drives travels where either of them does.

    Args:
        sense: in which it can travel, 1 or -1; voltage: at the motors at rest [V]; theoretical: r_k ω_k [m/s].
        rest: speed within which friction at rest is not resolved [m/s].
    """
    shafts, travel = sense * theoretical, sense * speed
    driven = sense * voltage > 0
    return jnp.where(driven, jnp.minimum(shafts, travel), jnp.maximum(shafts, travel)) < rest


def status_moving(robot: Robot, conditions: Conditions, end: Signals, voltage: Scalar) -> Array:
    """Status of a run over time that friction does not hold at its end, by its last instant.

    Args:
        conditions: that act then; voltage: that the driver gives the motors then [V].

    Returns:
        `not_settled` while the speed changes, or movers that slide beyond V_s win speed; `slides` where those lose
        speed or the robot stands; `stalled` where it creeps; else the status of steady travel.
    """
    settling = jnp.abs(end.acceleration) * TIME > SHARE * jnp.abs(end.speed)
    status = jnp.where(settling, NOT_SETTLED, travels(end.speed, voltage))
    sense, rest = direction(robot, conditions), robot.chassis(conditions.configuration).speed_still
    still = creeps(sense, voltage_at_rest(robot, conditions), end.speed_theoretical, end.speed, rest)
    status = jnp.where(still & (sense * end.acceleration < STARTS), STALLED, status)
    gain = end.acceleration * jnp.sign(end.speed_sliding)
    return unless_slipping(status, robot, end, gain, GAIN, still)


def unless_slipping(
    status: Array, robot: Robot, signals: Signals, gain: Scalar, least: float, stands: Array | bool
) -> Array:
    """The status of a run, of one that slips by what the robot does: `not_settled` while it gains speed, `slides`
    where it loses speed or stands, else what it is without.

    Args:
        gain: how fast it gains speed [m/s²]; least: from which that counts; stands: whether it does not travel.
    """
    loose = jnp.where(gain > least, NOT_SETTLED, jnp.where(jnp.asarray(gain < -least) | stands, SLIDES, status))
    return jnp.where(slips(robot, signals), loose, status)
