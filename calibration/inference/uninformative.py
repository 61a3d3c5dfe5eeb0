"""Uninformative tables of settled runs: of one condition, or with a channel computed from another."""

from __future__ import annotations

import itertools

import numpy as np

from calibration.data.computed_columns import line_through
from calibration.data.runs import Runs
from calibration.inference.fit_notes import Remark
from calibration.inference.noise import Noise
from calibration.inference.operating import operating_readings
from calibration.inference.unused import unused_columns
from mmrjax.model.robot import Robot

#: Range of readings that differ only by noise, in its sds: on average 5 for a hundred rows.
RANGE = 8.0


def nothing_varies(runs: Runs, robot: Robot, noise: Noise) -> Remark | None:
    """Note that readings and predictions are the same in all rows within the noise.

    None if a channel differs by more, or if the file's robot does not reach a row.
    """
    if len(runs) < 2 or any(float(c.torque_gravity) > 0 for c in robot.configurations.members):
        return None
    foreseen = operating_readings(robot, runs.conditions(robot))
    is_read = np.isfinite(foreseen) & np.isfinite(runs.measured()) & np.isfinite(noise.sd)
    if not is_read.all():
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
        if (line := line_through(x, y)) is not None:
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
