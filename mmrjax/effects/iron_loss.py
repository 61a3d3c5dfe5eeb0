"""Eddy currents in the motor's solid parts, weakened by their own field at high speed."""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar

from mmrjax.effects.base import Effect
from mmrjax.params import Scalar, parameter
from mmrjax.signals import Signals

if TYPE_CHECKING:
    from mmrjax.robot import Robot


class IronLoss(Effect):
    """ΔM_df = a 2x / (1 + x²), x = ω_m / ω_c: the drag of an eddy-current brake.

    Source: Wouterse, Critical torque and speed of eddy current brake with widely separated soft iron poles,
    IEE Proc. B 138 (1991). Below ω_c the drag grows as the speed and is eq. (14)'s viscous term; hysteresis
    is its dry one: what can be told from them is the bend towards ω_c.
    """

    name: ClassVar[str] = "iron_loss"
    balance: ClassVar[str] = "motor"
    dissipative: ClassVar[bool] = True

    amplitude: Scalar = parameter(
        0.0,
        unit="N·m",
        meaning="largest drag torque, reached at ω_c",
        bounds=(-2e-3, 1e-2),
        sd=1e-3,
        source="a quarter of the no-load torque of 4.3 mN·m",
        amplitude=True,
    )
    speed_critical: Scalar = parameter(
        800.0,
        unit="rad/s",
        meaning="motor speed ω_c of the largest drag",
        bounds=(50.0, 2e4),
        relative_sd=0.5,
        source="millimetres of solid steel: 10^2 to 10^4 rad/s",
    )

    def term(self, robot: Robot, signals: Signals) -> Scalar:
        share = signals.speed_motor / self.speed_critical
        return self.amplitude * 2 * share / (1 + share**2)
