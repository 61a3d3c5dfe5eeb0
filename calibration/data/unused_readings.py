"""Readings that a fit does not use: computed torques, unread speeds, repeats, rows beyond a limit or thinned out."""

from __future__ import annotations

import itertools
from dataclasses import replace

import jax.numpy as jnp
import numpy as np

from calibration.data import input_files
from calibration.data.clock import applied_drive
from calibration.data.columns import LOAD, ROWS, SUPPLY
from calibration.data.contradictions import CURRENTS
from calibration.data.inferred_facts import FEWEST, common_step
from calibration.data.input_errors import BadConfiguration, BadData, rows_text
from calibration.data.table import Runs
from mmrjax.errors import count_noun
from mmrjax.model.quantities import VOLTAGE
from mmrjax.model.robot import Robot

#: Fewest rows and distinct readings for which an exact line through all of them is no coincidence.
LINE_ROWS, LINE_LEVELS = 8, 4
#: Rounding error in a file as a share of a channel's range. Fewest display steps within the range for an exact line
#: not to be due to rounding.
ROUNDED, STEPS = 2e-6, 40.0
#: Steps of the search for a load. Largest error of the resulting current as a share of the largest reading.
SEARCH, ERROR = 8, 1e-3
#: A torque that a user may name as a reading.
TORQUE = "output_torque_Nm"


def drop_computed_torques(runs: Runs, robot: Robot) -> Runs:
    """Table without torque columns that are exact multiples of a current in all rows.

    Motor friction causes an offset between current and torque, so a measured or set torque is no exact multiple.
    If no load torque is set, the load of each row is computed from its current with the balances of the robot. The
    current is then no longer a reading.

    Raises:
        BadData: the load of a log is computed, the current is imposed, or there is no other channel.
    """
    columns, notes = dict(runs.columns), list(runs.notes)
    channels_by_column = {c.column: c.name for c in runs.present_channels}
    for torque, current in itertools.product((LOAD, TORQUE), CURRENTS):
        if torque not in columns or not runs.has(current) or (torque == TORQUE and len(channels_by_column) < 2):
            continue
        line = None if len(np.unique(runs[current])) < FEWEST else line_through(runs[current], runs[torque])
        if line is None or line[0] != 0.0:
            continue
        computed = (
            f"{runs.source}, {torque}: equals {line[1]:.4g} times {current} in every row, to the last digit, so it "
            "was computed, not measured"
        )
        if torque == TORQUE:
            columns.pop(torque)
            notes.append(f"{computed}. It is left out")
        elif runs.sampled or channels_by_column.keys() <= {current, TORQUE} or current not in channels_by_column:
            raise BadData(f"{computed}; remove it and keep rows without a load, or give the torque set at the brake")
        else:
            columns[torque] = _load_for_current(runs, robot, channels_by_column[current], columns.pop(current))
            notes.append(
                f"{computed}. It is left out. The load follows from {current} and the robot's file, so this "
                "current is no reading either"
            )
    return replace(runs, columns=columns, notes=tuple(notes))


def _load_for_current(runs: Runs, robot: Robot, channel: str, current: np.ndarray) -> np.ndarray:
    """Load torque in each row that makes the robot draw the measured current [N·m].

    Raises:
        BadData: no load gives this current in a row.
    """
    from mmrjax.fidelities.simulation import simulate

    conditions = runs.conditions(robot)
    load = np.zeros(len(runs))
    motors = float(robot.sides) if channel == "total_current" else 1.0
    rise = float(robot.gearbox.ratio * robot.gearbox.efficiency_load * robot.motor.torque_constant) / motors
    for _ in range(SEARCH):
        drawn = np.asarray(simulate(robot, replace(conditions, load_torque=jnp.asarray(load))).reading[channel])
        current_error = np.where(np.isfinite(current), current - drawn, 0.0)
        load = load + rise * np.nan_to_num(current_error)
    bad_rows = np.flatnonzero(~(np.abs(current_error) <= ERROR * np.nanmax(np.abs(current))))
    if bad_rows.size:
        raise BadData(
            f"{runs.place(bad_rows[0])}, {LOAD}: it was computed from {channel}, and the file's robot draws "
            f"{current[bad_rows[0]]:.4g} A without a load torque; check the numbers in the file, or remove the row"
        )
    return load


