"""States of the equations that a log shows, and the time windows of its runs.

A point is the mean of neighbouring rows, so that no row is left out of a long log and a window has a few dozen
points. No window contains a jump of an imposed quantity, a gap between rows, or rest. After a jump the current rises
within a fraction of the time between rows, and friction at rest is not a function of speed.
"""

from __future__ import annotations

import dataclasses
import operator
from collections.abc import Mapping
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from calibration.data import Columns
from calibration.data.runs import Runs
from calibration.inference.fit_notes import Remark
from calibration.inference.problem import Problem
from mmrjax.model import balances
from mmrjax.model.channels import Channel
from mmrjax.model.conditions import Conditions
from mmrjax.model.params import Scalar
from mmrjax.model.quantities import CURRENT, VOLTAGE
from mmrjax.model.robot import Robot
from mmrjax.model.signals import State

#: Length of a window in correlation times of the motion and in rows, at least; its points, about; its fewest rows;
#: distance between the starts of windows, as a share of their length.
CORRELATED, LONG, POINTS, FEWEST, APART = 0.35, 16, 32, 9, 0.25
#: Jump of an imposed quantity as a share of its largest value, and the same for the acceleration of an imposed speed,
#: with which the current jumps; a time between rows that is a gap, over the usual one.
JUMP, KINK, GAP = 0.05, 0.3, 3.0
#: Speed below which a shaft may be at rest: in sds of its reading, and as a share of the largest. From 1 %, windows
#: of EMPS leave twice their variance, and a clean log of an angle has parameters up to 3 posterior sds off.
REST_SD, REST = 5.0, 0.02
#: Noise of the slope of an angle, as a share of its usual size; most rows whose slope it is.
STEEP, STEEPEST = 0.02, 201
#: Largest change of a delay for which its effect is extrapolated [rows].
REACH = 2.0
#: Width added to both ends of an interval, so that a single row has one [rows].
EDGE = 1e-4
#: Fields of `Conditions` with a mean over an interval; others are those at its middle.
IMPOSED = "voltage", "duty", "motor_current", "motor_speed", "motor_acceleration", "load_torque"


class StatePlan(eqx.Module):
    """Channels that give the states of the equations.

    Attributes:
        current: index of the current channel, -1 if the current follows from an imposed quantity.
        motion: index of the motion channel, -1 if the motion is imposed.
        angle: True if the motion channel is an angle. It enters integrated twice.
        travels: True if the motion is that of the load, not of a shaft.
        others: indices of channels that follow from the states.
        imposed: imposed quantity, as in `Rig.imposed`.
    """

    current: int = eqx.field(static=True)
    motion: int = eqx.field(static=True)
    angle: bool = eqx.field(static=True)
    travels: bool = eqx.field(static=True)
    others: tuple[int, ...] = eqx.field(static=True)
    imposed: str = eqx.field(static=True)

    @property
    def electrical(self) -> bool:
        """True if the voltage balance is an equation of the log."""
        return self.imposed == "voltage" and self.current >= 0

    @property
    def mechanical(self) -> bool:
        """True if the torque balance is an equation of the log."""
        return self.imposed != "motor_speed"


def state_plan(problem: Problem) -> StatePlan | None:
    """State plan of a log. None if the log does not show the states."""
    counts = np.asarray(problem.data.weight).sum(0) > 0
    duty: Any = problem.observe.of_rows.duty  # type: ignore[attr-defined]
    channels_read = {k: c for k, c in enumerate(problem.channels) if counts[k]}
    plan = state_plan_or_reason(problem.base, channels_read, bool(np.ptp(np.asarray(duty)) > 0))
    return plan if isinstance(plan, StatePlan) else None


