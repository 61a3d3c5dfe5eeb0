"""Logs with more rows than a fit has time for: of which rows the readings are read."""

from __future__ import annotations

import dataclasses

import numpy as np

from calibration.data.columns import ROWS
from calibration.data.input_errors import BadConfiguration
from calibration.data.table import Runs

#: Rows at the start of a run that are read whatever follows: the beginning of a run is measured by them.
FIRST = 5


def thinned(runs: Runs, most: int = ROWS) -> Runs:
    """A log with about `most` of its rows, if it has more; what drives its runs stays as it is, in `Runs.log`.

    Of each run are kept its first rows, its last, and one of every few between: of rows side by side the one with
    readings of the channels of which fewest were kept so far, else the first. A table without `time_s` is left as it
    is.

    Raises:
        BadConfiguration: none at all is asked for.
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
        read: whether a row has a reading, shape (rows, channels).
    """
    kept = list(range(min(FIRST, len(read))))
    count = read[kept].sum(0)
    for begin in range(apart, len(read) - 1, apart):
        kept.append(begin + int(np.argmax(read[begin : begin + apart] @ (1.0 / (1.0 + count)))))
        count = count + read[kept[-1]]
    return np.array(sorted({*kept, len(read) - 1}))
