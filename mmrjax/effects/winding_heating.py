"""The winding's resistance rises as the current heats it."""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar

import jax.numpy as jnp

from mmrjax.effects.base import Effect
from mmrjax.params import Scalar, parameter
from mmrjax.signals import Signals

if TYPE_CHECKING:
    from mmrjax.robot import Robot

COPPER = 0.00393  # temperature coefficient of copper's resistance at 20 °C [1/K], IEC 60028 (1925)


class WindingHeating(Effect):
    """ΔU = a α R I · R_th R I²: copper's resistance at a share `a` of the settled temperature rise.

    Source: IEC 60028 for α; the maker's sheet for R_th = 7.7 K/W. A run shorter than the thermal time
    constants (16 s winding, 593 s housing) reaches only a share of the settled rise: 1 is settled, 0 cold.
    The rise is taken at the cold resistance (first order in α) and held at the winding's limit of 125 °C, so
    that the inrush of a start, which lasts milliseconds, is not taken for a settled current of 50 A.
    """

    name: ClassVar[str] = "winding_heating"
    balance: ClassVar[str] = "electrical"
    dissipative: ClassVar[bool] = True

    amplitude: Scalar = parameter(
        0.0,
        unit="-",
        meaning="share of the settled temperature rise that the run reaches",
        bounds=(-0.5, 3.0),
        sd=1.0,
        source="0 cold, 1 settled; above 1 for a closed housing",
        amplitude=True,
    )

    def term(self, robot: Robot, signals: Signals) -> Scalar:
        motor = robot.motor
        rise = jnp.minimum(motor.temperature_winding(signals.current), motor.temperature_limit)
        rise = rise - motor.temperature_ambient
        return self.amplitude * COPPER * rise * motor.voltage_winding(signals.current)
