"""Friction through a bristle that bends before it slides. Base of the effects that a reversal shows."""

from __future__ import annotations

import equinox as eqx

from mmrjax.effects.base import Effect
from mmrjax.model.params import Scalar, parameter
from mmrjax.model.robot import Robot
from mmrjax.model.signals import Signals


def breakaway_parameter() -> Scalar:
    """The breakaway angle θ_s of a bristle, a field of every effect with one."""
    return parameter(
        0.02, "rad", "angle θ_s of the driven shaft until the contacts slide", (1e-4, 2.0),
        "1 mm of belt, a degree of a geared shaft", relative_sd=0.5,
    )  # fmt: skip


class Bristle(Effect):
    """A term in the bend z of a bristle at the driven shaft: θ_s z' = ω_k - |ω_k| z, z(0) = 0, settled z = sign ω_k.

    Dahl, A solid friction model (1968), with exponent 1. The first order of Canudas de Wit, Olsson, Åström and
    Lischinsky (1995) with a steady curve that does not depend on speed. The memory is z [-].
    """

    memory_size = 1.0
    memory_unit = "-"

    angle_breakaway: eqx.AbstractVar[Scalar]

    def settled(self, robot: Robot, signals: Signals) -> Scalar:
        return signals.direction

    def rate(self, robot: Robot, signals: Signals) -> Scalar:
        speed = signals.speed_wheel
        return speed * (1 - signals.direction * signals.memory[self.name]) / self.angle_breakaway