def state_plan_or_reason(robot: Robot, channels_read: Mapping[int, Channel], pulsed: bool = False) -> StatePlan | str:
    """State plan of a log, or the reason why it has no plan, a key of `loop_words.UNSHOWN`.

    Args:
        channels_read: channels with readings, by index.
        pulsed: True if the duty changes.
    """
    if robot.rig.turns:
        return "turn"
    if robot.rig.follows_goal:
        return "goal"
    if robot.loose:
        return "slack"
    if {c.name for c in channels_read.values()} & robot.rig.magnitudes:
        return "sign"
    imposed = robot.rig.imposed
    current_channel = "total_current"  # proportional to the duty of pulses
    currents = {k: c.name == current_channel for k, c in channels_read.items() if c.rests_on == CURRENT}
    voltages = [k for k, c in channels_read.items() if c.rests_on == VOLTAGE]
    speeds = [k for k, c in channels_read.items() if c.zero_at_rest and c.settled]
    angles = [k for k, c in channels_read.items() if c.zero_at_rest and not c.settled]
    if imposed == "motor_speed":
        others = (*currents, *voltages)
        return StatePlan(-1, -1, False, False, others, imposed) if others else "follower"
    current = next(iter(sorted(currents, key=lambda k: currents[k])), -1) if imposed == "voltage" else -1
    current = -1 if current >= 0 and pulsed and currents[current] else current
    if not (speeds or angles):
        return "motion"
    motion = (*speeds, *angles)[0]
    travel_speeds = [
        k
        for k in speeds[1:]
        if robot.has_ground and _shows_travel(channels_read[k]) and not _shows_travel(channels_read[motion])
    ]
    others = (*travel_speeds, *(voltages if imposed == "motor_current" else ()))
    return StatePlan(current, motion, not speeds, _shows_travel(channels_read[motion]), others, imposed)


def _shows_travel(channel: Channel) -> bool:
    """True if a channel shows the motion of the load, not of a shaft."""
    return channel.unit_si in ("m", "m/s")


class LogPoints(eqx.Module):
    """Conditions, readings and states at each point of a log, shape (points, ...).

    Attributes:
        conditions: mean conditions over the interval of each point.
        readings: readings [SI], averaged over the rows of each point.
        sd: standard deviation of these averages.
        rate: time derivative of the motion channel, if that is an angle [SI/s].
        way: direction of travel, 0 if the robot may be at rest.
        angle: angle of the output since the first row of the run [rad].
        since: time since the previous point [s], 0 for the first of a run.
        time: time since the start of the run [s].
        table_row: index of the table row in the middle of the point.
        delay: delay of the rig for which the conditions were computed [s].
        drift: derivatives of the conditions with respect to the delay, by field.
        reach: change of the delay within which these derivatives hold [s].
        memory: memory of each of the robot's effects that has one, by name.
    """

    conditions: Conditions
    readings: Float[Array, "points channels"]
    sd: Float[Array, "points channels"]
    rate: Float[Array, " points"]
    way: Float[Array, " points"]
    angle: Float[Array, " points"]
    since: Float[Array, " points"]
    time: Float[Array, " points"]
    table_row: Int[Array, " points"]
    delay: Float[Array, " points"]
    reach: Float[Array, " points"]
    drift: Mapping[str, Float[Array, " points"]]
    memory: Mapping[str, Float[Array, " points"]] = eqx.field(default_factory=dict)

    def imposed(self, delay: Scalar) -> Conditions:
        """Conditions at another delay, limited to `reach`. Can be differentiated."""
        conditions = self.conditions
        shift = jnp.clip(delay - self.delay, -self.reach, self.reach)
        for name, drift in self.drift.items():
            conditions = with_condition(conditions, name, getattr(conditions, name) + shift * drift)
        return conditions


def with_condition(conditions: Conditions, name: str, value: Any) -> Conditions:
    """Conditions with another value of one field. Shapes of other fields are unchanged."""
    return eqx.tree_at(operator.attrgetter(name), conditions, value)


@dataclasses.dataclass(frozen=True)
class ImposedCourse:
    """Imposed quantities over time as integrals, so that each interval has a mean at any delay.

    Attributes:
        time: times of their changes, for all runs one after the other [s].
        values: values from each of these times on, by field of `Conditions`.
        integrals: integrals up to each of these times, by field of `Conditions`.
        cell: begin and end of the interval of each point, on the same time axis.
    """

    time: np.ndarray
    values: Columns
    integrals: Columns
    cell: np.ndarray

    def at(self, delay: float) -> tuple[Columns, Columns]:
        """Mean of each quantity over the interval of each point, and its derivative with respect to the delay.

        Args:
            delay: time by which a quantity acts later than its column states [s].
        """
        low, high = (edge - delay for edge in self.cell.T)
        inner = 1e-3 * (high - low)  # an interval may end at a jump
        mean, drift = {}, {}
        for name, x in self.integrals.items():
            mean[name] = (np.interp(high, self.time, x) - np.interp(low, self.time, x)) / (high - low)
            ends = [
                self.values[name][np.searchsorted(self.time, t, side="right") - 1]
                for t in (low + inner, high - inner)
            ]
            drift[name] = (ends[0] - ends[1]) / (high - low)
        return mean, drift


