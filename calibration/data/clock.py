"""Times of loggers, corrections of their clocks, and conditions that change within a run of a time history."""

from __future__ import annotations

import datetime
import math
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from calibration.data import Names
from calibration.data.columns import LOAD, SUPPLY, TIME, Column
from calibration.data.named_arrays import NamedArrays, Raw, column_numbers, missing_readings
from calibration.data.table import Runs
from mmrjax.errors import count_noun

#: Widths of counters that wrap [bit], and their periods. A 32-bit count of ms, µs or ns may be given in seconds.
DIGITS = (15, 16, 24, 31, 32)
PERIODS = (*(2.0**n for n in DIGITS), *(2.0**32 * one for one in (1e-3, 1e-6, 1e-9)))
#: Largest step across a wrap, in usual steps.
LACKING = 5.0
#: Rows are samples of an even clock if at least the first share repeats the stamp of the row before. At most the
#: second share of stamps then has an unusual number of rows.
SHARED, ODD = 0.1, 0.1


def unwrap_counter(count: np.ndarray, run: np.ndarray) -> tuple[np.ndarray, float]:
    """Counter with its wraps removed, and its period (0 if it does not wrap).

    A counter wraps if it falls only from its largest to its smallest numbers, by a step of at most `LACKING` usual
    steps.

    Args:
        count: counter as logged, shape (rows,).
        run: index of the recording of each row, shape (rows,).
    """
    same_run = np.diff(run) == 0
    step = np.where(same_run, np.diff(count), 0.0)
    falls = np.flatnonzero(step < 0)
    if not falls.size or not (step > 0).any():
        return count, 0.0
    usual_step = float(np.median(step[step > 0]))
    for period in PERIODS:
        step_across_wrap = step[falls] + period
        is_counter = period < 2**15 or not (count % 1).any()
        is_within = count.min() >= 0 and count.max() < period
        if is_counter and is_within and ((step_across_wrap >= 0) & (step_across_wrap <= LACKING * usual_step)).all():
            wraps = np.zeros(len(count))
            wraps[falls + 1] = 1.0
            wraps_before = np.cumsum(wraps)
            first_row_of_run = np.maximum.accumulate(np.where(np.r_[False, ~same_run], np.arange(len(count)), 0))
            return count + period * (wraps_before - wraps_before[first_row_of_run]), period
    return count, 0.0


def spread_shared_stamps(time: np.ndarray, run: np.ndarray) -> tuple[np.ndarray, float]:
    """Times in which rows with equal time stamps are spread evenly up to the next stamp, and the number of rows per
    stamp.

    The number of rows is 0 if nothing was changed.

    Args:
        time: time of the rows in order, shape (rows,).
        run: index of the recording of each row, shape (rows,).
    """
    if len(time) < 3:
        return time, 0.0
    first_rows = np.flatnonzero(np.r_[True, (np.diff(time) != 0) | (np.diff(run) != 0)])
    rows_of_each_stamp = np.diff(np.append(first_rows, len(time)))
    if (rows_of_each_stamp - 1).sum() < SHARED * len(time) or (np.diff(time)[np.diff(run) == 0] < 0).any():
        return time, 0.0
    step = np.append(np.where(np.diff(run[first_rows]) == 0, np.diff(time[first_rows]), np.nan), np.nan)
    usual_step = float(np.nanmedian(step)) if np.isfinite(step).any() else np.nan
    rows_per_stamp = float(np.median(rows_of_each_stamp))
    inner_rows = rows_of_each_stamp[1:-1] if len(rows_of_each_stamp) > 4 else rows_of_each_stamp
    if not np.isfinite(usual_step) or (np.abs(inner_rows - rows_per_stamp) > 1).mean() > ODD:
        return time, 0.0
    row_step = np.minimum(
        np.where(np.isfinite(step), step, usual_step) / rows_of_each_stamp, usual_step / rows_per_stamp * 1.5
    )
    index = np.arange(len(time)) - np.repeat(first_rows, rows_of_each_stamp)
    return time + index * np.repeat(row_step, rows_of_each_stamp), float(rows_of_each_stamp.mean())


