"""Leads and inner resistance that both motors share."""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar

from mmrjax.effects.base import Effect
from mmrjax.params import Scalar, parameter
from mmrjax.signals import Signals

if TYPE_CHECKING:
    from mmrjax.robot import Robot


class SupplySag(Effect):
    """ΔU = a I_Σ: Ohm's law for what carries the current of all motors.

    Source: Fig. 20 of the paper (supply, leads and ammeter of the bench); Ohm (1827). With sides that are
    alike (assumption 3) it equals `series_resistance` of twice its size: only a run with one motor off tells
    them apart.
    """

    name: ClassVar[str] = "supply_sag"
    balance: ClassVar[str] = "supply"
    dissipative: ClassVar[bool] = True

    amplitude: Scalar = parameter(
        0.0,
        unit="ohm",
        meaning="resistance between the source and the motors' junction",
        bounds=(-0.2, 2.0),
        sd=0.2,
        source="bench leads of 1.5 mm^2, connectors and shunt: 0.05 to 0.3 ohm",
        amplitude=True,
    )

    def term(self, robot: Robot, signals: Signals) -> Scalar:
        return self.amplitude * signals.total_current
