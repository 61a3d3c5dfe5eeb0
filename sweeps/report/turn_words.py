"""Sentences and tables on turns and postures, for the terminal and pages."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping

import jax
import numpy as np

from calibration.data import Columns, Json
from calibration.data.columns import LEVERS
from calibration.data.table import Runs
from mmrjax.climbing import static_limits
from mmrjax.climbing.resting_posture import SideOutline
from mmrjax.fidelities.simulation import STRAIGHT
from mmrjax.model.channels import SIDES
from mmrjax.model.conditions import Conditions
from mmrjax.model.quantities import MM
from mmrjax.model.robot import Robot, turn_error
from mmrjax.model.signals import NOT_SETTLED, STATUSES
from mmrjax.turning.two_sides import BETWEEN, OVER
from sweeps.pages import words

FULL_TURN = 2 * math.pi  # rad per turn
#: Speed below which a motor counts as stalled [rpm], and below which a robot turns on the spot [mm/s].
STALL_SPEED, SPOT_SPEED = 1.0, 1.0


def unlike_sides_note(name: str, robot: Robot) -> str:
    """Remark on effects that differ between the sides, which runs without a turn do not show."""
    imposes_speed = robot.rig.imposed == "motor_speed"
    options = "motor_speed_left_rpm and motor_speed_right_rpm" if imposes_speed else "--left and --right"
    reason = turn_error(robot, robot.configurations)
    turn_text = f"turning cannot be computed: {reason}" if reason else f"equal {options} show the turn"
    return f"{name}: {STRAIGHT} ({', '.join(robot.unlike)}); {turn_text}"


def has_motion(row: Json) -> bool:
    """True if a turn has a motion, settled or not."""
    return math.isfinite(float(row["yaw_rate_rad_s"])) and row["status"] in ("converged", "not_settled")


def turn_answer(row: Json, end: Mapping[str, float] | None) -> str:
    """One sentence on a turn.

    Args:
        row: row of the table of runs.
        end: `time_s`, `displacement_m` and `turned_deg` at the end of a run over time. None: a settled turn.
    """
    status = str(row["status"])
    if not has_motion(row):
        has_no_turn = end is None and status == STATUSES[NOT_SETTLED]
        return f"{status}: {words.NO_TURN if has_no_turn else words.status_meaning(status)}"
    if end is None:
        return _motion(row)
    return (
        f"After {end['time_s']:g} s: {end['displacement_m']:.2f} m from the start, turned by "
        f"{end['turned_deg']:.0f}°. {_motion(row, status == 'converged')}"
    )


def _is_on_slope(row: Json) -> bool:
    return float(row["slope_deg"]) != 0


def _motion(row: Json, settled: bool = True) -> str:
    """Motion at the end, in words."""
    yaw_rate, radius, speed = (float(row[c]) for c in ("yaw_rate_rad_s", "turning_radius_mm", "speed_mm_s"))
    direction = SIDES[int(yaw_rate <= 0)]
    magnitude = abs(yaw_rate)
    if not settled:
        return (
            f"Not settled: it then moves at {speed:.0f} mm/s and turns to the {direction} at {magnitude:.2f} rad/s."
        )
    if not math.isfinite(radius):
        return f"Straight at {speed:.0f} mm/s."
    if _is_on_slope(row):
        return (
            f"At this heading the forward speed is {speed:.0f} mm/s and the yaw rate {magnitude:.2f} rad/s to the "
            f"{direction}. On a slope a turn is not a circle."
        )
    if abs(speed) < SPOT_SPEED:
        turns_per_minute = 60 / FULL_TURN * magnitude
        return (
            f"Turns on the spot to the {direction} at {magnitude:.2f} rad/s, {turns_per_minute:.1f} turns a minute."
        )
    return (
        f"Turns {'backward ' * (speed < 0)}to the {direction} on a circle of {abs(radius):.0f} mm radius, at "
        f"{abs(speed):.0f} mm/s and {magnitude:.2f} rad/s, one turn in {FULL_TURN / magnitude:.1f} s."
    )


def turn_notes(robot: Robot, row: Json) -> list[str]:
    """Remarks on a turn: effective width, motors that stand or are driven, and exceeded limits."""
    notes = []
    true_width = float(robot.configurations[str(row["configuration"])].turning.width) / MM
    width = float(row["effective_width_mm"])
    if math.isfinite(width) and not _is_on_slope(row) and row["status"] == "converged":
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
        motor_speed = float(row[f"motor_speed_{side}_rpm"])
        if abs(motor_speed) < STALL_SPEED:
            notes.append(f"the {side} motor is stalled at {abs(current):.2f} A")
        elif motor_speed * current < 0:
            returned = f", {-power:.1f} W go back to the supply" if power < 0 else ""
            notes.append(f"the {side} motor is driven by the turn and braked with {abs(current):.2f} A{returned}")
    if float(row["power_supply_W"]) < 0:
        notes.append("the supply has to absorb power")
    notes += [f"{flag}: {words.FLAGS[flag]}" for flag in str(row["flags"]).split(";") if flag]
    return notes


@dataclasses.dataclass(frozen=True)
class SideView:
    """Robot from the side on a ground with a step below its centre of mass.

    Attributes:
        outline: outline of the robot in a frame along the ground.
        base: height of the middle of the wheelbase [m].
        step: height of the step [m].
        slope: slope of the ground [rad].
    """

    outline: SideOutline
    base: float
    step: float
    slope: float = 0.0


@dataclasses.dataclass(frozen=True)
class Postures:
    """Postures of the runs of a table.

    Attributes:
        table: columns of the postures.
        rest, step: posture of the first run at rest and on its highest step.
        best: highest step in any posture [m], and angles of front and rear levers there [deg], of the first run.
    """

    table: Columns
    rest: SideView
    step: SideView
    best: tuple[float, float, float]


def posture_of_runs(robot: Robot, runs: Runs, conditions: Conditions) -> Postures | None:
    """Postures of the runs of a table. None if it states no lever angles."""
    if not conditions.states_levers:
        return None
    rests, limits, outlines, steps = jax.device_get(static_limits.postures_of_runs(robot, conditions))
    condition_names = ("configuration", *(c for c in ("payload_kg", "slope_deg", *LEVERS) if runs.has(c)))
    degrees = 180 / np.pi
    millimetres = 1 / MM
    table = {name: runs[name] for name in condition_names} | {
        "pitch_deg": degrees * rests.pitch,
        "contact_mm": millimetres * rests.length,
        "bears": np.where(rests.line > 0.5, "all along", "at its ends"),
        "load_front_percent": 100 * rests.load_front,
        "centre_height_mm": millimetres * rests.centre_height,
        "margin_mm": millimetres * rests.margin,
        "inertia_kg_m2": rests.inertia,
        "tips_back_deg": degrees * limits.tips_back,
        "tips_forward_deg": degrees * limits.tips_forward,
        "tips_aside_deg": degrees * limits.tips_aside,
        "highest_step_mm": millimetres * limits.step,
        "widest_gap_mm": millimetres * limits.gap,
        "tip_front_mm": millimetres * limits.tip_front,
        "tip_rear_mm": millimetres * limits.tip_rear,
        "overall_length_mm": millimetres * limits.length,
        "overall_height_mm": millimetres * limits.height,
    }
    first_conditions, outline, step = jax.tree.map(lambda x: x[0], (conditions, outlines, steps))
    at_rest = SideView(outline, float(rests.height[0]), 0.0, float(first_conditions.slope))
    highest, front, rear = static_limits.best_step(robot, first_conditions)
    best = float(highest.height), degrees * float(front), degrees * float(rear)
    return Postures(table, at_rest, SideView(step.side, float(step.base), float(step.height)), best)


#: Most runs that a remark names.
NAMED_RUNS = 20


def posture_sentences(postures: Postures) -> str:
    """One or two sentences on the posture of the first run and its geometric limits."""
    run = {c: values[0] for c, values in postures.table.items()}
    (highest, front, rear) = postures.best
    return (
        f"posture: pitch {run['pitch_deg']:z.1f}°, on {run['contact_mm']:.0f} mm, carried by {run['bears']}. It tips "
        f"on slopes of {run['tips_back_deg']:.1f}° uphill, {run['tips_forward_deg']:.1f}° downhill, "
        f"{run['tips_aside_deg']:.1f}° across. Its geometry allows steps up to {run['highest_step_mm']:.0f} mm "
        f"and gaps up to {run['widest_gap_mm']:.0f} mm. The highest step in any posture is {highest / MM:.0f} mm "
        f"(front {front:.0f}°, rear {rear:.0f}°)"
    )


def tipping_remarks(postures: Postures) -> list[str]:
    """Remarks on runs that would tip over, because the numbers of straight travel do not show it."""
    margin = postures.table["margin_mm"]
    numbers = ", ".join(str(k + 1) for k in np.flatnonzero(margin < 0)[:NAMED_RUNS])
    subject = "the run" if len(margin) == 1 else f"runs {numbers}"
    sentence = (
        f"posture: {subject} would tip over on that slope. Currents and speeds are those of a robot held upright"
    )
    return [sentence] * bool(numbers)
