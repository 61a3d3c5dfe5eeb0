"""The distance rolled per turn differs from the nominal radius."""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar

from mmrjax.effects.base import Effect
from mmrjax.params import Scalar, parameter
from mmrjax.signals import Signals

if TYPE_CHECKING:
    from mmrjax.robot import Robot


class RollingRadius(Effect):
    """ΔV = -a r_k ω_k: the robot travels (1 + a) r_k per radian, at the same lever arm of the traction.

    Source: kinematic rolling radius against loaded radius (Wong, Theory of Ground Vehicles, 2008, ch. 1).
    The difference is kinematic, so it is not dissipative by itself: a > 0 lessens the loss in slip.
    """

    name: ClassVar[str] = "rolling_radius"
    balance: ClassVar[str] = "slip"
    dissipative: ClassVar[bool] = False

    amplitude: Scalar = parameter(
        0.0,
        unit="-",
        meaning="relative error of the rolling radius",
        bounds=(-0.2, 0.2),
        sd=0.03,
        source="belt and tyre thickness against radius: a few percent",
        amplitude=True,
    )

    def term(self, robot: Robot, signals: Signals) -> Scalar:
        return -self.amplitude * signals.speed_theoretical
