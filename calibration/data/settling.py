"""Settled runs of a log: stretches of constant drive in which every channel has settled."""

from __future__ import annotations

import functools
import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from itertools import pairwise

import jax.numpy as jnp
import numpy as np

from calibration.data import Columns
from calibration.data.clock import applied_drive, differs_from_row_before
from calibration.data.columns import LOAD, SPEED
from calibration.data.contradictions import GAP
from calibration.data.inferred_facts import common_step
from calibration.data.input_errors import BadData
from calibration.data.row_checks import inertia_at_motor
from calibration.data.runs import Runs
from mmrjax.errors import count_noun
from mmrjax.model import balances, channels
from mmrjax.model.channels import Channel
from mmrjax.model.conditions import Conditions
from mmrjax.model.robot import Robot
from mmrjax.model.signals import State

#: Below this share of its largest value, a signal counts as zero: motors not driven, output at rest.
STILL = 0.02
#: Smallest uncertainty of a signal as a share of its largest value, in addition to the share of its mean.
FINE = 0.005
#: Default of the largest change within a stretch, as a share of the mean.
DRIFT = 0.02
#: Default length of the shortest stretch [s].
LEAST = 0.3
#: Fewest samples of a stretch, and of the parts whose means are compared.
FEWEST, PART = 8, 3
#: Largest difference between means of parts that agree [sds].
SDS = 3.0
#: Sd of the change along a stretch, by a straight-line fit, divided by the sd of its mean: √12.
OF_CHANGE = 12**0.5
#: Number of beginnings of a stretch that are tried. A change below this share of the allowed change is slight.
TRIES, SLIGHT = 20, 0.05
#: An instrument has coarse steps if at most this share of its readings are different.
COARSE = 0.2
#: Number of equal successive readings that noise rules out, if at most this share of all readings repeat the one
#: before.
STUCK, CHANCE = 20, 0.2
#: Distance of a glitch from neighbouring readings, in robust sds and in steps of the instrument.
FAR = 6.0
#: Largest share of glitches in a usable stretch. Samples around a tested reading.
MOST_GLITCHES, BESIDE = 0.25, (21, 101)
#: Channels that are zero in straight travel.
OF_YAW = tuple(c.name for c in channels.OF_TURNS if c.directed and c.side is None)
#: Conditions that end a stretch whenever they change.
EXACT = ("configuration", "surface", "mode", "slope_deg", "payload_kg", "total_mass_kg")
#: Reasons for omitting samples: finding, advice, and an option of `settle` that helps.
REASONS = {
    "changes": ("the imposed quantity always changes", "hold each level for a while"),
    "short": ("the level is held too briefly", "hold it longer", "lower --shortest"),
    "settling": ("still changes at the end of its level", "hold it longer", "raise --drift"),
    "accelerates": ("still accelerates at the end of its level", "hold it longer", "raise --drift"),
    "idle": ("nothing drives the motors", "nothing"),
    "rest": ("the drive does not move", "nothing, friction holds the drive"),
    "stuck": ("is saturated or frozen", "check the instrument"),
    "glitches": ("has many outliers", "check the instrument, or log a mean of pulses"),
    "unread": ("no channel has enough readings", "log more, or remove these rows"),
    "undriven": ("the driver brakes or coasts", "nothing, a fit to the log uses them"),
}


@dataclass(frozen=True)
class Signal:
    """Readings of a channel in settled travel, sample by sample.

    Attributes:
        channel: channel of the table of settled runs.
        shown: its readings [unit of the column], NaN if missing or a glitch.
        angle: readings of the angle whose derivative the channel is [unit of its column], empty if the channel is
            read directly.
        step: resolution of its instrument [unit], 0 if there is none.
        largest: 98th percentile of the magnitudes of its readings.
        glitches: True for readings far from their neighbours, see `find_glitches`, shape (rows,).
    """

    channel: Channel
    shown: np.ndarray
    angle: np.ndarray
    step: float
    largest: float
    glitches: np.ndarray

    @functools.cached_property
    def filled(self) -> float:
        """Share of the log's rows with a reading. Below 1 if instruments log at different rates."""
        return float(np.isfinite(self.shown).mean())


#: Current needed to accelerate the motors of a configuration. Channels of a speed and of a current (empty if the
#: current is imposed). Current [A] for one unit of the speed column per second. Smallest current to which shares
#: refer [A].
Inertia = tuple[str, str, float, float]


