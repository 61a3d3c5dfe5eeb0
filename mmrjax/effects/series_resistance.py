"""Leads, ammeter and brush contacts in series with each motor."""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar

from mmrjax.effects.base import Effect
from mmrjax.params import Scalar, parameter
from mmrjax.signals import Signals

if TYPE_CHECKING:
    from mmrjax.robot import Robot


class SeriesResistance(Effect):
    """ΔU = a I_d: Ohm's law for everything in series with one motor that its data sheet leaves out.

    Source: Fig. 20 of the paper (leads and ammeter of the bench); Ohm (1827).
    """

    name: ClassVar[str] = "series_resistance"
    balance: ClassVar[str] = "electrical"
    dissipative: ClassVar[bool] = True

    amplitude: Scalar = parameter(
        0.0,
        unit="ohm",
        meaning="resistance in series with each motor",
        bounds=(-0.5, 5.0),
        sd=0.5,
        source="bench leads and meters: tenths of an ohm",
        amplitude=True,
    )

    def term(self, robot: Robot, signals: Signals) -> Scalar:
        return self.amplitude * signals.current
