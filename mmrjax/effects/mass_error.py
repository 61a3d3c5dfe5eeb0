"""The robot and its load weigh more than stated, by a share."""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar

from mmrjax.effects.base import Effect
from mmrjax.params import Scalar, parameter
from mmrjax.signals import Signals

if TYPE_CHECKING:
    from mmrjax.robot import Robot


class MassError(Effect):
    """ΔM = a M: the stated mass, payload included, times 1 + a.

    Source: calibration error of the scales (OIML R 76 class IIII: a few tenths of a percent; a spring
    balance: percents). Weight, adhesion, guide load and inertia all follow from the mass, so it enters there
    and nowhere else.
    """

    name: ClassVar[str] = "mass_error"
    balance: ClassVar[str] = "mass"
    dissipative: ClassVar[bool] = False

    amplitude: Scalar = parameter(
        0.0,
        unit="-",
        meaning="relative error of the stated mass",
        bounds=(-0.3, 0.3),
        sd=0.03,
        source="spring balance, cables and mud: a few percent",
        amplitude=True,
    )

    def term(self, robot: Robot, signals: Signals) -> Scalar:
        return self.amplitude * signals.mass
