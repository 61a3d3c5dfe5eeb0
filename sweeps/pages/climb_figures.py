"""Figures of climbs and postures: silhouettes, and currents and margin over time."""

from __future__ import annotations

import itertools
from typing import Any

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
from sweeps.report.turn_words import Drawn, Postures

_GROUND = "#b8a98f"
#: Most silhouettes on a page.
SHOWN = 6
#: Numbers of silhouettes closer than this share of the time are joined.
NEAR = 0.03


def _belt_outlines(found: ClimbResult, q: np.ndarray) -> list[tuple[np.ndarray, np.ndarray]]:
    """Closed outlines of the belts, and tips of their grousers, in the world [m]."""
    robot = found.robot
    chassis = robot.configurations[found.configuration]
    shape = footing.contact_shape_of_robot(chassis, robot.running_gear, robot.radius_pulley)
    body, front, rear = footing.part_frames(shape, jnp.asarray(q))
    belts = [(shape.main, body._replace(origin=rear.origin), q[SHAFT])]
    if np.asarray(chassis.on_tracks) > 0.5:
        belts += [(shape.lever, lever, q[SHAFT] + q[lever.turns]) for lever in (front, rear)]
    outlines = []
    for belt, frame, belt_angle in belts:
        path = frame.world(belt.point(jnp.linspace(0.0, belt.length, 120)[:-1]))
        tips = frame.world(levers.grouser_tips(belt, belt.places(belt.first * belt_angle))[0])
        outlines.append((np.asarray(path), np.asarray(tips)))
    if np.asarray(chassis.on_tracks) < 0.5:
        round_ = np.linspace(0, 2 * np.pi, 60)
        circle = float(chassis.radius) * np.stack([np.cos(round_), np.sin(round_)], 1)
        outlines += [(np.asarray(lever.origin) + circle, np.zeros((0, 2))) for lever in (front, rear)]
    return outlines


def _draw_robot(axes: Any, found: ClimbResult, q: np.ndarray) -> None:
    outlines = _belt_outlines(found, q)
    cos, sin = np.cos(-q[PITCH]), np.sin(-q[PITCH])
    chassis = found.robot.configurations[found.configuration]
    shape = footing.contact_shape_of_robot(chassis, found.robot.running_gear, found.robot.radius_pulley)
    half, under = float(shape.half), float(shape.belly)
    top = under + BODY_HEIGHT
    box = np.array([(-half, under), (half, under), (half + 0.01, top), (-half - 0.01, top)])
    box = box @ np.array([[cos, sin], [-sin, cos]]) + q[:2]
    axes.add_patch(Polygon(box, facecolor=BLUE, edgecolor=INK, lw=0.8, alpha=0.55))
    for path, tips in outlines:
        axes.add_patch(Polygon(path, facecolor=BLUE, edgecolor=INK, lw=1.4, alpha=0.35))
        axes.add_patch(Polygon(path, fill=False, edgecolor=INK, lw=1.2))
        if len(tips):
            axes.plot(*tips.T, ".", color=INK, ms=2.5)


def decisive_instants(found: ClimbResult) -> list[tuple[str, int]]:
    """Decisive samples of the run in order of time: label and index."""
    t = found.table
    picked = {
        "start": 0,
        "largest pitch": int(np.argmax(np.abs(t["pitch_deg"]))),
        "least margin": int(np.argmin(np.nan_to_num(t["margin_mm"], nan=np.inf))),
        "largest motor current": int(np.argmax(np.abs(t["traction_current_A"]))),
        "half way": int(np.argmin(np.abs(t["x_mm"] - (t["x_mm"][0] + t["x_mm"].max()) / 2))),
        "end": len(t["time_s"]) - 1,
    }
    names_by_instant: dict[int, str] = {}
    for name, k in picked.items():
        names_by_instant[k] = f"{names_by_instant[k]}, {name}" if k in names_by_instant else name
    return [(names_by_instant[k], k) for k in sorted(names_by_instant)][:SHOWN]


