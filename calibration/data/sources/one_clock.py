"""Signals with separate clocks, resampled to one time grid: commands are held, states are interpolated linearly."""

from __future__ import annotations

from collections.abc import Mapping
from collections.abc import Set as AbstractSet

import numpy as np

from calibration.data import Columns, Names
from calibration.data.clock import unwrap_counter
from calibration.data.input_errors import BadData
from calibration.data.sources.recorded_signals import UNITS, Clock, Signal
from mmrjax.errors import count_noun

#: Numbers in this range [s] (1990 to 2100) count from 1970.
EPOCH = (6.3e8, 4.2e9)
#: Largest delay of a recorded sample, in usual steps.
LATE = 20.0
#: Stamps that differ by less are equal, as a share of the grid step.
SAME = 1e-3
#: Largest step of whole numbers that are ms, µs and ns, for rates down to 10 Hz.
_STEPS = {"ms": 1e2, "us": 1e5, "ns": 1e8}


def clock_seconds(clock: Clock) -> tuple[np.ndarray, float, str, float]:
    """Returns the times of a clock.

    If a clock does not state its unit, the size of its numbers since 1970 or their steps determine it. Numbers that
    are not whole are seconds. Wraps of a counter are removed.

    Returns:
        Time since its first sample [s], shape (n,). Clock reading of the first sample [s]. Unit of its numbers, empty
        for dates. Period of a counter that wraps, otherwise 0.

    Raises:
        BadData: a time stamp is missing or infinite.
    """
    raw = np.asarray(clock.load())
    if (missing_rows := np.flatnonzero(~np.isfinite(raw))).size:
        raise BadData(
            f"{clock.name}: got {raw[missing_rows[0]]} at sample {missing_rows[0] + 1}; expected a time in every "
            "sample"
        )
    if raw.dtype.kind in "Mm":
        ticks = raw.astype("datetime64[ns]" if raw.dtype.kind == "M" else "timedelta64[ns]").astype(np.int64)
        return (ticks - ticks[:1]) * 1e-9, float(ticks[0]) * 1e-9, "", 0.0
    if raw.dtype.kind in "iu":
        raw = raw.astype(np.int64)
    unit, period = clock.unit or guessed_unit(raw), 0.0
    if (np.diff(raw) < 0).any():
        raw, period = unwrap_counter(raw.astype(float), np.zeros(len(raw), int))
    seconds_per_unit = UNITS[unit]
    return (raw - raw[:1]) * seconds_per_unit, float(raw[0]) * seconds_per_unit, unit, period


def guessed_unit(raw: np.ndarray) -> str:
    """Unit of a clock, inferred from its numbers: a key of `recorded_signals.UNITS`."""
    stamps = np.asarray(raw, float)
    stamps = stamps[np.isfinite(stamps)]
    if not len(stamps):
        return "s"
    for unit in ("s", "ms", "us", "ns"):
        low, high = (limit / UNITS[unit] for limit in EPOCH)
        if low <= stamps[0] <= high:
            return unit
    steps = np.diff(stamps)
    steps = steps[steps > 0]
    if not len(steps) or (stamps % 1).any():
        return "s"
    step = float(np.median(steps))
    if step % 100 == 0 and 1e2 < step <= 1e5 and 1e6 % step and not (steps % 100).any():
        return "ms"  # a count of µs has varying last digits
    return next((unit for unit, largest in _STEPS.items() if step <= largest), "s")


