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

FULL = 2 * math.pi  # rad per turn
#: Speed below which a motor stands [rpm], and below which a robot turns on the spot [mm/s].
STANDS, SPOT = 1.0, 1.0


def unlike_sides_note(name: str, robot: Robot) -> str:
    """Remark on effects that differ between the sides, which runs without a turn do not show."""
    of_speed = robot.rig.imposed == "motor_speed"
    options = "motor_speed_left_rpm and motor_speed_right_rpm" if of_speed else "--left and --right"
    why = turn_error(robot, robot.configurations)
    turn = f"turning cannot be computed: {why}" if why else f"equal {options} show the turn"
    return f"{name}: {STRAIGHT} ({', '.join(robot.unlike)}); {turn}"


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
        return _motion(row)
    return (
        f"After {ended['time_s']:g} s: {ended['displacement_m']:.2f} m from the start, turned by "
        f"{ended['turned_deg']:.0f}°. {_motion(row, status == 'converged')}"
    )


def _sloping(row: Json) -> bool:
    return float(row["slope_deg"]) != 0


def _motion(row: Json, settled: bool = True) -> str:
    """Motion at the end, in words."""
    rate, radius, speed = (float(row[c]) for c in ("yaw_rate_rad_s", "turning_radius_mm", "speed_mm_s"))
    way, size = SIDES[int(rate <= 0)], abs(rate)
    if not settled:
        return f"Not settled: it then moves at {speed:.0f} mm/s and turns to the {way} at {size:.2f} rad/s."
    if not math.isfinite(radius):
        return f"Straight at {speed:.0f} mm/s."
    if _sloping(row):
        return (
            f"At this heading the forward speed is {speed:.0f} mm/s and the yaw rate {size:.2f} rad/s to the {way}. "
            "On a slope a turn is not a circle."
        )
    if abs(speed) < SPOT:
        return f"Turns on the spot to the {way} at {size:.2f} rad/s, {60 / FULL * size:.1f} turns a minute."
    return (
        f"Turns {'backward ' * (speed < 0)}to the {way} on a circle of {abs(radius):.0f} mm radius, at "
        f"{abs(speed):.0f} mm/s and {size:.2f} rad/s, one turn in {FULL / size:.1f} s."
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


@dataclasses.dataclass(frozen=True)
class Drawn:
    """Robot from the side on a ground with a step below its centre of mass.

    Attributes:
        side: side in a frame along the ground.
        base: height of the middle of the wheelbase [m].
        step: height of the step [m].
        slope: slope of the ground [rad].
    """

    side: SideOutline
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
    rest: Drawn
    step: Drawn
    best: tuple[float, float, float]


def posture_of_runs(robot: Robot, runs: Runs, conditions: Conditions) -> Postures | None:
    """Postures of the runs of a table. None if it states no lever angles."""
    if not conditions.states_levers:
        return None
    rests, limits, lies, steps = jax.device_get(static_limits.postures_of_runs(robot, conditions))
    shown = ("configuration", *(c for c in ("payload_kg", "slope_deg", *LEVERS) if runs.has(c)))
    degrees, millimetres = 180 / np.pi, 1 / MM
    table = {name: runs[name] for name in shown} | {
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
    first_conditions, side, step = jax.tree.map(lambda x: x[0], (conditions, lies, steps))
    level = Drawn(side, float(rests.height[0]), 0.0, float(first_conditions.slope))
    highest, front, rear = static_limits.best_step(robot, first_conditions)
    best = float(highest.height), degrees * float(front), degrees * float(rear)
    return Postures(table, level, Drawn(step.side, float(step.base), float(step.height)), best)


#: Most runs that a remark names.
ROWS = 20


def posture_sentences(found: Postures) -> str:
    """One or two sentences on the posture of the first run and its geometric limits."""
    run, (highest, front, rear) = {c: values[0] for c, values in found.table.items()}, found.best
    return (
        f"posture: pitch {run['pitch_deg']:z.1f}°, on {run['contact_mm']:.0f} mm, carried by {run['bears']}. It tips "
        f"on slopes of {run['tips_back_deg']:.1f}° uphill, {run['tips_forward_deg']:.1f}° downhill, "
        f"{run['tips_aside_deg']:.1f}° across. Its geometry allows steps up to {run['highest_step_mm']:.0f} mm "
        f"and gaps up to {run['widest_gap_mm']:.0f} mm. The highest step in any posture is {highest / MM:.0f} mm "
        f"(front {front:.0f}°, rear {rear:.0f}°)"
    )


def tipping_remarks(found: Postures) -> list[str]:
    """Remarks on runs that would tip over, because the numbers of straight travel do not show it."""
    margin = found.table["margin_mm"]
    numbers = ", ".join(str(k + 1) for k in np.flatnonzero(margin < 0)[:ROWS])
    who = "the run" if len(margin) == 1 else f"runs {numbers}"
    sentence = f"posture: {who} would tip over on that slope. Currents and speeds are those of a robot held upright"
    return [sentence] * bool(numbers)
