"""Selection of rows whose readings a fit uses, for logs with too many rows."""

from __future__ import annotations

import dataclasses

import numpy as np

from calibration.data.columns import ROWS
from calibration.data.input_errors import BadConfiguration
from calibration.data.table import Runs

#: Rows at the start of a run whose readings are always used: they show its initial state.
FIRST = 5


def thin_log(runs: Runs, most: int = ROWS) -> Runs:
    """Returns a log with about `most` of its rows, if it has more; `Runs.log` keeps the drive in all rows.

    Each run keeps its first rows, its last row, and one row of every few in between. Of neighbouring rows, it keeps
    the one with readings of the channels with the fewest readings so far, else the first. A table without `time_s`
    is returned unchanged.

    Raises:
        BadConfiguration: `most` is less than 1.
    """
    if most < 1:
        raise BadConfiguration(f"rows: got {most}; expected 1 or more")
    if not runs.sampled or len(runs) <= most:
        return runs
    apart, kept = -(-len(runs) // most), []
    read = np.isfinite(runs.measured())
    for name in dict.fromkeys(runs.run_names.tolist()):
        rows = runs.in_order(name)
        kept.append(rows[_evenly(read[rows], apart)])
    return dataclasses.replace(runs.where(np.sort(np.concatenate(kept))), log=runs.whole)


def _evenly(read: np.ndarray, apart: int) -> np.ndarray:
    """First rows, last row, and one of every `apart`.

    Args:
        read: true if a row has a reading, shape (rows, channels).
    """
    kept = list(range(min(FIRST, len(read))))
    count = read[kept].sum(0)
    for begin in range(apart, len(read) - 1, apart):
        kept.append(begin + int(np.argmax(read[begin : begin + apart] @ (1.0 / (1.0 + count)))))
        count = count + read[kept[-1]]
    return np.array(sorted({*kept, len(read) - 1}))