#: Day assumed for a time without a date, and length of a day [s].
_SOME_DAY, _DAY = "1970-01-01T", 86400.0
#: Numbers in this range [s] (1990 to 2100) count from 1970. Smaller units of such clocks, in seconds.
EPOCH, PARTS = (6.3e8, 4.2e9), {"ms": 1e-3, "us": 1e-6, "ns": 1e-9}
#: A date as 25.11.2026.
_WITH_POINTS = re.compile(r"(\d\d)\.(\d\d)\.(\d{4})(?=[ T])")


def drop_empty_rows(arrays: NamedArrays, meanings: Sequence[Column | None]) -> NamedArrays:
    """The columns without empty rows, and a note with the number of these rows.

    A row is empty if all of its cells are missing, or if it is at the end of a log whose clock has returned to 0.
    Such loggers write out their whole memory.
    """
    empty_rows = np.arange(len(arrays))
    for raw in arrays.values:
        empty_rows = empty_rows[missing_readings(raw, empty_rows)]
    if len(arrays) > len(empty_rows) > 0:
        note = (
            f"left out: {count_noun(len(empty_rows), 'row')} without any reading. Row numbers count only the others"
        )
        arrays = arrays.rows(~np.isin(np.arange(len(arrays)), empty_rows), note)
    by_name = {m.column: raw for m, raw in zip(meanings, arrays.values, strict=True) if m is not None}
    clock = next((by_name[column] for column in TIME if column in by_name), None)
    if clock is None or "run_id" in by_name or not len(arrays):
        return arrays
    count = column_numbers(clock)
    filled_rows = np.flatnonzero(count != 0)
    if not len(filled_rows) or filled_rows[-1] == len(count) - 1 or not np.nanmax(count) > 0:
        return arrays
    is_kept = np.arange(len(count)) <= filled_rows[-1]
    note = f"left out: {count_noun(int((~is_kept).sum()), 'row')} at the end, because the clock restarts at 0 there"
    return arrays.rows(is_kept, note)


def time_since_start(name: str, meaning: Column, raw: Raw, runs: Sequence[str] | None) -> tuple[Raw, Names]:
    """A column of time, converted to the time since the first row of each run, and notes on the changes.

    A run begins at its first row. Its clock may show a time of day or the time since a controller started. Times of
    day are in ISO 8601, have a date such as 25.11.2026, or are numbers beyond the largest time. Such numbers count s,
    ms, µs or ns since 1970, depending on their size. Times without a date that fall back by more than half a day have
    passed midnight. Wraps of a counter are removed. Rows that share a time stamp are spread evenly up to the next
    stamp. A column with a cell that is no time is returned unchanged, and the reader rejects that cell.

    Args:
        name: name of the source.
        meaning: meaning of the column.
        runs: `run_id` of each cell. None: all cells belong to one run.
    """
    factor, notes = meaning.value(1.0), list[str]()
    run_names, run = np.array([""]), np.zeros(len(raw), int)
    if runs is not None:
        run_names, run = np.unique(runs, return_inverse=True)
    seconds = np.full(1, np.nan)
    if isinstance(raw, list) and ":" in raw[0]:
        seconds = np.array([_date_seconds(cell) for cell in raw])
    is_time_of_day = bool(np.isfinite(seconds).all())
    if not is_time_of_day:
        low, high = (limit * factor for limit in meaning.limits())
        count, notes = _unwrap_clock(f"{name}: {meaning.shown}", column_numbers(raw), run)
        seconds = count * factor
        is_time_of_day = bool((seconds > high).all())
        if is_time_of_day and seconds[0] > EPOCH[1]:
            unit = next((u for u, one in PARTS.items() if EPOCH[0] <= seconds[0] * one <= EPOCH[1]), None)
            if unit is None:
                return raw, ()
            seconds = seconds * PARTS[unit]
            notes.append(f"{name}: {meaning.shown} is read as {unit} since 1970, judging by its size")
        if not is_time_of_day and not ((low <= seconds) & (seconds <= high)).all():
            return raw, ()
    if isinstance(raw, list):
        _add_days_after_midnight(seconds, raw, run)
    start_time = np.full(len(run_names), seconds.min())
    if len(run_names) > 1:  # takes ten times as long
        start_time[:] = np.inf
        np.minimum.at(start_time, run, seconds)
    if not start_time.any():
        return (seconds / factor if notes else raw), tuple(notes)
    if is_time_of_day:
        notes.append(f"{name}: {meaning.shown} is a time of day, counted from the first row of each run")
    else:
        run_index = run[np.flatnonzero(start_time[run])[0]]
        run_words = f" in run {run_names[run_index]}" if run_names[run_index] else ""
        notes.append(
            f"{name}: {meaning.shown} begins at {start_time[run_index] / factor:g}{run_words}, and counts from the "
            "first row of a run. If it began earlier, add a row without readings then"
        )
    return np.round(seconds - start_time[run], 9) / factor, tuple(notes)


