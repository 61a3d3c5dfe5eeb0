"""Effects on the readings of the sensors, each in its channel's unit, and on the duty [-] that the driver gives."""

from __future__ import annotations

import abc
from collections.abc import Iterator
from types import SimpleNamespace

import jax.numpy as jnp

from mmrjax.effects.base import Effect, EffectClasses, amplitude, name_class
from mmrjax.model import channels
from mmrjax.model.channels import Channel
from mmrjax.model.params import Scalar, parameter
from mmrjax.model.robot import Robot
from mmrjax.model.signals import Signals
from mmrjax.numerics.elementary import at_least


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


def _sensor_error(measured: Channel, of_zero: bool) -> type[Effect]:
    """The error of scale or zero of a channel's instrument."""
    largest, unit = (10 * measured.zero_error, measured.unit_si) if of_zero else (0.2, "-")
    sources = "limits of error of instruments, IEC 60051-2", "class of the instrument: 0.5 to 2.5 %"
    if measured.unit_shown == "°C":
        sources = "tolerances of thermocouples, IEC 60584-1", "class of the instrument: 1 to 3 K"
    is_odd = of_zero and measured.directed
    is_zero = of_zero

    class Error(SensorEffect):
        name = f"{measured.name}_{'offset' if is_zero else 'gain'}"
        channel = measured.name
        of_zero = is_zero
        odd_in_travel = is_odd

        amplitude: Scalar = amplitude(
            unit,
            f"error of the {measured.label} reading"
            if is_zero
            else f"relative error of the {measured.label} reading",
            (-largest, largest), sources[1], sd=measured.zero_error if is_zero else 0.02,
        )  # fmt: skip

    Error.__doc__ = f"""Δx = a{"" if is_zero else " x"} in the reading x of {measured.label}.

    The {"zero" if is_zero else "scale"} of the instrument is wrong.

    Source: {sources[0]}.
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
OF_CHANNELS: EffectClasses = {effect.name: effect for effect in _sensor_errors()}
#: The same by class name, see `made`.
Made = SimpleNamespace(**{effect.__name__: effect for effect in OF_CHANNELS.values()})


#: Duty below which a power is continued as a line, because it has no derivative at 0 [-].
LEAST_POWER = 1e-3


class DutyEffect(Effect):
    """Part of the demanded duty D that the bridge does not give [-].

    Voltage and share of the current drawn from the supply follow the duty that is given. It never changes its sign
    and never exceeds 1.
    """

    balance = "duty"
    driver = "duty"
    needs_duty = True


class DutyExponent(DutyEffect):
    """ΔD = a D (1 - |D|^(n-1)) / (n - 1): with a = n - 1 the bridge gives |D|^n sign D.

    The driver's voltage is a power of the command, as in a speed controller with a throttle curve.

    Source: Gabriel, Meyer and du Plessis, Brushless DC motor characterisation and selection for a fixed wing UAV,
    IEEE Africon (2011), measure voltage over command of speed controllers, which is not a line. Box and Cox, An
    analysis of transformations, J. Royal Statistical Society B 26 (1964), for the form. n = 1 is the logarithm
    ΔD = -a D ln |D|. Below a duty of 0.001 the power continues as a line.
    """

    amplitude: Scalar = amplitude(
        "-", "exponent of the command minus 1", (-0.8, 2.0), "throttle curves of hobby controllers: 0.5 to 2", sd=0.2
    )
    exponent: Scalar = parameter(
        1.0, "-", "exponent n of the command", (0.2, 4.0), "1 plus the amplitude for a pure power", relative_sd=0.3
    )

    def term(self, robot: Robot, signals: Signals) -> Scalar:
        log = jnp.log(at_least(jnp.abs(signals.command), LEAST_POWER))
        exponent = (self.exponent - 1) * log
        is_small = jnp.abs(exponent) < 1e-6
        nonzero_exponent = jnp.where(is_small, 1.0, exponent)
        ratio = jnp.where(is_small, 1 + exponent / 2, jnp.expm1(nonzero_exponent) / nonzero_exponent)
        return -self.amplitude * signals.command * log * ratio


class DutyDeadBand(DutyEffect):
    """ΔD = a (1 - |D|) sign D: with a = d / (1 - d) the bridge gives (|D| - d) / (1 - d) sign D, and 0 below d.

    The driver gives no voltage for small commands.

    Source: dead time and dead band of bridges, Mohan, Undeland and Robbins, Power Electronics (2003), chapter 8
    (blanking time). The sign is smooth within a duty of 0.001.
    """

    amplitude: Scalar = amplitude(
        "-", "dead band d as d / (1 - d)", (-0.2, 1.0), "a few percent of the command", sd=0.05
    )

    def term(self, robot: Robot, signals: Signals) -> Scalar:
        size = jnp.abs(signals.command)
        return self.amplitude * (1 - size) * signals.command / at_least(size, LEAST_POWER)


class DutySaturation(DutyEffect):
    """ΔD = a max(|D| - D_s, 0) sign D: with a = 1 the voltage no longer grows above a duty of D_s.

    The driver or the supply reaches its limit before full command.

    Source: end points of speed controllers, and supplies in current limit. Åström and Murray, Feedback Systems
    (2008), section 10.4, saturation of actuators. `driver.current_limit` limits the current instead of the voltage.
    """

    amplitude: Scalar = amplitude(
        "-", "share of the duty above D_s that is lost", (-1.0, 1.0), "1 if the voltage stops rising at D_s", sd=0.5
    )
    duty_full: Scalar = parameter(
        0.8, "-", "duty D_s where the limit begins", (0.3, 0.99), "end points of speed controllers: 0.8 to 1",
        relative_sd=0.2,
    )  # fmt: skip

    def term(self, robot: Robot, signals: Signals) -> Scalar:
        return self.amplitude * at_least(jnp.abs(signals.command) - self.duty_full, 0.0) * jnp.sign(signals.command)
