"""The belt goes over its grousers as over the corners of a polygon."""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar

import jax.numpy as jnp
from jaxtyping import Array, Int

from mmrjax.effects.base import Effect
from mmrjax.effects.periodic import Periodic, phase_parameter
from mmrjax.params import Scalar, parameter
from mmrjax.signals import Signals

if TYPE_CHECKING:
    from mmrjax.robot import Robot


class GrouserPolygon(Periodic, Effect):
    """ΔF = a sin(2π r_k θ_k / p + φ) in the tracked configuration, p the pitch of the grousers.

    Source: chordal action of chain drives (Budynas and Nisbett, Shigley's Mechanical Engineering Design,
    2011, ch. 17), grousers every 35 mm (Section 3.2.4): 6.9 passages a turn of the pulley. What is lifted
    comes down again, so it takes no power out over a passage.
    """

    name: ClassVar[str] = "grouser_polygon"
    balance: ClassVar[str] = "ground"
    movers: ClassVar[str] = "tracks"

    amplitude: Scalar = parameter(
        0.0,
        unit="N",
        meaning="amplitude of the force of one side",
        bounds=(-20.0, 20.0),
        sd=1.0,
        source="a few percent of the weight of a side",
        amplitude=True,
    )
    phase: Scalar = phase_parameter()
    pitch: Scalar = parameter(
        35e-3,
        unit="m",
        meaning="pitch p of the grousers",
        bounds=(5e-3, 0.2),
        relative_sd=0.01,
        source="Section 3.2.4",
    )

    def order(self, robot: Robot, configuration: Int[Array, ""]) -> Scalar:
        passages = robot.radius_pulley / (self.pitch * robot.gearbox.ratio)
        return 2 * jnp.pi * passages * robot.chassis(configuration).on_tracks

    def term(self, robot: Robot, signals: Signals) -> Scalar:
        return self.amplitude * self.wave(signals)
