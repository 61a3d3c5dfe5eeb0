"""Silhouettes of a robot at rest and on its highest step."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Polygon
from scipy.spatial import ConvexHull

from mmrjax.climbing.resting_posture import BELTS, FRONT_AXLE, REAR_AXLE, SideOutline
from mmrjax.model.quantities import MM
from sweeps.pages.figure_style import BLUE, INK, ORANGE, VERMILION, new_figure
from sweeps.report.words.posture_words import Drawn, Postures

_GROUND = "#d9cfbf"
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
