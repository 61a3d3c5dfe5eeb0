"""Inductance of leads and supply in series with the armature."""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar

import jax.numpy as jnp

from mmrjax.effects.base import Effect
from mmrjax.params import Scalar, parameter
from mmrjax.signals import Signals

if TYPE_CHECKING:
    from mmrjax.robot import Robot


class ArmatureInductance(Effect):
    """ΔL = a in eq. (15), for one motor.

    Source: eq. (15); leads have about 1 µH/m, a supply's output choke tens to hundreds of µH. It only shows
    while the current changes within a millisecond.
    """

    name: ClassVar[str] = "armature_inductance"
    balance: ClassVar[str] = "inductance"
    dissipative: ClassVar[bool] = False
    transient: ClassVar[bool] = True

    amplitude: Scalar = parameter(
        0.0,
        unit="H",
        meaning="inductance in series with each motor beyond L_d",
        bounds=(-1e-4, 5e-3),
        sd=1e-4,
        source="output filter of a bench supply",
        amplitude=True,
    )

    def term(self, robot: Robot, signals: Signals) -> Scalar:
        return self.amplitude * jnp.ones_like(signals.speed_motor)
