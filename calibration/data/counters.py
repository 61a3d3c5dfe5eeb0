"""Faults of clocks that count: numbers that wrap at the end of their digits, and stamps that several rows share."""

from __future__ import annotations

import numpy as np

#: Numbers of binary digits after which counters wrap; of a 32-bit counter also in seconds, from ms, µs and ns.
DIGITS = (15, 16, 24, 31, 32)
PERIODS = (*(2.0**n for n in DIGITS), *(2.0**32 * one for one in (1e-3, 1e-6, 1e-9)))
#: Usual steps that a counter may lack across its wrap.
LACKING = 5.0
#: Least share of rows that share their stamp with the row before, and largest share of stamps with other numbers of
#: rows than the usual one or the next: beyond these the rows are no samples of an even clock.
SHARED, ODD = 0.1, 0.1


def unwrap_counter(count: np.ndarray, run: np.ndarray) -> tuple[np.ndarray, float]:
    """Returns a counter that goes on past its end, and its period; 0 where it does not.

    A counter wraps where it falls from its last numbers to its first ones, within `LACKING` usual steps, and never
    goes back otherwise.

    Args:
        count: as logged, shape (rows,); run: index of the recording of each row, shape (rows,).
    """
    same = np.diff(run) == 0
    step = np.where(same, np.diff(count), 0.0)
    back = np.flatnonzero(step < 0)
    if not back.size or not (step > 0).any():
        return count, 0.0
    usual = float(np.median(step[step > 0]))
    for period in PERIODS:
        across = step[back] + period
        whole = period < 2**15 or not (count % 1).any()
        if (
            whole
            and count.min() >= 0
            and count.max() < period
            and (np.abs(across) <= LACKING * usual).all()
            and (across >= 0).all()
        ):
            wraps = np.zeros(len(count))
            wraps[back + 1] = 1.0
            total = np.cumsum(wraps)
            first = np.zeros(len(count), int)
            first[1:][~same] = np.flatnonzero(~same) + 1
            begins = total[np.maximum.accumulate(first)]  # wraps before the recording of each row began
            return count + period * (total - begins), period
    return count, 0.0


def spread_shared_stamps(time: np.ndarray, run: np.ndarray) -> tuple[np.ndarray, float]:
    """Returns times with rows that share a stamp set evenly between it and the next, and the rows of a stamp.

    The number of rows is 0 where nothing is changed.

    Args:
        time: of rows in order, shape (rows,); run: index of the recording of each row, shape (rows,).
    """
    if len(time) < 3:
        return time, 0.0
    begins = np.flatnonzero(np.concatenate([[True], (np.diff(time) != 0) | (np.diff(run) != 0)]))
    rows = np.diff(np.append(begins, len(time)))
    if (rows - 1).sum() < SHARED * len(time) or (np.diff(time)[np.diff(run) == 0] < 0).any():
        return time, 0.0
    stamps, recording = time[begins], run[begins]
    step = np.diff(stamps)
    step = np.append(step, np.nan)
    step[np.append(np.diff(recording) != 0, True)] = np.nan
    usual = float(np.nanmedian(step)) if np.isfinite(step).any() else np.nan
    each = float(np.median(rows))
    inner = rows[1:-1] if len(rows) > 4 else rows
    if not np.isfinite(usual) or (np.abs(inner - each) > 1).mean() > ODD:
        return time, 0.0
    apart = np.where(np.isfinite(step), step, usual) / rows
    apart = np.minimum(apart, usual / np.maximum(each, 1.0) * 1.5)
    index = np.arange(len(time)) - np.repeat(begins, rows)
    return np.repeat(stamps, rows) + index * np.repeat(apart, rows), float(rows.mean())
