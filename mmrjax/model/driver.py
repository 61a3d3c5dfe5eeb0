"""Motor driver: the bridge between supply and motors, its current limit, and controllers of speed and position."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array

from mmrjax.model.params import Scalar, parameter
from mmrjax.numerics.elementary import at_least, at_most, clip

#: Slope of the duty beyond the current limit, per relative excess [-]: an excess of 0.1 % lowers the duty by 0.5.
STEEPNESS = 500.0
#: Duty below which a driver gives no pulses [-].
LEAST_DUTY = 1e-9
#: Current [A] and duty [-] within which a diode begins to block.
CURRENT_DIODE, DUTY_DIODE = 1e-3, 5e-3


#: State of the bridge between the pulses of a duty: motors shorted (`slow`), or coasting (`fast`).
DECAYS = SLOW, FAST = "slow", "fast"


class Driver(eqx.Module):
    """A bridge that applies the supply voltage in pulses. The duty D is their signed share of a period.

    It is lossless and its ripple is not resolved: voltage and current are means over a period.

    Slow decay: the bridge shorts the motors between pulses and the current continues. U = D U_s, I_s = D I.

    Fast decay: the bridge disconnects the motors and the current ends within each period, so that they coast between
    pulses. U = D U_s + (1 - |D|) E and I = |D| (±U_s - E) / R. The supply gives all of it, I_s = ±I, and the mean of
    I² is I²/|D|. This holds for pulses and pauses long compared with L/R, whose rise and fall cancel in the mean.
    With shorter ones the current continues through the pauses, at the latest above D = (1 + E/U_s)/2 (discontinuous
    conduction: Mohan, Undeland and Robbins, Power Electronics, 2003, chapter 7). At |D| = 1 both are equal.

    Attributes:
        decay: `slow` or `fast`.
        returns_current: True if supply and bridge take current back from driven motors. If False, a diode blocks it,
            and motors that turn faster than the supply would turn them coast.
    """

    current_limit: Scalar = parameter(
        1000.0, "A", "largest current of one motor that the driver permits", (0.01, 1e4),
        "no limit on the bench", relative_sd=0.1,
    )  # fmt: skip
    gain: Scalar = parameter(
        4.0, "-", "proportional gain of the speed controller over the speed constant C_E", (0.0, 1e3),
        "assumed", relative_sd=0.1,
    )  # fmt: skip
    time_reset: Scalar = parameter(
        0.05, "s", "reset time of the speed controller",
        (1e-3, 1e3), "assumed", relative_sd=0.1,
    )  # fmt: skip
    returns_current: bool = eqx.field(default=True, static=True)
    decay: str = eqx.field(default=SLOW, static=True)

    def unlimited(self) -> Driver:
        """Same driver without limit and diode."""
        changes: dict[str, Any] = {"current_limit": None, "returns_current": True}
        return replace(self, **changes)

    def voltage(self, source: Scalar, duty: Scalar, pause: Scalar, back_emf: Scalar) -> Scalar:
        """Mean voltage at the motors [V]. `pause`: share of a period without pulses [-]. `back_emf`: E [V]."""
        pulses = duty * source
        return pulses + pause * back_emf if self.decay == FAST else pulses

    def share_drawn(self, duty: Scalar) -> Scalar:
        """Share of the motors' mean current that the supply gives, I_s / I [-]."""
        return jnp.sign(duty) if self.decay == FAST else duty

    def ripple(self, duty: Scalar) -> Scalar:
        """Mean square of the current over the square of its mean [-], 1 if no pulse drives a current."""
        if self.decay != FAST:
            return 1.0
        pulsed = jnp.abs(duty) > LEAST_DUTY
        return jnp.where(pulsed, 1 / jnp.where(pulsed, jnp.abs(duty), 1.0), 1.0)

    def duty_limited(self, duty: Scalar, current: Scalar, polarity: Scalar = 1.0) -> Scalar:
        """`duty` [-], reduced where the motor's `current` [A] exceeds the limit, so that it stays near the limit.

        `polarity` is the sign of the supply voltage.
        """
        if self.current_limit is None:
            return duty
        excess = at_least(0.0, jnp.abs(current) * (1 / self.current_limit) - 1)
        return clip(duty - polarity * jnp.sign(current) * STEEPNESS * excess, -1.0, 1.0)

    def limits(self, current: Scalar) -> Array:
        """True if the limit acts at a motor `current` [A]."""
        return jnp.abs(current) > self.current_limit

    def conducts(
        self, duty: Scalar, limited_duty: Scalar, current: Scalar, excess: Scalar, open_circuit: Scalar
    ) -> Scalar:
        """Share of time in which the driver's voltage is at the motors [-], else they are free, at the back-EMF E.

        An open circuit never conducts. A diode conducts current in the direction of the duty. It begins and ends
        smoothly within `CURRENT_DIODE` of 0, where a negative share drives a current through the diode back to 0. A
        limit that would reverse the duty opens the circuit instead, smoothly within `DUTY_DIODE` of 0.

        Args:
            duty: demanded [-], with the sign of the voltage that it gives.
            limited_duty: duty after the current limit [-].
            current: current of a motor [A].
            excess: the driver's voltage less E [V].
        """
        closed = jnp.where(jnp.asarray(open_circuit) > 0.5, 0.0, 1.0)
        if self.returns_current:
            return closed
        relative_current = jnp.sign(duty) * current / CURRENT_DIODE
        diode_share = jnp.where(
            jnp.sign(duty) * excess < 0, clip(relative_current, -1.0, 1.0), clip(1 + relative_current, 0.0, 1.0)
        )
        reverses = (limited_duty * current < 0) & (duty * current >= 0)
        return closed * jnp.where(reverses, clip(1 - jnp.abs(limited_duty) / DUTY_DIODE, 0.0, 1.0), diode_share)

    def admitted(self, unlimited_current: Scalar, duty: Scalar, source_current: Scalar) -> tuple[Scalar, Scalar]:
        """Current that flows [A], and the part of `unlimited_current` that a diode holds back [A].

        Limit and diode as a curve over the current that the demanded duty alone would drive. Along it the voltage
        available to change the current falls evenly, so that Newton's method crosses them. With over = |wanted| less
        the limit, the limiter takes D = over / (|U_s|/R + I_max/`STEEPNESS`) of the duty, up to full reverse duty.
        Beyond, the current increases again. With a diode, the duty is not reversed and the current does not increase.

        Args:
            unlimited_current: any number.
            duty: as for `conducts`.
            source_current: |U_s|/R, or any number above 0 if it has no source [A].
        """
        if self.current_limit is None:
            return unlimited_current, jnp.zeros_like(unlimited_current)
        sign = jnp.where(unlimited_current < 0, -1.0, 1.0)
        limit = self.current_limit
        forward_duty = sign * duty
        excess = at_least(jnp.abs(unlimited_current) - limit, 0.0)
        limit_step = limit / STEEPNESS
        reduction = at_most(
            excess / (source_current + limit_step),
            1 + forward_duty if self.returns_current else at_least(forward_duty, 0.0),
        )
        excess_beyond = excess - reduction * (source_current + limit_step)
        current = at_most(jnp.abs(unlimited_current), limit) + reduction * limit_step
        if self.returns_current:
            return sign * (current + excess_beyond), jnp.zeros_like(excess_beyond)
        current = jnp.where(forward_duty < 0, 0.0, sign * current)
        return current, jnp.where(forward_duty < 0, unlimited_current, sign * excess_beyond)

    def demand(self, error: Scalar, integral: Scalar, speed: Scalar, constant: Scalar) -> Scalar:
        """Voltage [V] of the speed controller: PI with the back-EMF fed forward.

        U = C_E (ω* + K (e + 1/T ∫ e dt)).

        Args:
            error: e, demanded less actual motor speed [rad/s].
            integral: ∫ e dt [rad].
            speed: ω*, demanded [rad/s].
            `constant`: C_E [V·s/rad].
        """
        return constant * (speed + self.gain * (error + integral / self.time_reset))


