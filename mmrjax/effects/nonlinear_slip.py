"""Slip that grows steeply as the adhesion is used up."""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar

import jax.numpy as jnp

from mmrjax.effects.base import Effect
from mmrjax.params import Scalar, parameter
from mmrjax.signals import Signals

if TYPE_CHECKING:
    from mmrjax.robot import Robot


class NonlinearSlip(Effect):
    """ΔV = a V_teor u³, u = demand over the adhesion limit of eq. (6).

    Source: Janosi and Hanamoto (1961): traction saturates over slip; the cube is the steep part of its
    inverse. u is held within 2, beyond which the robot slides anyway. A loss where demand and traction agree
    in sign.
    """

    name: ClassVar[str] = "nonlinear_slip"
    balance: ClassVar[str] = "slip"
    dissipative: ClassVar[bool] = False

    amplitude: Scalar = parameter(
        0.0,
        unit="-",
        meaning="slip at the adhesion limit",
        bounds=(-0.05, 0.5),
        sd=0.05,
        source="slip of tracks at full adhesion: 5 to 20 %",
        amplitude=True,
    )

    def term(self, robot: Robot, signals: Signals) -> Scalar:
        used = jnp.clip(signals.demand / signals.adhesion_limit, -2.0, 2.0)
        return self.amplitude * used**3 * signals.speed_theoretical * signals.direction
