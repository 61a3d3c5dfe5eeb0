"""Behaviour of runs that limits their information: they end early, or the robot never grips."""

from __future__ import annotations

import numpy as np

from calibration.data import Names
from calibration.data.clock import applied_drive, rows_of_varying_runs
from calibration.data.runs import Runs
from calibration.inference import observers
from calibration.inference.fit_notes import Remark
from calibration.inference.ranges import UNDER_WAY, operating_readings
from mmrjax.model import channels
from mmrjax.model.robot import Robot

#: Share of the speed of steady travel below which a short run has ended early, and share of the movers' speed below
#: which a long run does not grip [-].
SLOW, SLIDING = 0.7, 0.7


#: Change of the drive that is a step, as a share of its largest value; share of a squared error from which it lies
#: after the steps, and largest share of the rows that these are [-].
STEP, MOST_ERROR, FEW_ROWS = 0.1, 0.5, 0.1


def rows_after_steps(runs: Runs) -> np.ndarray:
    """Rows with a step of the command, and the rows after them, shape (2, rows)."""
    driven = applied_drive(runs)
    largest = max(float(np.abs(driven).max(initial=0.0)), 1e-300)
    with_step, after = both = np.zeros((2, len(runs)), bool)
    for rows in runs.rows_by_run().values():
        stepped = np.flatnonzero(np.abs(np.diff(driven[rows])) > STEP * largest) + 1
        with_step[rows[stepped]] = True
        after[rows[np.minimum(stepped + 1, len(rows) - 1)]] = True
    return both


def error_after_steps(runs: Runs, off: np.ndarray) -> list[Remark]:
    """Remarks on channels whose error is concentrated in the first sample at or after each step of the command.

    Args:
        off: simulated minus measured reading [SI], NaN where one is missing, shape (rows, channels).
    """
    if not observers.observer_kind(runs).axis:
        return []
    notes, both = [], rows_after_steps(runs)
    for k, channel in enumerate(runs.channels):
        squares = np.nan_to_num(off[:, k]) ** 2
        largest_sum, count = max((float(squares[rows].sum()), int(rows.sum())) for rows in both)
        if 0 < count <= FEW_ROWS * len(runs) and largest_sum >= MOST_ERROR * squares.sum() > 0:
            notes.append(
                Remark(
                    "after_steps",
                    channel=channel.name,
                    share=largest_sum / squares.sum(),
                    rows=count,
                    total=len(runs),
                )
            )
    if notes:
        return notes
    # An error that is mostly a shift in time is proportional to the simulated rate of change.
    time, rows_of_runs = runs["time_s"], list(runs.rows_by_run().values())
    for k, channel in enumerate(runs.channels):
        simulated, rate = runs.measured()[:, k] + off[:, k], np.zeros(len(runs))
        for rows in (r for r in rows_of_runs if len(r) > 1 and np.ptp(time[r]) > 0):
            rate[rows] = np.nan_to_num(np.gradient(simulated[rows], time[rows]))
        error = np.nan_to_num(off[:, k])
        late, size = error @ rate, rate @ rate
        if late**2 >= MOST_ERROR * size * (error @ error) > 0:
            shift, share = float(late / size), float(late**2 / size / (error @ error))
            notes.append(Remark("shifted", channel=channel.name, share=share, shift=shift))
    return notes


def conduct_notes(runs: Runs, robot: Robot) -> list[Remark]:
    """Remarks on runs that end before steady travel, and on runs in which the robot never grips."""
    runs = runs.of(robot)
    kind = observers.observer_kind(runs)
    ends, readings, lasts = kind.settled(runs)
    if not kind.axis or not len(ends) or not robot.has_ground or "speed" not in robot.rig.channels:
        return []
    speed = readings[:, channels.channel_index("speed", robot.channels)]
    names = ends["run_id"] if ends.has("run_id") else np.array(["(no run_id)"] * len(ends))
    conditions = ends.conditions(robot)
    if "motor_speed" in robot.rig.channels:
        turning = readings[:, channels.channel_index("motor_speed", robot.channels)]
    else:
        imposed = conditions.motor_speed
        turning = np.full(len(ends), np.nan) if imposed is None else np.asarray(imposed)
    steady = operating_readings(robot, conditions)[:, channels.channel_index("speed", robot.channels)]
    radius = np.asarray([float(c.radius) for c in robot.configurations.members])[np.asarray(conditions.configuration)]
    movers = radius * turning / float(robot.gearbox.ratio)
    measured = np.isfinite(speed)
    slow = measured & np.isfinite(steady) & (speed < SLOW * steady)
    early = (lasts < UNDER_WAY) & (slow | ~measured)
    is_sliding = (lasts >= UNDER_WAY) & measured & np.isfinite(movers) & (movers > 0) & (speed < SLIDING * movers)
    # Settled ends of runs that vary are only parts of them.
    is_sliding &= ~np.isin(names, runs.run_names[rows_of_varying_runs(runs)])
    remarks: list[Remark] = []
    if early.any():
        shares = speed[slow & early] / steady[slow & early]
        share = float(np.nanmedian(shares)) if len(shares) else float("nan")
        remarks.append(
            Remark("ends_early", runs=_run_names(names, early), lasts=float(lasts[early].max()), share=share)
        )
    if is_sliding.any():
        share = max(float(np.median(speed[is_sliding] / movers[is_sliding])), 0.0)
        remarks.append(Remark("never_grips", runs=_run_names(names, is_sliding), share=share))
    if is_sliding.any() and (is_sliding | early).all():
        remarks.append(Remark("no_grip"))
    return remarks


def _run_names(names: np.ndarray, which: np.ndarray) -> Names:
    return tuple(str(n) for n in names[which])
