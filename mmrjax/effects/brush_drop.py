"""Contact voltage of the brushes, nearly the same at every current."""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar

import jax.numpy as jnp

from mmrjax.effects.base import Effect
from mmrjax.params import Scalar, parameter
from mmrjax.signals import Signals

if TYPE_CHECKING:
    from mmrjax.robot import Robot


class BrushDrop(Effect):
    """ΔU = a I / √(I² + I_b²): a constant drop against the current, smooth through zero.

    Source: IEEE Std 113-1985 takes a constant 2 V for carbon and graphite brushes of large machines; small
    graphite brushes on copper drop tenths of a volt. The smoothing current I_b is that below which the
    contact is ohmic.
    """

    name: ClassVar[str] = "brush_drop"
    balance: ClassVar[str] = "electrical"
    dissipative: ClassVar[bool] = True

    amplitude: Scalar = parameter(
        0.0,
        unit="V",
        meaning="voltage drop of a pair of brushes",
        bounds=(-0.5, 3.0),
        sd=0.5,
        source="0.2 V (copper-graphite) to 1 V (graphite) a pair",
        amplitude=True,
    )
    current_ohmic: Scalar = parameter(
        0.1,
        unit="A",
        meaning="current I_b below which the contact is ohmic",
        bounds=(5e-3, 1.0),
        relative_sd=0.5,
        source="below the no-load current of 165 mA",
    )

    def term(self, robot: Robot, signals: Signals) -> Scalar:
        return self.amplitude * signals.current / jnp.sqrt(signals.current**2 + self.current_ohmic**2)