@dataclass(frozen=True)
class Stretch:
    """Consecutive samples of a log that are tested as one run.

    Attributes:
        run: name of the run.
        rows: indices in the table, in the order of time.
        begin, end: first and last time [s].
        why: empty for a settled run, else one of `REASONS`.
        channel: the channel responsible, if there is one.
        size: relative change of this channel [-].
        mean, sd: mean and standard deviation of each channel, by name [unit of the column]. Only for a settled run.
        drift: change of each channel over it, by name [unit].
        imposed: mean of the imposed quantity: voltage, speed or current.
        glitches: number of readings that the mean of each channel omits, by name. Only channels with glitches.
    """

    run: str
    rows: np.ndarray
    begin: float
    end: float
    imposed: float
    why: str = ""
    channel: str = ""
    size: float = 0.0
    mean: Mapping[str, float] = field(default_factory=dict)
    sd: Mapping[str, float] = field(default_factory=dict)
    drift: Mapping[str, float] = field(default_factory=dict)
    glitches: Mapping[str, int] = field(default_factory=dict)

    @property
    def lasts(self) -> float:
        """Duration [s]."""
        return self.end - self.begin

    @property
    def reason(self) -> str:
        """Reason why it is left out: `total_current still changes at the end of its level (6.1 %)`."""
        size_text = f" ({100 * self.size:.2g} %)" if self.size else ""
        return f"{self.channel} {REASONS[self.why][0]}{size_text}".strip()


@dataclass(frozen=True)
class Settled:
    """Settled travel of a log.

    Attributes:
        runs: the log.
        stretches: all of them, in the order of the log.
        signals: signals of its channels.
        shortest, drift: as requested.
        gaps: rows after which samples are missing.
        scatter: extra sd of each channel between stretches under the same conditions, by name [unit].
    """

    runs: Runs
    stretches: tuple[Stretch, ...]
    signals: tuple[Signal, ...]
    shortest: float
    drift: float
    gaps: tuple[int, ...]
    scatter: Mapping[str, float]

    @property
    def kept(self) -> tuple[Stretch, ...]:
        """Stretches that are settled runs."""
        return tuple(s for s in self.stretches if not s.why)

    @property
    def points(self) -> int:
        """Number of operating points: settled runs with different drives or conditions."""
        step = DRIFT * float(np.max(np.abs(applied_drive(self.runs))))
        return len({(round(s.imposed / step), *_operating_point(self.runs, s)) for s in self.kept})

    def settled_runs(self) -> Runs:
        """Settled runs, in the form of a table from a file."""
        columns = self.table()
        extras = {name: columns.pop(name) for name in self.runs.extras if name in columns}
        return replace(self.runs, columns=columns, extras=extras, log=None)

    def table(self) -> Columns:
        """Settled runs as columns of a table of runs."""
        stretches = self.kept
        columns: Columns = {}
        means = self.runs.columns | {k: v for k, v in self.runs.extras.items() if v.dtype.kind == "f"}
        omitted = {s.channel.column for s in self.signals} | {c.sd_column for c in channels.EVERY}
        omitted |= {"time_s", "order", "run_id", "mode", *(angle for angle, _, _ in RATES)}
        omitted |= {SPEED} if self.runs.turns else set()
        for name in (name for name in means if name not in omitted):
            cells = [means[name][s.rows] for s in stretches]
            is_number = means[name].dtype.kind == "f"
            columns[name] = np.array([_rounded(_finite_mean(x)) if is_number else str(x[0]) for x in cells])
        for channel in (s.channel for s in self.signals):
            if any(math.isfinite(s.mean[channel.name]) for s in stretches):
                columns[channel.column] = np.array([_rounded(s.mean[channel.name]) for s in stretches])
                columns[channel.sd_column] = np.array([_rounded(s.sd[channel.name], 3) for s in stretches])
        columns["run_id"] = np.array([f"{s.run or 'log'} {s.begin:.6g}-{s.end:.6g} s" for s in stretches])
        columns["order"] = np.arange(1.0, len(stretches) + 1)
        return columns


def _rounded(x: float, digits: int = 7) -> float:
    return float(f"{x:.{digits}g}") if math.isfinite(x) else math.nan


def settle_log(
    runs: Runs,
    robot: Robot | None = None,
    *,
    shortest: float | None = None,
    drift: float = DRIFT,
) -> Settled:
    """Returns the settled runs of a log.

    The log is divided into levels where the imposed quantity changes. The settled run of a level is the mean over its
    end. This end is extended backward as long as every channel's mean stays the same within noise. Means omit
    glitches (`find_glitches`). The sd of a mean has four parts:

    * noise with its autocorrelation (Geyer's initial positive sequence, 1992),
    * the error from the steps of the instrument (Widrow and Kollár, Quantization noise, 2008, first term for normal
      noise),
    * the remaining drift, and
    * the scatter of stretches under the same conditions.

    Args:
        robot: robot of the log. Stretches in which its acceleration takes more than `drift` of the current are
            omitted. None: no stretch is.
        shortest: shortest stretch [s]. None: 0.3 s, and at least 20 samples.
        drift: largest change within a stretch, as a share of the mean.

    Raises:
        BadData: time does not increase, there is no stretch, or speeds or currents have no sign.
    """
    result = _divide_log(runs, shortest, drift, {} if robot is None else acceleration_currents(robot))
    if not result.kept:
        raise BadData(_nothing_settled_message(result))
    if doubt := _sign_doubt(result):  # from their own sds, because repeats with different signs widen the final ones
        raise BadData(doubt)
    return replace(
        result,
        stretches=tuple(
            replace(s, sd={name: math.hypot(sd, result.scatter[name]) for name, sd in s.sd.items()})
            for s in result.stretches
        ),
    )


