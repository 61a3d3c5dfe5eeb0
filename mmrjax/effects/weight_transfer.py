"""The slope loads the rear of the tracks, and uneven pressure costs more."""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar

import jax.numpy as jnp

from mmrjax.effects.base import Effect
from mmrjax.params import Scalar, parameter
from mmrjax.signals import Signals

if TYPE_CHECKING:
    from mmrjax.robot import Robot


class WeightTransfer(Effect):
    """ΔF_f = a N tan² α against the travel.

    Source: load transfer (h/L) tan α of the weight (Wong 2008, ch. 1); resistance that is convex in the
    local pressure gains the square of an antisymmetric transfer (Bekker 1956: compaction as a power of the
    pressure above 1), so the first-order part cancels and a ~ f (h/L)².
    """

    name: ClassVar[str] = "weight_transfer"
    balance: ClassVar[str] = "ground"
    dissipative: ClassVar[bool] = True

    amplitude: Scalar = parameter(
        0.0,
        unit="-",
        meaning="rise of the coefficient f over squared slope",
        bounds=(-0.2, 2.0),
        sd=0.2,
        source="at 20 deg 0.03, half of f of Table 4",
        amplitude=True,
    )

    def term(self, robot: Robot, signals: Signals) -> Scalar:
        return self.amplitude * signals.normal * jnp.tan(signals.slope) ** 2 * signals.direction_travel
