"""The battery's voltage sinks over the first half minute of a load."""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar

from mmrjax.effects.base import Effect
from mmrjax.params import Scalar, parameter
from mmrjax.signals import Signals

if TYPE_CHECKING:
    from mmrjax.robot import Robot


class BatterySag(Effect):
    """ΔU = a q on the battery, with the current's slow part q: τ q' = I_Σ - q, q(0) = 0.

    Source: Chen and Rincón-Mora, Accurate electrical battery model capable of predicting runtime and I-V
    performance, IEEE Trans. Energy Conversion 21 (2006), the first RC pair; a is its resistance for the
    whole battery. The memory is q [A]; where none is kept it is settled. The pair gives back what it has
    stored, so it is not a pure loss. On an external supply it is absent.
    """

    name: ClassVar[str] = "battery_sag"
    balance: ClassVar[str] = "supply"
    dissipative: ClassVar[bool] = False
    memory_size: ClassVar[float | None] = 10.0
    memory_unit: ClassVar[str] = "A"

    amplitude: Scalar = parameter(
        0.0,
        unit="ohm",
        meaning="polarisation resistance of the battery",
        bounds=(-0.1, 2.0),
        sd=0.2,
        source="half of the 8 x 0.049 ohm of Table 1",
        amplitude=True,
    )
    time_constant: Scalar = parameter(
        20.0,
        unit="s",
        meaning="time constant of the polarisation τ",
        bounds=(0.5, 1000.0),
        relative_sd=0.5,
        source="lithium cells of a few Ah: 10 to 60 s",
    )

    def settled(self, robot: Robot, signals: Signals) -> Scalar:
        return signals.total_current

    def rate(self, robot: Robot, signals: Signals) -> Scalar:
        return (signals.total_current - signals.memory[self.name]) / self.time_constant

    def term(self, robot: Robot, signals: Signals) -> Scalar:
        return self.amplitude * self.recall(robot, signals) * signals.battery
