"""Lost motion of an output: the angle lost at each reversal of a log, or twisted by acceleration."""

from __future__ import annotations

import numpy as np

from calibration.data.clock import applied_drive
from calibration.data.columns import SUPPLY
from calibration.data.runs import Runs
from calibration.inference.fit_notes import Remark
from mmrjax.model.robot import Robot

#: Samples on each side of one for its smoothed angle and speed.
AROUND = 4
#: Speed below which the direction is that of the samples before, and above which a flank is in contact, as shares of
#: the rms speed.
SLOW, IN_CONTACT = 0.1, 0.2
#: Voltages that the motor's dry friction may take, as quantiles of the applied ones.
FRICTIONS = np.linspace(0.0, 0.9, 12)
#: Least ratio of the lost motion to its sd, and least number of reversals. Least share of the variance of the changes
#: of angle that the lost motion explains in addition to drive, friction, inertia and delay.
SURE, REVERSALS, EXPLAINED = 6.0, 6, 0.3


def lost_motion_notes(runs: Runs, robot: Robot) -> list[Remark]:
    """Remark on an angle that is lost at each reversal or by acceleration, for a log of a robot without backlash.

    With an elastic joint of stiffness k, the output lags the motor by J α / k, if a log shows both.
    """
    position_channels = [
        k for k, c in enumerate(runs.channels) if c.name in ("output_angle", "position") and runs.has(c.column)
    ]
    speed_channels = [k for k, c in enumerate(runs.channels) if c.name == "motor_speed" and runs.has(c.column)]
    if not runs.sampled or not position_channels or robot.has_ground or robot.loose:
        return []
    if not speed_channels and runs.layout.imposed_column != SUPPLY:
        return []
    channel = runs.channels[position_channels[0]]
    measured_values = runs.measured()
    drive = measured_values[:, speed_channels[0]] if speed_channels else applied_drive(runs)
    changes = [
        _changes_between_contacts(runs["time_s"][rows], measured_values[rows, position_channels[0]], drive[rows])
        for rows in map(runs.in_order, np.unique(runs.run_names))
    ]
    (
        motion,
        drive_integrals,
        clipped_integrals,
        speed_changes,
        drive_changes,
        reversals_by_change,
        acceleration_changes,
        curvature_free_motion,
    ) = (np.concatenate(x, -1) for x in zip(*changes, strict=True))
    reversals = int(np.sum(np.abs(reversals_by_change)))
    if reversals < REVERSALS or len(motion) < 2 * REVERSALS:
        return []
    regressor_sets = (
        [[drive_integrals]]
        if speed_channels
        else [[drive_integrals, regressor, speed_changes, drive_changes] for regressor in clipped_integrals]
    )
    _, width, sd, explained = min(
        _fit_lost_angle(motion, reversals_by_change, np.stack(x, 1)) for x in regressor_sets
    )
    is_lost = width > SURE * sd and explained > EXPLAINED
    stiffness = 0.0
    load = robot.configurations.members[0]
    radius = float(load.radius) if channel.name == "position" else 1.0
    if speed_channels:
        _, lag_per_acceleration, sd, explained = _fit_lost_angle(
            curvature_free_motion,
            acceleration_changes,
            np.stack([drive_integrals, speed_changes, reversals_by_change], 1),
        )
        if lag_per_acceleration > SURE * sd and explained > EXPLAINED:
            stiffness, width = (
                float(load.inertia) * radius / lag_per_acceleration,
                lag_per_acceleration * np.sqrt(np.mean(acceleration_changes**2)),
            )
    if not (is_lost or stiffness):
        return []
    return [
        Remark(
            "lost_motion", source=runs.source, column=channel.column, reversals=reversals,
            width=width / channel.factor, unit=channel.unit, angle=width / radius, stiffness=stiffness,
        )
    ]  # fmt: skip


def _changes_between_contacts(time: np.ndarray, angle: np.ndarray, drive: np.ndarray) -> tuple[np.ndarray, ...]:
    """Changes between instants at which one tooth flank surely carries load. Each stroke has three, from its fastest
    to its end.

    Returns:
        Changes of the angle, of the time integral of the drive, and of that integral with the drive clipped at each
        of `FRICTIONS`. Then changes of speed, drive, direction (1 or -1 at a reversal) and acceleration. The last is
        the change of the angle minus the curvature of a parabola.
    """
    is_read = np.isfinite(angle) & np.isfinite(drive)
    time, angle, drive = time[is_read], angle[is_read], drive[is_read]
    count = len(time)
    if count < 4 * AROUND:
        return tuple(np.zeros((*shape, 0)) for shape in ((), (), FRICTIONS.shape, (), (), (), (), ()))
    steps = np.arange(-AROUND, AROUND + 1)
    neighbours = np.clip(np.arange(count)[:, None] + steps, 0, count - 1)
    smooth = angle[neighbours].mean(1)
    speed = angle[neighbours] @ steps / np.maximum(time[neighbours] @ steps, 1e-12)
    squared_times, centred_squares = (time[neighbours] - time[:, None]) ** 2, steps**2 - np.mean(steps**2)
    acceleration = angle[neighbours] @ centred_squares / np.maximum(squared_times @ centred_squares / 2, 1e-12)
    rms_speed = np.sqrt(np.mean(speed**2))
    direction = np.where(np.abs(speed) > SLOW * rms_speed, np.sign(speed), 0.0)
    direction = direction[np.maximum.accumulate(np.where(direction != 0, np.arange(count), 0))]
    points: list[int] = []
    for stroke in np.split(np.arange(count), np.flatnonzero(np.diff(direction)) + 1):
        fast = stroke[np.abs(speed[stroke]) > IN_CONTACT * rms_speed]
        if direction[stroke[0]] != 0 and len(stroke) > 2 * AROUND and len(fast) > 2:
            fastest = stroke[np.argmax(np.abs(speed[stroke]))]
            points += sorted({int(fastest), int(fastest + fast[-1]) // 2, int(fast[-1])})
    integral = lambda x: np.append(0.0, np.cumsum((x[1:] + x[:-1]) / 2 * np.diff(time)))  # noqa: E731
    levels = np.maximum(np.quantile(np.abs(drive), FRICTIONS), 1e-9 * np.max(np.abs(drive), initial=1e-300))
    clipped = np.array([integral(np.clip(drive / level, -1, 1)) for level in levels])
    regressors = (
        smooth,
        integral(drive),
        clipped,
        speed,
        drive,
        direction / 2,
        acceleration,
        smooth - acceleration * squared_times.mean(1) / 2,
    )
    return tuple(np.diff(x[..., points]) for x in regressors)


def _fit_lost_angle(
    moved: np.ndarray, reversed_: np.ndarray, others: np.ndarray
) -> tuple[float, float, float, float]:
    """Fits the angle that is lost at a reversal, in addition to other causes.

    Returns:
        Remaining sum of squares, the angle, its sd, and the share of the sum of squares that the angle explains.
    """
    terms = np.column_stack([others / np.maximum(np.linalg.norm(others, axis=0), 1e-300), -reversed_])
    causes = terms[:, :-1]
    fitted = np.linalg.lstsq(terms, moved)[0]
    residual, residual_without = moved - terms @ fitted, moved - causes @ np.linalg.lstsq(causes, moved)[0]
    rest_with, rest_without = float(residual @ residual), float(residual_without @ residual_without)
    variance = rest_with / max(len(moved) - terms.shape[1], 1)
    sd = np.sqrt(variance * np.linalg.pinv(terms.T @ terms)[-1, -1])
    return rest_with, float(fitted[-1]), float(sd), 1 - rest_with / max(rest_without, 1e-300)