def line_through(x: np.ndarray, y: np.ndarray) -> tuple[float, float] | None:
    """Intercept and slope of a line through all points within their rounding. None if there is no such line."""
    is_paired = np.isfinite(x) & np.isfinite(y)
    x, y = x[is_paired], y[is_paired]
    if len(x) < LINE_ROWS or min(len(np.unique(x)), len(np.unique(y))) < LINE_LEVELS:
        return None
    slope, intercept = np.polyfit(x - x.mean(), y, 1)
    intercept -= slope * x.mean()
    rounding = common_step(y) + abs(slope) * common_step(x)
    allowed = 0.75 * rounding + ROUNDED * (np.ptp(y) + np.max(np.abs(y)))
    if np.ptp(y) < STEPS * rounding or np.max(np.abs(y - intercept - slope * x)) > allowed:
        return None
    return (0.0 if abs(intercept) <= 2 * allowed else float(intercept)), float(slope)


#: A motor turns if its current is below this share of the stall current, and above the friction current by this
#: factor.
TURNS, DRIVES = 0.3, 2.0
#: Readings no longer change if they vary by at most this share while the command rises by such a factor.
ALIKE, RISE = 0.02, 1.05
#: Two such rows suffice if the supply voltage falls by at least this share, otherwise three.
FALLS = 0.05
#: Most rows that a note lists, and its words for the rest.
SHOWN = 12, " and {} more"


def without_unread(runs: Runs, robot: Robot) -> Runs:
    """Table of settled runs with invalid readings marked as missing, and a note on each kind."""
    if runs.sampled or runs.turns or runs.layout.imposed_column != SUPPLY or runs.has("held"):
        return runs
    columns, notes = dict(runs.columns), list(runs.notes)
    drive = np.abs(applied_drive(runs))
    is_limited = _beyond_limit(runs, drive)
    unread = _turning_mask(runs, robot, drive) & ~is_limited
    for channel in runs.present_channels:
        not_read = unread & (runs[channel.column] == 0) & channel.zero_at_rest
        columns[channel.column] = np.where(is_limited | not_read, np.nan, runs[channel.column])
        if not_read.any():
            rows = rows_text(np.flatnonzero(not_read).tolist(), *SHOWN)
            notes.append(
                f"{runs.source}, {channel.column}: 0 in {rows} although the current is a turning motor's. These "
                "readings count as missing"
            )
    if is_limited.any():
        rows = rows_text(np.flatnonzero(is_limited).tolist(), *SHOWN)
        notes.append(
            f"{runs.source}, {rows}: readings no longer change while the command rises: supply or driver is at a "
            "limit. These rows are set aside"
        )
    return replace(runs, columns=columns, notes=tuple(notes))


def _turning_mask(runs: Runs, robot: Robot, drive: np.ndarray) -> np.ndarray:
    """True for rows whose motor current is far below the stall current and above that of friction."""
    motor = robot.motor
    if runs.has("motor_current_A"):
        current = np.abs(runs["motor_current_A"])
    elif runs.has("total_current_A"):
        duty = np.abs(runs["duty"]) if runs.has("duty") else 1.0
        current = np.abs(runs["total_current_A"]) / (float(robot.sides) * np.maximum(duty, 1e-9))
    else:
        return np.zeros(len(runs), bool)
    with np.errstate(invalid="ignore", divide="ignore"):
        is_slow = current < TURNS * drive / float(motor.resistance)
        return is_slow & (current * float(motor.torque_constant) > DRIVES * float(motor.friction_coulomb))