def _unwrap_clock(place: str, count: np.ndarray, run: np.ndarray) -> tuple[np.ndarray, list[str]]:
    """Times of a clock with wraps and shared time stamps removed, and notes on both."""
    step, notes = np.diff(count), list[str]()
    if (step > 0).all() or not np.isfinite(step).all():
        return count, notes
    count, period = unwrap_counter(count, run)
    if period:
        notes.append(f"{place} wraps at {period:.10g}. The wraps are removed")
    count, rows = spread_shared_stamps(count, run)
    if rows:
        notes.append(f"{place} repeats, {rows:.3g} rows per time stamp. Rows are spaced evenly between stamps")
    return count, notes


def _add_days_after_midnight(clock: np.ndarray, cells: Sequence[str], run: np.ndarray) -> None:
    """Adds a day [s] to times without a date after they fall back by more than half a day within their run."""
    last_time: dict[int, float] = {}
    for k, (x, run_index) in enumerate(zip(clock.tolist(), run.tolist(), strict=True)):
        if _is_time_without_date(cells[k]):
            clock[k] = x = x + _DAY * max(math.floor((last_time.get(run_index, x) - x) / _DAY + 0.5), 0)
        last_time[run_index] = x


def _is_time_without_date(cell: str) -> bool:
    return cell[2:3] == ":"


def _date_seconds(cell: str) -> float:
    """Seconds since 1970 of a date and time, NaN for other cells. A time without date is on `_SOME_DAY`."""
    if ":" not in cell:
        return math.nan
    iso_text = _WITH_POINTS.sub(r"\3-\2-\1", cell)
    try:
        when = datetime.datetime.fromisoformat(_SOME_DAY + cell if _is_time_without_date(cell) else iso_text)
    except ValueError:
        return math.nan
    return when.replace(tzinfo=when.tzinfo or datetime.UTC).timestamp()


#: Columns whose values may change between the samples of a run. A stated mass may change with the payload.
CHANGING = ("supply_voltage_V", "slope_deg", "payload_kg", "total_mass_kg", LOAD, "surface", "duty", "mode", "held")


@dataclass(frozen=True)
class ConstantInterval:
    """Consecutive samples of a run under the same conditions.

    Attributes:
        rows: indices of the samples in order of time, shape (samples,).
        begin, end: times since the start of the run at which these conditions begin and end [s].
        driven: true if the motors are driven forward.
        whole: true if it is the whole run.
    """

    rows: np.ndarray
    begin: float
    end: float
    driven: bool
    whole: bool

    @property
    def lasts(self) -> float:
        """Duration [s]."""
        return self.end - self.begin

    def after(self, time: np.ndarray, share: float) -> np.ndarray:
        """Rows after a share of its duration. `time`: time of every row of the table [s]."""
        return self.rows[time[self.rows] >= self.begin + share * (self.end - self.begin)]


