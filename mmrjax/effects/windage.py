"""Air drag of the rotor."""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar

from mmrjax.effects.base import Effect
from mmrjax.params import Scalar, parameter
from mmrjax.signals import Signals

if TYPE_CHECKING:
    from mmrjax.robot import Robot


class Windage(Effect):
    """ΔM_df = a ω_m |ω_m|: turbulent drag, torque as the square of speed.

    Source: Vrancik, Prediction of windage power loss in alternators, NASA TN D-4849 (1968): power as the
    cube of speed at a constant skin friction coefficient.
    """

    name: ClassVar[str] = "windage"
    balance: ClassVar[str] = "motor"
    dissipative: ClassVar[bool] = True

    amplitude: Scalar = parameter(
        0.0,
        unit="N·m·s^2",
        meaning="torque over squared motor speed",
        bounds=(-1e-9, 1e-8),
        sd=5e-10,
        source="at 1200 rad/s 0.7 mN·m, a fifth of eq. (14)",
        amplitude=True,
    )

    def term(self, robot: Robot, signals: Signals) -> Scalar:
        # ω² with the shaft's smooth sign: |ω| alone has no derivative at rest.
        return self.amplitude * signals.speed_motor**2 * signals.direction
