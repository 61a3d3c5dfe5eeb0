"""Track loss that grows with the square of speed."""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar

from mmrjax.effects.base import Effect
from mmrjax.params import Scalar, parameter
from mmrjax.signals import Signals

if TYPE_CHECKING:
    from mmrjax.robot import Robot


class Churning(Effect):
    """ΔM_t = a ω_k |ω_k| at the pulley, for a side's tracks.

    Source: the next term after eq. (24); impact of teeth and grousers takes a momentum that grows as the
    speed, at a rate that grows as the speed (Merritt, The Evolution of a Tank Transmission, 1946).
    """

    name: ClassVar[str] = "churning"
    balance: ClassVar[str] = "track"
    dissipative: ClassVar[bool] = True

    amplitude: Scalar = parameter(
        0.0,
        unit="N·m·s^2",
        meaning="torque over squared pulley speed",
        bounds=(-1e-3, 1e-2),
        sd=5e-4,
        source="at 25 rad/s a tenth to the whole of eq. (24)",
        amplitude=True,
    )

    def term(self, robot: Robot, signals: Signals) -> Scalar:
        # ω² with the shaft's smooth sign: |ω| alone has no derivative at rest.
        return self.amplitude * signals.speed_wheel**2 * signals.direction
