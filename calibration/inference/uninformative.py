"""Uninformative tables of settled runs: of one condition, or with a channel computed from another."""

from __future__ import annotations

import itertools

import numpy as np

from calibration.data.columns import LOAD
from calibration.data.contradictions import CURRENTS
from calibration.data.instruments import FEWEST, step_of
from calibration.data.runs import Runs
from calibration.inference.fit_notes import Remark
from calibration.inference.noise import Noise
from calibration.inference.operating import operating_readings
from calibration.inference.unused import unused_columns
from mmrjax.model.robot import Robot

#: Fewest rows and distinct readings for a line through all of them to be significant.
ROWS, LEVELS = 8, 4
#: Rounding error in a file as a share of a channel's range; fewest steps of a display within the range for a line
#: through all readings to be more than the display's rounding.
ROUNDED, STEPS = 2e-6, 40.0
#: Range of readings that differ only by noise, in its sds: on average 5 for a hundred rows.
RANGE = 8.0


def nothing_varies(runs: Runs, robot: Robot, noise: Noise) -> Remark | None:
    """Note that readings and predictions are the same in all rows within the noise.

    None if a channel differs by more, or if the file's robot does not reach a row.
    """
    if len(runs) < 2 or any(float(c.torque_gravity) > 0 for c in robot.configurations.members):
        return None
    foreseen = operating_readings(robot, runs.conditions(robot))
    seen = np.isfinite(foreseen) & np.isfinite(runs.measured()) & np.isfinite(noise.sd)
    if not seen.all():
        return None
    sd = np.median(noise.sd, 0)
    if (np.ptp(foreseen, 0) >= sd).any() or (np.ptp(runs.measured(), 0) >= RANGE * sd).any():
        return None
    return Remark(
        "nothing_varies",
        source=runs.source,
        rows=len(runs),
        column=runs.layout.imposed_column,
        unused=unused_columns(runs),
    )


def copied_channels(runs: Runs, robot: Robot) -> list[Remark]:
    """Channels that are a linear function of another channel in all rows, to the digits of the file."""
    copied, copies = list[Remark](), set[str]()
    names = [c for c in runs.channels if runs.has(c.column)]
    for one, other in itertools.combinations(names, 2):
        if {one.name, other.name} & copies:
            continue
        x, y = np.asarray(runs[one.column], float), np.asarray(runs[other.column], float)
        both = np.isfinite(x) & np.isfinite(y)
        if (line := _line(x[both], y[both])) is not None:
            copies.add(other.name)
            same = one.unit_si == other.unit_si
            copied.append(
                Remark(
                    "copied",
                    source=runs.source,
                    column=other.column,
                    other=one.column,
                    intercept=line[0],
                    slope=line[1],
                    tied=same or (not robot.has_ground and one.zero_at_rest and other.zero_at_rest),
                )
            )
    return copied


def computed_load(runs: Runs) -> Remark | None:
    """Note that a load torque is a multiple of a current in all rows, to the digits of the file.

    A motor's friction would leave an offset between the two, so a torque that was set or read is no multiple.
    """
    for column in CURRENTS if runs.has(LOAD) else ():
        if not runs.has(column) or len(np.unique(runs[column])) < FEWEST:
            continue
        both = np.isfinite(runs[column])
        line = _line(runs[column][both], runs[LOAD][both])
        if line is not None and line[0] == 0.0:
            return Remark(
                "copied", source=runs.source, column=LOAD, other=column, intercept=line[0], slope=line[1], tied=False
            )
    return None


def _line(x: np.ndarray, y: np.ndarray) -> tuple[float, float] | None:
    """Intercept and slope of a line through all points, within their digits; None without such a line."""
    if len(x) < ROWS or min(len(np.unique(x)), len(np.unique(y))) < LEVELS:
        return None
    slope, intercept = np.polyfit(x - x.mean(), y, 1)
    intercept -= slope * x.mean()
    rounding = step_of(y) + abs(slope) * step_of(x)
    allowed = 0.75 * rounding + ROUNDED * (np.ptp(y) + np.max(np.abs(y)))
    if np.ptp(y) < STEPS * rounding or np.max(np.abs(y - intercept - slope * x)) > allowed:
        return None
    return (0.0 if abs(intercept) <= 2 * allowed else float(intercept)), float(slope)