def doubtful_sign(runs: Runs) -> str:
    """Reason to doubt the sign of a channel, from the settled stretches, empty without evidence."""
    try:
        return _sign_doubt(_divide_log(runs, None, DRIFT, {}))
    except BadData:  # a log without a stretch
        return ""


def _divide_log(runs: Runs, shortest: float | None, drift: float, inertia: Mapping[str, Inertia]) -> Settled:
    """Stretches of a log with their means, before they are compared with each other."""
    if not runs.sampled:
        raise BadData(
            f"{runs.source}: column time_s is missing, so each row is already a settled run; use it with loop"
        )
    rows_by_run = _rows_by_run(runs)
    step = float(np.median(np.concatenate([np.diff(runs["time_s"][rows]) for rows in rows_by_run])))
    shortest = max(LEAST, 20 * step) if shortest is None else shortest
    drives = applied_drive(runs)
    gaps: list[int] = []
    levels: list[np.ndarray] = []
    for rows in rows_by_run:
        rows_of_gaps = np.flatnonzero(np.diff(runs["time_s"][rows]) > GAP * step)
        gaps += rows[rows_of_gaps].tolist()
        levels += np.split(rows, rows_of_gaps + 1)
    for driver in (*(runs.of_sides if runs.turns else (drives,)), *([runs[LOAD]] if runs.has(LOAD) else [])):
        levels = [x for level in levels for x in _divided_levels(runs, driver, level, shortest, drift, step)]
    signals = _settled_signals_of_log(runs, rows_by_run, levels, max(1, round(shortest / 6 / step)), drift)
    stuck = np.array([_stuck_rows(s, rows_by_run) for s in signals])
    stretches = tuple(
        _settled_end(runs, signals, drives, level, shortest, drift, step, stuck, inertia) for level in levels
    )
    scatter = _scatter_of_repeats(runs, stretches, signals, float(np.max(np.abs(drives))))
    return Settled(runs, stretches, signals, shortest, drift, tuple(gaps), scatter)


# --- time and channels ----------------------------------------------------------------------------------


def settled_channels(robot: Robot) -> tuple[Channel, ...]:
    """Channels that settled runs of a robot's logs can have: its own channels, and rates of its angles."""
    rates = {rate for angle, rate, _ in RATES if angle in {c.column for c in robot.channels}}
    return tuple(c for c in channels.EVERY if (c in robot.channels and c.settled) or c.name in rates)


def _rows_by_run(runs: Runs) -> list[np.ndarray]:
    """Rows of each run, in order of time, which must not be repeated."""
    rows_by_run, time = list(runs.rows_by_run().values()), runs["time_s"]
    for rows in rows_by_run:
        for k in np.flatnonzero(np.diff(time[rows]) == 0)[:1].tolist():
            raise BadData(
                f"{runs.place(rows[k + 1])}, time_s: {time[rows[k]]:g} s is repeated; give each sample its own time, "
                "or remove one of them"
            )
    if (longest := max(map(len, rows_by_run))) < FEWEST:
        raise BadData(
            f"{runs.source}: {count_noun(longest, 'sample')} in its longest run; at least {FEWEST} are needed"
        )
    return rows_by_run


def _settled_signals_of_log(
    runs: Runs, rows_by_run: list[np.ndarray], levels: list[np.ndarray], half: int, drift: float
) -> tuple[Signal, ...]:
    """Returns the readings of each channel of settled runs. If only an angle is measured, its rate."""
    width = min(max(6 * half, BESIDE[0]), BESIDE[1])
    sources = [(c, c, 0.0) for c in runs.present_channels if c.settled and np.isfinite(runs[c.column]).any()]
    read_directly = {c.name for c, _, _ in sources}
    for angle, rate, factor in RATES:
        if rate not in read_directly and runs.has(angle):
            sources += [(channels.find_channel(rate), c, factor) for c in runs.channels if c.column == angle]
    signals = []
    for channel, source, factor in sources:
        raw = runs[source.column]
        is_glitch = find_glitches(
            raw, levels, width, _step_of_instrument(runs, source, raw), None if factor else drift
        )
        readings, angles, step = np.where(is_glitch, np.nan, raw), np.zeros(0), 0.0
        if factor:
            angles, readings = readings * factor, np.full(len(runs), np.nan)
            for rows in rows_by_run:
                # rate over the last `2 * half` samples, so that samples after a level do not affect its end
                time, x, k = runs["time_s"][rows], angles[rows], np.arange(len(rows))
                first_row, last_row = np.maximum(k - 2 * half, 0), np.maximum(k, 1)
                readings[rows] = (x[last_row] - x[first_row]) / (time[last_row] - time[first_row])
        else:
            step = _step_of_instrument(runs, channel, readings)
        signals.append(Signal(channel, readings, angles, step, _reading_size(readings), is_glitch))
    if not signals:
        raise BadData(f"{runs.source}: no channel has readings that can be used for settled runs")
    return tuple(signals)


