"""Sentences on a turn, for the terminal and its page."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np

from calibration.data import Json
from mmrjax.derived.turning_figures import NONE
from mmrjax.fidelities.simulation import STRAIGHT
from mmrjax.model.channels import SIDES
from mmrjax.model.quantities import MM
from mmrjax.model.robot import Robot
from mmrjax.model.signals import NOT_SETTLED, STATUSES, Result
from mmrjax.turning.two_sides import BETWEEN, OVER
from sweeps.pages import words

FULL = 2 * math.pi  # rad per turn
#: Speed below which a motor stands [rpm], and below which a robot turns on the spot [mm/s].
STANDS, SPOT = 1.0, 1.0


def unlike_sides_note(name: str, effects: Sequence[str], turns: str) -> str:
    """Remark on effects that differ between the sides, which runs without a turn do not show."""
    return f"{name}: {STRAIGHT} ({', '.join(effects)}); {turns}"


def turn_under_equal_commands(robot: Robot, found: Result, value: float) -> str:
    """Turn of a robot whose sides are driven equally, by configuration, in words. Empty if it travels straight.

    Args:
        value: imposed voltage or motor speed [V, rpm].
    """
    imposed, states = ("rpm", "motor_speed_left_rpm and motor_speed_right_rpm") if (
        robot.rig.imposed == "motor_speed"
    ) else ("V", "--left and --right, or duty_left and duty_right")  # fmt: skip
    rates, speeds = (np.asarray(found.reading[channel]) for channel in ("yaw_rate", "speed"))
    rates_by_configuration = zip(robot.configurations, rates, speeds, np.asarray(found.status), strict=True)
    told = [
        f"{name} {words.short_status(STATUSES[int(status)])}" if not math.isfinite(rate)
        else f"{name} turns to the {SIDES[int(rate < 0)]} at {abs(rate):.3g} rad/s and {speed:.3g} m/s"
        for name, rate, speed, status in rates_by_configuration
        if not abs(rate) < NONE
    ]  # fmt: skip
    alike = f"with {value:g} {imposed} on both sides on level ground"
    return f"{alike}, the robot does not travel straight: {', '.join(told)} ({states} show it)" if told else ""


def has_motion(row: Json) -> bool:
    """True if a turn has a motion, settled or not."""
    return math.isfinite(float(row["yaw_rate_rad_s"])) and row["status"] in ("converged", "not_settled")


def turn_answer(row: Json, ended: Mapping[str, float] | None) -> str:
    """One sentence on a turn.

    Args:
        row: row of the table of runs.
        ended: `time_s`, `displacement_m` and `turned_deg` at the end of a run over time. None: a settled turn.
    """
    status = str(row["status"])
    if not has_motion(row):
        unsettled = ended is None and status == STATUSES[NOT_SETTLED]
        return f"{status}: {words.NO_TURN if unsettled else words.status_meaning(status)}"
    if ended is None:
        return _moves(row)
    return (
        f"After {ended['time_s']:g} s: {ended['displacement_m']:.2f} m from the start, turned by "
        f"{ended['turned_deg']:.0f}°. {_moves(row) if status == 'converged' else _now(row)}"
    )


def _sloping(row: Json) -> bool:
    return float(row["slope_deg"]) != 0


def _way(row: Json) -> str:
    return SIDES[0] if float(row["yaw_rate_rad_s"]) > 0 else SIDES[1]


def _now(row: Json) -> str:
    """Motion that still changes, in words."""
    rate, speed = float(row["yaw_rate_rad_s"]), float(row["speed_mm_s"])
    return f"Not settled: it then moves at {speed:.0f} mm/s and turns to the {_way(row)} at {abs(rate):.2f} rad/s."


def _moves(row: Json) -> str:
    rate, radius, speed = (float(row[c]) for c in ("yaw_rate_rad_s", "turning_radius_mm", "speed_mm_s"))
    if not math.isfinite(radius):
        return f"Straight at {speed:.0f} mm/s."
    if _sloping(row):
        return (
            f"At this heading the forward speed is {speed:.0f} mm/s and the yaw rate {abs(rate):.2f} rad/s to "
            f"the {_way(row)}. On a slope a turn is not a circle."
        )
    if abs(speed) < SPOT:
        minute = 60 / FULL * abs(rate)
        return f"Turns on the spot to the {_way(row)} at {abs(rate):.2f} rad/s, {minute:.1f} turns a minute."
    backward = "backward " if speed < 0 else ""
    return (
        f"Turns {backward}to the {_way(row)} on a circle of {abs(radius):.0f} mm radius, at {abs(speed):.0f} mm/s "
        f"and {abs(rate):.2f} rad/s, one turn in {FULL / abs(rate):.1f} s."
    )


def turn_notes(robot: Robot, row: Json) -> list[str]:
    """Remarks on a turn: effective width, motors that stand or are driven, and exceeded limits."""
    notes = []
    true_width = float(robot.configurations[str(row["configuration"])].turning.width) / MM
    width = float(row["effective_width_mm"])
    if math.isfinite(width) and not _sloping(row) and row["status"] == "converged":
        notes.append(
            f"effective track width {width:.0f} mm, {width / true_width:.2f} times the {true_width:.0f} mm "
            "between the sides: the speed difference of the turn, relative to that without sliding"
        )
    if robot.rig.inherits and not BETWEEN <= true_width * MM <= OVER:
        notes.append(
            f"{true_width:.0f} mm between the sides is outside the packaged robot's range, {BETWEEN / MM:.0f} to "
            f"{OVER / MM:.0f} mm"
        )
    for side in SIDES:
        power, current = float(row[f"power_{side}_W"]), float(row[f"motor_current_{side}_A"])
        turning = float(row[f"motor_speed_{side}_rpm"])
        if abs(turning) < STANDS:
            notes.append(f"the {side} motor is stalled at {abs(current):.2f} A")
        elif turning * current < 0:
            returned = f", {-power:.1f} W go back to the supply" if power < 0 else ""
            notes.append(f"the {side} motor is driven by the turn and braked with {abs(current):.2f} A{returned}")
    if float(row["power_supply_W"]) < 0:
        notes.append("the supply has to absorb power")
    notes += [f"{flag}: {words.FLAGS[flag]}" for flag in str(row["flags"]).split(";") if flag]
    return notes