def draw_silhouettes(found: ClimbResult) -> Figure:
    """The robot at the decisive instants."""
    instants = decisive_instants(found)
    q = footing_coordinates(found.table)
    fig, axes = new_figure(-(-len(instants) // 3), 3, 2.7 * -(-len(instants) // 3))
    for n, (ax, (name, k)) in enumerate(zip(axes.ravel(), instants, strict=False), 1):
        begin = q[k, 0] - 0.5
        end = q[k, 0] + 0.5
        points = np.asarray(found.terrain.points) + np.array([-1.0, 1.0]) * float(found.terrain.nose)
        points = points[(points[:, 0] > begin - 200) & (points[:, 0] < end + 200)]
        bottom = points[:, 1].min() - 0.08 if points[:, 1].min() > -1 else -0.25
        outline = np.concatenate([points, [[points[-1, 0], bottom], [points[0, 0], bottom]]])
        ax.add_patch(Polygon(np.maximum(outline, [-1e9, bottom]), color=_GROUND, alpha=0.55, lw=0))
        ax.plot(*points.T, color=INK, lw=1.2)
        _draw_robot(ax, found, q[k])
        ax.set(xlim=(q[k, 0] - 0.48, q[k, 0] + 0.48), ylim=(q[k, 1] - 0.38, q[k, 1] + 0.38), aspect="equal")
        ax.set_title(f"{n}: {found.table['time_s'][k]:.2f} s, {name}", fontsize=9)
        ax.axis("off")
    for ax in axes.ravel()[len(instants) :]:
        ax.axis("off")
    return fig


def draw_climb_course(found: ClimbResult) -> Figure:
    """Posture, margin and the currents of all drives over time, with the instants of the silhouettes."""
    t = found.table
    fig, axes = new_figure(4, 1, 8.0, sharex=True)
    rows = [
        ("angle [deg]", {"pitch, nose up": ("pitch_deg", BLUE), "front levers": ("front_deg", ORANGE),
                         "rear levers": ("rear_deg", PURPLE)}),
        ("place, margin [mm]", {"middle from obstacle": ("x_mm", BLUE),
                                "margin of tipping": ("margin_mm", VERMILION)}),
        ("motor current [A]", {"each traction motor": ("traction_current_A", BLUE),
                               "front levers": ("front_current_A", ORANGE),
                               "rear levers": ("rear_current_A", PURPLE)}),
        ("energy [J]", {"from the supply": ("supply_J", INK), "sliding": ("sliding_J", VERMILION),
                        "windings": ("winding_J", ORANGE), "stored": ("stored_J", GREEN)}),
    ]  # fmt: skip
    times = [t["time_s"][k] for _, k in decisive_instants(found)]
    for ax, (label, lines) in zip(axes.ravel(), rows, strict=True):
        for name, (column, colour) in lines.items():
            ax.plot(t["time_s"], t[column], color=colour, lw=1.3, label=name)
        ax.set_ylabel(label)
        for x in times:
            ax.axvline(x, color=FAINT, lw=0.8)
        ax.legend(loc="upper left", bbox_to_anchor=(1.01, 1.0))
    above = axes[0, 0].secondary_xaxis("top")
    ends = [0, *(np.flatnonzero(np.diff(times) > NEAR * t["time_s"][-1]) + 1), len(times)]
    numbers = [(a + 1, b) for a, b in itertools.pairwise(ends)]
    above.set_xticks(
        [(times[a - 1] + times[b - 1]) / 2 for a, b in numbers],
        [f"{a}" if a == b else f"{a}-{b}" for a, b in numbers],
    )
    above.tick_params(length=0)
    axes[-1, 0].set_xlabel("time [s]")
    return fig


_ROUND = np.linspace(0.0, 2 * np.pi, 181)
_CIRCLE = np.stack([np.cos(_ROUND), np.sin(_ROUND)], 1)


def belt_outline(side: SideOutline, belt: tuple[int, int]) -> np.ndarray:
    """Corners of the belt around a pair of circles, over its grousers [m]."""
    radii = [float(side.belt) if k in (REAR_AXLE, FRONT_AXLE) else float(side.radius[k]) for k in belt]
    outline = [np.array([float(side.forward[k]), float(side.up[k])]) for k in belt]
    points = np.concatenate([c + r * _CIRCLE for c, r in zip(outline, radii, strict=True)])
    return points[ConvexHull(points).vertices]


def draw_silhouette(axes: Axes, shown: Drawn, title: str) -> None:
    """Draws a robot on its ground, uphill and forward to the right [mm], with centre of mass and line of gravity."""
    side, cosine, sine = shown.side, np.cos(shown.slope), np.sin(shown.slope)
    tilt = np.array([[cosine, sine], [-sine, cosine]])

    def page(points: np.ndarray) -> np.ndarray:
        return (points + np.array([0.0, shown.base])) @ tilt / MM

    edge, far, deep = float(side.centre_forward), 0.6, 0.3
    low, high = -shown.base, -shown.base + shown.step
    ground = [(-far, low), (edge, low), (edge, high), (far, high), (far, low - deep), (-far, low - deep)]
    axes.add_patch(Polygon(page(np.array(ground)), color=_GROUND, lw=0))
    colours = {BELTS[0]: ORANGE, BELTS[1]: BLUE, BELTS[2]: ORANGE}
    for belt, colour in colours.items():
        if belt == BELTS[1] or float(side.tracked) > 0.5:
            axes.add_patch(
                Polygon(page(belt_outline(side, belt)), facecolor=colour, alpha=0.45, edgecolor=INK, lw=1.0)
            )
    for x, z, r in zip(side.forward, side.up, side.radius, strict=True):
        axes.plot(*page(np.array([x, z]) + float(r) * _CIRCLE).T, color=INK, lw=0.7)
    mass = page(np.array([[side.centre_forward, side.centre_up]]))[0]
    axes.plot(*mass, "o", color=VERMILION, ms=6)
    axes.plot([mass[0]] * 2, [mass[1], mass[1] - (float(side.centre_up) - high) / MM], color=VERMILION, lw=1, ls="--")
    outline_points = np.concatenate([page(belt_outline(side, belt)) for belt in colours])
    (left, low), (right, high) = outline_points.min(0) - 40, outline_points.max(0) + 40
    axes.set(title=title, aspect="equal", xlim=(left, right), ylim=(low, high), xlabel="mm", ylabel="mm")


def draw_rest_and_step(found: Postures) -> Figure:
    """The first run at rest on its slope, and where its centre of mass is over the edge of its highest step."""
    fig, grid = new_figure(1, 2, 3.6)
    pitch, contact, step = (found.table[c][0] for c in ("pitch_deg", "contact_mm", "highest_step_mm"))
    draw_silhouette(grid[0, 0], found.rest, f"At rest: pitch {pitch:.1f}°, contact {contact:.0f} mm")
    draw_silhouette(grid[0, 1], found.step, f"Highest step of this posture: {step:.0f} mm")
    return fig
