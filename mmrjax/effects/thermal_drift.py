"""The winding warms up while the run lasts."""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar

from mmrjax.effects.base import Effect
from mmrjax.params import Scalar, parameter
from mmrjax.signals import Signals

if TYPE_CHECKING:
    from mmrjax.robot import Robot

ALPHA = 0.00393  # temperature coefficient of copper's resistance at 20 °C [1/K], IEC 60028 (1925)


class ThermalDrift(Effect):
    """ΔU = a α R I T, with the rise T of the winding over its housing: τ T' = R_wh R I² - T, T(0) = 0.

    Source: IEC 60028 for α; the maker's sheet of RE30 310007 for τ and R_wh. The housing, with 593 s, stays
    where it was during a run: its share is `winding_heating`, which settled travel cannot tell from this.
    The memory is T [K]; where none is kept it is settled.
    """

    name: ClassVar[str] = "thermal_drift"
    balance: ClassVar[str] = "electrical"
    dissipative: ClassVar[bool] = True
    memory_size: ClassVar[float | None] = 10.0
    memory_unit: ClassVar[str] = "K"

    amplitude: Scalar = parameter(
        0.0,
        unit="-",
        meaning="share of the sheet's temperature rise",
        bounds=(-1.0, 10.0),
        sd=1.0,
        source="1 by the sheet; more in still air between printed walls",
        amplitude=True,
    )
    time_constant: Scalar = parameter(
        16.3,
        unit="s",
        meaning="thermal time constant of the winding τ",
        bounds=(1.0, 600.0),
        relative_sd=0.3,
        source="maker's sheet of RE30 310007",
    )
    resistance_thermal: Scalar = parameter(
        1.7,
        unit="K/W",
        meaning="thermal resistance winding to housing R_wh",
        bounds=(0.1, 20.0),
        relative_sd=0.2,
        source="maker's sheet of RE30 310007",
    )

    def settled(self, robot: Robot, signals: Signals) -> Scalar:
        return self.resistance_thermal * robot.motor.voltage_winding(signals.current) * signals.current

    def rate(self, robot: Robot, signals: Signals) -> Scalar:
        return (self.settled(robot, signals) - signals.memory[self.name]) / self.time_constant

    def term(self, robot: Robot, signals: Signals) -> Scalar:
        drop = robot.motor.voltage_winding(signals.current)
        return self.amplitude * ALPHA * self.recall(robot, signals) * drop