def find_glitches(
    readings: np.ndarray, levels: list[np.ndarray], width: int, step: float, drift: float | None
) -> np.ndarray:
    """True for readings far from their neighbours, shape (rows,).

    A glitch differs from the median of the `width` readings around it by more than `FAR` robust sds, `FAR` steps and
    the allowed drift. The robust sd is 1.4826 times the median difference (Hampel, The influence curve and its role
    in robust estimation, 1974). In normal noise their share is 2e-9, so means of clean logs do not change. A level
    has no glitches if most of its readings are near zero, because the mean of a pulsed current depends on the pulses.
    For an angle, half of its usual travel over the window replaces the drift. The first `width` readings of a level
    may be a start, so `PART` of them in a row are no glitches.

    Args:
        readings: readings, NaN if missing.
        levels: rows of each level, in the order of time.
        width: number of readings in a median.
        step: step of the instrument [unit of the readings].
        drift: largest change within a stretch, as a share of the mean. None: the readings are an angle.
    """
    from scipy.ndimage import binary_opening, median_filter

    is_glitch = np.zeros(len(readings), bool)
    largest = _reading_size(readings)
    for rows in levels:
        rows = rows[np.isfinite(readings[rows])]
        if len(rows) < FEWEST:
            continue
        window = min(width, len(rows)) | 1
        x, pad = readings[rows], window // 2
        # A level is padded with its end values: if it were mirrored, a start would appear as a glitch.
        ends = np.full(pad, np.median(x[:PART])), np.full(pad, np.median(x[-PART:]))
        middle = median_filter(np.concatenate([ends[0], x, ends[1]]), window)[pad : pad + len(x)]
        deviation = np.abs(x - middle)
        scatter = 1.4826 * median_filter(deviation, min(5 * window, len(x)) | 1, mode="reflect")
        # Readings may be coarse although the file states no step.
        coarse_step = max(step, float(np.diff(np.unique(x)).min())) if np.ptp(x) > 0 else step
        noise = FAR * np.maximum(scatter, coarse_step)
        if drift is None:
            is_far = deviation > np.maximum(noise, 0.5 * window * np.median(np.abs(np.diff(x))))
        else:
            allowed = np.maximum(noise, np.maximum(drift * np.abs(middle), FINE * largest))
            is_far = (deviation > allowed) & (np.abs(middle) > STILL * largest)
        is_far[:window] &= ~binary_opening(is_far[:window], np.ones(PART))
        is_glitch[rows] = is_far
    return is_glitch


#: Columns of angles, the channel of their rate, and one unit of the angle per second in the unit of that channel.
RATES = (("output_angle_deg", "output_speed", 1 / 6), ("position_mm", "speed", 1.0))


def _step_of_instrument(runs: Runs, channel: Channel, readings: np.ndarray) -> float:
    """Step of a channel's instrument [unit of the column], from its readings or else from the file.

    If neither gives one and most readings repeat, it is their smallest difference.
    """
    quanta = (i.quantum or 0.0 for i in runs.layout.instruments if i.channel == channel.name)
    if step := common_step(readings) or next(quanta, 0.0) / channel.factor:
        return step
    levels = np.unique(readings[np.isfinite(readings)])
    coarse = 1 < len(levels) < COARSE * np.isfinite(readings).sum()
    return float(np.median(np.diff(levels)[np.diff(levels) < 1.5 * np.diff(levels).min()])) if coarse else 0.0


def _stuck_rows(signal: Signal, rows_by_run: list[np.ndarray]) -> np.ndarray:
    """Rows in which a channel shows only 0 or repeats one number for longer than noise allows."""
    is_stuck = np.full(len(signal.shown), signal.largest == 0)
    for rows in rows_by_run if not len(signal.angle) else ():
        readings = signal.shown[rows]
        repeats = np.diff(readings) == 0
        if not len(repeats):
            continue
        is_limit = np.isin(readings[1:], (np.nanmin(readings, initial=np.inf), np.nanmax(readings, initial=-np.inf)))
        if (repeats & ~is_limit).mean() > CHANCE:  # coarse steps
            continue
        edges = np.flatnonzero(np.diff(np.concatenate([[0], repeats.astype(int), [0]])))
        for low, high in edges.reshape(-1, 2):
            if high - low >= STUCK and readings[low] != 0:
                is_stuck[rows[low : high + 1]] = True
    return is_stuck


# --- levels and stretches -------------------------------------------------------------------------------


