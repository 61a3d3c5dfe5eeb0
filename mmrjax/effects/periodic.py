"""Effects that repeat with the angle of a shaft. A history shows them as orders."""

from __future__ import annotations

import abc

import equinox as eqx
import jax.numpy as jnp

from mmrjax.effects.base import Effect
from mmrjax.model import power
from mmrjax.model.conditions import Conditions
from mmrjax.model.params import Index, Scalar, parameter
from mmrjax.model.robot import Robot
from mmrjax.model.signals import Signals

STEPS = 12  # integration steps per period: derivatives at amplitude 0 are then accurate to 1e-5


def phase_parameter() -> Scalar:
    """The phase of a wave, a field of every periodic effect."""
    return parameter(
        0.0, "rad", "phase φ of the wave at the start of the run", (-4.0, 4.0),
        "position of the parts at the start: arbitrary", sd=2.0,
    )  # fmt: skip


class Periodic(Effect):
    """term = a w(signals) sin(ψ + φ), with ψ' = k ω_m and k the order per radian of the motor's shaft.

    The memory is the phase ψ [rad]. Without a memory (`steady`) the wave has its mean, zero.
    """

    transient = True
    memory_size = 100.0
    memory_unit = "rad"

    phase: eqx.AbstractVar[Scalar]

    @abc.abstractmethod
    def order(self, robot: Robot, configuration: Index) -> Scalar:
        """Radians of the wave per radian of the motor's shaft k [-]."""

    def rate(self, robot: Robot, signals: Signals) -> Scalar:
        return self.order(robot, signals.configuration) * signals.speed_motor

    def settled(self, robot: Robot, signals: Signals) -> Scalar:
        """0: a phase has no settled value. `wave` then returns its mean."""
        return jnp.zeros_like(signals.speed_motor)

    def wave(self, signals: Signals) -> Scalar:
        """sin(ψ + φ), or 0 if no phase is followed [-]."""
        if self.name not in signals.memory:
            return jnp.zeros_like(signals.speed_motor)
        return jnp.sin(signals.memory[self.name] + self.phase)

    def step_longest(self, robot: Robot, conditions: Conditions) -> Scalar:
        """A twelfth of the period at the no-load speed [s]."""
        source = power.voltage_source(
            robot.battery, conditions.voltage, conditions.battery, 0.0, conditions.discharge
        )
        rate = self.order(robot, conditions.configuration) * source / robot.motor.torque_constant
        return 2 * jnp.pi / STEPS / jnp.maximum(jnp.abs(rate), 1.0)