@dataclasses.dataclass(frozen=True)
class RunWindows:
    """Time windows of one run: indices of their points, and Δt w, Δt w', Δt w'' and Δt there, shape (windows,
    length).

    The last point of a shorter window is repeated with zero weights.
    """

    run: int
    rows: np.ndarray
    weight: np.ndarray
    slope: np.ndarray
    bend: np.ndarray
    steps: np.ndarray

    def part(self, which: np.ndarray) -> RunWindows:
        """Copy with some of the windows."""
        arrays = self.rows, self.weight, self.slope, self.bend, self.steps
        return RunWindows(self.run, *(x[which] for x in arrays))


def join_windows(windows: list[RunWindows], empty: int = 0) -> RunWindows:
    """Windows of all runs, padded to one length, followed by `empty` windows without weight."""
    longest = max(w.rows.shape[1] for w in windows)

    def joined(name: str) -> np.ndarray:
        parts = []
        for x in (getattr(w, name) for w in windows):
            padding = (0, 0), (0, longest - x.shape[1])
            parts.append(np.pad(x, padding, "edge") if name in ("rows", "steps") else np.pad(x, padding))
        return np.concatenate([*parts, np.full((empty, longest), float(name == "steps")).astype(parts[0].dtype)])

    return RunWindows(-1, *(joined(n) for n in ("rows", "weight", "slope", "bend", "steps")))


