"""Belt and pulley-bearing friction that falls as the belt gains speed."""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar

import jax.numpy as jnp

from mmrjax.effects.base import Effect
from mmrjax.params import Scalar, parameter
from mmrjax.signals import Signals

if TYPE_CHECKING:
    from mmrjax.robot import Robot


class StribeckTrack(Effect):
    """ΔM_t = a exp(-|ω_k| / ω_s) sign ω_k at the pulley, for a side's tracks.

    Source: Tustin (1947), the exponential law; Armstrong-Hélouvry, Dupont and Canudas de Wit (1994).
    """

    name: ClassVar[str] = "stribeck_track"
    balance: ClassVar[str] = "track"
    dissipative: ClassVar[bool] = True

    amplitude: Scalar = parameter(
        0.0,
        unit="N·m",
        meaning="loss torque at rest beyond M_t0",
        bounds=(-0.1, 1.0),
        sd=0.1,
        source="a third of M_t0 of Table 3",
        amplitude=True,
    )
    speed_fade: Scalar = parameter(
        8.0,
        unit="rad/s",
        meaning="pulley speed ω_s over which the excess fades",
        bounds=(0.5, 80.0),
        relative_sd=0.5,
        source="belt speeds of 0.1 to 0.5 m/s",
    )

    def term(self, robot: Robot, signals: Signals) -> Scalar:
        return self.amplitude * jnp.exp(-jnp.abs(signals.speed_wheel) / self.speed_fade) * signals.direction