def _divided_levels(
    runs: Runs, drives: np.ndarray, rows: np.ndarray, shortest: float, drift: float, step: float
) -> Iterator[np.ndarray]:
    """Rows of a part without gaps, divided wherever a condition changes, or `drives` by more than its noise.

    `drives` is the imposed quantity, or the torque of a brake.
    """
    if not len(rows):
        return
    cuts = differs_from_row_before(rows, (runs[name] for name in EXACT if runs.has(name)))
    cuts[0] = True
    x = drives[rows]
    changes = np.diff(x[np.isfinite(x)])
    largest, noise = float(np.max(np.abs(drives))), 0.0
    if len(changes):  # robust to steps, 0 if most samples equal the sample before
        noise = 1.4826 * float(np.median(np.abs(changes - np.median(changes)))) / math.sqrt(2)
    block_size = 1 if noise <= 1e-9 * largest else max(1, min(round(shortest / step / 6), 64))
    begin, mean, count = 0, float(x[0]), 0
    starts = np.arange(0, len(rows), block_size)
    sizes = np.diff(starts, append=len(rows))
    # Lists are faster here, and a log may have a million rows.
    blocks = (starts, sizes, np.add.reduceat(x, starts) / sizes, np.logical_or.reduceat(cuts, starts))
    for k, samples, value, is_cut in zip(*(block.tolist() for block in blocks), strict=True):
        tolerance = max(0.5 * drift * abs(mean), 0.2 * FINE * largest, 4 * noise / math.sqrt(block_size))
        if count and (abs(value - mean) > tolerance or is_cut):
            # the last averaged samples may belong to the next level
            yield rows[begin : k - block_size if block_size > 1 and k - begin > 3 * block_size else k]
            begin, mean, count = k, value, samples
        else:
            mean = (mean * count + value * samples) / (count + samples)
            count += samples
    yield rows[begin:]


def _settled_end(
    runs: Runs,
    signals: tuple[Signal, ...],
    drives: np.ndarray,
    rows: np.ndarray,
    shortest: float,
    drift: float,
    step: float,
    stuck: np.ndarray,
    inertia: Mapping[str, Inertia],
) -> Stretch:
    """The settled end of a level, or the reason why it has none."""
    time = runs["time_s"]
    begin, end, imposed = float(time[rows[0]]), float(time[rows[-1]]), float(np.mean(drives[rows]))
    level = Stretch(str(runs.run_names[rows[0]]), rows, begin, end, imposed)

    def omitted(why: str, channel: str = "", size: float = 0.0) -> Stretch:
        return replace(level, why=why, channel=channel, size=size)

    if runs.has("mode") and str(runs["mode"][rows[0]]) != "voltage":
        return omitted("undriven")
    if end - begin + step < shortest or len(rows) < FEWEST:
        return omitted("changes" if len(rows) < FEWEST else "short")
    if abs(imposed) <= STILL * float(np.max(np.abs(drives))):
        return omitted("idle")
    names = [s.channel.name for s in signals]
    for name, is_stuck in zip(names, stuck, strict=True):
        if is_stuck[rows].mean() > 0.5:
            return omitted("stuck", name)
    end_rows, means, left_over = _best_end(signals, time, rows, shortest, drift)
    glitches = [int(s.glitches[end_rows].sum()) for s in signals]
    for signal, (mean, sd, change), count in zip(signals, means, glitches, strict=True):
        if count > MOST_GLITCHES * len(end_rows):
            return omitted("glitches", signal.channel.name, count / len(end_rows))
        if not math.isfinite(mean):
            continue
        if abs(change) > max(drift * abs(mean), FINE * signal.largest) + SDS * OF_CHANGE * sd:
            return omitted("settling", signal.channel.name, abs(change) / max(abs(mean), FINE * signal.largest))
        to_come = _remaining_change(signal, rows, mean)
        if to_come > drift:
            return omitted("settling", signal.channel.name, to_come)
        left_over = max(left_over, to_come)
    if np.isnan(means).all():
        return omitted("unread")
    is_moving = [
        abs(mean) >= max(STILL * s.largest, SDS * sd)
        for s, (mean, sd, _) in zip(signals, means, strict=True)
        if s.channel.zero_at_rest and s.channel.name not in OF_YAW and math.isfinite(mean)
    ]
    if is_moving and not any(is_moving):
        return omitted("rest")
    by_name = {name: x for name, x in zip(names, means.tolist(), strict=True) if math.isfinite(x[0])}
    speed, current, per_rate, least = inertia.get(str(runs["configuration"][rows[0]]), ("", "", 0.0, 0.0))
    if speed in by_name and (not current or current in by_name):
        current_per_change = per_rate / float(time[end_rows[-1]] - time[end_rows[0]])
        _, sd, change = by_name[speed]
        full_scale = max(abs(by_name[current][0] if current else imposed), least)
        share = abs(current_per_change * change) / full_scale
        noise = OF_CHANGE * abs(current_per_change * sd) / full_scale
        if share > drift + SDS * noise:
            return omitted("accelerates", speed, share)
    mean, sd, change = means.T
    # The tail of a lag would continue by about as much again after the end, in all channels.
    sd = np.hypot(sd, left_over * _scales(signals, mean))
    return replace(
        level,
        rows=end_rows,
        begin=float(time[end_rows[0]]),
        mean=dict(zip(names, mean.tolist(), strict=True)),
        sd=dict(zip(names, sd.tolist(), strict=True)),
        drift=dict(zip(names, change.tolist(), strict=True)),
        glitches={name: count for name, count in zip(names, glitches, strict=True) if count},
    )


