"""Parts that turn with the driving wheel beyond Table 7."""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar

import jax.numpy as jnp

from mmrjax.effects.base import Effect
from mmrjax.params import Scalar, parameter
from mmrjax.signals import Signals

if TYPE_CHECKING:
    from mmrjax.robot import Robot


class RotatingInertia(Effect):
    """ΔJ_w = a in eq. (31), for one side.

    Source: Table 7 lists pulleys, wheels and belts; teeth, grousers, shafts and the belt stage of the drive
    are not weighed there. Settled travel does not feel it.
    """

    name: ClassVar[str] = "rotating_inertia"
    balance: ClassVar[str] = "inertia"
    dissipative: ClassVar[bool] = False
    transient: ClassVar[bool] = True

    amplitude: Scalar = parameter(
        0.0,
        unit="kg·m^2",
        meaning="inertia of one side at the driving wheel beyond J_w",
        bounds=(-5e-4, 2e-2),
        sd=5e-4,
        source="as much again as Table 7's pulleys",
        amplitude=True,
    )

    def term(self, robot: Robot, signals: Signals) -> Scalar:
        return self.amplitude * jnp.ones_like(signals.speed_motor)
