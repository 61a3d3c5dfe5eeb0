"""Sentences on a posture, for terminal and page."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import jax
import numpy as np

from calibration.data import Columns
from calibration.data.columns import LEVERS
from calibration.data.table import Runs
from mmrjax.climbing import static_limits
from mmrjax.climbing.resting_posture import SideOutline
from mmrjax.model.conditions import Conditions
from mmrjax.model.quantities import MM
from mmrjax.model.robot import Robot
from sweeps.report.document import Column, Table


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