def window_function(share: np.ndarray, length: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Window w = sin⁸ π s with its derivatives w' and w'', where s is the position in the window (0 to 1). 0 outside.

    Sums over rows integrate w'' times an angle without bias only if the window ends smoothly. With sin⁴, the inertia
    from 100 logs with only an angle was wrong by 6 posterior sds, with sin⁸ by 0.1.

    Args:
        share: positions s.
        length: length of the window [s].
    """
    s = np.sin(np.pi * share)
    c = np.cos(np.pi * share)
    is_inside = (share > 0) & (share < 1)
    rise = np.pi / length
    derivatives = s**8, 8 * rise * s**7 * c, 8 * rise**2 * s**6 * (7 * c**2 - s**2)
    return tuple(np.where(is_inside, x, 0.0) for x in derivatives)  # type: ignore[return-value]


def windows_of_run(time: np.ndarray, segment: np.ndarray, length: float) -> list[tuple[np.ndarray, np.ndarray]]:
    """Windows of one run, each as (indices of its points, their positions in the window from 0 to 1).

    Args:
        time: times of the points [s], increasing.
        segment: number of the segment of each point, -1 for points in no window. A window lies within one segment.
        length: length of a window [s]. A shorter segment has one window of its own length.
    """
    windows = list[tuple[np.ndarray, np.ndarray]]()
    starts = np.flatnonzero(np.r_[True, np.diff(segment) != 0])
    for begin, end in zip(starts, np.r_[starts[1:], len(segment)], strict=True):
        if segment[begin] < 0 or end - begin < FEWEST:
            continue
        times = time[begin:end]
        duration = times[-1] - times[0]
        window_length = min(length, duration)
        for window_start in times[0] + np.linspace(
            0.0, duration - window_length, int((duration - window_length) / (APART * window_length)) + 1
        ):
            low, high = np.searchsorted(times, (window_start - 1e-9, window_start + window_length + 1e-9))
            if high - low >= FEWEST - 1:
                windows.append(
                    (np.arange(begin + low, begin + high), (times[low:high] - window_start) / window_length)
                )
    return windows


def correlation_time(time: np.ndarray, speed: np.ndarray, noise: float) -> float:
    """Correlation time of a speed: lag where its mean squared change equals its variance [s]. 0 if shorter than a
    time step.

    Args:
        noise: standard deviation of the speed readings, which is subtracted.
    """
    signal_variance = float(np.var(speed)) - noise**2
    if len(time) < FEWEST or signal_variance <= 0:
        return 0.0
    lags = np.unique(np.geomspace(1, len(time) // 2, 60).astype(int))
    mean_square_change = np.array([np.mean((speed[k:] - speed[:-k]) ** 2) for k in lags]) - 2 * noise**2
    lags_beyond = np.flatnonzero(mean_square_change >= signal_variance)
    lag = lags[lags_beyond[0]] if len(lags_beyond) else lags[-1]
    return 0.0 if lag == 1 else float(lag * np.median(np.diff(time)))


def local_slopes(time: np.ndarray, values: np.ndarray, segment: np.ndarray, count: int) -> np.ndarray:
    """Slope at each point of a cubic through the `count` points around it, within its segment."""
    slopes = np.zeros(len(time))
    starts = np.flatnonzero(np.r_[len(segment) > 0, np.diff(segment) != 0])
    for begin, end in zip(starts.tolist(), [*starts[1:].tolist(), len(segment)], strict=True):
        width = min(count, end - begin)
        if width < FEWEST // 2:
            slopes[begin:end] = np.gradient(values[begin:end], time[begin:end]) if width > 1 else 0.0
            continue
        low = np.clip(np.arange(begin, end) - width // 2, begin, end - width)
        for part in np.array_split(np.arange(end - begin), 1 + (end - begin) * width // 1_000_000):
            neighbours = low[part][:, None] + np.arange(width)
            row_index = (begin + part)[:, None]
            time_offsets = time[neighbours] - time[row_index]
            scale = np.abs(time_offsets).max()
            powers = (time_offsets / scale)[:, :, None] ** np.arange(4)
            normal = np.einsum("nwi,nwj->nij", powers, powers)
            moments = np.einsum("nwi,nw->ni", powers, values[neighbours] - values[row_index])
            slopes[begin + part] = np.linalg.solve(normal, moments[..., None])[:, 1, 0] / scale
    return slopes


def slope_rows(time: np.ndarray, angle: np.ndarray, sd: float) -> tuple[int, float]:
    """Number of rows that give the slope of an angle with little noise, and the standard deviation of that slope.

    The noise of the slope is then `STEEP` of its size.
    """
    step = float(np.median(np.diff(time)))
    lag = max(len(time) // 20, 1)
    speed = float(np.sqrt(np.mean((angle[lag:] - angle[:-lag]) ** 2))) / (lag * step)
    count = np.ceil((12 * (sd / max(STEEP * speed * step, 1e-300)) ** 2) ** (1 / 3))
    count = int(np.clip(count, FEWEST, STEEPEST)) | 1
    return count, sd * (75 / count**3) ** 0.5 / step  # of a cubic


class _LogArrays:
    """Arrays of a log, by table row."""

    def __init__(self, problem: Problem, plan: StatePlan) -> None:
        observe: Any = problem.observe
        self.problem, self.plan, self.observe = problem, plan, observe
        self.time, self.of_rows = np.asarray(observe.time, float), observe.of_rows
        self.measured, self.sd = (np.asarray(x, float) for x in (problem.data.measured, problem.data.sd))
        states = [k for k in (plan.current, plan.motion if plan.mechanical else -1, *plan.others) if k >= 0]
        weight = np.asarray(problem.data.weight)
        rows_of_runs = [rows[rows >= 0] for rows in np.asarray(observe.rows_of)]
        self.rows_of_runs = [rows[np.all(weight[rows][:, states] > 0, 1)] for rows in rows_of_runs]
        time_steps = [np.diff(self.time[rows]) for rows in self.rows_of_runs if len(rows) > 1]
        self.step = float(np.median(np.concatenate(time_steps))) if time_steps else 1.0

    def motion(self, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
        """Time and speed in some rows of a run, and the noise of the speed (sd). The speed is in the unit of the
        motion channel.
        """
        plan = self.plan
        time = self.time[rows]
        if not plan.mechanical:
            return time, np.asarray(self.of_rows.motor_speed)[rows], 0.0
        readings = self.measured[rows, plan.motion]
        sd = float(np.median(self.sd[rows, plan.motion]))
        if plan.angle:
            lag = slope_rows(time, readings, sd)[0] // 2
            time_difference = time[lag:] - time[:-lag]
            return (
                time[lag:],
                (readings[lag:] - readings[:-lag]) / time_difference,
                1.5 * sd / float(np.median(time_difference)),
            )
        return time, readings, sd

    def length(self) -> float:
        """Length of a window [s], from the bandwidth of the motion."""
        correlation_times = [
            correlation_time(*self.motion(rows)) for rows in self.rows_of_runs if len(rows) > 2 * FEWEST
        ]
        return max(CORRELATED * float(np.median(correlation_times)) if correlation_times else 0.0, LONG * self.step)

    def points(self, run: int, size: int, delay: float | None) -> Columns:
        """Averages over groups of `size` consecutive rows of a run, within segments without a gap or a jump.

        Args:
            delay: delay of the jumps [s]. None: segments may contain jumps.

        Returns:
            By name: row, time, readings, sd and cell as in `LogPoints`. Also the segment of each point, -1 for
                points in no window.
        """
        rows = self.rows_of_runs[run]
        times = self.time[rows]
        begins_segment = np.r_[False, np.diff(times) > GAP * self.step][: len(rows)]
        # A reading at the instant of a jump still shows the state before it, as does the first of a run.
        jumps = np.zeros(0) if delay is None else _jump_times(self.observe, run) + delay
        rows_after_jumps = np.searchsorted(times, np.r_[times[:1], jumps] + 1e-9)
        if len(rows_after_jumps) * FEWEST < len(
            rows
        ):  # else a quantity that always jumps is one that changes smoothly
            begins_segment[rows_after_jumps[rows_after_jumps < len(rows)]] = True
        segment = np.cumsum(begins_segment)
        segment_starts = np.flatnonzero(np.r_[True, np.diff(segment) != 0])[: len(rows)]
        position = np.arange(len(rows)) - segment_starts[segment] if len(rows) else segment
        block = np.cumsum((position % size == 0) | begins_segment) - 1
        first_row, count = np.unique(block, return_index=True, return_counts=True)[1:]

        def mean(x: np.ndarray) -> np.ndarray:
            return np.add.reduceat(x, first_row, axis=0) / (count if x.ndim == 1 else count[:, None])

        middle = 0.5 * (times[1:] + times[:-1])
        is_within_segment = ~begins_segment[1:]
        low = np.r_[times[:1], np.where(is_within_segment, middle, times[1:])]
        high = np.r_[np.where(is_within_segment, middle, times[:-1]), times[-1:]]
        last_row = first_row + count - 1
        cell = np.stack([low[first_row] - EDGE * self.step, high[last_row] + EDGE * self.step], 1)
        return {
            "row": rows[first_row + count // 2],
            "time": mean(times),
            "readings": mean(self.measured[rows]),
            "sd": np.sqrt(mean(self.sd[rows] ** 2) / count[:, None]),
            "cell": cell,
            "segment": np.where(count == size, segment[first_row], -1),
        }

    def course(self, cells: list[np.ndarray]) -> ImposedCourse:
        """Imposed quantities over time. `cells`: intervals of the points of each run."""
        times_of_runs = np.asarray(self.observe.times)
        imposed = {n: np.asarray(x, float) for n in IMPOSED if (x := getattr(self.observe.conditions, n)) is not None}
        changing = {
            n: np.broadcast_to(x if x.ndim > 1 else x.reshape(-1, 1), times_of_runs.shape)
            for n, x in imposed.items()
            if np.ptp(x) > 0
        }
        linear = self.problem.base.rig.between_rows == "linear"
        knots, shifted_cells = list[np.ndarray](), list[np.ndarray]()
        values, integrals = ({name: list[np.ndarray]() for name in changing} for _ in range(2))
        for run, (times, cell) in enumerate(zip(times_of_runs, cells, strict=True)):
            instants = np.flatnonzero(np.diff(times, prepend=-1.0) > 0)
            times, period = times[instants], times[-1] + 1.0
            time = np.r_[-period, times, times[-1] + period]
            time_shift = (knots[-1][-1] if knots else 0.0) + 1.0 - time[0]
            for name, x in changing.items():
                padded = x[run, instants[np.r_[0, 0 : len(instants), -1]]]
                is_linear = linear or name in ("motor_speed", "motor_acceleration")
                mean = 0.5 * (padded[1:] + padded[:-1]) if is_linear else padded[:-1]
                integrals[name].append(np.r_[0.0, np.cumsum(np.diff(time) * mean)])
                values[name].append(padded)
            knots.append(time + time_shift)
            shifted_cells.append(cell + time_shift)
        joined_values, joined_integrals = (
            {n: np.concatenate(x) for n, x in arrays.items()} for arrays in (values, integrals)
        )
        return ImposedCourse(np.concatenate(knots), joined_values, joined_integrals, np.concatenate(shifted_cells))


def points_and_windows(
    problem: Problem, plan: StatePlan, delay: float = 0.0, *, across: bool = False
) -> tuple[LogPoints, ImposedCourse, list[RunWindows]]:
    """Points of a log, the imposed quantities over time, and the windows of its runs.

    Args:
        delay: delay between a jump in its column and its action [s].
        across: True for windows that may contain jumps.
    """
    log = _LogArrays(problem, plan)
    length = log.length()
    size = max(1, int(length / (POINTS * log.step)))
    parts = [log.points(run, size, None if across else delay) for run in range(len(log.rows_of_runs))]
    count = np.cumsum([0, *(len(p["time"]) for p in parts)])
    joined = {name: np.concatenate([p[name] for p in parts]) for name in parts[0]}
    run = np.repeat(np.arange(len(parts)), np.diff(count))
    imposed_course = log.course([p["cell"] for p in parts])
    mean_imposed, drift = imposed_course.at(delay)
    conditions: Any = jax.tree.map(lambda x: np.asarray(x)[joined["row"]], log.of_rows)
    for name, x in mean_imposed.items():
        conditions = with_condition(conditions, name, x)
    time, readings, sd = joined["time"], joined["readings"], joined["sd"]
    time_steps = np.where(np.diff(run, prepend=-1) != 0, 0.0, np.diff(time, prepend=0.0))
    # Points of different runs or on both sides of a jump are apart for slopes, and those of both ways for windows.
    slope_segment = np.cumsum(np.r_[False, (np.diff(run) != 0) | (np.diff(joined["segment"]) != 0)])
    slope_row_count = FEWEST
    rate_sd = 0.0
    rate = np.zeros(len(run))
    if plan.angle:
        longest_run = max(log.rows_of_runs, key=len)
        angle, sds = (x[longest_run, plan.motion] for x in (log.measured, log.sd))
        slope_row_count, rate_sd = slope_rows(log.time[longest_run], angle, float(np.median(sds)))
        slope_row_count = max(FEWEST, slope_row_count // size | 1)
        rate = local_slopes(time, readings[:, plan.motion], slope_segment, slope_row_count)
    way, speed = _travel_directions(problem, plan, conditions, readings, sd, rate, rate_sd)
    is_usable = (way != 0) & (joined["segment"] >= 0)
    window_segment = np.where(
        is_usable, np.cumsum(np.r_[False, (np.diff(slope_segment) != 0) | (np.diff(way) != 0)]), -1
    )
    if plan.angle:
        rate = local_slopes(time, readings[:, plan.motion], window_segment, slope_row_count)
    turned_angle = np.cumsum(np.where(time_steps > 0, 0.5 * (speed + np.roll(speed, 1)) * time_steps, 0.0))
    zeros = np.zeros(len(run))
    arrays = readings, sd, rate, way, turned_angle - turned_angle[count[:-1]][run], time_steps, time, joined["row"]
    delay_fields = zeros + delay, zeros + REACH * log.step, drift
    windows = [
        _weight_windows(r, time, windows_of_run(time, np.where(run == r, window_segment, -1), length))
        for r in range(len(parts))
    ]
    rows = LogPoints(*jax.tree.map(jnp.asarray, (conditions, *arrays, *delay_fields)))
    return rows, imposed_course, [w for w in windows if len(w.rows)]


def _weight_windows(run: int, time: np.ndarray, windows: list[tuple[np.ndarray, np.ndarray]]) -> RunWindows:
    """Windows of a run with their weights at the points."""
    longest = max((len(rows) for rows, _ in windows), default=0)
    rows_of_windows, values = np.zeros((len(windows), longest), int), np.zeros((4, len(windows), longest))
    values[3] = 1.0
    for k, (rows, share) in enumerate(windows):
        rows_of_windows[k], count = rows[-1], len(rows)
        length = (time[rows[-1]] - time[rows[0]]) / max(share[-1] - share[0], 1e-12)
        rows_of_windows[k, :count] = rows
        values[3, k, :count] = np.gradient(time[rows])
        weights = np.array(window_function(share, length)) * values[3, k, :count]
        values[:3, k, :count] = _exact_weights(weights, share, length)
    return RunWindows(run, rows_of_windows, *values)


def _exact_weights(weights: np.ndarray, share: np.ndarray, length: float) -> np.ndarray:
    """Window weights w, w', w'', corrected so that integration by parts is exact for polynomials up to the third
    degree.

    Plain sums over rows at irregular times are not exact. For an angle far from 0, the sum would be mostly error.
    """
    w = weights[0]
    powers = np.arange(4)
    scaled_place = 2 * share[:, None] - 1
    basis = scaled_place**powers
    normal = np.linalg.pinv(basis.T @ (w[:, None] * basis))
    moments = w @ basis
    first_moments = np.r_[0.0, powers[1:] * moments[:3]] * (2 / length)
    second_moments = np.r_[0.0, 0.0, (powers[1:] * powers[:-1])[1:] * moments[:2]] * (2 / length) ** 2
    errors = [-first_moments - weights[1] @ basis, second_moments - weights[2] @ basis]
    return np.stack([w, *(x + w * (basis @ (normal @ c)) for x, c in zip(weights[1:], errors, strict=True))])


def _jump_times(observe: Any, run: int) -> np.ndarray:
    """Times of the jumps of a run's imposed quantities [s]."""
    conditions = observe.conditions
    times = np.asarray(observe.times[run])
    jumps = np.zeros(len(times) - 1, bool)
    imposed = "voltage", "motor_current", "duty", "open", "load_torque", "slope_deg", "payload", "total_mass"
    for name in imposed:
        x = getattr(conditions, name)
        if x is not None and np.ndim(x) > 1:
            x = np.asarray(x)
            jumps |= np.abs(np.diff(x[run])) > JUMP * max(float(np.abs(x).max()), 1e-300)
    if conditions.motor_acceleration is not None and np.ndim(conditions.motor_acceleration) > 1:
        length = np.diff(times)
        slope = np.diff(np.asarray(conditions.motor_speed)[run]) / np.where(length > 0, length, np.inf)
        largest = max(float(np.abs(conditions.motor_acceleration).max()), 1e-300)
        jumps[:-1] |= (np.abs(np.diff(slope)) > KINK * largest) & (length[1:] > 0)
    return times[1:][jumps]


def _travel_directions(
    problem: Problem,
    plan: StatePlan,
    conditions: Any,
    readings: np.ndarray,
    sd: np.ndarray,
    rate: np.ndarray,
    rate_sd: float,
) -> tuple[np.ndarray, np.ndarray]:
    """Direction of travel at each point, 0 if the robot may be at rest, and the speed of the output [rad/s].

    Args:
        rate_sd: standard deviation of `rate`.
    """
    if plan.imposed == "motor_speed":
        speed = conditions.motor_speed / float(problem.base.gearbox.ratio)
        speed_sd = np.zeros(len(readings))
    else:
        robot = problem.base
        zero = jnp.zeros(())
        chassis = robot.configurations.members[0]
        rolling = State(zero, robot.gearbox.ratio, chassis.radius, zero, distance=chassis.radius)
        speed_per_reading = 1 / float(
            problem.channels[plan.motion].read(robot, balances.begin_signals(robot, Conditions(0), rolling))
        )
        speed = speed_per_reading * (rate if plan.angle else readings[:, plan.motion])
        speed_sd = abs(speed_per_reading) * (np.full(len(readings), rate_sd) if plan.angle else sd[:, plan.motion])
    limit = np.maximum(REST * np.abs(speed).max(initial=0.0), REST_SD * speed_sd)
    return np.where(np.abs(speed) > limit, np.sign(speed), 0.0), speed


def missing_states_remarks(runs: Runs, robot: Robot) -> list[Remark]:
    """Remark on a log that does not show the states of its equations."""
    read = {k: c for k, c in enumerate(runs.channels) if runs.sampled and np.isfinite(runs.measured()[:, k]).any()}
    plan = state_plan_or_reason(robot, read) if read else None
    return [Remark("unshown", source=runs.source, why=plan)] if isinstance(plan, str) else []
