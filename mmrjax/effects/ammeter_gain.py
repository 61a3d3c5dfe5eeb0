"""The ammeter's scale is off."""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar

from mmrjax.effects.base import Effect
from mmrjax.params import Scalar, parameter
from mmrjax.signals import Signals

if TYPE_CHECKING:
    from mmrjax.robot import Robot


class AmmeterGain(Effect):
    """ΔI_Σ = a I_Σ in the reading.

    Source: limits of error of meters by IEC 60051-2 (class 0.5 to 2.5) and tolerance of a shunt.
    """

    name: ClassVar[str] = "ammeter_gain"
    balance: ClassVar[str] = "sensor"
    dissipative: ClassVar[bool] = False
    channel: ClassVar[str] = "total_current"

    amplitude: Scalar = parameter(
        0.0,
        unit="-",
        meaning="relative error of the current reading",
        bounds=(-0.2, 0.2),
        sd=0.02,
        source="class 2.5 meter, shunt of 1 %",
        amplitude=True,
    )

    def term(self, robot: Robot, signals: Signals) -> Scalar:
        return self.amplitude * signals.total_current