#: Source of the gains.
STATED = "stated by the owner of the actuator"


class Controller(eqx.Module):
    """Proportional, integral and derivative action on a goal, and a feed-forward, within a limit.

    D = K_p e + K_i ∫ e dt - K_d dx/dt + K_f g, with e = g - x, |D| <= D_max. While D is at the limit, an error that
    drives it further is not integrated. The controlled x is the angle or the speed of the output, or the current of
    the motor. K_d acts if x is an angle, K_f if it is not. The duty follows D with a lag. With a `rate`, the
    controller reads x and g once per period T and adds T e to the integral. It holds D until the next sample.

    Attributes:
        lags: True if the lag is more than 0, so that the duty is a state.
        rate: of the samples, the first of which is at the start of a run [Hz]. 0: a continuous controller.
        samples_late: number of samples after which D acts, 0 or 1.
        supply_voltage: supply voltage of the driver, for tables without its column [V]. 0: they have the column.
    """

    kp: Scalar = parameter(
        0.0, "-", "proportional gain: share of the supply's voltage per rad, rad/s or A of error", (0.0, 1e6), STATED,
        relative_sd=0.3,
    )  # fmt: skip
    ki: Scalar = parameter(
        0.0, "1/s", "integral gain: the same per second", (0.0, 1e6), STATED, relative_sd=0.3,
    )  # fmt: skip
    kd: Scalar = parameter(
        0.0, "s", "derivative gain: share of the supply's voltage per rad/s of the output", (0.0, 1e4), STATED,
        relative_sd=0.3,
    )  # fmt: skip
    feed_forward: Scalar = parameter(
        0.0, "-", "share of the supply's voltage per rad/s or A of the goal", (-1e3, 1e3), STATED, relative_sd=0.3,
    )  # fmt: skip
    limit: Scalar = parameter(1.0, "-", "largest duty", (0.01, 1.0), STATED, relative_sd=0.1)
    lag: Scalar = parameter(
        0.0, "s", "lag of the duty behind the demand of the controller",
        (0.0, 1.0), STATED, relative_sd=0.3,
    )  # fmt: skip
    lags: bool = eqx.field(default=False, static=True)
    rate: float = eqx.field(default=0.0, static=True)
    samples_late: float = eqx.field(default=0.0, static=True)
    supply_voltage: float = eqx.field(default=0.0, static=True)

    @property
    def states(self) -> tuple[str, ...]:
        """Its fields of `State`. The last one of a controller with a rate is its clock."""
        if self.rate:
            return ("integral", "command", *["pending"] * bool(self.samples_late), "clock")
        return ("integral", *["command"] * self.lags)

    def duty(self, error: Scalar, integral: Scalar, speed: Scalar, goal: Scalar) -> Scalar:
        """Duty that the controller demands [-], within its limit.

        Args:
            error: e [rad, rad/s or A].
            integral: ∫ e dt.
            speed: dx/dt of an angle [rad/s], else 0.
            goal: g of a speed or a current, else 0.
        """
        demanded_duty = self.kp * error + self.ki * integral - self.kd * speed + self.feed_forward * goal
        return clip(demanded_duty, -self.limit, self.limit)
