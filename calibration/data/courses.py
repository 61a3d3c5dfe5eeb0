"""Conditions that change within a run of a time history: each value holds from its sample until the next."""

from __future__ import annotations

import dataclasses

import numpy as np

from calibration.data.runs import Runs

#: Columns of which every sample of a run may have a value of its own. A stated mass may change as the payload does.
CHANGING = ("supply_voltage_V", "slope_deg", "payload_kg", "total_mass_kg", "surface", "duty", "mode")


@dataclasses.dataclass(frozen=True)
class Stretch:
    """Samples of a run, one after the other, under the same conditions.

    Attributes:
        run: name of the run; rows: indices of the samples in the order of time, shape (samples,).
        begin, end: since the start of the run, when these conditions began, and when others follow or the run ends [s].
        driven: whether the motors are driven forwards.
        whole: whether the run has no other stretch.
    """

    run: str
    rows: np.ndarray
    begin: float
    end: float
    driven: bool
    whole: bool

    @property
    def lasts(self) -> float:
        """[s]."""
        return self.end - self.begin

    def after(self, time: np.ndarray, share: float) -> np.ndarray:
        """Rows later than a share of its time; `time` is of every row of the table [s]."""
        return self.rows[time[self.rows] >= self.begin + share * (self.end - self.begin)]


def names(runs: Runs) -> np.ndarray:
    """Which run each row belongs to, shape (rows,)."""
    return runs["run_id"] if runs.has("run_id") else np.zeros(len(runs), str)


def applied(runs: Runs) -> np.ndarray:
    """Voltage that the driver gives the motors in every row, 0 where they brake or coast [V], shape (rows,)."""
    voltage = runs["supply_voltage_V"] * (runs["duty"] if runs.has("duty") else 1.0)
    return np.where(runs["mode"] == "voltage", voltage, 0.0) if runs.has("mode") else voltage


def varies(runs: Runs, columns: tuple[str, ...] = CHANGING) -> np.ndarray:
    """Whether one of these columns changes within the run of a row, shape (rows,)."""
    found = np.zeros(len(runs), bool)
    if not runs.has("time_s"):
        return found
    _, run = np.unique(names(runs), return_inverse=True)
    first = np.unique(run, return_index=True)[1][run]
    for column in (c for c in columns if runs.has(c)):
        differs = runs[column] != runs[column][first]
        found |= np.bincount(run, differs)[run] > 0
    return found


def stretches(runs: Runs) -> list[Stretch]:
    """The stretches of all runs, run by run in the order of their names."""
    found = []
    all_names, time, volts = names(runs), runs["time_s"], applied(runs)
    columns = [runs[c] for c in CHANGING if runs.has(c)]
    for name in np.unique(all_names):
        rows = np.flatnonzero(all_names == name)
        rows = rows[np.argsort(time[rows], kind="stable")]
        differs = np.any([c[rows][1:] != c[rows][:-1] for c in columns], 0)
        cuts = [0, *(np.flatnonzero(differs) + 1).tolist(), len(rows)]
        for low, high in zip(cuts, cuts[1:], strict=False):
            begin = 0.0 if low == 0 else float(time[rows[low]])
            end = float(time[rows[min(high, len(rows) - 1)]])
            found.append(Stretch(str(name), rows[low:high], begin, end, bool(volts[rows[low]] > 0), len(cuts) == 2))
    return found


def courses(runs: Runs) -> np.ndarray:
    """For every row the course of its run's conditions, empty where they do not change; shape (rows,)."""
    found = np.full(len(runs), "", dtype=object)
    if varies(runs).any():
        columns = [c for c in CHANGING if runs.has(c)]
        said: dict[str, list[str]] = {}
        parts = [s for s in stretches(runs) if not s.whole]
        for s in parts:
            said.setdefault(s.run, []).append(f"{s.begin:g}: {', '.join(str(runs[c][s.rows[0]]) for c in columns)}")
        for s in parts:
            found[s.rows] = "; ".join(said[s.run])
    return found.astype(str)