def _best_end(
    signals: tuple[Signal, ...], time: np.ndarray, rows: np.ndarray, shortest: float, drift: float
) -> tuple[np.ndarray, np.ndarray, float]:
    """Final part of a level, with the length that gives the most certain means: longer parts average out more noise,
    shorter parts drift less.

    Returns:
        Its rows. Mean, sd and change of each channel [unit of the column], shape (channels, 3). The largest change
        beyond noise, as a share of `_scales`.
    """
    parts = _level_parts(time[rows], shortest)
    first_part = _first_steady(signals, rows, parts, drift)
    last_part = max(len(parts) - 3, first_part)
    ends = []
    for k in sorted({first_part, *np.linspace(first_part, last_part, TRIES).astype(int).tolist()}):
        end_rows = rows[parts[k][0] :]
        means = np.array([_segment_mean(s, time[end_rows], end_rows) for s in signals])
        mean, sd, change = means.T
        scales = _scales(signals, mean)
        left_over = float(np.nanmax(np.maximum(np.abs(change) - OF_CHANGE * sd, 0.0) / scales, initial=0.0))
        ends.append((math.hypot(np.nanmax(sd / scales, initial=0.0), left_over), (end_rows, means, left_over)))
        if left_over <= SLIGHT * drift:
            break
    return min(ends, key=lambda end: end[0])[1]


def _scales(signals: tuple[Signal, ...], means: np.ndarray) -> np.ndarray:
    """Scale of each channel's change [unit]: its mean, but at least a tenth of its largest reading."""
    return np.maximum(np.abs(means), [0.1 * s.largest for s in signals])


def _remaining_change(signal: Signal, rows: np.ndarray, mean: float) -> float:
    """Change expected after the end of a level, as a share of `_scales`.

    It is the tail of a lag, whose decay follows from the changes between quarters of the level. If noise hides the
    last change, it is extrapolated from the earlier ones.
    """
    quarters = [q[np.isfinite(q)] for q in np.array_split(signal.shown[rows], 4)]
    if min(map(len, quarters)) < PART:
        return 0.0
    first_change, earlier, later = np.diff([float(np.mean(q)) for q in quarters]).tolist()
    index = np.arange(len(quarters[3]))  # only the last quarter: earlier ones contain a lag's decay
    noise = quarters[3] - np.polyval(np.polyfit(index, quarters[3], 1), index)
    standard_error = SDS * math.sqrt(2 * _correlation_time(noise) / len(noise)) * float(np.std(noise))
    is_hidden = abs(later) < standard_error
    if is_hidden:
        earlier, later = first_change, earlier
    if abs(later) < standard_error or earlier * later <= 0:
        return 0.0
    decay = min(later / earlier, 0.9)
    last_change = min(abs(later) * decay, standard_error) if is_hidden else abs(later)
    return last_change * decay / (1 - decay) / max(abs(mean), 0.1 * signal.largest)


def _reading_size(readings: np.ndarray) -> float:
    """98th percentile of the magnitudes of a channel's finite readings, 0 if it has none."""
    sizes = np.abs(readings[np.isfinite(readings)])
    return float(np.quantile(sizes, 0.98)) if len(sizes) else 0.0


def _level_parts(time: np.ndarray, shortest: float) -> list[tuple[int, int]]:
    """Parts of a level: a third of the shortest stretch, at least `PART` samples. The last three form a stretch."""
    size = max(shortest / 3, float(time[-1] - time[0]) / 300)
    part = ((time[-1] - time) / size).astype(int)  # counted from the end, so that the last parts are complete
    edges = [0, *(np.flatnonzero(np.diff(part)) + 1).tolist(), len(time)]
    level_parts: list[tuple[int, int]] = []
    for low, high in reversed(list(pairwise(edges))):
        if level_parts and level_parts[-1][1] - level_parts[-1][0] < PART:
            level_parts[-1] = (low, level_parts[-1][1])
        else:
            level_parts.append((low, high))
    return level_parts[::-1]


def _first_steady(signals: tuple[Signal, ...], rows: np.ndarray, parts: list[tuple[int, int]], drift: float) -> int:
    """First part from which on every channel's mean stays at its final value."""
    earlier, tail_row = parts[:-3], parts[-3:][0][0]
    counts = np.array([max(high - low, 1) for low, high in earlier])
    is_steady = np.full(len(earlier), True)
    for s in signals:
        means = np.array([_finite_mean(s.shown[rows[low:high]]) for low, high in earlier])
        tail = s.shown[rows[tail_row:]]
        tail = tail[np.isfinite(tail)]
        mean, noise = _finite_mean(tail), 0.0
        if len(tail) > 2:
            noise = float(np.std(tail) * math.sqrt(_correlation_time(tail - mean)))
        scatter = noise * np.sqrt(1 / counts + 1 / (len(rows) - tail_row))
        is_steady &= ~(np.abs(means - mean) > max(0.5 * drift * abs(mean), FINE * s.largest) + SDS * scatter)
    return int(np.flatnonzero(~is_steady).max(initial=-1)) + 1


