"""Sentences on a posture, for terminal and page."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import jax
import numpy as np

from calibration.data import Columns
from calibration.data.columns import LEVERS
from calibration.data.table import Runs
from calibration.sizing.sheet import RequirementOutcome
from mmrjax.climbing import resting_posture, static_limits
from mmrjax.climbing.resting_posture import SideOutline
from mmrjax.model.conditions import Conditions
from mmrjax.model.masses import lever_angles
from mmrjax.model.quantities import MM
from mmrjax.model.robot import Robot
from sweeps.report.document import Column, Table

#: Angles of front and rear levers in the map of highest steps [deg].
ANGLES = np.arange(-180.0, 181.0, 6.0)


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
class StepMap:
    """Highest step and tipping margin as functions of the lever angles.

    Attributes:
        angles_deg: angles of front and rear levers [deg].
        step_mm, margin_mm: highest step, and margin at rest on the run's slope [mm], shape (front, rear).
        best: posture with the highest step.
        front_deg, rear_deg: angles of its levers.
        own_deg: angles of the run, front and rear.
    """

    angles_deg: np.ndarray
    step_mm: np.ndarray
    margin_mm: np.ndarray
    best: Drawn
    front_deg: float
    rear_deg: float
    own_deg: tuple[float, float]


@dataclasses.dataclass(frozen=True)
class Postures:
    """Postures of the runs of a table.

    Attributes:
        table: columns of the postures.
        rest, step: posture of the first run at rest and on its highest step.
        over: map of the first run.
    """

    table: Columns
    rest: Drawn
    step: Drawn
    over: StepMap


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
    found, margin = jax.device_get(static_limits.steps_over_lever_angles(robot, first_conditions, ANGLES, ANGLES))
    front, rear = np.unravel_index(np.argmax(found.height), found.height.shape)
    best = _on_step(jax.tree.map(lambda x: x[front, rear], found))
    lever_degrees = tuple(float(np.degrees(x)) for x in lever_angles(robot.running_gear, first_conditions))
    return Postures(
        table,
        level,
        _on_step(step),
        StepMap(
            ANGLES,
            found.height / MM,
            margin / MM,
            best,
            float(ANGLES[front]),
            float(ANGLES[rear]),
            (lever_degrees[0], lever_degrees[1]),
        ),
    )


def of_requirements(robot: Robot, outcomes: Sequence[RequirementOutcome]) -> dict[str, tuple[Drawn, float, float]]:
    """Robot in the posture of each geometric requirement, by name, with the angles of its levers [deg].

    On a step it is the best posture, over a gap the levers are flush with the belt, and for the size they are folded.
    """
    postures: dict[str, tuple[Drawn, float, float]] = {}
    for outcome in outcomes:
        name = outcome.requirement.name
        if name not in ("step_mm", "gap_mm", "length_mm"):
            continue
        conditions = Conditions(outcome.at["configuration"], payload=outcome.at.get("payload_kg", 0.0)).resolved(
            robot
        )
        if name == "step_mm":
            step, front, rear = jax.device_get(static_limits.best_step(robot, conditions))
            drawn = _on_step(step)
        else:
            front = rear = float(static_limits.flush_lever_angle(robot)) if name == "gap_mm" else np.pi
            stands = static_limits.with_lever_angles(conditions, front, rear)
            rests, side = resting_posture.level_posture(robot, stands), resting_posture.side_outline(robot, stands)
            drawn = Drawn(jax.device_get(side.with_pitch(rests.pitch)), float(rests.height), 0.0)
        postures[name] = drawn, float(np.degrees(front)), float(np.degrees(rear))
    return postures


def _on_step(found: static_limits.StepLimit) -> Drawn:
    return Drawn(found.side, float(found.base), float(found.height))


#: Columns of the page's table: heading, format.
COLUMNS = {
    "levers_front_deg": ("front levers [°]", "{:g}"), "levers_rear_deg": ("rear levers [°]", "{:g}"),
    "pitch_deg": ("pitch [°]", "{:.1f}"), "contact_mm": ("contact [mm]", "{:.0f}"), "bears": ("bears", "{}"),
    "load_front_percent": ("load at the front [%]", "{:.0f}"),
    "centre_height_mm": ("centre of mass over the ground [mm]", "{:.1f}"), "margin_mm": ("margin [mm]", "{:.0f}"),
    "tips_back_deg": ("tips back on [°]", "{:.1f}"), "tips_forward_deg": ("tips forward on [°]", "{:.1f}"),
    "tips_aside_deg": ("tips aside on [°]", "{:.1f}"), "highest_step_mm": ("highest step [mm]", "{:.0f}"),
    "widest_gap_mm": ("widest gap [mm]", "{:.0f}"), "tip_front_mm": ("front tip up to [mm]", "{:.0f}"),
    "tip_rear_mm": ("rear tip up to [mm]", "{:.0f}"), "overall_length_mm": ("length [mm]", "{:.0f}"),
    "overall_height_mm": ("height [mm]", "{:.0f}"),
}  # fmt: skip
#: Most rows of that table.
ROWS = 20


def posture_table(found: Postures, names: Sequence[str]) -> Table:
    """Postures of the first runs, one row for each."""
    shown = {c: about for c, about in COLUMNS.items() if c in found.table}
    rows = zip(names[:ROWS], *(found.table[c][:ROWS] for c in shown), strict=True)
    columns = (Column("run"), *(Column(heading, form=form) for heading, form in shown.values()))
    return Table("posture", columns, list(rows), file="posture.csv", sideways=True)


def posture_sentences(found: Postures) -> str:
    """One or two sentences on the posture of the first run and its geometric limits."""
    run, highest = {c: values[0] for c, values in found.table.items()}, found.over.step_mm.max()
    return (
        f"posture: pitch {run['pitch_deg']:z.1f}°, on {run['contact_mm']:.0f} mm, carried by {run['bears']}. It tips "
        f"on slopes of {run['tips_back_deg']:.1f}° uphill, {run['tips_forward_deg']:.1f}° downhill, "
        f"{run['tips_aside_deg']:.1f}° across. Its geometry allows steps up to {run['highest_step_mm']:.0f} mm "
        f"and gaps up to {run['widest_gap_mm']:.0f} mm. The highest step in any posture is {highest:.0f} mm (front "
        f"{found.over.front_deg:g}°, rear {found.over.rear_deg:g}°)"
    )


def tipping_remarks(found: Postures) -> list[str]:
    """Remarks on runs that would tip over, because the numbers of straight travel do not show it."""
    tipping_runs = np.flatnonzero(found.table["margin_mm"] < 0)
    if not tipping_runs.size:
        return []
    run_words = (
        "the run"
        if len(found.table["margin_mm"]) == 1
        else "runs " + ", ".join(str(k + 1) for k in tipping_runs[:ROWS])
    )
    return [
        f"posture: {run_words} would tip over on that slope. Currents and speeds are those of a robot held upright"
    ]
