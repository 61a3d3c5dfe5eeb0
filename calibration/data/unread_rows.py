"""Settled rows with invalid readings: speeds that were not read, and rows beyond a limit of supply or driver."""

from __future__ import annotations

import dataclasses

import numpy as np

from calibration.data.columns import LOAD, SUPPLY
from calibration.data.input_errors import rows_text
from calibration.data.table import Runs
from mmrjax.model.robot import Robot

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
    drive = runs[SUPPLY] * (runs["duty"] if runs.has("duty") else 1.0)
    is_limited = _beyond_limit(runs, np.abs(drive))
    unread = _turning_mask(runs, robot, drive) & ~is_limited
    for channel in (c for c in runs.channels if runs.has(c.column)):
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
    return dataclasses.replace(runs, columns=columns, notes=tuple(notes))


def _turning_mask(runs: Runs, robot: Robot, drive: np.ndarray) -> np.ndarray:
    """True for rows whose motor current is far below the stall current and above that of friction."""
    motor = robot.motor
    resistance, constant = float(motor.resistance), float(motor.torque_constant)
    share = np.abs(runs["duty"]) if runs.has("duty") else np.ones(len(runs))
    if runs.has("motor_current_A"):
        current = np.abs(runs["motor_current_A"])
    elif runs.has("total_current_A"):
        current = np.abs(runs["total_current_A"]) / (float(robot.sides) * np.maximum(share, 1e-9))
    else:
        return np.zeros(len(runs), bool)
    with np.errstate(invalid="ignore", divide="ignore"):
        slow = current < TURNS * np.abs(drive) / resistance
        return slow & (current * constant > DRIVES * float(motor.friction_coulomb))


def _beyond_limit(runs: Runs, drive: np.ndarray) -> np.ndarray:
    """True for rows whose readings, or whose supply current, equal those at the largest command.

    If the supply voltage falls over them, the supply is at its limit in all of them. Otherwise the smallest of these
    commands may just reach the limit.
    """
    is_limited = np.zeros(len(runs), bool)
    command, supply = (np.abs(runs["duty"]), np.abs(runs[SUPPLY])) if runs.has("duty") else (drive, drive)
    supply_current = [runs["total_current_A"][:, None]] if runs.has("total_current_A") else []
    other_conditions = [runs[c] for c in (LOAD, "slope_deg", "payload_kg", "configuration") if runs.has(c)]
    if len(runs) < 4 or any(len(np.unique(x)) > 1 for x in other_conditions):
        return is_limited
    order = np.argsort(-command, kind="stable")
    for magnitudes in (np.abs(x)[order] for x in (*supply_current, runs.measured())):
        is_equal = np.all(
            np.isnan(magnitudes) | (np.abs(magnitudes - magnitudes[0]) <= ALIKE * np.abs(magnitudes[0])), axis=1
        )
        top = order[: int(np.argmin(is_equal))]
        levels = np.unique(command[top])
        if len(levels) < 2 or levels[-1] < RISE * levels[0] or not np.isfinite(magnitudes[0]).any():
            continue
        if supply[top].min() < (1 - FALLS) * supply[top].max() and supply[top[0]] == supply[top].min():
            is_limited[top] = True
        elif len(levels) > 2 and drive[top].max() > RISE * drive[top].min():
            is_limited[top[command[top] > levels[0]]] = True
    return is_limited
