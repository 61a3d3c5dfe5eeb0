"""Rolling resistance that grows with the square of speed."""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar

from mmrjax.effects.base import Effect
from mmrjax.params import Scalar, parameter
from mmrjax.signals import Signals

if TYPE_CHECKING:
    from mmrjax.robot import Robot


class SpeedRolling(Effect):
    """ΔF_f = a N V² against the travel: f(V) = f + a V².

    Source: Wong, Theory of Ground Vehicles (2008), ch. 1: f = f_0 + f_s V² of rolling tyres; Bekker (1969)
    for light tracks.
    """

    name: ClassVar[str] = "speed_rolling"
    balance: ClassVar[str] = "ground"
    dissipative: ClassVar[bool] = True

    amplitude: Scalar = parameter(
        0.0,
        unit="s^2/m^2",
        meaning="rise of the coefficient f over squared speed",
        bounds=(-0.01, 0.1),
        sd=0.01,
        source="at 1 m/s a sixth to a third of f of Table 4",
        amplitude=True,
    )

    def term(self, robot: Robot, signals: Signals) -> Scalar:
        return self.amplitude * signals.normal * signals.speed**2 * signals.direction_travel
