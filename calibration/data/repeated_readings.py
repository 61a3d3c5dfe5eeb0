"""Readings that a log repeats: a slow sensor's last value, written in every row of a faster log."""

from __future__ import annotations

import numpy as np

#: Least rows between two readings of a slow sensor, and least number of its readings.
APART, FEWEST = 2, 12
#: Share of changes that may come sooner than a period, and least share that comes after a whole number of periods.
SOONER, REGULAR = 0.02, 0.8
#: Least share of rows that repeat the row before, and least ratio of the periods of recordings.
LEAST, ALIKE = 0.3, 0.8
#: Least share of changes by one smallest step for which a channel's repeats are attributed to its display.
STEPS = 0.5


def reading_period(values: np.ndarray) -> float:
    """Rows of a log between two readings of a slow sensor; 0 for a channel that is read in every row.

    A slow sensor changes at even distances of two rows or more, and rarely sooner. An instrument of coarse steps
    repeats numbers too, but changes by its smallest step, or at any distance.

    Args:
        values: readings of a channel in one recording, in the order of time; NaN if missing.
    """
    values = values[np.isfinite(values)]
    changed = np.flatnonzero(np.diff(values) != 0)
    gaps = np.diff(changed)
    if len(gaps) < FEWEST:
        return 0.0
    size = np.abs(np.diff(values)[changed])
    smallest = size.min()
    if (size <= 1.5 * smallest).mean() > STEPS:
        return 0.0
    usual = float(np.median(gaps))
    near = gaps[gaps <= 1.5 * usual]
    rows = usual if abs(near.mean() - usual) < 0.25 and (near == usual).mean() > 0.5 else float(near.mean())
    if usual < APART or (gaps < usual - 1.5).mean() > SOONER or (usual < 3 and (gaps < APART).mean() > SOONER):
        return 0.0
    off = np.abs(gaps - rows * np.maximum(np.round(gaps / rows), 1))
    return rows if (off <= np.maximum(1.0, 0.1 * gaps)).mean() >= REGULAR and len(near) >= 0.5 * len(gaps) else 0.0


def used_once(values: np.ndarray, time: np.ndarray, run: np.ndarray | None = None) -> tuple[np.ndarray, float]:
    """Returns a channel's values with one row for each reading of a slow sensor, NaN in the rows that repeat it, and
    the rows between readings; the unchanged values and 0 if no reading is repeated.

    Args:
        values: NaN for a missing reading, shape (rows,); time: of the rows; run: name of the recording of each row;
            None: all are of one.
    """
    if (np.diff(values) == 0).sum() < LEAST * len(values):
        return values, 0.0
    names = np.zeros(len(values), int) if run is None else np.unique(run, return_inverse=True)[1]
    order = np.lexsort((time, names))
    recordings = np.split(order, np.flatnonzero(np.diff(names[order])) + 1)
    periods = [reading_period(values[rows]) for rows in recordings]
    of_period = sum(len(rows) for rows, p in zip(recordings, periods, strict=True) if p)
    found = [p for p in periods if p]
    if not found or min(found) < ALIKE * max(found) or of_period < 0.5 * len(values):
        return values, 0.0
    rows_apart = float(np.median(found))
    kept = np.full(len(values), np.nan)
    for rows in recordings:
        shown = rows[np.isfinite(values[rows])]
        begins = np.flatnonzero(np.concatenate([[True], np.diff(values[shown]) != 0]))[: len(shown)]
        lengths = np.diff(np.append(begins, len(shown)))
        times = np.maximum(np.floor(lengths / rows_apart + 0.5), 1).astype(int)  # a reading may be the same again
        first = np.repeat(begins, times)
        again = np.arange(len(first)) - np.repeat(np.cumsum(times) - times, times)
        at = shown[np.minimum(first + np.round(again * rows_apart).astype(int), len(shown) - 1)]
        kept[at] = values[at]
    return kept, rows_apart
