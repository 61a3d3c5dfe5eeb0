"""Movers that sink in deeper under load meet more resistance."""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar

from mmrjax.effects.base import Effect
from mmrjax.params import Scalar, parameter
from mmrjax.signals import Signals

if TYPE_CHECKING:
    from mmrjax.robot import Robot


class Sinkage(Effect):
    """ΔF_f = a N (M / M_0)^(1/n) against the travel, M_0 the robot without payload.

    Source: Bekker, Theory of Land Locomotion (1956): compaction resistance as the power (n + 1)/n of the
    load with sinkage exponent n. Written as a change of the coefficient at the unladen robot, so that a is a
    coefficient.
    """

    name: ClassVar[str] = "sinkage"
    balance: ClassVar[str] = "ground"
    dissipative: ClassVar[bool] = True

    amplitude: Scalar = parameter(
        0.0,
        unit="-",
        meaning="rise of the coefficient f at the robot's own mass",
        bounds=(-0.03, 0.3),
        sd=0.02,
        source="a third of f of Table 4",
        amplitude=True,
    )
    exponent: Scalar = parameter(
        1.0,
        unit="-",
        meaning="sinkage exponent n",
        bounds=(0.3, 2.0),
        relative_sd=0.3,
        source="0.5 clay, 1 sand, felt and lacquer like springs (Wong 2008, ch. 2)",
    )

    def term(self, robot: Robot, signals: Signals) -> Scalar:
        unladen = robot.chassis(signals.configuration).mass
        growth = (signals.mass / unladen) ** (1 / self.exponent)
        return self.amplitude * signals.normal * growth * signals.direction_travel
