"""Belt and tyre that yield under load roll off less."""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar

from mmrjax.effects.base import Effect
from mmrjax.params import Scalar, parameter
from mmrjax.signals import Signals

if TYPE_CHECKING:
    from mmrjax.robot import Robot


class LoadSlip(Effect):
    """ΔV = a V_teor N: radius r_k (1 - a N).

    Source: effective rolling radius of a loaded tyre (Wong 2008, ch. 1; Pacejka, Tire and Vehicle Dynamics,
    2012, ch. 1). Kinematic, so not dissipative by itself.
    """

    name: ClassVar[str] = "load_slip"
    balance: ClassVar[str] = "slip"
    dissipative: ClassVar[bool] = False

    amplitude: Scalar = parameter(
        0.0,
        unit="1/N",
        meaning="relative loss of rolling radius over load of a side",
        bounds=(-1e-3, 2e-3),
        sd=1e-4,
        source="at 100 N 1 %: tread 5 mm thick yields 0.5 mm",
        amplitude=True,
    )

    def term(self, robot: Robot, signals: Signals) -> Scalar:
        return self.amplitude * signals.normal * signals.speed_theoretical
