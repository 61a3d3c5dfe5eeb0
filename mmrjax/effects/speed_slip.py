"""Slip that grows with speed."""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar

from mmrjax.effects.base import Effect
from mmrjax.params import Scalar, parameter
from mmrjax.signals import Signals

if TYPE_CHECKING:
    from mmrjax.robot import Robot


class SpeedSlip(Effect):
    """ΔV = a V_teor |V_teor|: a share of the speed in proportion to the speed.

    Source: first term of an expansion of the slip in speed; treads that lift off between impacts. The loss
    is kinematic: on a descent it does not take power out.
    """

    name: ClassVar[str] = "speed_slip"
    balance: ClassVar[str] = "slip"
    dissipative: ClassVar[bool] = False

    amplitude: Scalar = parameter(
        0.0,
        unit="s/m",
        meaning="slip over speed",
        bounds=(-0.1, 0.2),
        sd=0.02,
        source="2 % at 1 m/s",
        amplitude=True,
    )

    def term(self, robot: Robot, signals: Signals) -> Scalar:
        return self.amplitude * signals.speed_theoretical**2 * signals.direction
