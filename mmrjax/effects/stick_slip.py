"""Break-away: dry contacts of the track hold more before they slip."""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar

import jax.numpy as jnp

from mmrjax.effects.base import Effect
from mmrjax.params import Scalar, parameter
from mmrjax.signals import Signals

if TYPE_CHECKING:
    from mmrjax.robot import Robot


class StickSlip(Effect):
    """ΔM_t = a z, θ_s z' = ω_k exp(-(ω_k/ω_s)²) - |ω_k| z, z(0) = 0: bristles bend over θ_s, then let go.

    Source: Dahl (1968) with the Stribeck curve of Canudas de Wit, Olsson, Åström and Lischinsky, A new model
    for control of systems with friction, IEEE Trans. Automatic Control 40 (1995); the curve stands with the
    drive of z so that its rate stays finite. Settled: z = exp(-(ω_k/ω_s)²) sign ω_k, nothing at travelling
    speed. Torque that falls with speed is what lets a crawling drive stick and slip. The memory is z [-].
    Bent bristles give energy back, so it is not a pure loss.
    """

    name: ClassVar[str] = "stick_slip"
    balance: ClassVar[str] = "track"
    dissipative: ClassVar[bool] = False
    transient: ClassVar[bool] = True
    memory_size: ClassVar[float | None] = 1.0
    memory_unit: ClassVar[str] = "-"

    amplitude: Scalar = parameter(
        0.0,
        unit="N·m",
        meaning="break-away torque of a side beyond M_t0",
        bounds=(-0.2, 2.0),
        sd=0.1,
        source="a third of M_t0 of Table 3",
        amplitude=True,
    )
    angle_breakaway: Scalar = parameter(
        0.01,
        unit="rad",
        meaning="turn of the pulley over which the contacts let go θ_s",
        bounds=(1e-4, 1.0),
        relative_sd=0.5,
        source="0.4 mm of belt: shear of teeth and seals",
    )
    speed_fade: Scalar = parameter(
        3.0,
        unit="rad/s",
        meaning="pulley speed ω_s above which the excess is gone",
        bounds=(0.05, 8.0),
        relative_sd=0.5,
        source="belt speed of 0.1 m/s",
    )

    def _excess(self, signals: Signals) -> Scalar:
        return jnp.exp(-((signals.speed_wheel / self.speed_fade) ** 2))

    def settled(self, robot: Robot, signals: Signals) -> Scalar:
        return self._excess(signals) * signals.direction

    def rate(self, robot: Robot, signals: Signals) -> Scalar:
        speed = signals.speed_wheel
        turn = speed * self._excess(signals) - speed * signals.direction * signals.memory[self.name]
        return turn / self.angle_breakaway

    def term(self, robot: Robot, signals: Signals) -> Scalar:
        return self.amplitude * self.recall(robot, signals)