def _beyond_limit(runs: Runs, drive: np.ndarray) -> np.ndarray:
    """True for rows whose readings, or whose supply current, equal those at the largest command.

    If the supply voltage falls over them, the supply is at its limit in all of them. Otherwise the smallest of these
    commands may just reach the limit.
    """
    is_limited = np.zeros(len(runs), bool)
    command, supply = (np.abs(runs["duty"]), np.abs(runs[SUPPLY])) if runs.has("duty") else (drive, drive)
    others = [runs[c] for c in (LOAD, "slope_deg", "payload_kg", "configuration") if runs.has(c)]
    if len(runs) < 4 or any(len(np.unique(x)) > 1 for x in others):
        return is_limited
    readings = [runs.measured()]
    if runs.has("total_current_A"):
        readings.insert(0, runs["total_current_A"][:, None])
    order = np.argsort(-command, kind="stable")
    for sizes in (np.abs(x)[order] for x in readings):
        is_equal = np.isnan(sizes) | (np.abs(sizes - sizes[0]) <= ALIKE * np.abs(sizes[0]))
        top = order[: int(np.argmin(is_equal.all(1)))]
        levels = np.unique(command[top])
        if len(levels) < 2 or levels[-1] < RISE * levels[0] or not np.isfinite(sizes[0]).any():
            continue
        if supply[top].min() < (1 - FALLS) * supply[top].max() and supply[top[0]] == supply[top].min():
            is_limited[top] = True
        elif len(levels) > 2 and drive[top].max() > RISE * drive[top].min():
            is_limited[top[command[top] > levels[0]]] = True
    return is_limited


#: Reading above which an angle is not at rest, as a share of its largest value. A reading is held if it stays the
#: same over these shares of the run and of the imposed range. A smaller share suffices for an instrument that repeats
#: few of its other readings, with the share of readings that differ from the one before.
MOVES, HELD, SLIGHTLY, NOISY = 0.05, 0.1, 0.02, 0.8


def drive_heading(runs: Runs) -> str:
    """Name in the file of the column that drives the motors."""
    column = "duty" if runs.has("duty") else runs.layout.imposed_column
    return runs.heading(column)


def without_held(runs: Runs) -> Runs:
    """Log without repeats of the last speed or current while the imposed quantity changes, and a note on each channel
    that has some. An angle may rest, so its repeats are only noted.
    """
    if not (runs.sampled and runs.has(runs.layout.imposed_column)):
        return runs
    columns, notes, drive = dict(runs.columns), dict[str, str](), np.nan_to_num(applied_drive(runs))
    present_channels = [c for c in runs.present_channels if c.rests_on != VOLTAGE]
    # Others are frozen from the start.
    changing = [c for c in present_channels if np.ptp(np.nan_to_num(runs[c.column])) > 0]
    for rows, channel in itertools.product(runs.rows_by_run().values(), changing):
        column, readings = channel.column, runs[channel.column][rows]
        at_rest = 0.0 if channel.settled else MOVES * np.nanmax(np.abs(readings), initial=0.0)
        begins = np.flatnonzero(np.r_[True, np.diff(readings) != 0])
        lengths = np.diff(np.r_[begins, len(rows)])
        is_long = lengths > HELD * len(rows)
        noisy = not is_long.all() and np.mean(lengths[~is_long] == 1) > NOISY
        for k in np.flatnonzero(is_long & (np.abs(readings[begins]) > at_rest)):
            stretch = rows[begins[k] : begins[k] + lengths[k]]
            if np.ptp(drive[stretch]) <= (SLIGHTLY if noisy else HELD) * np.ptp(drive):
                continue
            cure = "Empty these cells to use the other rows"
            if channel.settled:
                columns[column] = columns[column].copy()
                columns[column][stretch[1:]] = np.nan
                cure = "Such rows are left out"
            notes[column] = (
                f"{runs.place(stretch[0], stretch[-1])}, {runs.heading(column)}: the same "
                f"reading while {drive_heading(runs)} changes, like repeats. {cure}"
            )
    return runs.with_columns(columns, *notes.values())


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
    rows, free = min(len(runs), most), input_files.available_memory()
    if not runs.sampled and ROW * rows > free:
        raise BadData(
            f"{runs.source}: {count_noun(rows, 'row')} need {ROW * rows / 1e9:.3g} GB, and {free / 1e9:.3g} GB of "
            f"memory are free, enough for {free / ROW:.0f} rows; set --rows"
        )
    if len(runs) <= most:
        return runs
    apart = -(-len(runs) // most)
    read = np.isfinite(runs.measured())
    if runs.sampled:
        ordered = list(runs.rows_by_run().values())
    else:
        ordered = [np.lexsort([runs[column] for column in reversed(("configuration", *runs.axes))])]
    kept_rows = np.concatenate([rows[_evenly_spaced_rows(read[rows], apart)] for rows in ordered])
    return replace(runs.where(np.sort(kept_rows)), log=runs.whole)


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
