"""Motor driver: the bridge between supply and motors, its current limit, and the controller of a demanded speed."""

from __future__ import annotations

import equinox as eqx
import jax.numpy as jnp

from mmrjax.model.params import Scalar, parameter
from mmrjax.numerics.one_sided import at_least, clip

#: How fast the duty falls beyond the current limit, per limit exceeded by its own size [-]: 0.1 % over takes 0.5.
STEEPNESS = 500.0
#: Duty below which a driver gives no pulses [-].
LEAST_DUTY = 1e-9


#: What a bridge does between the pulses of a duty: it shorts the motors, or lets them coast.
DECAYS = SLOW, FAST = "slow", "fast"


class Driver(eqx.Module):
    """A bridge that gives the motors the supply's voltage in pulses; D is their share of a period, with their sign.

    It is lossless and its ripple is not resolved: voltage and current are means over a period.

    Slow decay, the bridge shorts the motors between pulses and the current flows on: U = D U_s, I_s = D I.

    Fast decay, it lets go of them and the current ends within each period, so that they coast between pulses:
    U = D U_s + (1 - |D|) E and I = |D| (±U_s - E) / R, all of which the supply gives, I_s = ±I; the mean of I² is
    I²/|D|. This takes pulses and pauses long against L/R, whose rise and fall then cancel in the mean; with shorter
    ones the current flows on through the pauses, at the latest where D exceeds (1 + E/U_s)/2. Mohan, Undeland and
    Robbins, Power Electronics (2003), chapter 7, of the discontinuous conduction of such a stage. At |D| = 1 both
    are the same.

    Attributes:
        decay: `slow` or `fast`.
        returns_current: whether supply and bridge take current back from motors that are driven; where not, a diode
            keeps it from flowing, and motors that turn faster than the supply would turn them coast.
    """

    current_limit: Scalar = parameter(
        1000.0,
        unit="A",
        meaning="largest current of one motor that the driver lets flow",
        bounds=(0.01, 1e4),
        relative_sd=0.1,
        source="none on the bench: above any current",
    )
    gain: Scalar = parameter(
        4.0,
        unit="-",
        meaning="proportional gain of the speed controller, in multiples of the speed constant C_E",
        bounds=(0.0, 1e3),
        relative_sd=0.1,
        source="assumed; the paper has no controller",
    )
    time_reset: Scalar = parameter(
        0.05,
        unit="s",
        meaning="reset time of the speed controller: how long its integral takes to repeat the proportional answer",
        bounds=(1e-3, 1e3),
        relative_sd=0.1,
        source="assumed; the paper has no controller",
    )
    returns_current: bool = eqx.field(default=True, static=True)
    decay: str = eqx.field(default=SLOW, static=True)

    def voltage(self, source: Scalar, duty: Scalar, pause: Scalar, back: Scalar) -> Scalar:
        """Mean voltage at the motors [V]; `pause`: share of a period without a pulse [-]; `back`: their E [V]."""
        pulses = duty * source
        return pulses + pause * back if self.decay == FAST else pulses

    def share_drawn(self, duty: Scalar) -> Scalar:
        """Share of the motors' mean current that the supply gives, I_s / I [-]."""
        return jnp.sign(duty) if self.decay == FAST else duty

    def ripple(self, duty: Scalar) -> Scalar:
        """Mean of the square of the current over the square of its mean [-]; 1 where no pulse makes one flow."""
        if self.decay != FAST:
            return 1.0
        pulsed = jnp.abs(duty) > LEAST_DUTY
        return jnp.where(pulsed, 1 / jnp.where(pulsed, jnp.abs(duty), 1.0), 1.0)

    def duty_limited(self, duty: Scalar, current: Scalar, polarity: Scalar = 1.0) -> Scalar:
        """Duty D [-] that holds the motor's `current` [A] at the limit, between -1 and 1; `polarity`: sign of the
        supply's voltage."""
        over = at_least(0.0, jnp.abs(current) / self.current_limit - 1)
        return clip(duty - polarity * jnp.sign(current) * STEEPNESS * over, -1.0, 1.0)

    def limits(self, current: Scalar) -> Scalar:
        """Whether the limit acts at a motor's `current` [A]."""
        return jnp.abs(current) > self.current_limit

    def blocks(self, duty: Scalar, current: Scalar, open_circuit: Scalar) -> Scalar:
        """Whether nothing holds the motors' terminals, which are then at the back-EMF.

        The circuit is open, or the diode of a supply that takes nothing back keeps a current from flowing there.
        """
        blocked = jnp.asarray(open_circuit) > 0.5
        return blocked if self.returns_current else blocked | (duty * current < 0)

    def demand(self, error: Scalar, integral: Scalar, speed: Scalar, constant: Scalar) -> Scalar:
        """Voltage [V] by which a demanded motor speed is followed: PI with the back-EMF fed forward.

        U = C_E (ω* + K (e + 1/T ∫ e dt)).

        Args:
            error: e, demanded less actual motor speed [rad/s]; integral: ∫ e dt [rad]; speed: ω*, demanded [rad/s];
            constant: C_E [V·s/rad].
        """
        return constant * (speed + self.gain * (error + integral / self.time_reset))
