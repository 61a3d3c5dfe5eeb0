"""Checks of data before a fit: each failure is reported in one sentence, and remarks describe data that can be
fitted.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import numpy as np
from scipy.optimize import nnls

from calibration.data import Names
from calibration.data.clock import applied_drive
from calibration.data.columns import LOAD, SPEED, SUPPLY
from calibration.data.input_errors import BadConfiguration, BadData
from calibration.data.runs import Runs
from calibration.data.unused_readings import line_through
from calibration.inference import observers
from calibration.inference.conduct import conduct_notes
from calibration.inference.fit_notes import Remark
from calibration.inference.lost_motion import lost_motion_notes
from calibration.inference.noise import Noise
from calibration.inference.ranges import check_ranges, operating_readings
from calibration.inference.residual_clusters import TIMES
from mmrjax.errors import count_noun
from mmrjax.model import channels
from mmrjax.model.robot import Robot
from mmrjax.model.signals import SLIDES, STATUSES

# --- columns that vary and are not used -----------------------------------------------------------


#: Share of a torque's variation unexplained by any load of a shaft above which a brake may impose it; least variation
#: of the torque as a share of its size.
BRAKED, VARIES = 0.5, 0.2
#: Channel of the torque at the output.
TORQUE = channels.find_channel("output_torque")


def unused_notes(runs: Runs) -> tuple[Remark, ...]:
    """Remark that lists the numeric columns that vary and are not used, other than row numbers and times. Empty if
    there are none."""
    columns = tuple((name, runs.layout.nearest(name, runs.columns)) for name in unused_columns(runs))
    return (Remark("unused", source=runs.source, columns=columns),) if columns else ()


def unused_columns(runs: Runs) -> Names:
    """Names of numeric columns that vary and have no role. Row numbers and times are left out."""
    unused = []
    for name, cells in runs.extras.items():
        if cells.dtype.kind == "f" and not TIMES.search(name):
            levels = np.unique(cells[np.isfinite(cells)])
            is_row_number = len(levels) == len(cells) and bool((np.diff(levels) == 1).all())
            unused += [name] if len(levels) > 1 and not is_row_number else []
    return tuple(unused)


def unexplained_torque_notes(runs: Runs) -> tuple[Remark, ...]:
    """Remark on a measured output torque that varies in a way that no load on a shaft can explain.

    A load takes M_0 sign ω + K ω + M_c with M_0, K ≥ 0. If the best such load of each configuration leaves more than
    `BRAKED` of the variance of the readings, a brake imposes the torque.
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
    torque = runs[column]
    way = np.sign(applied_drive(runs))
    is_read = np.isfinite(torque) & np.isfinite(speed)
    for name in np.unique(runs["configuration"]):
        in_configuration = is_read & (runs["configuration"] == name)
        if in_configuration.sum() >= 4:
            torques, speeds, directions = (
                torque[in_configuration],
                np.abs(speed[in_configuration]),
                way[in_configuration],
            )  # a meter may show only magnitudes
            unexplained += min(
                _unexplained_torque(torques, speeds, directions),
                _unexplained_torque(np.abs(torques), speeds, np.abs(directions)),
            )
            total += float(np.sum((torques - torques.mean()) ** 2))
    if unexplained <= BRAKED * total or total < VARIES**2 * float(np.sum(torque[is_read] ** 2)):
        return ()
    return (
        Remark(
            "no_load_gives",
            source=runs.source,
            column=column,
            theirs=runs.heading(column),
            share=unexplained / total,
        ),
    )


def _unexplained_torque(torque: np.ndarray, speed: np.ndarray, way: np.ndarray) -> float:
    """Sum of squared residuals of a torque after fitting a load M_0 sign ω + K ω + M_c with M_0, K ≥ 0.

    `speed`: magnitudes of ω. `way`: its signs."""
    w = speed / max(float(speed.max()), 1e-12)
    ones = np.ones(len(speed))
    return float(nnls(np.stack([way, way * w, ones, -ones], 1), torque)[1] ** 2)


# --- uninformative tables -----------------------------------------------------------------------


#: Range of readings that differ only by noise, in its sds: on average 5 for a hundred rows.
RANGE = 8.0


