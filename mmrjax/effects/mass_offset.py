"""Kilograms that one configuration carries beyond what is stated."""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar

import jax.numpy as jnp

from mmrjax.effects.base import Effect
from mmrjax.params import Scalar, parameter
from mmrjax.signals import Signals

if TYPE_CHECKING:
    from mmrjax.robot import Robot


class MassOffset(Effect):
    """M = stated mass + a in the wheeled configuration; in the tracked one M is as stated.

    Source: Table A2 prints 13.1 kg for the wheeled robot, Table 7 states 11.5 kg. Weight, adhesion,
    guide load and inertia all follow from the mass, so it enters there and nowhere else.
    """

    name: ClassVar[str] = "mass_offset"
    balance: ClassVar[str] = "mass"
    dissipative: ClassVar[bool] = False
    movers: ClassVar[str] = "wheels"

    amplitude: Scalar = parameter(
        0.0,
        unit="kg",
        meaning="mass of the wheeled robot beyond the stated mass",
        bounds=(-5.0, 5.0),
        sd=1.0,
        source="flippers weigh 4 x (470 + 25) g, wheels 4 x 86 g (Table 7)",
        amplitude=True,
    )

    def term(self, robot: Robot, signals: Signals) -> Scalar:
        return self.amplitude * jnp.ones_like(signals.payload)
