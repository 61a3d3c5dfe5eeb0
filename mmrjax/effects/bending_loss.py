"""Rubber that is bent round the pulleys relaxes while it passes."""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar

from mmrjax.effects.base import Effect
from mmrjax.params import Scalar, parameter
from mmrjax.signals import Signals

if TYPE_CHECKING:
    from mmrjax.robot import Robot


class BendingLoss(Effect):
    """ΔM_t = a 2x / (1 + x²), x = ω_k / ω_r: loss modulus of a standard linear solid.

    Source: Ferry, Viscoelastic Properties of Polymers (1980), ch. 3, the loss modulus G'' of a Maxwell
    element; Gerbert, Traction Belt Mechanics (1999), bending loss of a belt at each run on and off a pulley.
    Far from ω_r it is like eq. (24)'s terms.
    """

    name: ClassVar[str] = "bending_loss"
    balance: ClassVar[str] = "track"
    dissipative: ClassVar[bool] = True

    amplitude: Scalar = parameter(
        0.0,
        unit="N·m",
        meaning="largest loss torque, reached at ω_r",
        bounds=(-0.1, 1.0),
        sd=0.05,
        source="a seventh of M_t0 of Table 3",
        amplitude=True,
    )
    speed_relaxation: Scalar = parameter(
        8.0,
        unit="rad/s",
        meaning="pulley speed ω_r of the largest loss",
        bounds=(0.5, 200.0),
        relative_sd=0.5,
        source="relaxation over a tenth of a second, about the bend's duration",
    )

    def term(self, robot: Robot, signals: Signals) -> Scalar:
        share = signals.speed_wheel / self.speed_relaxation
        return self.amplitude * 2 * share / (1 + share**2)
