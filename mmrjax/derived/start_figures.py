"""Start from standstill: its peak current, duration, electrical energy and stages."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from mmrjax.compile.compiling import compiled
from mmrjax.fidelities.base import History
from mmrjax.fidelities.drive import TIME_SETTLED, drive
from mmrjax.model.conditions import Conditions
from mmrjax.model.paper_tables import PITCH_GROUSER, PITCH_TOOTH
from mmrjax.model.params import Scalar, Times
from mmrjax.model.robot import Robot
from mmrjax.model.signals import CONVERGED
from mmrjax.numerics.elementary import value_and_slope

#: A number of each instant.
OverTime = Float[np.ndarray, " times"]

#: Names of the stages, in order.
NAMES = ("starting", "acceleration with slipping", "uniform")
#: Deviation from the last speed that ends a start [-], and length of the end of a run that is averaged for it [s].
WITHIN, LAST = 0.01, 0.15


@dataclasses.dataclass(frozen=True)
class StartStages:
    """Stages of one start. Times count from its first sample.

    Attributes:
        sense: direction of rotation of the shafts at the end, 1 or -1.
        starting: end of the first stage [s]: the slide has reached its maximum, the shafts have spun up.
        slipping: end of the second stage [s]: the slide stays within V_s from here, `starting` if it never left.
        settled: t' [s]: the speed is within 1 % of its last value, the mean over the last 0.15 s.
        end: end of the run [s].
        slip: mean slip of each stage [-] (`mean_slip`), NaN for a stage without length.
        slip_settling: mean slip until t' [-].
    """

    sense: float
    starting: float
    slipping: float
    settled: float
    end: float
    slip: tuple[float, float, float]
    slip_settling: float

    @property
    def bounds(self) -> tuple[float, float, float, float]:
        """Start and end times of the stages [s]."""
        return 0.0, self.starting, self.slipping, self.end

    def to_json(self) -> dict[str, Any]:
        """The stages as in `result.json`."""

        def number(x: float) -> float | None:
            return float(x) if np.isfinite(x) else None

        stages = zip(NAMES, self.bounds[:-1], self.bounds[1:], self.slip, strict=True)
        return {
            "stages": [{"stage": n, "from_s": a, "until_s": b, "slip": number(s)} for n, a, b, s in stages],
            "acceleration_time_s": self.settled,
            "slip_over_acceleration": number(self.slip_settling),
        }


def _moving_means(time: np.ndarray, values: np.ndarray, period: float) -> np.ndarray:
    """Means over a `period` around each instant of evenly spaced samples. At the ends, over the nearest whole
    period.
    """
    count = min(round(period / (time[-1] / len(time))) | 1, len(values) | 1) if time[-1] > 0 else 1
    if count < 3 or count > len(values):
        return values
    return np.pad(np.convolve(values, np.ones(count) / count, "valid"), count // 2, mode="edge")


def mean_slip(
    time: OverTime,
    speed: OverTime,
    theoretical: OverTime,
    begin: float,
    end: float,
) -> float:
    """Mean slip (33) over an interval, 1 - ∫V_x dt / ∫V_x_teor dt [-]: the lost share of the movers' distance.

    It weights s by V_x_teor and is finite from standstill on, where s itself is 0/0. NaN if the movers do not move.
    """
    if not end > begin:
        return np.nan
    within = time[(time > begin) & (time < end)]
    instants = np.concatenate([[begin], within, [end]])
    travelled, rolled = (np.trapezoid(np.interp(instants, time, v), instants) for v in (speed, theoretical))
    return float(1 - travelled / rolled) if abs(rolled) > 1e-9 else np.nan


def stages_of_start(
    time: OverTime,
    speed: OverTime,
    theoretical: OverTime,
    sliding: OverTime,
    speed_static: float,
    ripple_pitch: float = 0.0,
) -> StartStages:
    """Stages of one start, from samples without gaps.

    Args:
        time: times of the samples [s].
        speed, theoretical, sliding: speed V, theoretical speed r_k ω_k, and speed of the contact patch over the
            ground [m/s].
        speed_static: V_s of the friction law [m/s].
        ripple_pitch: travel between two contacts that cause ripple [m], 0 for none. Speeds are averaged over that
            distance at the last speed.
    """
    sense = -1.0 if theoretical[-1] < -1e-4 else 1.0
    starting = float(time[int(np.argmax(sense * sliding))])
    sliding, mean_speed = (
        _moving_means(time, x, ripple_pitch / max(abs(float(theoretical[-1])), 1e-3)) for x in (sliding, speed)
    )
    slipping_instants = np.flatnonzero((sense * sliding > speed_static) & (time >= starting))
    slipping = float(time[min(int(slipping_instants[-1]) + 1, len(time) - 1)]) if slipping_instants.size else starting
    final_speed = speed[last_samples(time)].mean()
    unsettled_instants = np.flatnonzero(np.abs(mean_speed - final_speed) > WITHIN * abs(final_speed))
    settled = float(time[min(int(unsettled_instants[-1]) + 1, len(time) - 1)]) if unsettled_instants.size else 0.0
    bounds = (0.0, starting, max(slipping, starting), float(time[-1]))
    slips = [mean_slip(time, speed, theoretical, a, b) for a, b in itertools.pairwise(bounds)]
    mean_of_start = mean_slip(time, speed, theoretical, 0.0, settled)
    return StartStages(sense, bounds[1], bounds[2], settled, bounds[3], (slips[0], slips[1], slips[2]), mean_of_start)


def stages_of_histories(
    robot: Robot, history: History, configurations: Sequence[int] | np.ndarray
) -> list[StartStages | None]:
    """Stages of each run of a batch from standstill, up to its last finite sample. None for a run without samples.

    Args:
        configurations: index of each run's configuration in `robot`. Its loads are vehicles.
    """
    stages: list[StartStages | None] = []
    for k, index in enumerate(configurations):
        signals = history.signals
        sample_count = count_finite_samples(np.asarray(signals.total_current)[k])
        series = (history.time, signals.speed, signals.speed_theoretical, signals.speed_sliding)
        time, *motion = (np.asarray(x)[k][:sample_count] for x in series)
        chassis = robot.configurations.members[int(index)]
        speed_static = float(chassis.ground.friction.speed_static)
        ripple_pitch = 0.0
        if history.reactions is not None:  # from individual contacts
            ripple_pitch = PITCH_GROUSER if float(chassis.on_tracks) > 0.5 else PITCH_TOOTH
        stages.append(
            stages_of_start(time, motion[0], motion[1], motion[2], speed_static, ripple_pitch)
            if sample_count
            else None
        )
    return stages


def count_finite_samples(values: OverTime) -> int:
    """Number of samples of a run up to the last finite one."""
    finite = np.flatnonzero(np.isfinite(values))
    return int(finite[-1]) + 1 if finite.size else 0


def last_samples(time: OverTime) -> np.ndarray:
    """True for the samples of the last 0.15 s, which contain several pitches of the running gear. For a short run, of
    its last tenth.
    """
    return np.asarray(time >= time[-1] - min(LAST, 0.1 * float(time[-1])))


#: Share of the final speed that ends a start [-].
SHARE = 0.95
#: Times of the inrush, first and last [s], and of the rest of the run.
INRUSH, EARLIEST, LATEST, REST = 250, 2e-5, 0.02, 800
#: Error of a step of the run; a derivative of the time to speed is then accurate to 1e-4 (at `drive`'s 1e-6 to 6e-3).
TOLERANCE = 1e-7


def curve_peak(times: Times, x: Times, kink: Scalar = np.inf) -> Float[Array, ""]:
    """Largest value of a sampled curve: vertex of the parabola through its largest sample and the two neighbours.

    Args:
        times: not decreasing [s].
        x: samples, NaN if the curve has no value.
        kink: upper limit of the peak. At a current limit, the curve has a corner.
    """
    finite_values = jnp.where(jnp.isfinite(x), x, -jnp.inf)
    k = jnp.clip(jnp.argmax(finite_values), 1, x.shape[0] - 2)
    width_before, width_after = times[k] - times[k - 1], times[k + 1] - times[k]
    is_peak = (width_before > 0) & (width_after > 0) & (x[k] > x[k - 1]) & (x[k] > x[k + 1])
    width_before, width_after = jnp.where(is_peak, width_before, 1.0), jnp.where(is_peak, width_after, 1.0)
    rise, fall = (x[k] - x[k - 1]) / width_before, (x[k + 1] - x[k]) / width_after
    curvature = (fall - rise) / (width_before + width_after)
    slope = rise + curvature * width_before
    highest = finite_values[jnp.argmax(finite_values)]
    vertex = jnp.minimum(x[k] - slope**2 / (4 * jnp.where(is_peak, curvature, -1.0)), jnp.maximum(kink, highest))
    return jnp.where(is_peak, vertex, highest)


def first_crossing(times: Times, x: Times, rate: Times, level: Array) -> tuple[Array, Array]:
    """First time at which a sampled curve crosses a level: index of the sample before, and fraction of the way to the
    next.

    Found on the cubic through two samples and their rates, by Newton's method from the straight line.
    """
    k = jnp.clip(jnp.argmax(x >= level), 1, x.shape[0] - 1) - 1
    width, rise = times[k + 1] - times[k], x[k + 1] - x[k]
    slope_begin, slope_end = width * rate[k], width * rate[k + 1]

    def cubic(s: Array) -> Array:
        return x[k] + s * rise + s * (1 - s) * ((1 - s) * (slope_begin - rise) - s * (slope_end - rise))

    share = (level - x[k]) / jnp.where(rise > 0, rise, 1.0)
    for _ in range(3):
        slope = value_and_slope(cubic, share)[1]
        share = share - (cubic(share) - level) / jnp.where(jnp.abs(slope) > 0, slope, 1.0)
    return k, jnp.clip(share, 0.0, 1.0)


@compiled
def compute(robot: Robot, conditions: Conditions) -> dict[str, Array]:
    """Simulates one start from standstill by `drive`, over `TIME_SETTLED`.

    Returns:
        `peak_current` of all motors [A], `time_to_speed`, until 95 % of the final speed [s], `energy_start`,
        ∫ U_e I_s dt until then [J]. `status` of the run. Numbers are NaN unless it is `converged`: a run that slides,
        stalls or has not settled has no final speed. Derivatives are forward.
    """
    early = np.geomspace(EARLIEST, LATEST, INRUSH, endpoint=False)
    times = jnp.asarray(np.concatenate([[0.0], early, np.linspace(LATEST, TIME_SETTLED, REST)]))
    run = drive(robot, conditions, times, TOLERANCE)
    signals = run.signals
    speed = signals.speed
    current = signals.total_current
    power = signals.voltage * current
    before, fraction = first_crossing(times, speed, signals.acceleration, SHARE * speed[-1])
    width = jnp.diff(times)
    energy_so_far = jnp.concatenate([jnp.zeros(1), jnp.cumsum(width * (power[1:] + power[:-1]) / 2)])
    power_at_instant = power[before] + fraction * (power[before + 1] - power[before])
    columns = {
        "peak_current": curve_peak(times, (robot.sides * signals.current), robot.sides * robot.driver.current_limit),
        "time_to_speed": times[before] + fraction * width[before],
        "energy_start": energy_so_far[before] + fraction * width[before] * (power[before] + power_at_instant) / 2,
    }
    converged = run.result.status == CONVERGED
    return {**{name: jnp.where(converged, x, jnp.nan) for name, x in columns.items()}, "status": run.result.status}
