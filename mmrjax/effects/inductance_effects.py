"""Effects on the inductance [H] of the armature circuit, eq. (15)."""

from __future__ import annotations

import jax.numpy as jnp

from mmrjax.effects.base import Effect, amplitude
from mmrjax.model.params import Scalar
from mmrjax.model.robot import Robot
from mmrjax.model.signals import Signals


class ArmatureInductance(Effect):
    """ΔL = a in eq. (15), for one motor.

    The inductance of leads and supply is in series with the armature.

    Source: eq. (15). Leads have about 1 µH/m, a supply's output choke tens to hundreds of µH. Visible only
    while the current changes within a millisecond.
    """

    balance = "inductance"
    transient = True

    amplitude: Scalar = amplitude(
        "H", "inductance in series with each motor beyond L_d", (-1e-4, 5e-3), "output filter of a bench supply",
        sd=1e-4,
    )  # fmt: skip

    def term(self, robot: Robot, signals: Signals) -> Scalar:
        return self.amplitude * jnp.ones_like(signals.speed_motor)
