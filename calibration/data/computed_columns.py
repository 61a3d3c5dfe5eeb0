"""Removal of torque columns that were computed from a current instead of measured."""

from __future__ import annotations

import dataclasses

import jax.numpy as jnp
import numpy as np

from calibration.data.columns import LOAD
from calibration.data.contradictions import CURRENTS
from calibration.data.input_errors import BadData
from calibration.data.instruments import FEWEST, common_step
from calibration.data.table import Runs
from mmrjax.model.robot import Robot

#: Fewest rows and distinct readings for which an exact line through all of them is no coincidence.
ROWS, LEVELS = 8, 4
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
    shown_columns = {c.column: c.name for c in runs.channels if runs.has(c.column)}
    for torque, current in ((t, c) for t in (LOAD, TORQUE) for c in CURRENTS if runs.has(t) and runs.has(c)):
        if torque not in columns or (torque == TORQUE and len(shown_columns) < 2):
            continue
        line = None if len(np.unique(runs[current])) < FEWEST else line_through(runs[current], runs[torque])
        if line is None or line[0] != 0.0:
            continue
        computed = (
            f"{runs.source}, {torque}: equals {line[1]:.4g} times {current} in every row, to the last "
            "digit, so it was "
        )
        computed += "computed, not measured, and does not show torque constant, friction or efficiency"
        if torque == TORQUE:
            columns.pop(torque)
            notes.append(f"{computed}. It is left out")
        elif runs.sampled or set(shown_columns) <= {current, TORQUE} or current not in shown_columns:
            raise BadData(f"{computed}; remove it and keep rows without a load, or give the torque set at the brake")
        else:
            columns[torque] = _load_for_current(runs, robot, shown_columns[current], runs[current])
            columns.pop(current)
            notes.append(
                f"{computed}. It is left out. The load follows from {current} and the robot's file, so this "
                "current is no reading either. Only voltages and speeds are used"
            )
    return dataclasses.replace(runs, columns=columns, notes=tuple(notes))


def _load_for_current(runs: Runs, robot: Robot, channel: str, current: np.ndarray) -> np.ndarray:
    """Load torque in each row that makes the robot draw the measured current [N·m].

    Raises:
        BadData: no load gives this current in a row.
    """
    from mmrjax.fidelities.simulation import simulate

    conditions, load = runs.conditions(robot), np.zeros(len(runs))
    many = float(robot.sides) if channel == "total_current" else 1.0
    rise = float(robot.gearbox.ratio * robot.gearbox.efficiency_load * robot.motor.torque_constant) / many
    for _ in range(SEARCH):
        drawn = np.asarray(
            simulate(robot, dataclasses.replace(conditions, load_torque=jnp.asarray(load))).reading[channel]
        )
        current_error = np.where(np.isfinite(current), current - drawn, 0.0)
        load = load + rise * np.nan_to_num(current_error)
    bad = np.flatnonzero(~(np.abs(current_error) <= ERROR * np.nanmax(np.abs(current))))
    if bad.size:
        raise BadData(
            f"{runs.source} row {bad[0] + 1}, {LOAD}: it was computed from {channel}, and the file's robot draws "
            f"{current[bad[0]]:.4g} A without a load torque; check the numbers in the file, or remove the row"
        )
    return load


def line_through(x: np.ndarray, y: np.ndarray) -> tuple[float, float] | None:
    """Intercept and slope of a line through all points within their rounding. None if there is no such line."""
    is_paired = np.isfinite(x) & np.isfinite(y)
    x, y = x[is_paired], y[is_paired]
    if len(x) < ROWS or min(len(np.unique(x)), len(np.unique(y))) < LEVELS:
        return None
    slope, intercept = np.polyfit(x - x.mean(), y, 1)
    intercept -= slope * x.mean()
    rounding = common_step(y) + abs(slope) * common_step(x)
    allowed = 0.75 * rounding + ROUNDED * (np.ptp(y) + np.max(np.abs(y)))
    if np.ptp(y) < STEPS * rounding or np.max(np.abs(y - intercept - slope * x)) > allowed:
        return None
    return (0.0 if abs(intercept) <= 2 * allowed else float(intercept)), float(slope)
