"""Energy: sources and sinks of the power of an instant, and the energy stored."""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp

from mmrjax.model.balances import Travel, effects_sum, power_drawn
from mmrjax.model.conditions import Conditions
from mmrjax.model.params import Scalar, Scalars
from mmrjax.model.quantities import SINKS as SINKS
from mmrjax.model.robot import Robot
from mmrjax.model.signals import GRAVITY, PlaneMotion, Signals
from mmrjax.numerics.elementary import sine


def source_power(robot: Robot, conditions: Conditions, signals: Signals) -> Scalar:
    """Power of the source [W], negative if it takes power back.

    For the battery, its current times the no-load voltage. For the external supply, its output.
    """
    battery = robot.battery
    chemical = battery.cells * battery.voltage_no_load(signals.discharge) * battery.current(signals.total_current)
    return jnp.where(conditions.battery > 0.5, chemical, signals.voltage_source * signals.total_current)


def sink_powers(robot: Robot, conditions: Conditions, signals: Signals) -> Scalars:
    """Power into each of `SINKS` [W], over all motors and sides.

    Together with the change of the energy `stored_energy` they add up to `source_power` at each instant.
    """
    sides = robot.sides
    battery = robot.battery
    on_battery = conditions.battery > 0.5
    battery_current = battery.current(signals.total_current)
    torque_out = signals.torque_load - signals.torque_track_loss  # at the wheel: ground, and effects of the gearbox
    traction_power = signals.traction * signals.speed_theoretical
    mesh_loss = signals.torque_input * signals.speed_motor - signals.torque_gear * signals.speed_wheel
    return {
        "battery": jnp.where(on_battery, battery.cells * battery.resistance * battery_current**2, 0.0),
        "other": jnp.where(on_battery, battery.current_other * signals.voltage_source, 0.0),
        "driver": signals.voltage_source * signals.total_current - power_drawn(robot, signals),
        "winding": sides * signals.voltage_drop * signals.current * robot.driver.ripple(signals.duty),
        "motor": sides * signals.torque_motor_loss * signals.speed_motor,
        "gearbox": sides * (mesh_loss + torque_out * signals.speed_wheel - traction_power),
        "track": sides * signals.torque_track_loss * signals.speed_wheel,
        "sliding": sides * signals.traction * (signals.speed_theoretical - signals.speed),
        "rolling": sides * signals.resistance * signals.speed,
        "lift": sides * signals.gravity * signals.speed,
    }


def stored_energy(robot: Robot, signals: Signals) -> Scalar:
    """Energy in the motion of robot, wheels and rotors, and in the motors' inductance [J]."""
    inertia = robot.chassis(signals.configuration).inertia + signals.inertia_added
    rotating = robot.motor.inertia * signals.speed_motor**2 + inertia * signals.speed_wheel**2
    magnetic = signals.inductance * signals.current**2
    return 0.5 * (signals.mass * signals.speed**2 + robot.sides * (rotating + magnetic))


def sink_powers_turning(robot: Robot, conditions: Conditions, travel: Travel) -> Scalars:
    """Same as `sink_powers` for a robot that turns: sliding is Σ F·u over all contacts, lift follows its heading."""
    signals = travel.signals
    powers_of_sides = jax.vmap(lambda c, s: sink_powers(robot, c, s))(conditions.of_sides(), signals)
    powers: Scalars = {name: jnp.mean(power) for name, power in powers_of_sides.items()}
    downhill_force = jnp.mean(signals.mass) * GRAVITY * sine(conditions.slope)
    speed_aside = jnp.mean(signals.speed_lateral) * sine(jnp.mean(signals.heading))
    powers["sliding"] = powers["sliding"] + jnp.sum(travel.grip.lateral_power)
    for balance, rate in (("lateral", signals.speed_lateral), ("yaw", signals.yaw_rate)):
        effect_terms = jax.vmap(lambda s, balance=balance: effects_sum(robot, s, balance) * jnp.ones(()))(signals)
        powers["sliding"] = powers["sliding"] + robot.sides / 2 * jnp.sum(effect_terms * rate)
    powers["lift"] = powers["lift"] - downhill_force * speed_aside
    return powers


def stored_energy_turning(robot: Robot, travel: Travel, motion: PlaneMotion) -> Scalar:
    """Same as `stored_energy` for a robot that turns, with lateral and yaw motion [J]."""
    signals = replace(travel.signals, speed=jnp.broadcast_to(motion.speed, (2,)))
    turning = robot.chassis(jnp.max(signals.configuration)).turning
    mean_energy = jnp.mean(jax.vmap(lambda s: stored_energy(robot, s))(signals))
    mass_speed_squared = jnp.mean(signals.mass) * motion.speed_lateral**2
    return mean_energy + 0.5 * (mass_speed_squared + turning.inertia * motion.yaw_rate**2)
