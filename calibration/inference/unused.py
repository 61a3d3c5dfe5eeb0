"""Columns of a table that vary from row to row but are no conditions of its fit."""

from __future__ import annotations

import numpy as np
from scipy.optimize import nnls

from calibration.data import Names
from calibration.data.columns import LOAD, SPEED
from calibration.data.courses import applied_drive
from calibration.data.runs import Runs
from calibration.inference.fit_notes import Remark
from calibration.inference.residual_clusters import TIMES
from mmrjax.model import channels

#: Share of a torque's variation unexplained by any load of a shaft above which a brake may impose it; least variation
#: of the torque as a share of its size.
BRAKED, VARIES = 0.5, 0.2
#: Channel of the torque at the output.
TORQUE = channels.find_channel("output_torque")


def unused_notes(runs: Runs) -> tuple[Remark, ...]:
    """A note on the columns of numbers that vary and have no role, without row numbers and times."""
    columns = tuple((name, runs.layout.nearest(name, runs.columns)) for name in unused_columns(runs))
    return (Remark("unused", source=runs.source, columns=columns),) if columns else ()


def unused_columns(runs: Runs) -> Names:
    """Names of the columns of numbers that vary and have no role."""
    return tuple(name for name, cells in runs.extras.items() if _varies(name, cells))


def _varies(name: str, cells: np.ndarray) -> bool:
    """True for a column of several numbers that neither counts the rows nor states when they were measured."""
    if cells.dtype.kind != "f" or TIMES.search(name):
        return False
    levels = np.unique(cells[np.isfinite(cells)])
    counts = len(levels) == len(cells) and bool((np.diff(levels) == 1).all())
    return len(levels) > 1 and not counts


def unexplained_torque_notes(runs: Runs) -> tuple[Remark, ...]:
    """A note on a measured output torque with a variation that no load on a shaft causes.

    A load takes M_0 sign ω + K ω + M_c with M_0 and K of at least 0. If the best such load in each configuration
    leaves more than `BRAKED` of the variance of the readings, a brake imposes the torque.
    """
    column = TORQUE.column
    if (
        runs.layout.has_ground
        or runs.has(LOAD)
        or runs.has("held")
        or not (runs.has(column) and TORQUE in runs.channels)
    ):
        return ()
    speed = next((runs[c] for c in (SPEED, "output_speed_rpm") if runs.has(c)), None)
    if speed is None or runs.sampled:
        return ()
    total = unexplained = 0.0
    torque, way = runs[column], np.sign(applied_drive(runs))
    read = np.isfinite(torque) & np.isfinite(speed)
    for name in np.unique(runs["configuration"]):
        of_configuration = read & (runs["configuration"] == name)
        if of_configuration.sum() >= 4:
            y, w, d = (
                torque[of_configuration],
                np.abs(speed[of_configuration]),
                way[of_configuration],
            )  # a meter may show only magnitudes
            unexplained += min(_unexplained_torque(y, w, d), _unexplained_torque(np.abs(y), w, np.abs(d)))
            total += float(np.sum((y - y.mean()) ** 2))
    if unexplained <= BRAKED * total or total < VARIES**2 * float(np.sum(torque[read] ** 2)):
        return ()
    return (
        Remark(
            "no_load_gives",
            source=runs.source,
            column=column,
            theirs=runs.headings.get(column, column),
            share=unexplained / total,
        ),
    )


def _unexplained_torque(torque: np.ndarray, speed: np.ndarray, way: np.ndarray) -> float:
    """Sum of squared residuals of a torque after the best load, for magnitudes of a speed and its directions."""
    w, ones = speed / max(float(speed.max()), 1e-12), np.ones(len(speed))
    return float(nnls(np.stack([way, way * w, ones, -ones], 1), torque)[1] ** 2)
