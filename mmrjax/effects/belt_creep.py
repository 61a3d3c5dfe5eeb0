"""The belt stretches under traction and creeps on its pulley."""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar

from mmrjax.effects.base import Effect
from mmrjax.params import Scalar, parameter
from mmrjax.signals import Signals

if TYPE_CHECKING:
    from mmrjax.robot import Robot


class BeltCreep(Effect):
    """ΔV = a P V_teor: elastic creep, a share of the speed in proportion to the traction.

    Source: Firbank, Mechanics of the belt drive, Int. J. Mech. Sci. 12 (1970) 1053: creep = change of
    tension over the belt's stiffness E A; so a = 1/(E A). The demand stands for the traction, equal to it in
    steady travel; where the two differ in sign it is no loss.
    """

    name: ClassVar[str] = "belt_creep"
    balance: ClassVar[str] = "slip"
    dissipative: ClassVar[bool] = False

    amplitude: Scalar = parameter(
        0.0,
        unit="1/N",
        meaning="creep over traction of a side, 1/(E A)",
        bounds=(-1e-3, 1e-2),
        sd=5e-4,
        source="E A of 1 to 20 kN for narrow rubber with cord; at 22 N 1 %",
        amplitude=True,
    )

    def term(self, robot: Robot, signals: Signals) -> Scalar:
        return self.amplitude * signals.demand * signals.speed_theoretical * signals.direction
