"""The observation that every fidelity returns, made from the signals of one instant."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
from jaxtyping import Array, Int

from mmrjax import balances, ground
from mmrjax.params import Scalar
from mmrjax.robot import Robot
from mmrjax.signals import NOT_SETTLED, SLIDES, Result, Signals, quotient


def result(robot: Robot, signals: Signals, status: Int[Array, "..."]) -> Result:
    """Readings, power chain of Fig. 4 and exceeded limits of one instant."""
    sides = robot.sides
    power_supply = signals.voltage * signals.total_current
    power_motor = sides * signals.torque_motor * signals.speed_motor
    power_gear = sides * signals.torque_gear * signals.speed_wheel
    power_ground = sides * signals.traction * signals.speed
    temperature = robot.motor.temperature_winding(signals.current)
    over = (
        jnp.abs(signals.speed_motor) > robot.motor.speed_limit,
        jnp.abs(signals.speed_motor) > robot.gearbox.speed_limit,
        temperature > robot.motor.temperature_limit,
        slips(robot, signals),
    )
    flags = sum(jnp.where(o, 1 << k, 0) for k, o in enumerate(over))
    return Result(
        reading=balances.sensor(robot, signals),
        theoretical_speed=signals.speed_theoretical,
        slip=ground.slip(signals.speed, signals.speed_theoretical),
        voltage=signals.voltage,
        mass=signals.mass,
        traction=sides * signals.traction,
        adhesion_used=signals.demand / signals.adhesion_limit,
        power_supply=power_supply,
        power_motor=power_motor,
        power_gear=power_gear,
        power_ground=power_ground,
        power_lift=sides * signals.gravity * signals.speed,
        efficiency_motor=_efficiency(power_motor, power_supply),
        efficiency_gear=_efficiency(power_gear, power_motor),
        efficiency_chassis=_efficiency(power_ground, power_gear),
        temperature_winding=temperature,
        status=status,
        flags=jnp.asarray(flags),
    )


def slips(robot: Robot, signals: Signals) -> Array:
    """Whether the movers slide over the ground faster than V_s."""
    friction = robot.chassis(signals.configuration).ground.friction
    return jnp.abs(signals.speed_sliding) > friction.speed_static


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


def _efficiency(out: Scalar, into: Scalar) -> Array:
    # What comes back from a slope is no efficiency of the way there.
    forward = (out > 0) & (into >= out)
    return jnp.where(forward, quotient(out, into), 0.0)


def withhold(answer: Result, there: Array, sound: Array) -> Result:
    """NaN in every number of `answer` where `there` is false; mass and adhesion used stand where `sound`.

    The flags of a withheld member are cleared; its status says why it has no numbers.
    """
    blank = jax.tree.map(
        lambda x: jnp.where(there, x, 0 if jnp.issubdtype(x.dtype, jnp.integer) else jnp.nan), answer
    )
    stands = {name: jnp.where(sound, getattr(answer, name), jnp.nan) for name in ("mass", "adhesion_used")}
    return dataclasses.replace(blank, **stands, status=answer.status)
