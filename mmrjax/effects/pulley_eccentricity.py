"""The driving pulley or wheel runs out of true."""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar

from jaxtyping import Array, Int

from mmrjax.effects.base import Effect
from mmrjax.effects.periodic import Periodic, phase_parameter
from mmrjax.params import Scalar, parameter
from mmrjax.signals import Signals

if TYPE_CHECKING:
    from mmrjax.robot import Robot


class PulleyEccentricity(Periodic, Effect):
    """ΔV = -a r_k ω_k sin(θ_k + φ): the radius that rolls off is r_k (1 + a sin) with a = e / r_k.

    Source: order 1 of the driving wheel's angle; total run-out by ISO 1101. The lever arm of the traction
    changes alike, which is left out: an effect enters one balance.
    """

    name: ClassVar[str] = "pulley_eccentricity"
    balance: ClassVar[str] = "slip"

    amplitude: Scalar = parameter(
        0.0,
        unit="-",
        meaning="eccentricity over rolling radius e / r_k",
        bounds=(-0.1, 0.1),
        sd=0.01,
        source="0.2 to 0.5 mm of run-out on a printed or pressed pulley of 38 mm",
        amplitude=True,
    )
    phase: Scalar = phase_parameter()

    def order(self, robot: Robot, configuration: Int[Array, ""]) -> Scalar:
        return 1.0 / robot.gearbox.ratio

    def term(self, robot: Robot, signals: Signals) -> Scalar:
        return -self.amplitude * signals.speed_theoretical * self.wave(signals)