def nothing_varies(runs: Runs, robot: Robot, noise: Noise) -> Remark | None:
    """Remark on a table whose readings and predictions are the same in all rows, to within the noise.

    None if a channel differs by more, or if the robot of the file does not reach some row.
    """
    if len(runs) < 2 or any(float(c.torque_gravity) > 0 for c in robot.configurations.members):
        return None
    predicted = operating_readings(robot, runs.conditions(robot))
    is_read = np.isfinite(predicted) & np.isfinite(runs.measured()) & np.isfinite(noise.sd)
    if not is_read.all():
        return None
    sd = np.median(noise.sd, 0)
    if (np.ptp(predicted, 0) >= sd).any() or (np.ptp(runs.measured(), 0) >= RANGE * sd).any():
        return None
    return Remark(
        "nothing_varies",
        source=runs.source,
        rows=len(runs),
        column=runs.layout.imposed_column,
        unused=unused_columns(runs),
    )


def copied_channels(runs: Runs, robot: Robot) -> list[Remark]:
    """Remarks on channels that are a linear function of another channel in all rows, to the digits of the file."""
    remarks = list[Remark]()
    copied_names = set[str]()
    for one, other in itertools.combinations(runs.present_channels, 2):
        if {one.name, other.name} & copied_names:
            continue
        x, y = np.asarray(runs[one.column], float), np.asarray(runs[other.column], float)
        if (line := line_through(x, y)) is not None:
            copied_names.add(other.name)
            same_unit = one.unit_si == other.unit_si
            remarks.append(
                Remark(
                    "copied",
                    source=runs.source,
                    column=other.column,
                    other=one.column,
                    intercept=line[0],
                    slope=line[1],
                    tied=same_unit or (not robot.has_ground and one.zero_at_rest and other.zero_at_rest),
                )
            )
    return remarks


# --- checks -------------------------------------------------------------------------------------


def check_data(runs: Runs, robot: Robot, names: Sequence[str], noise: Noise) -> list[Remark | str]:
    """Rejects data that cannot be fitted. Returns remarks on data that can.

    Raises:
        BadData: too few readings, a stuck channel, contradictory replicates, samples of one run under different
            conditions, a configuration that `robot` does not have, or readings in other units.
        BadConfiguration: a free parameter belongs to a configuration without rows.
    """
    present = {robot.configurations.names[k] for k in np.unique(runs.configurations(robot))}
    for name in names:
        configuration = name.split(".")[0]
        if configuration in robot.configurations and configuration not in present:
            raise BadConfiguration(
                f"--free {name}: {runs.source} has no {configuration} rows, so nothing measures it; "
                f"add {configuration} runs or leave it fixed"
            )
    _check_enough_readings(runs, names, noise)
    _check_motion(runs, noise)
    remarks = [
        *_check_stuck_channels(runs),
        *observers.observer_kind(runs).check(runs, noise),
        *_constant_conditions(runs),
    ]
    remarks += [*unused_notes(runs), *unexplained_torque_notes(runs)]
    remarks += check_ranges(runs, robot)
    if not (runs.sampled or runs.turns):
        constant_conditions = nothing_varies(runs, robot, noise)
        remarks += [constant_conditions] if constant_conditions is not None else copied_channels(runs, robot)
    return [*remarks, *conduct_notes(runs, robot), *lost_motion_notes(runs, robot)]


#: Scatter of a speed over the scatter of its changes from row to row, up to which the speed is only noise.
WHITE = 1.5


def _check_motion(runs: Runs, noise: Noise) -> None:
    """Rejects a log whose speeds are only noise, except for a driven, locked shaft with stated noise."""
    speeds = [(k, c) for k, c in enumerate(runs.channels) if c.zero_at_rest and runs.has(c.column)]
    if not runs.sampled or runs.turns or not speeds:
        return
    driven = bool(applied_drive(runs).any())
    for k, channel in speeds:
        readings = runs[channel.column][np.isfinite(runs[channel.column])]
        scatter = float(np.std(np.diff(readings))) / 2**0.5 if len(readings) > 2 else 0.0
        if np.std(readings) > WHITE * scatter or abs(np.mean(readings)) > WHITE * scatter:
            return
        if driven and scatter <= WHITE * float(np.nanmax(noise.sd[:, k])) / channel.factor:
            return
    imposed, (_, channel) = runs.layout.imposed_column, speeds[0]
    size = f"{float(f'{scatter:.2g}'):g}"
    name = channel.name
    unit = channel.unit
    if driven:
        raise BadData(
            f"{runs.source} rows 1 to {len(runs)}, {channel.column}: readings are noise about zero ({size} "
            f"{unit}), so nothing moves; log motion, or for a locked shaft set --noise {name}={size}{unit}"
        )
    raise BadData(
        f"{runs.source} rows 1 to {len(runs)}, {imposed}: nothing drives the motors and nothing moves; log "
        "driven motion, or name the column that drives them under [columns]"
    )


