"""Effects on the inertia [kg·m²] that turns with the driving wheel, eq. (31)."""

from __future__ import annotations

import jax.numpy as jnp

from mmrjax.effects.base import Effect, amplitude
from mmrjax.model.params import Scalar
from mmrjax.model.robot import Robot
from mmrjax.model.signals import Signals


class RotatingInertia(Effect):
    """ΔJ_w = a in eq. (31), for one side.

    Parts that turn with the driving wheel beyond Table 7.

    Source: Table 7 lists pulleys, wheels and belts; teeth, grousers, shafts and the belt stage of the drive
    are not included. It has no influence on steady travel.
    """

    balance = "inertia"
    transient = True

    amplitude: Scalar = amplitude(
        unit="kg·m^2",
        meaning="inertia of one side at the driving wheel beyond J_w",
        bounds=(-5e-4, 2e-2),
        sd=5e-4,
        source="as much again as Table 7's pulleys",
    )

    def term(self, robot: Robot, signals: Signals) -> Scalar:
        return self.amplitude * jnp.ones_like(signals.speed_motor)
