"""Counts of the motor's encoder are divided by a wrong number."""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar

from mmrjax.effects.base import Effect
from mmrjax.params import Scalar, parameter
from mmrjax.signals import Signals

if TYPE_CHECKING:
    from mmrjax.robot import Robot


class EncoderScale(Effect):
    """Δω_m = a ω_m in the reading.

    Source: time base and pulses per turn of the counter; a tachometer's class by IEC 60051.
    """

    name: ClassVar[str] = "encoder_scale"
    balance: ClassVar[str] = "sensor"
    dissipative: ClassVar[bool] = False
    channel: ClassVar[str] = "motor_speed"

    amplitude: Scalar = parameter(
        0.0,
        unit="-",
        meaning="relative error of the motor speed reading",
        bounds=(-0.1, 0.1),
        sd=0.01,
        source="optical tachometer 0.1 %, analogue one 1 to 2 %",
        amplitude=True,
    )

    def term(self, robot: Robot, signals: Signals) -> Scalar:
        return self.amplitude * signals.speed_motor