def _check_enough_readings(runs: Runs, names: Sequence[str], noise: Noise) -> None:
    estimated_count = int(noise.estimated.sum())
    readings = int(np.isfinite(runs.measured()).sum())
    channels_with_readings = sum(word != "no readings" for word in noise.source)
    needed = max(2, -(-(len(names) + estimated_count) // max(channels_with_readings, 1)) + (estimated_count > 0))
    if readings >= needed * channels_with_readings:
        return
    also = f" and estimate {estimated_count} noise levels" if estimated_count else ""
    cure = "fix some with --fix, or set --noise" if estimated_count else "fix some with --fix"
    is_complete = readings == len(runs) * channels_with_readings
    rows = count_noun(len(runs), "row")
    present_words = (
        f"{rows} of {channels_with_readings} channels"
        if is_complete
        else f"{count_noun(readings, 'reading')} in {rows}"
    )
    needed_words = f"{needed} rows" if is_complete else f"{needed * channels_with_readings} readings"
    problem_words = f"cannot fit {count_noun(len(names), 'parameter')}{also}" if names else "cannot be fitted"
    raise BadData(
        f"{runs.source}: {present_words} {problem_words}; at least {needed_words} are needed"
        f"{f', or {cure}' if names else ''}"
    )


def _check_stuck_channels(runs: Runs) -> list[Remark]:
    """Rejects a channel that has the same value under different conditions. Returns a remark if this is the motor
    voltage.
    """
    labels = () if runs.layout.complete else ("configuration", "surface")
    columns = [c for c in (*observers.observer_kind(runs).axes_of(runs), *labels) if runs.has(c)]
    condition_levels = [np.unique(runs[c], return_inverse=True)[1] for c in columns]
    remarks: list[Remark] = []
    if len(np.unique(np.stack(condition_levels, 1), axis=0)) < 2:
        return remarks
    for channel in runs.channels:
        readings = (
            runs[channel.column][np.isfinite(runs[channel.column])] if runs.has(channel.column) else np.zeros(0)
        )
        if len(readings) > 2 and np.ptp(readings) == 0:
            if channel.name == "motor_voltage":
                remarks.append(Remark("stiff_supply", column=channel.column, value=float(readings[0])))
                continue
            raise BadData(
                f"{runs.source}, {channel.column}: {readings[0]:g} in every row although conditions vary; "
                f"{'nothing moved, ' * channel.zero_at_rest}the instrument was stuck or the column is a copy"
            )
    return remarks


def _constant_conditions(runs: Runs) -> list[Remark]:
    imposed = runs.layout.imposed_column
    indistinguishable_losses = {
        "slope_deg": "guides" if runs.layout.complete else "slope",
        imposed: "voltage" if imposed == SUPPLY else "speed",  # and levels of current identify friction by speed
    }
    return [
        Remark("constant", column=column, value=runs[column][0], alike=losses)
        for column, losses in indistinguishable_losses.items()
        if column in runs.axes
        and np.ptp(runs[column]) == 0
        and (column != SUPPLY or np.ptp(applied_drive(runs)) == 0)
    ]


def infeasible_error(
    runs: Runs, robot: Robot, status: np.ndarray, is_unreached: np.ndarray, names: Sequence[str]
) -> BadConfiguration:
    """Error message for rows that the model cannot reproduce even at the best point of all searches.

    Args:
        robot: robot at the best point.
        status: status of each row, shape (rows,).
        is_unreached: True for rows that are not reached, shape (rows,).
        names: names of the free parameters.
    """

    def listed(mask: np.ndarray) -> str:
        return ", ".join(str(k + 1) for k in np.flatnonzero(mask))

    is_sliding = is_unreached & (status == SLIDES)
    if not is_sliding.any():
        words = ", ".join(STATUSES[k] for k in np.unique(status[is_unreached]))
        return BadConfiguration(
            f"no start is feasible: the model has no result in {runs.source} rows {listed(is_unreached)} ({words} at "
            "best); check their conditions, or widen the priors"
        )
    sliding_configurations = sorted(set(runs.configurations_named(robot)[is_sliding]), key=robot.configurations.index)
    parameter = {c: f"{c}.ground.friction.static" for c in sliding_configurations}
    frictions = ", ".join(
        f"{float(robot.configurations[c].ground.friction.static):.3g}" for c in sliding_configurations
    )
    cure = "free it, or raise it in --robot" if set(parameter.values()) - set(names) else "widen its prior"
    return BadConfiguration(
        f"no start is feasible: {runs.source} rows {listed(is_sliding)} were steady, but the model slides there "
        f"({' and '.join(parameter.values())} = {frictions} cannot carry the demand); {cure}"
    )
