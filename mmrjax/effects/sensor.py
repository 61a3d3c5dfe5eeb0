"""Effects on what the instruments show, each in its channel's unit."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import jax.numpy as jnp

from mmrjax import channels
from mmrjax.channels import Channel
from mmrjax.effects.base import Effect, amplitude, made
from mmrjax.params import Scalar
from mmrjax.robot import Robot
from mmrjax.signals import Signals


class SensorEffect(Effect):
    """What is added to the reading of one channel."""

    balance = "sensor"


class AmmeterGain(SensorEffect):
    """ΔI_Σ = a I_Σ in the reading.

    The ammeter's scale is off.

    Source: limits of error of meters by IEC 60051-2 (class 0.5 to 2.5) and tolerance of a shunt.
    """

    channel = "total_current"

    amplitude: Scalar = amplitude(
        unit="-",
        meaning="relative error of the current reading",
        bounds=(-0.2, 0.2),
        sd=0.02,
        source="class 2.5 meter, shunt of 1 %",
    )

    def term(self, robot: Robot, signals: Signals) -> Scalar:
        return self.amplitude * signals.total_current


class AmmeterOffset(SensorEffect):
    """ΔI_Σ = a in the reading, in either direction of travel.

    The ammeter does not show zero at zero.

    Source: zero error of meters, IEC 60051-2; consumers beside the motors on the same line, eq. (10).
    """

    channel = "total_current"

    amplitude: Scalar = amplitude(
        unit="A",
        meaning="current shown with the motors off",
        bounds=(-1.0, 2.0),
        sd=0.1,
        source="control electronics on the line: 0.05 to 0.2 A",
    )

    def term(self, robot: Robot, signals: Signals) -> Scalar:
        # Times one of the signals' shape, so that a batch stays a batch.
        return self.amplitude * jnp.ones_like(signals.total_current)


class EncoderScale(SensorEffect):
    """Δω_m = a ω_m in the reading.

    Counts of the motor's encoder are divided by a wrong number.

    Source: time base and pulses per turn of the counter; a tachometer's class by IEC 60051.
    """

    channel = "motor_speed"

    amplitude: Scalar = amplitude(
        unit="-",
        meaning="relative error of the motor speed reading",
        bounds=(-0.1, 0.1),
        sd=0.01,
        source="optical tachometer 0.1 %, analogue one 1 to 2 %",
    )

    def term(self, robot: Robot, signals: Signals) -> Scalar:
        return self.amplitude * signals.speed_motor


class SpeedGain(SensorEffect):
    """ΔV = a V in the reading.

    The distance over which the robot is timed is not what is stated.

    Source: speed as distance over time (Section 4 of the paper): both errors are relative ones.
    """

    channel = "speed"

    amplitude: Scalar = amplitude(
        unit="-",
        meaning="relative error of the speed reading",
        bounds=(-0.1, 0.1),
        sd=0.02,
        source="1 to 2 cm in 1 m, a tenth of a second by hand",
    )

    def term(self, robot: Robot, signals: Signals) -> Scalar:
        return self.amplitude * signals.speed


def _scale(shown_by: Channel) -> type[Effect]:
    """The error of the scale of a channel's instrument; of a temperature, whose zero is a convention, of its zero."""
    offset = shown_by.unit_shown == "°C"

    class Scale(SensorEffect):
        name = f"{shown_by.name}_{'offset' if offset else 'gain'}"
        channel = shown_by.name

        amplitude: Scalar = amplitude(
            unit="°C" if offset else "-",
            meaning=f"error of the {shown_by.label} reading"
            if offset
            else f"relative error of the {shown_by.label} reading",
            bounds=(-20.0, 20.0) if offset else (-0.2, 0.2),
            sd=2.0 if offset else 0.02,
            source="class of the instrument: 1 to 3 K" if offset else "class of the instrument: 0.5 to 2.5 %",
        )

        def term(self, robot: Robot, signals: Signals) -> Scalar:
            read: Any = shown_by.read(robot, signals)
            return self.amplitude * (jnp.ones_like(read) if offset else read)

    Scale.__doc__ = f"""Δx = a{"" if offset else " x"} in the reading x of {shown_by.label}.

    The {"zero" if offset else "scale"} of the instrument is off.

    Source: {"tolerances of thermocouples, IEC 60584-1" if offset else "limits of error of instruments, IEC 60051-2"}.
    """
    return made(Scale, "".join(word.capitalize() for word in Scale.name.split("_")))


#: Of every channel that the classes above are not about: a rig that has it.
OF_CHANNELS: dict[str, type[Effect]] = {
    effect.name: effect for effect in (_scale(c) for c in channels.EVERY if c not in channels.usual())
}
#: The same by the names of their classes, see `made`.
Made = SimpleNamespace(**{effect.__name__: effect for effect in OF_CHANNELS.values()})
