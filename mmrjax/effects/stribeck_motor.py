"""Friction of brushes and bearings that falls as the shaft gains speed."""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar

import jax.numpy as jnp

from mmrjax.effects.base import Effect
from mmrjax.params import Scalar, parameter
from mmrjax.signals import Signals

if TYPE_CHECKING:
    from mmrjax.robot import Robot


class StribeckMotor(Effect):
    """ΔM_df = a exp(-|ω_m| / ω_s) sign ω_m.

    Source: Tustin, The effects of backlash and of speed-dependent friction on the stability of closed-cycle
    control systems, J. IEE 94 (1947), the exponential law; Armstrong-Hélouvry, Dupont and Canudas de Wit
    (1994), with exponent 1.
    """

    name: ClassVar[str] = "stribeck_motor"
    balance: ClassVar[str] = "motor"
    dissipative: ClassVar[bool] = True

    amplitude: Scalar = parameter(
        0.0,
        unit="N·m",
        meaning="friction torque at rest beyond the dry friction",
        bounds=(-3e-3, 2e-2),
        sd=1.5e-3,
        source="half of the dry friction of Table 2",
        amplitude=True,
    )
    speed_fade: Scalar = parameter(
        300.0,
        unit="rad/s",
        meaning="motor speed ω_s over which the excess fades",
        bounds=(20.0, 3000.0),
        relative_sd=0.5,
        source="sleeve bearings leave mixed lubrication at 1000 to 5000 rpm",
    )

    def term(self, robot: Robot, signals: Signals) -> Scalar:
        return self.amplitude * jnp.exp(-jnp.abs(signals.speed_motor) / self.speed_fade) * signals.direction