def changing_columns(runs: Runs) -> Names:
    """Columns of a table that are imposed or may change within a run (`CHANGING`)."""
    return tuple(c for c in dict.fromkeys((runs.layout.imposed_column, *CHANGING)) if runs.has(c))


def applied_drive(runs: Runs) -> np.ndarray:
    """Voltage of the motors in every row, or the imposed speed or current, shape (rows,) [V], [rpm] or [A].

    The voltage is 0 if the driver brakes or coasts. In turns it is that of the side with the larger magnitude.
    """
    if runs.turns:
        return np.abs(runs.of_sides).max(0)
    if runs.layout.imposed_column != SUPPLY:
        return runs[runs.layout.imposed_column]
    voltage = runs["supply_voltage_V"] * (runs["duty"] if runs.has("duty") else 1.0)
    return np.where(runs["mode"] == "voltage", voltage, 0.0) if runs.has("mode") else voltage


def rows_of_varying_runs(runs: Runs, columns: Names | None = None) -> np.ndarray:
    """True for rows of runs in which one of these columns changes, shape (rows,). Default: all columns that may
    change.
    """
    varies = np.zeros(len(runs), bool)
    if not runs.sampled:
        return varies
    _, first_rows, run = np.unique(runs.run_names, return_index=True, return_inverse=True)
    for column in changing_columns(runs) if columns is None else filter(runs.has, columns):
        differs = runs[column] != runs[column][first_rows[run]]
        varies |= np.bincount(run, differs)[run] > 0
    return varies


def differs_from_row_before(rows: np.ndarray, conditions: Iterable[np.ndarray]) -> np.ndarray:
    """True for rows with a condition that differs from the row before, shape (rows,)."""
    differs_here = np.zeros(len(rows), bool)
    for condition in conditions:
        differs_here[1:] |= condition[rows][1:] != condition[rows][:-1]
    return differs_here


def divide_run(
    rows: np.ndarray, time: np.ndarray, conditions: Sequence[np.ndarray], applied: np.ndarray
) -> list[ConstantInterval]:
    """Divides a run into intervals of constant conditions.

    Args:
        rows: rows of the run in order of time.
        time: time of every row of the table [s].
        conditions: conditions of every row of the table.
        applied: applied voltage of every row of the table [V].
    """
    cuts = [0, *np.flatnonzero(differs_from_row_before(rows, conditions)).tolist(), len(rows)]
    begins = [0.0, *(float(time[rows[k]]) for k in cuts[1:-1]), float(time[rows[-1]])]
    return [
        ConstantInterval(rows[low:high], begin, end, bool(applied[rows[low]] > 0), len(cuts) == 2)
        for low, high, begin, end in zip(cuts[:-1], cuts[1:], begins[:-1], begins[1:], strict=True)
    ]


def intervals_by_run(runs: Runs) -> list[list[ConstantInterval]]:
    """Intervals of constant conditions for every run, in the order of the runs' names."""
    volts, columns = applied_drive(runs), [runs[c] for c in changing_columns(runs)]
    return [divide_run(runs.in_order(name), runs["time_s"], columns, volts) for name in np.unique(runs.run_names)]


def course_of_each_row(runs: Runs) -> np.ndarray:
    """Short name of the sequence of conditions in each row's run, shape (rows,). Empty if no conditions change.

    The name is short because the whole sequence, with thousands of changes in each row, would take gigabytes.
    """
    courses, names = np.full(len(runs), "", dtype=object), dict[str, str]()
    columns = changing_columns(runs)
    for run in intervals_by_run(runs) if rows_of_varying_runs(runs).any() else ():
        if len(run) > 1:
            descriptions = [f"{s.begin:g}: {', '.join(str(runs[c][s.rows[0]]) for c in columns)}" for s in run]
            name = names.setdefault("; ".join(descriptions), f"course {len(names) + 1}")
            courses[np.concatenate([s.rows for s in run])] = name
    return courses.astype(str)
