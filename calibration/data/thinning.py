"""Selection of rows whose readings a fit uses, for tables and logs with too many rows."""

from __future__ import annotations

import dataclasses

import numpy as np

from calibration.data import input_files
from calibration.data.columns import ROWS
from calibration.data.input_errors import BadConfiguration, BadData
from calibration.data.table import Runs
from mmrjax.errors import count_noun
from mmrjax.model.robot import Robot

#: Number of rows at the start of a run that are always used, because they show its initial state.
FIRST = 5
#: Memory of a loop for each settled row [bytes]. The base fit took 61 kB with 50 000 rows of a bench.
ROW = 100_000


def used_rows(runs: Runs, robot: Robot, most: int) -> Runs:
    """Rows of the runs that a fit uses, with the robot's channels.

    Raises:
        BadConfiguration: the arguments are no `Runs` and `Robot`, or as in `thin_rows`.
        BadData: for the same reasons as `Runs.of` and `thin_rows`.
    """
    for name, value, kind in (("runs", runs, Runs), ("robot", robot, Robot)):
        if not isinstance(value, kind):
            example = "mmrjax.read_runs(source, robot)" if kind is Runs else "mmrjax.read_robot(file)"
            raise BadConfiguration(f"{name}: got {type(value).__name__}; expected {kind.__name__} of {example}")
    return thin_rows(runs.of(robot), most)


def thin_rows(runs: Runs, most: int = ROWS) -> Runs:
    """Runs with about `most` of their rows, if they have more. `Runs.log` keeps all rows.

    In a log, each run keeps its first rows, its last row, and every n-th row in between. A table without `time_s` is
    sorted by its conditions, the imposed quantity first, and treated as one run. The kept rows are therefore spread
    evenly over the conditions. Among n neighbouring rows, the one with readings of the channels with the fewest kept
    readings is preferred.

    Raises:
        BadConfiguration: `most` is less than 1.
        BadData: the settled rows need more memory than is free.
    """
    if most < 1:
        raise BadConfiguration(f"rows: got {most}; expected 1 or more")
    need, free = 0.0 if runs.sampled else float(ROW * min(len(runs), most)), input_files.available_memory()
    if need > free:
        raise BadData(
            f"{runs.source}: {count_noun(min(len(runs), most), 'row')} need {need / 1e9:.3g} GB, and "
            f"{free / 1e9:.3g} GB of memory are free, enough for {free / ROW:.0f} rows; set --rows"
        )
    if len(runs) <= most:
        return runs
    rows_per_kept, kept_rows = -(-len(runs) // most), []
    read = np.isfinite(runs.measured())
    if runs.sampled:
        ordered = list(runs.rows_by_run().values())
    else:
        ordered = [np.lexsort([runs[column] for column in reversed(("configuration", *runs.axes))])]
    for rows in ordered:
        kept_rows.append(rows[_evenly_spaced_rows(read[rows], rows_per_kept)])
    return dataclasses.replace(runs.where(np.sort(np.concatenate(kept_rows))), log=runs.whole)


def _evenly_spaced_rows(read: np.ndarray, apart: int) -> np.ndarray:
    """First rows, last row, and one of every `apart` rows.

    Args:
        read: True if a row has a reading, shape (rows, channels).
    """
    kept_rows = list(range(min(FIRST, len(read))))
    count = read[kept_rows].sum(0)
    for begin in range(apart, len(read) - 1, apart):
        kept_rows.append(begin + int(np.argmax(read[begin : begin + apart] @ (1.0 / (1.0 + count)))))
        count = count + read[kept_rows[-1]]
    return np.array(sorted({*kept_rows, len(read) - 1}))
