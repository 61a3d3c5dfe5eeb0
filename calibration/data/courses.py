"""Conditions that change within a run of a time history. Each value holds from its sample until the next."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Sequence

import numpy as np

from calibration.data import Names
from calibration.data.columns import LOAD, SUPPLY
from calibration.data.table import Runs

#: Columns whose values may change between the samples of a run. A stated mass may change with the payload.
CHANGING = ("supply_voltage_V", "slope_deg", "payload_kg", "total_mass_kg", LOAD, "surface", "duty", "mode", "held")


@dataclasses.dataclass(frozen=True)
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
    columns = changing_columns(runs) if columns is None else columns
    varies = np.zeros(len(runs), bool)
    if not runs.sampled:
        return varies
    _, run = np.unique(runs.run_names, return_inverse=True)
    first_row_of_run = np.unique(run, return_index=True)[1][run]
    for column in (c for c in columns if runs.has(c)):
        differs = runs[column] != runs[column][first_row_of_run]
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
    stretches = []
    time, volts = runs["time_s"], applied_drive(runs)
    columns = [runs[c] for c in changing_columns(runs)]
    for name in np.unique(runs.run_names):
        stretches.append(divide_run(runs.in_order(name), time, columns, volts))
    return stretches


def course_of_each_row(runs: Runs) -> np.ndarray:
    """Short name of the sequence of conditions in each row's run, shape (rows,). Empty if no conditions change.

    The name is short because the whole sequence, with thousands of changes in each row, would take gigabytes.
    """
    courses, names = np.full(len(runs), "", dtype=object), dict[str, str]()
    if rows_of_varying_runs(runs).any():
        columns = changing_columns(runs)
        for run in (r for r in intervals_by_run(runs) if len(r) > 1):
            descriptions = [f"{s.begin:g}: {', '.join(str(runs[c][s.rows[0]]) for c in columns)}" for s in run]
            name = names.setdefault("; ".join(descriptions), f"course {len(names) + 1}")
            courses[np.concatenate([s.rows for s in run])] = name
    return courses.astype(str)
