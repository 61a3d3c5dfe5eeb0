"""Teeth lose more, or less, of the load than the catalogue says."""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar

import jax.numpy as jnp

from mmrjax.effects.base import Effect
from mmrjax.params import Scalar, parameter
from mmrjax.signals import Signals

if TYPE_CHECKING:
    from mmrjax.robot import Robot


class GearLoadLoss(Effect):
    """ΔM_r = a |M_load|: a share of the torque at the output shaft.

    Source: Niemann and Winter, Maschinenelemente II (2003): load-dependent mesh loss P_Z = P μ_z H_v. It is
    eq. (19)'s η_rm in another form: look-alike of a change of η_rm by -a η_rm.
    """

    name: ClassVar[str] = "gear_load_loss"
    balance: ClassVar[str] = "gearbox"
    dissipative: ClassVar[bool] = True

    amplitude: Scalar = parameter(
        0.0,
        unit="-",
        meaning="share of the output torque lost beyond eq. (19)",
        bounds=(-0.2, 0.5),
        sd=0.05,
        source="η_rm of two or three planet stages: 0.70 to 0.80",
        amplitude=True,
    )

    def term(self, robot: Robot, signals: Signals) -> Scalar:
        load = signals.torque_track_loss + robot.chassis(signals.configuration).radius * signals.traction
        return self.amplitude * jnp.abs(load) * signals.direction
