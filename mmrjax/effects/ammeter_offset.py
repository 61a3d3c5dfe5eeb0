"""The ammeter does not show zero at zero."""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar

import jax.numpy as jnp

from mmrjax.effects.base import Effect
from mmrjax.params import Scalar, parameter
from mmrjax.signals import Signals

if TYPE_CHECKING:
    from mmrjax.robot import Robot


class AmmeterOffset(Effect):
    """ΔI_Σ = a in the reading, in either direction of travel.

    Source: zero error of meters, IEC 60051-2; consumers beside the motors on the same line, eq. (10).
    """

    name: ClassVar[str] = "ammeter_offset"
    balance: ClassVar[str] = "sensor"
    dissipative: ClassVar[bool] = False
    channel: ClassVar[str] = "total_current"

    amplitude: Scalar = parameter(
        0.0,
        unit="A",
        meaning="current shown with the motors off",
        bounds=(-1.0, 2.0),
        sd=0.1,
        source="control electronics on the line: 0.05 to 0.2 A",
        amplitude=True,
    )

    def term(self, robot: Robot, signals: Signals) -> Scalar:
        # Times one of the signals' shape, so that a batch stays a batch.
        return self.amplitude * jnp.ones_like(signals.total_current)