def signals_on_one_grid(
    name: str, chosen: Mapping[str, Signal], held: AbstractSet[str], measured: AbstractSet[str], grid: str
) -> tuple[np.ndarray, Columns, Names]:
    """Returns the time since the first row [s], the values of each signal at these times, and notes on the
    resampling.

    The grid consists of the time stamps of the densest measured signal, or of the stated clock. Signals with this
    clock are unchanged. A command keeps the value of its last sample. Rows before the first sample of a command are
    omitted. Each sample of a reading is used once, in the nearest row, interpolated linearly to its time. Other rows
    have no reading.

    Args:
        name: name of the source.
        chosen: signals by the name of their column, each with a clock.
        held: columns whose values are held.
        measured: columns of readings.
        grid: name of the clock to use as grid. Empty: the densest.

    Raises:
        BadData: a clock goes back, or the clocks have no time in common.
    """
    clocks = {id(s.clock): s.clock for s in chosen.values() if s.clock is not None}
    try:
        clock_readings = {key: clock_seconds(clock) for key, clock in clocks.items()}
    except BadData as error:
        raise BadData(f"{name}, {str(error).removeprefix(f'{name}, ')}") from error
    begin = min(first_reading for _, first_reading, *_ in clock_readings.values())
    times: dict[int, np.ndarray] = {}
    order: dict[int, np.ndarray] = {}
    notes = []
    for key, (time, first_reading, unit, period) in clock_readings.items():
        clock = clocks[key].name
        time = time + (first_reading - begin)
        if late := _late_samples(time):
            order[key] = np.argsort(time, kind="stable")
            time = time[order[key]]
            notes.append(
                f"{name}: {count_noun(late, 'sample')} of {clock} arrived late. Samples are sorted by time stamp"
            )
        times[key] = time
        if period:
            notes.append(f"{name}: {clock} wraps at {period:.10g}. The wraps are removed")
        if not clocks[key].unit and unit not in ("", "s"):
            notes.append(f"{name}: {clock} has no unit. Its numbers are read as {unit} ({_rate_text(time)})")
        _check_clock(name, clock, time)
    grid_clocks = [key for key, clock in clocks.items() if grid and clock.name == grid]
    clocks_of_readings = {id(s.clock) for column, s in chosen.items() if column in measured}
    grid_clock = (
        grid_clocks[0] if grid_clocks else min(clocks_of_readings or times, key=lambda key: _median_step(times[key]))
    )
    tolerance = SAME * min(_median_step(times[grid_clock]), 1.0)
    starts = [times[id(s.clock)][0] for column, s in chosen.items() if column in held]
    is_covered = times[grid_clock] >= max(starts, default=-np.inf) - tolerance
    rows = times[grid_clock][is_covered]
    for key, time in times.items():
        if not len(rows) or time[-1] < rows[0]:
            raise BadData(
                f"{name}: {clocks[key].name} ends at {time[-1]:g} s, before {clocks[grid_clock].name} and every "
                "command have begun; expected signals that overlap in time"
            )
    values: Columns = {}
    resampled: dict[str, list[str]] = {}
    for column, signal in chosen.items():
        key, signal_values = id(signal.clock), signal.load()
        signal_values = signal_values[order[key]] if key in order else signal_values
        if np.array_equal(times[key], times[grid_clock]):
            values[column] = signal_values[is_covered]
        elif column in held or signal_values.dtype.kind not in "biuf":
            values[column] = signal_values[
                np.maximum(np.searchsorted(times[key], rows + tolerance, side="right") - 1, 0)
            ]
            resampled.setdefault("held from sample to sample", []).append(column)
        else:
            values[column] = readings_used_once(rows, times[key], signal_values)
            resampled.setdefault("interpolated linearly between samples, each used once", []).append(column)
    if not is_covered.all():
        notes.insert(0, f"{name}: {np.count_nonzero(~is_covered)} rows before the first command are left out")
    if resampled:
        resampled_words = "; ".join(f"{', '.join(columns)} {how}" for how, columns in resampled.items())
        notes.insert(
            0,
            f"{name}: signals have different clocks. Rows are taken at the samples of {clocks[grid_clock].name} "
            f"({_rate_text(times[grid_clock])}): {resampled_words}",
        )
    return rows - rows[0], values, tuple(notes)


def readings_used_once(rows: np.ndarray, time: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Readings in the rows nearest to their samples, interpolated linearly. NaN in other rows.

    Args:
        rows: time of the rows [s], shape (rows,).
        time, values: time and values of the samples, shape (samples,).
    """
    numbers = np.asarray(values, float)
    is_finite = np.isfinite(numbers)
    time, numbers = time[is_finite], numbers[is_finite]
    resampled = np.full(len(rows), np.nan)
    if not len(time) or not len(rows):
        return resampled
    after = np.minimum(np.searchsorted(rows, time), len(rows) - 1)
    before = np.maximum(after - 1, 0)
    nearest = np.where(time - rows[before] <= rows[after] - time, before, after)
    near_rows = np.unique(nearest[np.abs(rows[nearest] - time) <= max(_median_step(rows), 1e-9)])
    near_rows = near_rows[(rows[near_rows] >= time[0]) & (rows[near_rows] <= time[-1])]
    resampled[near_rows] = np.interp(rows[near_rows], time, numbers)
    return resampled


def _late_samples(time: np.ndarray) -> int:
    """Number of samples that were recorded slightly late. 0 if the clock was set back."""
    step = np.diff(time)
    is_late = step < 0
    return 0 if (step < -LATE * np.median(np.abs(step))).any() else int(np.count_nonzero(is_late))


def usual_step(time: np.ndarray) -> float:
    """Median of the steps of a clock that rise, NaN if it never rises."""
    steps = np.diff(time)
    return float(np.median(steps[steps > 0])) if (steps > 0).any() else np.nan


def _median_step(time: np.ndarray) -> float:
    return float(np.median(np.diff(time))) if len(time) > 1 else np.inf


def _rate_text(time: np.ndarray) -> str:
    step = _median_step(time)
    return f"{round(1 / step, 3 if step > 1 else 0):g} Hz" if 0 < step < np.inf else "one sample"


def _check_clock(name: str, clock: str, time: np.ndarray) -> None:
    if not len(time):
        raise BadData(f"{name}, {clock}: has no sample; expected time stamps")
    if (rows_of_falls := np.flatnonzero(~(np.diff(time) >= 0))).size:
        row = int(rows_of_falls[0])
        raise BadData(
            f"{name}, {clock}: goes back from {time[row]:g} to {time[row + 1]:g} s at sample {row + 2}; expected "
            "increasing time stamps; sort the recording, or give each part its own file"
        )
