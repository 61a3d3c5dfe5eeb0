"""Controller of an actuator: the duty that it demands for a goal, from the readings of the output or the motor."""

from __future__ import annotations

import equinox as eqx

from mmrjax.model.params import Scalar, parameter
from mmrjax.numerics.one_sided import clip

#: Source of the gains.
STATED = "stated by the owner of the actuator"


class Controller(eqx.Module):
    """Proportional, integral and derivative action on a goal, and a feed-forward, within a limit.

    D = K_p e + K_i ∫ e dt - K_d dx/dt + K_f g, with e = g - x, |D| <= D_max. While D is at the limit, an error that
    drives it further is not integrated. x is the angle or the speed of the output, or the current of the motor. dx/dt
    acts where x is an angle, K_f g where it is not. The duty follows D with a lag. With a `rate`, the controller
    reads x and g at each multiple of its period T, adds T e to the integral, and holds D until the next sample.

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
        demanded_voltage = self.kp * error + self.ki * integral - self.kd * speed + self.feed_forward * goal
        return clip(demanded_voltage, -self.limit, self.limit)
