"""The start from standstill: its peak current, duration and electrical energy."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from mmrjax.compile.compiling import compiled
from mmrjax.fidelities.drive import TIME_SETTLED, drive
from mmrjax.model.conditions import Conditions
from mmrjax.model.params import Scalar
from mmrjax.model.robot import Robot
from mmrjax.model.signals import CONVERGED

#: Share of the final speed that ends a start [-].
SHARE = 0.95
#: Times of the inrush, first and last [s], and of the rest of the run.
INRUSH, EARLIEST, LATEST, REST = 250, 2e-5, 0.02, 800
#: Error of a step of the run; a derivative of the time to speed is then accurate to 1e-4 (at `drive`'s 1e-6 to 6e-3).
TOLERANCE = 1e-7


def start_times() -> np.ndarray:
    """Times of a start [s]: spaced by 3 % while the current rises to its peak, then by 5 ms."""
    early = np.geomspace(EARLIEST, LATEST, INRUSH, endpoint=False)
    return np.concatenate([[0.0], early, np.linspace(LATEST, TIME_SETTLED, REST)])


def curve_peak(times: Float[Array, " times"], x: Float[Array, " times"], kink: Scalar = np.inf) -> Float[Array, ""]:
    """Largest value of a sampled curve: the vertex of the parabola through its largest sample and both neighbours.

    Args:
        times: not decreasing [s]; x: samples, NaN if the curve has no value.
        kink: value at which the curve bends, as a current does at its limit; no parabola reaches beyond it.
    """
    known = jnp.where(jnp.isfinite(x), x, -jnp.inf)
    k = jnp.clip(jnp.argmax(known), 1, x.shape[0] - 2)
    before, after = times[k] - times[k - 1], times[k + 1] - times[k]
    inside = (before > 0) & (after > 0) & (x[k] > x[k - 1]) & (x[k] > x[k + 1])
    before, after = jnp.where(inside, before, 1.0), jnp.where(inside, after, 1.0)
    rise, fall = (x[k] - x[k - 1]) / before, (x[k + 1] - x[k]) / after
    bend = (fall - rise) / (before + after)
    slope = rise + bend * before
    highest = known[jnp.argmax(known)]
    top = jnp.minimum(x[k] - slope**2 / (4 * jnp.where(inside, bend, -1.0)), jnp.maximum(kink, highest))
    return jnp.where(inside, top, highest)


def first_crossing(
    times: Float[Array, " times"], x: Float[Array, " times"], rate: Float[Array, " times"], level: Array
) -> tuple[Array, Array]:
    """First crossing of a level by a sampled curve: index of the sample before, and share of the way to the next.

    Found on the cubic through two samples and their rates, by Newton's method from the straight line.
    """
    k = jnp.clip(jnp.argmax(x >= level), 1, x.shape[0] - 1) - 1
    width, rise = times[k + 1] - times[k], x[k + 1] - x[k]
    begin, end = width * rate[k], width * rate[k + 1]

    def cubic(s: Array) -> Array:
        return x[k] + s * rise + s * (1 - s) * ((1 - s) * (begin - rise) - s * (end - rise))

    def slope(s: Array) -> Array:
        return jax.jvp(cubic, (s,), (jnp.ones_like(s),))[1]

    share = (level - x[k]) / jnp.where(rise > 0, rise, 1.0)
    for _ in range(3):
        steep = slope(share)
        share = share - (cubic(share) - level) / jnp.where(jnp.abs(steep) > 0, steep, 1.0)
    return k, jnp.clip(share, 0.0, 1.0)


@compiled
def compute(robot: Robot, conditions: Conditions) -> dict[str, Array]:
    """One start from standstill by `drive`, over `TIME_SETTLED`.

    Returns:
        `peak_current` of all motors [A]; `time_to_speed`, until 95 % of the final speed [s]; `energy_start`,
        ∫ U_e I_s dt until then [J]; `status` of the run. Numbers are NaN unless it is `converged`: a run that slides,
        stalls or has not settled has no final speed. Derivatives are forward.
    """
    times = jnp.asarray(start_times())
    run = drive(robot, conditions, times, TOLERANCE)
    signals = run.signals
    speed, rate, current = (jnp.asarray(x) for x in (signals.speed, signals.acceleration, signals.total_current))
    power = jnp.asarray(signals.voltage) * current
    k, share = first_crossing(times, speed, rate, SHARE * speed[-1])
    width = jnp.diff(times)
    whole = jnp.concatenate([jnp.zeros(1), jnp.cumsum(width * (power[1:] + power[:-1]) / 2)])
    here = power[k] + share * (power[k + 1] - power[k])
    found = {
        "peak_current": curve_peak(
            times, jnp.asarray(robot.sides * signals.current), robot.sides * robot.driver.current_limit
        ),
        "time_to_speed": times[k] + share * width[k],
        "energy_start": whole[k] + share * width[k] * (power[k] + here) / 2,
    }
    converged = run.result.status == CONVERGED
    return {**{name: jnp.where(converged, x, jnp.nan) for name, x in found.items()}, "status": run.result.status}
