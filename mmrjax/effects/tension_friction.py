"""Belt friction that grows with the traction the belt carries."""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar

import jax.numpy as jnp

from mmrjax.effects.base import Effect
from mmrjax.params import Scalar, parameter
from mmrjax.signals import Signals

if TYPE_CHECKING:
    from mmrjax.robot import Robot


class TensionFriction(Effect):
    """ΔM_t = a r_k |P_t|: tension presses the tight side on pulleys and guides.

    Source: Euler (1769) and Eytelwein (1808): normal force of a belt round a pulley in proportion to its
    tension; Merritt, The Evolution of a Tank Transmission (1946), track efficiency as a share of the
    tractive effort.
    """

    name: ClassVar[str] = "tension_friction"
    balance: ClassVar[str] = "track"
    dissipative: ClassVar[bool] = True

    amplitude: Scalar = parameter(
        0.0,
        unit="-",
        meaning="loss torque over torque of the traction",
        bounds=(-0.2, 1.0),
        sd=0.1,
        source="1 - efficiency of a rubber track's final drive: 5 to 15 %",
        amplitude=True,
    )

    def term(self, robot: Robot, signals: Signals) -> Scalar:
        radius = robot.chassis(signals.configuration).radius
        return self.amplitude * radius * jnp.abs(signals.traction) * signals.direction
