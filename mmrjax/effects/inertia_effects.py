"""Effects on the inertia [kg·m²] that turns with the driving wheel, eq. (31)."""

from __future__ import annotations

import jax.numpy as jnp

from mmrjax.effects.base import Effect, amplitude
from mmrjax.model.params import Scalar
from mmrjax.model.robot import Robot
from mmrjax.model.signals import Signals


class RotatingInertia(Effect):
    """ΔJ_w = a in eq. (31), for one side.

    Parts that Table 7 does not list turn with the driving wheel.

    Source: Table 7 lists pulleys, wheels and belts. Teeth, grousers, shafts and the belt stage of the drive
    are not included. It has no influence on steady travel.
    """

    balance = "inertia"
    transient = True

    amplitude: Scalar = amplitude(
        "kg·m^2", "inertia of one side at the driving wheel beyond J_w", (-5e-4, 2e-2),
        "as much again as Table 7's pulleys", sd=5e-4,
    )  # fmt: skip

    def term(self, robot: Robot, signals: Signals) -> Scalar:
        return self.amplitude * jnp.ones_like(signals.speed_motor)
