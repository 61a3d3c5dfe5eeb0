"""Robots whose sides are driven apart: circling as a root, and turning over time, of the same equations.

Both are parts of the fidelities `steady` and `drive`, which come here where conditions say more of one side
(`Conditions.turns`).
"""

from __future__ import annotations

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from mmrjax import balances, channels, ground
from mmrjax.compiling import compiled
from mmrjax.conditions import Conditions
from mmrjax.effects.base import Effect
from mmrjax.fidelities import lanes, rest
from mmrjax.fidelities.rest import SHARE, TIME, voltage_at_rest
from mmrjax.fidelities.result import efficiency, result, withhold
from mmrjax.fidelities.rosenbrock import inverse
from mmrjax.params import Scalar
from mmrjax.robot import Robot
from mmrjax.signals import (
    BATTERY_EMPTY,
    CONVERGED,
    FAILED,
    NOT_SETTLED,
    STALLED,
    TIPS,
    PlaneMotion,
    Result,
    Signals,
)

# Units of the unknowns: currents, motor speeds, speed, lateral speed, yaw rate; heading, place; discharge.
_UNITS = (10.0, 10.0, 1000.0, 1000.0, 1.0, 1.0, 10.0, 1.0, 1.0, 1.0, 10.0)
#: Unknowns of a robot that travels straight.
OF_STRAIGHT = 5
#: Unknowns that settle on level ground.
SETTLING = 7

#: Of the search for a settled turn: implicit Euler's first step, its shortest and longest [s]; by what the next is
#: longer, and shorter where the rates grew by more than `WORSE`, or an unknown changed by more than `FAR` units.
FIRST, SHORTEST, LONGEST, LONGER, SHORTER, WORSE, FAR = 0.05, 1e-6, 1e9, 3.0, 0.25, 1.05, 0.1
#: It has ended at a change so small where the rates are small too [1/s] or the step is long [s]; and failed after so
#: many.
SMALL, SMALL_RATE, LONG, TURNS = 1e-9, 1e-7, 10.0, 200


def _kept(robot: Robot, size: int) -> tuple[Effect, ...]:
    """The effects of which so many unknowns hold a memory: all that have one, or none, which are then settled."""
    return robot.remembering if size > len(_UNITS) else ()


def _units(kept: tuple[Effect, ...]) -> Array:
    return jnp.asarray((*_UNITS, *(size for e in kept for size in (e.memory_size or 1.0,) * 2)))


def motion_of(robot: Robot, y: Float[Array, " unknowns"]) -> PlaneMotion:
    """The motion that a vector of unknowns stands for."""
    kept = _kept(robot, y.shape[0])
    y = y * _units(kept).astype(y.dtype)
    memory = {e.name: y[len(_UNITS) + 2 * k :][:2] for k, e in enumerate(kept)}
    return PlaneMotion(y[:2], y[2:4], y[4], y[5], y[6], y[7], y[8], y[9], y[10], memory)


_turning = compiled(balances.turning)


@compiled
def rates(robot: Robot, conditions: Conditions, y: Float[Array, " unknowns"]) -> Float[Array, " unknowns"]:
    """Rates of the unknowns, in their units [1/s]; those of a motor whose speed is imposed are 0."""
    motion, kept = motion_of(robot, y), _kept(robot, y.shape[0])
    travel = _turning(robot, conditions, motion)
    signals = travel.signals
    free = conditions.of_sides().motor_speed is None
    cos, sin = jnp.cos(motion.heading), jnp.sin(motion.heading)
    found = [
        *jnp.asarray(free * signals.voltage_left / signals.inductance),
        *jnp.asarray(free * signals.acceleration_wheel * robot.gearbox.ratio),
        travel.acceleration,
        travel.acceleration_lateral,
        travel.acceleration_yaw,
        motion.yaw_rate,
        motion.speed * cos - motion.speed_lateral * sin,
        motion.speed * sin + motion.speed_lateral * cos,
        robot.battery.current(jnp.mean(jnp.asarray(signals.total_current))) * (conditions.battery > 0.5),  # eq. (11)
    ]
    for effect in kept:
        found.extend(jax.vmap(lambda s, effect=effect: effect.rate(robot, s))(signals))
    return jnp.stack([jnp.asarray(x, y.dtype) for x in found]) / _units(kept).astype(y.dtype)


