"""The slope is not what the inclinometer says."""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar

from mmrjax.effects.base import Effect
from mmrjax.params import Scalar, parameter
from mmrjax.signals import Signals

if TYPE_CHECKING:
    from mmrjax.robot import Robot


class SlopeBias(Effect):
    """ΔF = a N: m_i g (sin(α + a) - sin α) to first order, whichever way the robot goes.

    Source: expansion of eq. (1); the change of the normal load, second order in a on the level, is left out.
    On the level it looks like rolling resistance while the robot goes forward; reverse travel tells them
    apart.
    """

    name: ClassVar[str] = "slope_bias"
    balance: ClassVar[str] = "ground"
    dissipative: ClassVar[bool] = False

    amplitude: Scalar = parameter(
        0.0,
        unit="rad",
        meaning="angle by which the slope is steeper than stated",
        bounds=(-0.1, 0.1),
        sd=9e-3,
        source="half a degree for an inclinometer on a bench",
        amplitude=True,
    )

    def term(self, robot: Robot, signals: Signals) -> Scalar:
        return self.amplitude * signals.normal
