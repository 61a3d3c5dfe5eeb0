"""Effects on the duty [-] of the driver: characteristics of a bridge whose voltage is not the command's share."""

from __future__ import annotations

import jax.numpy as jnp

from mmrjax.effects.base import Effect, amplitude
from mmrjax.model.params import Scalar, parameter
from mmrjax.model.robot import Robot
from mmrjax.model.signals import Signals
from mmrjax.numerics.one_sided import at_least

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
        near = jnp.abs(exponent) < 1e-6
        far = jnp.where(near, 1.0, exponent)
        ratio = jnp.where(near, 1 + exponent / 2, jnp.expm1(far) / far)
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