def start(robot: Robot, conditions: Conditions, rolling: bool = False) -> Float[Array, " unknowns"]:
    """At rest, headed as the conditions say; or settled in its turn, at rest where there is none. Motors turn where
    their speed is imposed."""
    heading = 0.0 if conditions.heading_deg is None else jnp.radians(conditions.heading_deg)
    size, own = _units(robot.remembering), conditions.of_sides()
    y = jnp.zeros_like(size).at[7].set(heading).at[10].set(conditions.discharge)
    if own.motor_speed is not None:
        y = y.at[2:4].set(own.motor_speed)
    if not rolling:
        return y / size
    settled, solved = _settled(robot, conditions)
    signals = balances.turning(robot, conditions, motion_of(robot, settled)).signals
    memory = [jax.vmap(lambda s, e=e: e.settled(robot, s))(signals) for e in robot.remembering]
    rolls = jnp.concatenate([settled * size[: len(_UNITS)], *memory]).at[7].set(y[7])
    return jnp.where(solved & jnp.all(jnp.isfinite(rolls)), rolls, y) / size


# --- circling


def _guess(robot: Robot, conditions: Conditions) -> Float[Array, " 11"]:
    """Motors near their no-load speed, the robot turning as one twice as wide that does not slip."""
    own, chassis = conditions.of_sides(), robot.chassis(conditions.configuration)
    shafts = 0.9 * jax.vmap(lambda c: voltage_at_rest(robot, c))(own) / robot.motor.torque_constant
    if own.motor_speed is not None:
        shafts = own.motor_speed
    speeds = chassis.radius * shafts / robot.gearbox.ratio
    turn = (speeds[1] - speeds[0]) / (2 * chassis.turning.width)
    y = jnp.zeros(len(_UNITS)).at[2:4].set(shafts).at[4].set(jnp.mean(speeds)).at[6].set(turn)
    return y.at[10].set(conditions.discharge) / jnp.asarray(_UNITS)


class _Search(eqx.Module):
    """A search for a settled turn.

    Attributes:
        y: those of the unknowns that settle; rates: theirs [1/s]; jacobian: of these by those.
        step: length of the next step [s]; turns: steps taken; solved: whether it has ended well.
    """

    y: Float[Array, " 7"]
    rates: Float[Array, " 7"]
    jacobian: Float[Array, "7 7"]
    step: Scalar
    turns: Scalar
    solved: Array


def _settled(robot: Robot, conditions: Conditions) -> tuple[Float[Array, " 11"], Bool[Array, ""]]:
    """The unknowns of a settled turn on level ground, and whether it was found.

    Implicit Euler's steps, longer and longer, follow a run to where it settles; in the end they are Newton's, and the
    last of those carries the derivatives, which are the implicit ones.
    """
    moves = np.arange(SETTLING) >= (0 if conditions.of_sides().motor_speed is None else 4)
    still = -jnp.eye(SETTLING)

    def others(conditions: Conditions) -> Array:
        return jnp.zeros(len(_UNITS) - SETTLING).at[-1].set(conditions.discharge / _UNITS[-1])

    def of(y: Array, robot: Robot, conditions: Conditions) -> Array:
        return rates(robot, conditions, jnp.concatenate([y, others(conditions)]))[:SETTLING]

    def begun(held: tuple[Robot, Conditions]) -> _Search:
        """Its first step goes nowhere: it only looks round."""
        guess = _guess(*held)[:SETTLING]
        none = jnp.zeros_like(guess)
        return _Search(guess, none, still, jnp.asarray(FIRST), jnp.asarray(0), jnp.asarray(False))

    def turn(held: tuple[Robot, Conditions], search: _Search) -> _Search:
        step = inverse(jnp.eye(SETTLING) / search.step - search.jacobian)(search.rates)
        there = search.y + step
        slope, found = jax.jacfwd(lambda y: (of(y, *held),) * 2, has_aux=True)(there)
        slope = jnp.where(moves[:, None], slope, still)  # what does not move has no equation of its own
        before, after = jnp.linalg.norm(search.rates), jnp.linalg.norm(found)
        worse = (~(after <= WORSE * before + SMALL) | (jnp.max(jnp.abs(step)) > FAR)) & (search.turns > 0)
        ended = ~worse & (jnp.max(jnp.abs(step)) < SMALL) & ((search.step > LONG) | (after < SMALL_RATE))
        y, found, slope = (
            jnp.where(worse, old, new)
            for old, new in ((search.y, there), (search.rates, found), (search.jacobian, slope))
        )
        length = jnp.clip(search.step * jnp.where(worse, SHORTER, LONGER), SHORTEST, LONGEST)
        return _Search(y, found, slope, length, search.turns + 1, ended)

    end = lanes.until(begun, turn, lambda search: (search.turns >= TURNS) | search.solved, (robot, conditions))
    sound = end.solved & jnp.all(jnp.isfinite(end.jacobian))
    slope = jnp.where(sound, end.jacobian, still)
    last = inverse(-slope)(jnp.where(sound, of(end.y, robot, conditions), 0.0))
    return jnp.concatenate([end.y + last, others(conditions)]), sound


