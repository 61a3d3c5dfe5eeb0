"""The belt's own centrifugal tension adds to its loss."""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar

from mmrjax.effects.base import Effect
from mmrjax.params import Scalar, parameter
from mmrjax.signals import Signals

if TYPE_CHECKING:
    from mmrjax.robot import Robot


class CentrifugalTension(Effect):
    """ΔM_t = a M_t0 v², v = ω_k r_p the belt's speed: dry loss M_t0 in proportion to the tension T_0 + ρ v².

    Source: centrifugal tension ρ v² of a running belt (Eytelwein 1808; Budynas and Nisbett, Shigley's
    Mechanical Engineering Design, 2011, ch. 17); so a = ρ / T_0. With the belts of Table 7, ρ = 0.05 kg/m,
    and T_0 of 1 to 10 N. Unlike `churning` it scales with the configuration's own M_t0. r_p is the radius of
    the pulley, which drives the belt in both.
    """

    name: ClassVar[str] = "centrifugal_tension"
    balance: ClassVar[str] = "track"
    dissipative: ClassVar[bool] = True

    amplitude: Scalar = parameter(
        0.0,
        unit="s^2/m^2",
        meaning="mass of the belt per length over its rest tension",
        bounds=(-0.1, 0.5),
        sd=0.05,
        source="0.005 for a taut belt, 0.05 for a slack one",
        amplitude=True,
    )

    def term(self, robot: Robot, signals: Signals) -> Scalar:
        loss = robot.chassis(signals.configuration).track.loss_coulomb
        belt_speed = signals.speed_wheel * robot.radius_pulley
        return self.amplitude * loss * belt_speed**2 * signals.direction
