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

#: Share of the speed of steady travel below which a short run has ended early [-]. Share of the wheels' or tracks'
#: speed below which a long run does not grip [-].
SLOW, SLIDING = 0.7, 0.7


#: Change of the drive that is a step, as a share of its largest value. Share of the squared error after steps from
#: which a remark reports it, and largest share of rows after steps [-].
STEP, MOST_ERROR, FEW_ROWS = 0.1, 0.5, 0.1


def rows_after_steps(runs: Runs) -> np.ndarray:
    """Rows with a step of the command, and the rows after them, shape (2, rows)."""
    drive = applied_drive(runs)
    largest = max(float(np.abs(drive).max(initial=0.0)), 1e-300)
    is_step, is_after_step = masks = np.zeros((2, len(runs)), bool)
    for rows in runs.rows_by_run().values():
        step_rows = np.flatnonzero(np.abs(np.diff(drive[rows])) > STEP * largest) + 1
        is_step[rows[step_rows]] = True
        is_after_step[rows[np.minimum(step_rows + 1, len(rows) - 1)]] = True
    return masks


def error_after_steps(runs: Runs, errors: np.ndarray) -> list[Remark]:
    """Remarks on channels whose error is concentrated in the first sample at or after each step of the command.

    Args:
        errors: simulated minus measured reading [SI], NaN where one is missing, shape (rows, channels).
    """
    if not observers.observer_kind(runs).axis:
        return []
    remarks = []
    masks = rows_after_steps(runs)
    for k, channel in enumerate(runs.channels):
        squares = np.nan_to_num(errors[:, k]) ** 2
        largest_sum, count = max((float(squares[rows].sum()), int(rows.sum())) for rows in masks)
        if 0 < count <= FEW_ROWS * len(runs) and largest_sum >= MOST_ERROR * squares.sum() > 0:
            remarks.append(
                Remark(
                    "after_steps",
                    channel=channel.name,
                    share=largest_sum / squares.sum(),
                    rows=count,
                    total=len(runs),
                )
            )
    if remarks:
        return remarks
    # An error that is mostly a shift in time is proportional to the simulated rate of change.
    time = runs["time_s"]
    rows_of_runs = list(runs.rows_by_run().values())
    for k, channel in enumerate(runs.channels):
        simulated = runs.measured()[:, k] + errors[:, k]
        rate = np.zeros(len(runs))
        for rows in (r for r in rows_of_runs if len(r) > 1 and np.ptp(time[r]) > 0):
            rate[rows] = np.nan_to_num(np.gradient(simulated[rows], time[rows]))
        channel_errors = np.nan_to_num(errors[:, k])
        projection, rate_power = channel_errors @ rate, rate @ rate
        if projection**2 >= MOST_ERROR * rate_power * (channel_errors @ channel_errors) > 0:
            shift, share = (
                float(projection / rate_power),
                float(projection**2 / rate_power / (channel_errors @ channel_errors)),
            )
            remarks.append(Remark("shifted", channel=channel.name, share=share, shift=shift))
    return remarks


def conduct_notes(runs: Runs, robot: Robot) -> list[Remark]:
    """Remarks on runs that end before steady travel, and on runs in which the robot never grips."""
    runs = runs.of(robot)
    observer = observers.observer_kind(runs)
    ends, readings, durations = observer.settled(runs)
    if not observer.axis or not len(ends) or not robot.has_ground or "speed" not in robot.rig.channels:
        return []
    travel_speed = readings[:, channels.channel_index("speed", robot.channels)]
    run_names = ends["run_id"] if ends.has("run_id") else np.array(["(no run_id)"] * len(ends))
    conditions = ends.conditions(robot)
    if "motor_speed" in robot.rig.channels:
        motor_speed = readings[:, channels.channel_index("motor_speed", robot.channels)]
    else:
        imposed = conditions.motor_speed
        motor_speed = np.full(len(ends), np.nan) if imposed is None else np.asarray(imposed)
    steady_speed = operating_readings(robot, conditions)[:, channels.channel_index("speed", robot.channels)]
    radius = np.asarray([float(c.radius) for c in robot.configurations.members])[np.asarray(conditions.configuration)]
    mover_speed = radius * motor_speed / float(robot.gearbox.ratio)
    is_measured = np.isfinite(travel_speed)
    is_slow = is_measured & np.isfinite(steady_speed) & (travel_speed < SLOW * steady_speed)
    ends_early = (durations < UNDER_WAY) & (is_slow | ~is_measured)
    is_sliding = (
        (durations >= UNDER_WAY)
        & is_measured
        & np.isfinite(mover_speed)
        & (mover_speed > 0)
        & (travel_speed < SLIDING * mover_speed)
    )
    # Settled ends of runs that vary are only parts of them.
    is_sliding &= ~np.isin(run_names, runs.run_names[rows_of_varying_runs(runs)])
    remarks: list[Remark] = []
    if ends_early.any():
        shares = travel_speed[is_slow & ends_early] / steady_speed[is_slow & ends_early]
        share = float(np.nanmedian(shares)) if len(shares) else float("nan")
        remarks.append(
            Remark(
                "ends_early",
                runs=_run_names(run_names, ends_early),
                lasts=float(durations[ends_early].max()),
                share=share,
            )
        )
    if is_sliding.any():
        share = max(float(np.median(travel_speed[is_sliding] / mover_speed[is_sliding])), 0.0)
        remarks.append(Remark("never_grips", runs=_run_names(run_names, is_sliding), share=share))
    if is_sliding.any() and (is_sliding | ends_early).all():
        remarks.append(Remark("no_grip"))
    return remarks


def _run_names(names: np.ndarray, mask: np.ndarray) -> Names:
    return tuple(str(n) for n in names[mask])