def circling(robot: Robot, conditions: Conditions) -> tuple[balances.Travel, PlaneMotion, Array]:
    """All of a settled turn on level ground, and its status; numbers whatever that is.

    Args:
        conditions: one run, scalar fields, on level ground.

    Returns:
        What both sides do, how the robot moves, and `converged`; `stalled` where neither shafts nor robot move faster
        than friction at rest is resolved; `tips` where no load is left on a side or at an end; `battery_empty`;
        `not_settled` where no settled turn was found: it may be that there is none, as friction falls with sliding.
    """
    y, solved = _settled(robot, conditions)
    motion = motion_of(robot, y)
    travel = balances.turning(robot, conditions, motion)
    status = _status(robot, conditions, travel, motion)
    return travel, motion, jnp.where(solved, status, NOT_SETTLED)


def _status(robot: Robot, conditions: Conditions, travel: balances.Travel, motion: PlaneMotion) -> Array:
    """Status of a robot that keeps its motion."""
    chassis = robot.chassis(conditions.configuration)
    shafts = jnp.max(jnp.abs(travel.signals.speed_theoretical))
    along = (
        jnp.abs(motion.speed) + jnp.abs(motion.speed_lateral) + jnp.abs(motion.yaw_rate) * chassis.turning.width / 2
    )
    status = jnp.where(jnp.minimum(shafts, along) < chassis.speed_still, STALLED, CONVERGED)
    status = jnp.where(tips(robot, travel), TIPS, status)
    empty = (conditions.battery > 0.5) & robot.battery.empty(motion.discharge)
    return jnp.where(empty, BATTERY_EMPTY, status)


def status_moving(robot: Robot, conditions: Conditions, travel: balances.Travel, motion: PlaneMotion) -> Array:
    """Status at the end of a run over time: `not_settled` while its motion in its own frame changes, else what it is
    of a robot that keeps it."""
    arm = robot.chassis(conditions.configuration).turning.width / 2
    size = jnp.abs(motion.speed) + jnp.abs(motion.speed_lateral) + arm * jnp.abs(motion.yaw_rate)
    change = (
        jnp.abs(travel.acceleration) + jnp.abs(travel.acceleration_lateral) + arm * jnp.abs(travel.acceleration_yaw)
    )
    status = _status(robot, conditions, travel, motion)
    return jnp.where((change * TIME > SHARE * size) & (status == CONVERGED), NOT_SETTLED, status)


def at_rest(y: Float[Array, " unknowns"]) -> Float[Array, " unknowns"]:
    """1 for those unknowns that change of a robot that friction holds: currents and charge."""
    return jnp.zeros_like(y).at[jnp.asarray([0, 1, 10])].set(1.0)


