"""Effects on the readings of the instruments, each in its channel's unit."""

from __future__ import annotations

import abc
from collections.abc import Iterator
from types import SimpleNamespace

import jax.numpy as jnp

from mmrjax.effects.base import Effect, amplitude, name_class
from mmrjax.model import channels
from mmrjax.model.channels import Channel
from mmrjax.model.params import Scalar
from mmrjax.model.robot import Robot
from mmrjax.model.signals import Signals


class SensorEffect(Effect):
    """An error of one channel's instrument, added to its reading: of its scale, a x, or of its zero, a."""

    balance = "sensor"

    @property
    @abc.abstractmethod
    def of_zero(self) -> bool:
        """True if the error does not depend on the value shown."""

    def term(self, robot: Robot, signals: Signals) -> Scalar:
        reading = robot.rig.instrument(self.channel).shows(channels.find_channel(self.channel).read(robot, signals))
        # A factor 1 of the signals' shape keeps a batch a batch.
        return self.amplitude * (jnp.ones_like(reading) if self.of_zero else reading)


class AmmeterGain(SensorEffect):
    """ΔI_Σ = a I_Σ in the reading.

    The ammeter's scale is wrong.

    Source: limits of error of meters by IEC 60051-2 (class 0.5 to 2.5) and tolerance of a shunt.
    """

    channel = "total_current"
    of_zero = False

    amplitude: Scalar = amplitude(
        "-", "relative error of the current reading", (-0.2, 0.2), "class 2.5 meter, shunt of 1 %", sd=0.02
    )


class AmmeterOffset(SensorEffect):
    """ΔI_Σ = a in the reading, in either direction of travel.

    The ammeter does not show zero at zero.

    Source: zero error of meters, IEC 60051-2. Other consumers on the same line, eq. (10).
    """

    channel = "total_current"
    of_zero = True

    amplitude: Scalar = amplitude(
        "A", "current shown with the motors off", (-1.0, 2.0), "control electronics on the line: 0.05 to 0.2 A",
        sd=0.1,
    )  # fmt: skip


class EncoderScale(SensorEffect):
    """Δω_m = a ω_m in the reading.

    The divisor for the counts of the motor's encoder is wrong.

    Source: time base and pulses per turn of the counter. A tachometer's class by IEC 60051.
    """

    channel = "motor_speed"
    of_zero = False

    amplitude: Scalar = amplitude(
        "-", "relative error of the motor speed reading", (-0.1, 0.1),
        "optical tachometer 0.1 %, analogue one 1 to 2 %", sd=0.01,
    )  # fmt: skip


class SpeedGain(SensorEffect):
    """ΔV = a V in the reading.

    The distance of the timed travel was measured wrongly.

    Source: speed as distance over time (Section 4 of the paper): the relative errors of both add.
    """

    channel = "speed"
    of_zero = False

    amplitude: Scalar = amplitude(
        "-", "relative error of the speed reading", (-0.1, 0.1), "1 to 2 cm in 1 m, a tenth of a second by hand",
        sd=0.02,
    )  # fmt: skip


def _sensor_error(read: Channel, of_zero: bool) -> type[Effect]:
    """The error of scale or zero of a channel's instrument."""
    largest, unit = (10 * read.zero_error, read.unit_si) if of_zero else (0.2, "-")
    source = "limits of error of instruments, IEC 60051-2", "class of the instrument: 0.5 to 2.5 %"
    if read.unit_shown == "°C":
        source = "tolerances of thermocouples, IEC 60584-1", "class of the instrument: 1 to 3 K"
    odd, zero = of_zero and read.directed, of_zero

    class Error(SensorEffect):
        name = f"{read.name}_{'offset' if zero else 'gain'}"
        channel = read.name
        of_zero = zero
        odd_in_travel = odd

        amplitude: Scalar = amplitude(
            unit, f"error of the {read.label} reading" if zero else f"relative error of the {read.label} reading",
            (-largest, largest), source[1], sd=read.zero_error if zero else 0.02,
        )  # fmt: skip

    Error.__doc__ = f"""Δx = a{"" if zero else " x"} in the reading x of {read.label}.

    The {"zero" if zero else "scale"} of the instrument is wrong.

    Source: {source[0]}.
    """
    return name_class(Error, "".join(word.capitalize() for word in Error.name.split("_")))


def _sensor_errors() -> Iterator[type[Effect]]:
    """Yields the errors of every channel that the classes above do not cover.

    First those of scale, except of temperatures, whose zero is a convention. Then those of zero. Random numbers
    depend on the position: add new ones at the end.
    """
    further = [c for c in channels.EVERY if c not in channels.usual_channels()]
    yield from (_sensor_error(c, of_zero=c.unit_shown == "°C") for c in further)
    yield from (_sensor_error(c, of_zero=True) for c in further if c.misses_zero)


#: A rig has the errors of its channels.
OF_CHANNELS: dict[str, type[Effect]] = {effect.name: effect for effect in _sensor_errors()}
#: The same by class name, see `made`.
Made = SimpleNamespace(**{effect.__name__: effect for effect in OF_CHANNELS.values()})
