"""The distance over which the robot is timed is not what is stated."""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar

from mmrjax.effects.base import Effect
from mmrjax.params import Scalar, parameter
from mmrjax.signals import Signals

if TYPE_CHECKING:
    from mmrjax.robot import Robot


class SpeedGain(Effect):
    """ΔV = a V in the reading.

    Source: speed as distance over time (Section 4 of the paper): both errors are relative ones.
    """

    name: ClassVar[str] = "speed_gain"
    balance: ClassVar[str] = "sensor"
    dissipative: ClassVar[bool] = False
    channel: ClassVar[str] = "speed"

    amplitude: Scalar = parameter(
        0.0,
        unit="-",
        meaning="relative error of the speed reading",
        bounds=(-0.1, 0.1),
        sd=0.02,
        source="1 to 2 cm in 1 m, a tenth of a second by hand",
        amplitude=True,
    )

    def term(self, robot: Robot, signals: Signals) -> Scalar:
        return self.amplitude * signals.speed