def norm(error: Float[Array, " unknowns"]) -> Scalar:
    """Root mean square of an error, both sides' as one: steps are those of straight travel where the sides are
    alike."""
    weight = jnp.ones(error.shape[0]).at[:4].set(0.5).at[len(_UNITS) :].set(0.5)
    return jnp.sqrt(jnp.sum(weight * error**2) / OF_STRAIGHT)


def holds(robot: Robot, conditions: Conditions) -> Array:
    """Whether friction at rest holds a robot that stands: each side against its motors and its share of gravity, the
    ground against all of gravity."""
    heading = 0.0 if conditions.heading_deg is None else jnp.radians(conditions.heading_deg)
    own = conditions.of_sides()
    along = jnp.degrees(jnp.arcsin(jnp.sin(own.slope) * jnp.cos(heading)))
    sides = jax.vmap(lambda c: rest.holds(robot, c))(dataclasses.replace(own, slope_deg=along, heading_deg=None))
    chassis = robot.chassis(conditions.configuration)
    level, aside = chassis.ground.friction.static * conditions.adhesion, jnp.tan(conditions.slope) * jnp.sin(heading)
    return jnp.all(sides) & (jnp.abs(aside) < level * chassis.turning.lateral)


def tips(robot: Robot, travel: balances.Travel) -> Array:
    """Whether no load is left on a side, or all of it is at an end of the contact."""
    load = jnp.sum(travel.grip.normal)
    return (jnp.abs(travel.grip.moved) >= load / 2) | (
        jnp.abs(travel.grip.centre) >= robot.running_gear.wheelbase / 2
    )


def together(signals: Signals) -> Signals:
    """Signals of both sides as those of one motor on average, from which totals follow as of sides alike."""
    return jax.tree.map(lambda x: jnp.mean(x, axis=-1) if jnp.ndim(x) else x, signals)


def shown(robot: Robot, signals: Signals) -> dict[str, Scalar]:
    """What the instruments show of every channel [SI], of signals whose last axis is that of the sides."""
    read = balances.sensor(robot, signals)
    return {
        c.name: jnp.mean(jnp.asarray(read[c.name]), -1) if c.side is None else jnp.asarray(read[c.name])[..., c.side]
        for c in channels.EVERY
    }


def result_of(robot: Robot, travel: balances.Travel, status: Array) -> Result:
    """Readings, powers and exceeded limits of an instant: means over both sides, and the worse of them."""
    signals = travel.signals
    each = jax.vmap(lambda s: result(robot, s, status))(signals)
    mean = jax.tree.map(lambda x: jnp.mean(x, axis=0), each)
    flags = each.flags[0] | each.flags[1]
    limit = robot.sides / 2 * signals.adhesion_limit
    return dataclasses.replace(
        mean,
        reading=shown(robot, signals),
        slip=ground.slip(mean.speed, mean.theoretical_speed),
        adhesion_used=jnp.max(jnp.hypot(travel.grip.ahead, travel.grip.aside) / limit),
        efficiency_motor=efficiency(mean.power_motor, mean.power_supply),
        efficiency_gear=efficiency(mean.power_gear, mean.power_motor),
        efficiency_chassis=efficiency(mean.power_ground, mean.power_gear),
        winding_settled=jnp.max(each.winding_settled),
        status=status,
        flags=flags,
    )


def operating_point(robot: Robot, conditions: Conditions) -> tuple[Result, Array]:
    """A settled turn, see `circling`, and whether its conditions are sound; with numbers whatever the status."""
    sound = jnp.asarray(True)
    for number in jax.tree.leaves(conditions):
        sound &= jnp.isfinite(number)
    conditions = jax.tree.map(lambda x: jnp.where(sound, x, jnp.ones_like(x)), conditions)
    travel, _, status = circling(robot, conditions)
    return result_of(robot, travel, jnp.where(sound, status, FAILED)), sound


def steady(robot: Robot, conditions: Conditions) -> Result:
    """`steady` of a robot that turns: see `circling`; NaN where it has no settled turn."""
    point, sound = operating_point(robot, conditions)
    return withhold(point, (point.status == CONVERGED) | (point.status == STALLED), sound)
