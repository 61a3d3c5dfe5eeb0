"""The observation that every fidelity returns, made from the signals of one instant."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Int

from mmrjax.fidelities import outputs
from mmrjax.model import balances, contact
from mmrjax.model.gearmotor import UNLIMITED
from mmrjax.model.params import Scalar
from mmrjax.model.quantities import HEAT
from mmrjax.model.robot import Robot
from mmrjax.model.signals import CONVERGED, FLAGS, REVERSES, ROLLS_BACK, Result, Signals, safe_quotient
from mmrjax.numerics.elementary import magnitude

#: Current into a supply that counts as 0 [A]: rounding and the remainder of a converged search.
CURRENT_SMALL = 1e-3


def result_of_signals(robot: Robot, signals: Signals, status: Int[Array, "..."]) -> Result:
    """Readings, power chain of Fig. 4 and warnings of one instant. Numbers with unknown parameters are NaN."""
    sides = robot.sides
    power_supply = balances.power_drawn(robot, signals)
    power_motor = sides * signals.torque_motor * signals.speed_motor
    power_gear = sides * signals.torque_gear * signals.speed_wheel
    power_ground = sides * signals.traction * signals.speed
    temperature = robot.motor.temperature_settled(signals.current * robot.driver.ripple(signals.duty) ** 0.5)
    limit = robot.motor.temperature_limit
    is_too_hot = (temperature > limit) & (limit < UNLIMITED) & robot.knows(HEAT)  # settled or not
    flags = flag_mask({**exceeded_limits(robot, signals), "winding_hot": is_too_hot})
    result = Result(
        reading=balances.sensor(robot, signals),
        theoretical_speed=signals.speed_theoretical,
        slip=contact.slip_ratio(signals.speed, signals.speed_theoretical),
        voltage=signals.voltage,
        mass=signals.mass,
        traction=sides * signals.traction,
        adhesion_used=magnitude(signals.demand, signals.direction_travel) / signals.adhesion_limit,
        power_supply=power_supply,
        power_motor=power_motor,
        power_gear=power_gear,
        power_ground=power_ground,
        power_lift=sides * signals.gravity * signals.speed,
        efficiency_motor=power_ratio(power_motor, power_supply),
        efficiency_gear=power_ratio(power_gear, power_motor),
        efficiency_chassis=power_ratio(power_ground, power_gear),
        winding_settled=temperature,
        voltage_cell=jnp.where(signals.battery > 0.5, signals.voltage_source / robot.battery.cells, 0.0),
        status=status,
        flags=flags,
    )
    return mask_unknown(robot, result)


def mask_unknown(robot: Robot, found: Result) -> Result:
    """Copy of `found` in which numbers that depend on unknown parameters of the robot are NaN."""
    unknown = [output.name for output in outputs.FURTHER if not robot.knows(output.rests_on)]
    nan: dict[str, Any] = {name: jnp.full_like(getattr(found, name), jnp.nan) for name in unknown}
    return dataclasses.replace(found, **nan)


def exceeded_limits(robot: Robot, signals: Signals) -> dict[str, Scalar]:
    """Limits exceeded at an instant, by the flag's name."""
    battery, on_battery = robot.battery, signals.battery > 0.5
    cell, current = signals.voltage_source / battery.cells, battery.current(signals.total_current)
    discharge_limit, charge_limit = battery.current_limit or jnp.inf, battery.current_charge or jnp.inf
    # A full cell at rest may have its charge voltage: only a current into it can exceed the limit.
    overcharged = (cell > battery.voltage_charge) & (current < 0)
    torque = jnp.abs(signals.torque_gear)
    return {
        "motor_overspeed": jnp.abs(signals.speed_motor) > robot.motor.speed_limit,
        "gearbox_overspeed": jnp.abs(signals.speed_motor) > robot.gearbox.speed_limit,
        "slips": movers_slip(robot, signals),
        "overvoltage": on_battery & (overcharged | (current < -charge_limit)),
        "cut_off": on_battery & (cell < battery.voltage_cutoff),
        "battery_overcurrent": on_battery & (current > discharge_limit),
        "current_limited": robot.driver.limits(signals.current),
        "gearbox_overload": torque > (robot.gearbox.torque_limit or jnp.inf),
        "voltage_rising": on_battery & battery.rises(signals.discharge),
        "current_returned": ~on_battery & (signals.total_current * jnp.sign(signals.voltage_source) < -CURRENT_SMALL),
    }


def flag_mask(over: Mapping[str, Scalar]) -> Array:
    """Bit mask over `FLAGS`."""
    return jnp.asarray(sum(jnp.where(o, 1 << FLAGS.index(name), 0) for name, o in over.items()))


def travel_status(speed: Scalar, voltage: Scalar) -> Array:
    """Status of steady travel at `speed` under a motor `voltage`, which distinguishes motion driven by the motors
    from motion driven by gravity.
    """
    backward = jnp.asarray(speed) < 0
    has_asked_sign = jnp.where(backward, jnp.asarray(voltage) < 0, jnp.asarray(voltage) >= 0)
    return jnp.where(has_asked_sign, jnp.where(backward, REVERSES, CONVERGED), ROLLS_BACK)


def movers_slip(robot: Robot, signals: Signals) -> Array:
    """True if the movers slide over the ground faster than V_s."""
    return jnp.abs(signals.speed_sliding) > robot.chassis(signals.configuration).speed_grip


def power_ratio(out: Scalar, into: Scalar) -> Array:
    """Power out over power in [-], 0 at rest and if power flows the other way."""
    # Power returned on a descent has no efficiency of forward travel.
    forward = (out >= 0) & (into >= out)
    return jnp.where(forward, safe_quotient(out, into), 0.0)


def withhold_numbers(answer: Result, valid: Array, sound: Array) -> Result:
    """Sets every number of `answer` to NaN if `valid` is false. Keeps mass and adhesion used if `sound`.

    The flags of a withheld member are cleared. Its status says why it has no numbers.
    """
    blank = jax.tree.map(
        lambda x: jnp.where(valid, x, 0 if jnp.issubdtype(x.dtype, jnp.integer) else jnp.nan), answer
    )
    stands = {name: jnp.where(sound, getattr(answer, name), jnp.nan) for name in ("mass", "adhesion_used")}
    return dataclasses.replace(blank, **stands, status=answer.status)
