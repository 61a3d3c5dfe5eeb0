"""Gear friction that falls as the input gains speed."""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar

import jax.numpy as jnp

from mmrjax.effects.base import Effect
from mmrjax.params import Scalar, parameter
from mmrjax.signals import Signals

if TYPE_CHECKING:
    from mmrjax.robot import Robot


class StribeckGear(Effect):
    """ΔM_r = a exp(-|ω_m| / ω_s) sign ω_m at the output shaft.

    Source: Tustin (1947), the exponential law; mixed lubrication of grease-packed planets (Niemann and
    Winter, 2003). With the same ω_s it is `stribeck_motor` times i η_rm.
    """

    name: ClassVar[str] = "stribeck_gear"
    balance: ClassVar[str] = "gearbox"
    dissipative: ClassVar[bool] = True

    amplitude: Scalar = parameter(
        0.0,
        unit="N·m",
        meaning="friction torque at rest, at the output",
        bounds=(-0.1, 1.0),
        sd=0.05,
        source="some 1.5 mN·m at the input, times 48 and η_rm",
        amplitude=True,
    )
    speed_fade: Scalar = parameter(
        300.0,
        unit="rad/s",
        meaning="input speed ω_s over which the excess fades",
        bounds=(20.0, 3000.0),
        relative_sd=0.5,
        source="grease leaves mixed lubrication at 1000 to 5000 rpm of the input",
    )

    def term(self, robot: Robot, signals: Signals) -> Scalar:
        return self.amplitude * jnp.exp(-jnp.abs(signals.speed_motor) / self.speed_fade) * signals.direction
