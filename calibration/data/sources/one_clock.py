"""Signals with separate clocks, resampled to one time grid: commands are held, states are interpolated linearly."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np

from calibration.data import Columns, Names
from calibration.data.clock import unwrap_counter
from calibration.data.input_errors import BadData
from calibration.data.sources.recorded_signals import UNITS, Clock, Signal
from mmrjax.errors import count_noun

#: Clocks that read between these seconds since 1970 (1990 and 2100) count from 1970.
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
    usual = float(np.median(steps))
    if usual % 100 == 0 and 1e2 < usual <= 1e5 and 1e6 % usual and not (steps % 100).any():
        return "ms"  # a count of µs has varying last digits
    return next((unit for unit, largest in _STEPS.items() if usual <= largest), "s")


def signals_on_one_grid(
    name: str,
    chosen: Mapping[str, Signal],
    is_held: Callable[[str], bool],
    is_measured: Callable[[str], bool],
    grid: str,
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
        is_held: True for a column whose values are held.
        is_measured: True for a column of readings.
        grid: name of the clock to use as grid. Empty: the densest.

    Raises:
        BadData: a clock goes back, or the clocks have no time in common.
    """
    clocks = {id(s.clock): s.clock for s in chosen.values() if s.clock is not None}
    try:
        read = {key: clock_seconds(clock) for key, clock in clocks.items()}
    except BadData as error:
        raise BadData(f"{name}, {str(error).removeprefix(f'{name}, ')}") from error
    begin = min(first for _, first, *_ in read.values())
    times = {key: time + (first - begin) for key, (time, first, *_) in read.items()}
    order = {key: _sample_order(time) for key, time in times.items()}
    late = {key: int(np.count_nonzero(np.diff(times[key]) < 0)) for key, rows in order.items() if rows is not None}
    times = {key: time if order[key] is None else time[order[key]] for key, time in times.items()}
    shared_clock = {key: next(k for k in times if np.array_equal(times[k], time)) for key, time in times.items()}
    for key, time in times.items():
        _check(name, clocks[key].name, time)
    measured = {id(s.clock) for column, s in chosen.items() if is_measured(column)}
    grid_clocks = [key for key, clock in clocks.items() if grid and clock.name == grid]
    pool = grid_clocks or sorted(measured or times, key=lambda key: _step(times[key]))
    main = pool[0]
    rows = times[main]
    step_columns = {column for column in chosen if is_held(column)}
    starts = [times[id(chosen[column].clock)][0] for column in step_columns]
    alike = SAME * min(_step(rows), 1.0)
    is_covered = rows >= max(starts, default=-np.inf) - alike
    for key, time in times.items():
        if time[-1] < rows[is_covered][0] if is_covered.any() else True:
            raise BadData(
                f"{name}: {clocks[key].name} ends at {time[-1]:g} s, before {clocks[main].name} and every command "
                "have begun; expected signals that overlap in time"
            )
    values: Columns = {}
    brought: dict[str, list[str]] = {}
    for column, signal in chosen.items():
        signal_values, key, sorted_by = signal.load(), shared_clock[id(signal.clock)], order[id(signal.clock)]
        signal_values = signal_values if sorted_by is None else signal_values[sorted_by]
        if key == shared_clock[main]:
            values[column] = signal_values[is_covered]
            continue
        on = rows[is_covered]
        if column in step_columns or signal_values.dtype.kind not in "biuf":
            values[column] = signal_values[np.maximum(np.searchsorted(times[key], on + alike, side="right") - 1, 0)]
            brought.setdefault("held", []).append(column)
        else:
            values[column] = readings_used_once(on, times[key], signal_values)
            brought.setdefault("interpolated", []).append(column)
    notes = []
    if brought:
        resampling_words = {
            "held": "held from sample to sample",
            "interpolated": "interpolated linearly between samples, each used once",
        }
        kind_sentences = "; ".join(
            f"{', '.join(columns)} {resampling_words[kind]}" for kind, columns in brought.items()
        )
        notes.append(
            f"{name}: signals have different clocks. Rows are taken at the samples of {clocks[main].name} "
            f"({_rate(rows)}): {kind_sentences}"
        )
    if not is_covered.all():
        notes.append(f"{name}: {np.count_nonzero(~is_covered)} rows before the first command are left out")
    for key, clock in clocks.items():
        *_, unit, period = read[key]
        if key in late:
            notes.append(
                f"{name}: {count_noun(late[key], 'sample')} of {clock.name} arrived late. Samples are sorted by time "
                "stamp"
            )
        if period:
            notes.append(f"{name}: {clock.name} wraps at {period:.10g}. The wraps are removed")
        if not clock.unit and unit not in ("", "s"):
            notes.append(f"{name}: {clock.name} has no unit. Its numbers are read as {unit} ({_rate(times[key])})")
    on = rows[is_covered]
    return on - on[0], values, tuple(notes)


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
    next_row = np.clip(np.searchsorted(rows, time), 1, max(len(rows) - 1, 1))
    nearest = np.where(
        time - rows[next_row - 1] <= rows[np.minimum(next_row, len(rows) - 1)] - time, next_row - 1, next_row
    )
    nearest = np.minimum(nearest, len(rows) - 1)
    step = _step(rows)
    near = np.unique(nearest[np.abs(rows[nearest] - time) <= max(step, 1e-9)])
    near = near[(rows[near] >= time[0]) & (rows[near] <= time[-1])]
    resampled[near] = np.interp(rows[near], time, numbers)
    return resampled


def _sample_order(time: np.ndarray) -> np.ndarray | None:
    """Order of samples by their stamps if some were recorded slightly late. None if they are in order, or if the
    clock was set back.
    """
    step = np.diff(time)
    if not (step < 0).any() or step.min() < -LATE * float(np.median(np.abs(step))):
        return None
    return np.argsort(time, kind="stable")


def _step(time: np.ndarray) -> float:
    return float(np.median(np.diff(time))) if len(time) > 1 else np.inf


def _rate(time: np.ndarray) -> str:
    step = _step(time)
    return f"{round(1 / step, 3 if step > 1 else 0):g} Hz" if 0 < step < np.inf else "one sample"


def _check(name: str, clock: str, time: np.ndarray) -> None:
    if not len(time):
        raise BadData(f"{name}, {clock}: has no sample; expected time stamps")
    if (rows_of_falls := np.flatnonzero(~(np.diff(time) >= 0))).size:
        row = int(rows_of_falls[0])
        raise BadData(
            f"{name}, {clock}: goes back from {time[row]:g} to {time[row + 1]:g} s at sample {row + 2}; expected "
            "increasing time stamps; sort the recording, or give each part its own file"
        )
