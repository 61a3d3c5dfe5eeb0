"""Gear loss that grows faster than the load."""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar

from mmrjax.effects.base import Effect
from mmrjax.params import Scalar, parameter
from mmrjax.signals import Signals

if TYPE_CHECKING:
    from mmrjax.robot import Robot


class GearQuadraticLoss(Effect):
    """ΔM_r = a M_load²: the square of the torque at the output shaft.

    Source: second-order term of the load-dependent mesh loss, whose friction grows with tooth load
    (Ohlendorf, Verlustleistung und Erwärmung von Stirnrädern, 1958: μ as the power 0.2 of the load) and
    whose planets tilt.
    """

    name: ClassVar[str] = "gear_quadratic_loss"
    balance: ClassVar[str] = "gearbox"
    dissipative: ClassVar[bool] = True

    amplitude: Scalar = parameter(
        0.0,
        unit="1/N/m",
        meaning="loss torque over squared output torque",
        bounds=(-0.05, 0.3),
        sd=0.03,
        source="at 2 N·m 6 % of the load",
        amplitude=True,
    )

    def term(self, robot: Robot, signals: Signals) -> Scalar:
        load = signals.torque_track_loss + robot.chassis(signals.configuration).radius * signals.traction
        return self.amplitude * load**2 * signals.direction
