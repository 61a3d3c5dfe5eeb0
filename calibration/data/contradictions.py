"""What a table of a rig's runs cannot all be true of, each said in one sentence."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np

from calibration.data.columns import RPM, SPEED, SUPPLY
from calibration.data.errors import BadData, number
from calibration.data.table import Runs
from mmrjax.robot import Robot

#: Share of the motors' back-EMF below which no voltage turns them at an imposed speed [-], and least back-EMF that
#: tells [V].
TOO_SMALL, LEAST = 0.5, 0.2
#: Channel of a column whose instrument may show magnitude alone.
MAGNITUDES = {"motor_voltage_V": "motor_voltage"}
#: Jump of an angle between samples that is a turn lost [deg], and least multiple of the step that is usual.
TURN, UNUSUAL = 180.0, 4.0


def check(runs: Runs, robot: Robot) -> None:
    """Refuse a table that contradicts itself or its robot.

    Raises:
        BadData: a vehicle without mass, an imposed speed that the stated voltage cannot turn the motors at, or an
            angle that wraps.
    """
    _mass(runs, robot)
    if robot.rig.imposed == "motor_speed" and not runs.sampled:
        for column in (SUPPLY, "motor_voltage_V"):
            _voltage(runs, robot, column)
    if runs.sampled and runs.has("output_angle_deg"):
        _angle(runs)


def _mass(runs: Runs, robot: Robot) -> None:
    if not robot.has_ground or runs.has("total_mass_kg"):
        return
    for name in np.unique(runs.configurations_named(robot)):
        if name in robot.configurations and float(robot.configurations[str(name)].mass) <= 0:
            raise BadData(
                f"{runs.source}: no column total_mass_kg, and the robot's file states no mass of {name}; a vehicle "
                "needs one of them"
            )


def _voltage(runs: Runs, robot: Robot, column: str) -> None:
    """The motors' back-EMF follows from the imposed speed; a supply may be turned round by its bridge."""
    if not runs.has(column) or not np.nan_to_num(runs[column]).any():
        return
    voltage = runs[column]
    back = np.asarray(robot.motor.voltage_back(jnp.asarray(runs[SPEED] * RPM)))
    along = np.abs(voltage) if runs.layout.magnitude(MAGNITUDES.get(column, "")) else voltage * np.sign(back)
    if column == SUPPLY and (voltage > 0).all():
        along = np.abs(voltage)
    wrong = np.flatnonzero((np.abs(back) > LEAST) & (along < TOO_SMALL * np.abs(back)))
    if wrong.size:
        row = int(wrong[0])
        why = "of the other sign" if along[row] < 0 else "too small"
        raise BadData(
            f"{runs.source} row {row + 1}, {column}: got {number(voltage[row])} at an imposed {SPEED} of "
            f"{number(runs[SPEED][row])}, {why} for the motors' back-EMF of {number(float(f'{back[row]:.3g}'))} V; "
            "check both columns and motor.torque_constant in the robot's file"
        )


def _angle(runs: Runs) -> None:
    angle, time = runs["output_angle_deg"], runs["time_s"]
    run = runs["run_id"] if runs.has("run_id") else np.zeros(len(runs), str)
    for name in np.unique(run):
        mine = np.flatnonzero(run == name)
        mine = mine[np.argsort(time[mine], kind="stable")]
        mine = mine[np.isfinite(angle[mine])]
        step = np.diff(angle[mine])
        if step.size < 2:
            continue
        usual = float(np.median(np.abs(step)))
        jumps = np.flatnonzero(
            (np.abs(step) > TURN) & (np.abs(step) < 2 * TURN + UNUSUAL * usual) & (np.abs(step) > UNUSUAL * usual)
        )
        if jumps.size:
            row = int(mine[jumps[0] + 1])
            raise BadData(
                f"{runs.source} row {row + 1}, output_angle_deg: jumps by {number(float(f'{step[jumps[0]]:.4g}'))} "
                "deg from the sample before, as an angle that wraps; expected one that counts on beyond a turn"
            )
