"""Rubber that is peeled off the ground behind the contact."""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar

from mmrjax.effects.base import Effect
from mmrjax.params import Scalar, parameter
from mmrjax.signals import Signals

if TYPE_CHECKING:
    from mmrjax.robot import Robot


class AdhesiveDrag(Effect):
    """ΔF_f = a (1 + (V / V_p)²)^0.3 against the travel: a rest value that grows as V^0.6, whatever the load.

    Source: Roberts and Thomas, The adhesion and friction of smooth rubber surfaces, Wear 33 (1975) 45;
    Maugis and Barquins, J. Phys. D 11 (1978) 1989: energy of peeling w (1 + (V/V_p)^0.6) times the width.
    Here rounded off at rest, so that its derivative is finite there.
    """

    name: ClassVar[str] = "adhesive_drag"
    balance: ClassVar[str] = "ground"
    dissipative: ClassVar[bool] = True

    amplitude: Scalar = parameter(
        0.0,
        unit="N",
        meaning="peeling force of one side at a crawl",
        bounds=(-0.02, 0.3),
        sd=0.02,
        source="0.1 J/m^2 over 0.1 m of width and more where it is soft",
        amplitude=True,
    )
    speed_peel: Scalar = parameter(
        1e-3,
        unit="m/s",
        meaning="speed V_p from which peeling is rate-dependent",
        bounds=(1e-6, 1.0),
        relative_sd=1.0,
        source="rubber on glass at room temperature: micrometres to millimetres a second",
    )

    def term(self, robot: Robot, signals: Signals) -> Scalar:
        growth = (1 + (signals.speed / self.speed_peel) ** 2) ** 0.3
        return self.amplitude * growth * signals.direction_travel
