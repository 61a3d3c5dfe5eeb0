"""Figures of climbs and postures: silhouettes, and currents and margin over time."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Polygon
from scipy.spatial import ConvexHull

from mmrjax.climbing import footing, levers
from mmrjax.climbing.footing import PITCH, SHAFT
from mmrjax.climbing.resting_posture import BELTS, FRONT_AXLE, REAR_AXLE, SideOutline
from mmrjax.model.paper_tables import BODY_HEIGHT
from mmrjax.model.quantities import MM
from sweeps.pages.figure_style import (
    BLUE,
    FAINT,
    GREEN,
    INK,
    ORANGE,
    PURPLE,
    VERMILION,
    new_figure,
)
from sweeps.report.climb_report import ClimbResult, footing_coordinates
from sweeps.report.turn_words import Postures, SideView

_GROUND = "#b8a98f"
_ANGLES = np.linspace(0.0, 2 * np.pi, 181)
_CIRCLE = np.stack([np.cos(_ANGLES), np.sin(_ANGLES)], 1)
#: Most silhouettes on a page.
SILHOUETTES = 6
#: If two silhouettes are closer than this share of the time, their numbers share one label.
JOINED_SHARE = 0.03


def _draw_robot(axes: Axes, result: ClimbResult, q: np.ndarray) -> None:
    """Draws the chassis, its belts or wheels, and the tips of the grousers."""
    robot = result.robot
    chassis = result.robot.configurations[result.configuration]
    shape = footing.contact_shape_of_robot(chassis, robot.running_gear, robot.radius_pulley)
    half_length, belly_height = float(shape.half), float(shape.belly)
    top_height = belly_height + BODY_HEIGHT
    cos = np.cos(q[PITCH])
    sin = np.sin(q[PITCH])
    box = np.array(
        [
            (-half_length, belly_height),
            (half_length, belly_height),
            (half_length + 0.01, top_height),
            (-half_length - 0.01, top_height),
        ]
    )
    box = box @ np.array([[cos, -sin], [sin, cos]]) + q[:2]
    axes.add_patch(Polygon(box, facecolor=BLUE, edgecolor=INK, lw=0.8, alpha=0.55))
    body, front, rear = footing.part_frames(shape, jnp.asarray(q))
    belts = [(shape.main, body._replace(origin=rear.origin), q[SHAFT])]
    if float(chassis.on_tracks) > 0.5:
        belts += [(shape.lever, lever, q[SHAFT] + q[lever.turns]) for lever in (front, rear)]
        wheels = []
    else:
        wheels = [np.asarray(lever.origin) + float(chassis.radius) * _CIRCLE for lever in (front, rear)]
    paths = [frame.world(belt.point(jnp.linspace(0.0, belt.length, 120)[:-1])) for belt, frame, _ in belts]
    for path in (*map(np.asarray, paths), *wheels):
        axes.add_patch(Polygon(path, facecolor=BLUE, edgecolor=INK, lw=1.4, alpha=0.35))
        axes.add_patch(Polygon(path, fill=False, edgecolor=INK, lw=1.2))
    for belt, frame, angle in belts:
        tips = frame.world(levers.grouser_tips(belt, belt.places(belt.first * angle))[0])
        axes.plot(*np.asarray(tips).T, ".", color=INK, ms=2.5)


def decisive_instants(result: ClimbResult) -> list[tuple[str, int]]:
    """Decisive samples of the run in order of time: label and index."""
    table = result.table
    sample_of_event = {
        "start": 0,
        "largest pitch": int(np.argmax(np.abs(table["pitch_deg"]))),
        "least margin": int(np.argmin(np.nan_to_num(table["margin_mm"], nan=np.inf))),
        "largest motor current": int(np.argmax(np.abs(table["traction_current_A"]))),
        "half way": int(np.argmin(np.abs(table["x_mm"] - (table["x_mm"][0] + table["x_mm"].max()) / 2))),
        "end": len(table["time_s"]) - 1,
    }
    names_by_instant: dict[int, str] = {}
    for name, k in sample_of_event.items():
        names_by_instant[k] = f"{names_by_instant[k]}, {name}" if k in names_by_instant else name
    return [(names_by_instant[k], k) for k in sorted(names_by_instant)][:SILHOUETTES]


def draw_silhouettes(result: ClimbResult) -> Figure:
    """The robot at the decisive instants."""
    instants = decisive_instants(result)
    q = footing_coordinates(result.table)
    corners = np.asarray(result.terrain.points) + np.array([-1.0, 1.0]) * float(result.terrain.nose)
    rows = -(-len(instants) // 3)
    fig, grid = new_figure(rows, 3, 2.7 * rows)
    for axes in grid.ravel():
        axes.axis("off")
    for n, (axes, (name, k)) in enumerate(zip(grid.ravel(), instants, strict=False), 1):
        x, z = q[k, :2]
        ground_x, ground_z = corners[abs(corners[:, 0] - x) < 200].T
        bottom = ground_z.min() - 0.08 if ground_z.min() > -1 else -0.25
        axes.fill_between(ground_x, bottom, np.maximum(ground_z, bottom), color=_GROUND, alpha=0.55, lw=0)
        axes.plot(ground_x, ground_z, color=INK, lw=1.2)
        _draw_robot(axes, result, q[k])
        axes.set(xlim=(x - 0.48, x + 0.48), ylim=(z - 0.38, z + 0.38), aspect="equal")
        axes.set_title(f"{n}: {result.table['time_s'][k]:.2f} s, {name}", fontsize=9)
    return fig


def draw_climb_course(result: ClimbResult) -> Figure:
    """Posture, margin and the currents of all drives over time, with the instants of the silhouettes."""
    table = result.table
    fig, grid = new_figure(4, 1, 8.0, sharex=True)
    panels = {
        "angle [deg]": {"pitch_deg": ("pitch, nose up", BLUE), "front_deg": ("front levers", ORANGE),
                        "rear_deg": ("rear levers", PURPLE)},
        "place, margin [mm]": {"x_mm": ("middle from obstacle", BLUE), "margin_mm": ("margin of tipping", VERMILION)},
        "motor current [A]": {"traction_current_A": ("each traction motor", BLUE),
                              "front_current_A": ("front levers", ORANGE), "rear_current_A": ("rear levers", PURPLE)},
        "energy [J]": {"supply_J": ("from the supply", INK), "sliding_J": ("sliding", VERMILION),
                       "winding_J": ("windings", ORANGE), "stored_J": ("stored", GREEN)},
    }  # fmt: skip
    times = np.array([table["time_s"][k] for _, k in decisive_instants(result)])
    for axes, (label, lines) in zip(grid[:, 0], panels.items(), strict=True):
        for column, (name, colour) in lines.items():
            axes.plot(table["time_s"], table[column], color=colour, lw=1.3, label=name)
        axes.set_ylabel(label)
        for instant in times:
            axes.axvline(instant, color=FAINT, lw=0.8)
        axes.legend(loc="upper left", bbox_to_anchor=(1.01, 1.0))
    group_of_instant = np.cumsum(np.diff(times, prepend=times[0]) > JOINED_SHARE * table["time_s"][-1])
    groups = [np.flatnonzero(group_of_instant == group) for group in range(group_of_instant[-1] + 1)]
    above = grid[0, 0].secondary_xaxis("top")
    above.set_xticks(
        [times[members[[0, -1]]].mean() for members in groups],
        ["-".join(dict.fromkeys(f"{k + 1}" for k in members[[0, -1]])) for members in groups],
    )
    above.tick_params(length=0)
    grid[-1, 0].set_xlabel("time [s]")
    return fig


def _belt_outline(side: SideOutline, belt: tuple[int, int]) -> np.ndarray:
    """Corners of the belt around a pair of circles, over its grousers [m]."""
    radii = [side.belt if k in (REAR_AXLE, FRONT_AXLE) else side.radius[k] for k in belt]
    circles = [[side.forward[k], side.up[k]] + float(r) * _CIRCLE for k, r in zip(belt, radii, strict=True)]
    points = np.concatenate(circles)
    return points[ConvexHull(points).vertices]


def _draw_silhouette(axes: Axes, view: SideView, title: str) -> None:
    """Draws a robot on its ground, uphill and forward to the right [mm], with centre of mass and line of gravity."""
    outline = view.outline
    cosine = np.cos(view.slope)
    sine = np.sin(view.slope)
    tilt = np.array([[cosine, sine], [-sine, cosine]])

    def to_page(points: np.ndarray) -> np.ndarray:
        return (points + np.array([0.0, view.base])) @ tilt / MM

    step_edge = float(outline.centre_forward)
    half_extent = 0.6
    depth = 0.3
    low, high = -view.base, -view.base + view.step
    ground = [
        (-half_extent, low),
        (step_edge, low),
        (step_edge, high),
        (half_extent, high),
        (half_extent, low - depth),
        (-half_extent, low - depth),
    ]
    axes.add_patch(Polygon(to_page(np.array(ground)), color=_GROUND, lw=0))
    outlines = [to_page(_belt_outline(outline, belt)) for belt in BELTS]
    for k, (corners_of_belt, colour) in enumerate(zip(outlines, (ORANGE, BLUE, ORANGE), strict=True)):
        if k == 1 or float(outline.tracked) > 0.5:
            axes.add_patch(Polygon(corners_of_belt, facecolor=colour, alpha=0.45, edgecolor=INK, lw=1.0))
    for x, z, r in zip(outline.forward, outline.up, outline.radius, strict=True):
        axes.plot(*to_page(np.array([x, z]) + float(r) * _CIRCLE).T, color=INK, lw=0.7)
    ((x, z),) = to_page(np.array([[outline.centre_forward, outline.centre_up]]))
    axes.plot(x, z, "o", color=VERMILION, ms=6)
    axes.plot([x, x], [z, z - (float(outline.centre_up) - high) / MM], color=VERMILION, lw=1, ls="--")
    all_corners = np.concatenate(outlines)
    (left, low) = all_corners.min(0) - 40
    (right, high) = all_corners.max(0) + 40
    axes.set(title=title, aspect="equal", xlim=(left, right), ylim=(low, high), xlabel="mm", ylabel="mm")


def draw_rest_and_step(postures: Postures) -> Figure:
    """The first run at rest on its slope, and on its highest step with the centre of mass above the edge."""
    fig, ((rest_axes, step_axes),) = new_figure(1, 2, 3.6)
    pitch, contact, step = (postures.table[c][0] for c in ("pitch_deg", "contact_mm", "highest_step_mm"))
    _draw_silhouette(rest_axes, postures.rest, f"At rest: pitch {pitch:.1f}°, contact {contact:.0f} mm")
    _draw_silhouette(step_axes, postures.step, f"Highest step of this posture: {step:.0f} mm")
    return fig