def _finite_mean(x: np.ndarray) -> float:
    finite = x[np.isfinite(x)]
    return float(np.mean(finite)) if len(finite) else math.nan


def _correlation_time(x: np.ndarray) -> float:
    """Autocorrelation time 1 + 2 Σ ρ_k, at least 1. The sum ends before the first negative pair of successive terms
    (Geyer 1992).
    """
    power = float(np.mean(x**2))
    if len(x) < 4 or power <= 0:
        return 1.0
    longest_lag = min(len(x) // 3, 500)
    spectrum = np.fft.rfft(x, 2 * len(x))
    rho = np.fft.irfft(np.abs(spectrum) ** 2)[:longest_lag] / (len(x) * power)
    total = 1.0
    for k in range(1, longest_lag - 1, 2):
        pair = rho[k] + rho[k + 1]
        if pair <= 0:
            break
        total += 2 * float(pair)
    return max(total, 1.0)


def _segment_mean(signal: Signal, time: np.ndarray, rows: np.ndarray) -> tuple[float, float, float]:
    """Mean of a channel over a stretch, the sd of this mean, and the change along a straight-line fit."""
    readings = signal.shown[rows]
    finite = np.isfinite(readings)
    if finite.sum() < max(FEWEST, 0.5 * signal.filled * len(rows)):
        return math.nan, math.nan, math.nan
    t, x = time[finite] - time[finite].mean(), readings[finite]
    mean, lasts = float(x.mean()), float(np.ptp(t))
    change = float(t @ (x - mean) / (t @ t)) * lasts
    fitted = signal.angle[rows][finite] if len(signal.angle) else x
    slope = float(t @ (fitted - fitted.mean()) / (t @ t))
    residual = fitted - fitted.mean() - slope * t
    spread, correlation = float(np.std(residual)), _correlation_time(residual)
    if len(signal.angle):
        return slope, max(spread * math.sqrt(correlation / float(t @ t)), 1e-9 * abs(slope)), change
    sd = spread * math.sqrt(correlation / len(x))
    if signal.step > 0:  # without noise all readings round the same way; noise makes the error of their mean smaller
        # Two readings do not show how often noise moves one to the other.
        noise_in_steps = max(spread**2 / signal.step**2 - 1 / 12, 0.0) if len(np.unique(x)) > 2 else 0.0
        rounding = min(1 / math.sqrt(12), math.exp(-2 * math.pi**2 * noise_in_steps) / (math.pi * math.sqrt(2)))
        sd = math.hypot(sd, rounding * signal.step)
    return mean, max(sd, 1e-6 * abs(mean), 1e-9 * signal.largest), change


def _scatter_of_repeats(
    runs: Runs, stretches: tuple[Stretch, ...], signals: tuple[Signal, ...], largest: float
) -> dict[str, float]:
    """Extra sd of each channel between stretches under the same conditions [unit], 0 with too few repeats."""
    groups: list[tuple[tuple[object, ...], list[Stretch]]] = []
    for point, s in sorted(
        ((_operating_point(runs, s), s) for s in stretches if not s.why), key=lambda pair: (pair[0], pair[1].imposed)
    ):
        if groups and groups[-1][0] == point and s.imposed - groups[-1][1][0].imposed <= 0.2 * FINE * largest:
            groups[-1][1].append(s)
        else:
            groups.append((point, [s]))
    scatter = {}
    for name in (s.channel.name for s in signals):
        excess, degrees_of_freedom = 0.0, 0
        for _, group in groups:
            values = np.array([s.mean[name] for s in group if math.isfinite(s.mean[name])])
            sds = np.array([s.sd[name] for s in group if math.isfinite(s.mean[name])])
            if len(values) > 1:
                excess += float(np.sum((values - values.mean()) ** 2) - (1 - 1 / len(values)) * np.sum(sds**2))
                degrees_of_freedom += len(values) - 1
        scatter[name] = math.sqrt(max(excess, 0.0) / degrees_of_freedom) if degrees_of_freedom >= 3 else 0.0
    return scatter


def _sign_doubt(settled: Settled) -> str:
    """Message on speeds and currents that have the same sign in both directions of travel. Empty: there are none."""
    layout, runs = settled.runs.layout, settled.runs
    for signal in (s for s in settled.signals if runs.turns_round(s.channel)):
        channel = signal.channel
        name = channel.name
        clear = [s for s in settled.kept if abs(s.mean[name]) > max(SIGNED * s.sd[name], STILL * signal.largest)]
        backward, forward = ([s for s in clear if sign * s.imposed > 0] for sign in (-1, 1))
        wrong = [s for s in forward if s.mean[name] < 0]
        is_reversed = bool(wrong) and len(wrong) == len(forward)
        if backward and all(s.mean[name] > 0 for s in backward) and not is_reversed:
            return (
                f"{_place_text(settled, backward[0], channel)}; expected readings with their signs, negative in "
                f"reverse; or set [instruments.{name}] signed = false in the rig's file, if it shows only "
                "the magnitude"
            )
        if (is_reversed or (wrong and channel.zero_at_rest)) and not runs.pulled:
            cure = (
                f"state [columns] {channel.column} = {{column = ..., factor = -1}} in the rig's file"
                if is_reversed
                else f"give {'duty' if runs.has('duty') else layout.imposed_column} the sign of its direction"
            )
            return f"{_place_text(settled, wrong[0], channel)}; expected the sign of the imposed quantity; {cure}"
    return ""


def _operating_point(runs: Runs, stretch: Stretch) -> tuple[object, ...]:
    """Levels of the brake torque in a stretch, and of each side's drive in a turn, in steps of `DRIFT` of the
    largest, and its other conditions.
    """
    signals = (*(runs.of_sides if runs.turns else ()), *([runs[LOAD]] if runs.has(LOAD) else []))
    levels = (
        round(float(np.mean(x[stretch.rows])) / (DRIFT * float(np.max(np.abs(x))))) if x.any() else 0 for x in signals
    )
    return *levels, *(runs[c][stretch.rows[0]] for c in EXACT if runs.has(c))


#: A mean has a sign if it is at least this far from zero [sds].
SIGNED = 5.0


def _place_text(settled: Settled, stretch: Stretch, channel: Channel) -> str:
    """Place of a stretch, a channel's reading there, and the imposed value, for a message."""
    reading, unit = _rounded(stretch.mean[channel.name], 4), settled.runs.layout.imposed_column.rpartition("_")[2]
    return (
        f"{settled.runs.place(stretch.rows[0], stretch.rows[-1])}, {channel.column}: shows {reading:g} "
        f"{channel.unit} at {_rounded(stretch.imposed, 4):g} {unit}"
    )


def _nothing_settled_message(settled: Settled) -> str:
    """Message on a log without settled stretches: the reason that omits most of its time, and advice."""
    by_reason = {why: [s for s in settled.stretches if s.why == why] for why in REASONS}
    why = max(by_reason, key=lambda why: sum(s.lasts for s in by_reason[why]))
    longest = max(by_reason[why], key=lambda s: s.lasts)
    _, advice, *options = REASONS[why]
    # Turns are sought by calibrate and loop, which have no options of settle.
    others = (
        ["give one command for straight travel"] if settled.runs.turns else [*options, "use the log itself with loop"]
    )
    cure = "log driven motion" if advice.startswith("nothing") else advice
    place = settled.runs.place(longest.rows[0], longest.rows[-1])
    return (
        f"{place}: no settled segment: {longest.reason}. This level has {longest.lasts:.3g} s and "
        f"{count_noun(len(longest.rows), 'sample')}; expected at least {settled.shortest:.3g} s and {FEWEST} "
        f"samples; {', or '.join((cure, *others))}"
    )


# --- properties of the robot that settling needs ---


def acceleration_currents(robot: Robot) -> dict[str, Inertia]:
    """Current that acceleration takes in each configuration, if known."""
    constant = float(robot.motor.torque_constant)
    inertias = {}
    zeros, one = jnp.zeros(()), jnp.ones(())
    for k, (name, load) in enumerate(robot.configurations.items()):
        inertia = inertia_at_motor(robot, load)
        rolling_speed = jnp.asarray(float(load.radius) / float(robot.gearbox.ratio))
        currents = _settled_readings(robot, k, State(one, zeros, zeros, zeros))
        speeds = _settled_readings(robot, k, State(zeros, one, rolling_speed, zeros))
        current = next((n for n, x in currents.items() if x and not speeds[n]), "")
        speed = next((n for n, x in speeds.items() if x), "")
        is_known = current or robot.rig.imposed == "motor_current"
        if is_known and speed and inertia > 0 and constant > 0:
            per_rate = inertia / constant * currents.get(current, 1.0) / speeds[speed]
            inertias[name] = speed, current, per_rate, 1e-3
    return inertias


def _settled_readings(robot: Robot, configuration: int, state: State) -> dict[str, float]:
    """Readings of the settled channels in a state [unit of the column]. 0 for channels that depend on more."""
    signals = balances.begin_signals(robot, Conditions(configuration), state)
    readings = {}
    for channel in settled_channels(robot):
        try:
            readings[channel.name] = float(channel.read(robot, signals)) / channel.factor
        except (AttributeError, TypeError):  # a signal that the balances fill in
            readings[channel.name] = 0.0
    return readings
