"""Silhouettes of a robot at rest and on its highest step, and the map of steps over lever angles."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Polygon
from scipy.spatial import ConvexHull

from mmrjax.climbing.resting_posture import BELTS, FRONT_AXLE, REAR_AXLE, SideOutline
from mmrjax.model.quantities import MM
from sweeps.pages.figure_style import BLUE, FAINT, GREEN, INK, ORANGE, VERMILION, colour_bar, is_narrow, new_figure
from sweeps.report.check_report import (
    CheckResult,
    reached_value_text,
    required_value_text,
    requirement_label,
    requirement_limit,
)
from sweeps.report.words.posture_words import Drawn, Postures, StepMap

#: Larger margins are drawn with this length [%], with their value as a number.
LONGEST = 100.0


def draw_margins(found: CheckResult) -> Figure:
    """One bar for each requirement: margin in percent of the required value, to the right if it is met.

    Phone versions omit the values, which are in the page's table.
    """
    rows = found.outcomes
    fig, axes = new_figure(1, 1, 0.9 + 0.42 * len(rows))
    ax = axes[0, 0]
    for k, o in enumerate(rows):
        if o.margin is None:
            ax.text(
                -1.5, k, f"no value: {reached_value_text(o)}", va="center", ha="right", color=VERMILION, fontsize=8.5
            )
            continue
        share = 100 * o.margin / max(abs(requirement_limit(o)), 1e-12)
        length = float(np.clip(share, -LONGEST, LONGEST))
        ax.barh(k, length, height=0.62, color=GREEN if o.met else VERMILION)
        beyond_words = "" if abs(share) <= LONGEST or is_narrow() else " (beyond the axis)"
        right = length >= 0
        reached = "" if is_narrow() else f"{reached_value_text(o)}, "
        ax.annotate(
            f"{reached}{share:+.0f} %{beyond_words}", (length, k), xytext=(5 if right else -5, 0),
            textcoords="offset points", va="center", ha="left" if right else "right", fontsize=8.5, color=INK,
        )  # fmt: skip
    ax.set_yticks(range(len(rows)), [f"{requirement_label(o)} {required_value_text(o)}" for o in rows])
    ax.set_ylim(len(rows) - 0.4, -0.6)
    ax.set_xlim(-1.45 * LONGEST, 1.6 * LONGEST)
    ax.set_xticks(np.arange(-100, 101, 100 if is_narrow() else 50))
    ax.axvline(0, color=INK, linewidth=1)
    ax.grid(axis="y", visible=False)
    ax.set_xlabel("margin [% of what is required]")
    ax.text(0.005, 1.01, "missed", transform=ax.transAxes, color=FAINT, fontsize=8.5, ha="left", va="bottom")
    ax.text(0.995, 1.01, "met", transform=ax.transAxes, color=FAINT, fontsize=8.5, ha="right", va="bottom")
    return fig


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


#: Posture of each geometric requirement, in words.
ASKED = {"step_mm": "On its highest step", "gap_mm": "Flush over a gap", "length_mm": "Folded"}


def draw_required_postures(drawn: Mapping[str, tuple[Drawn, float, float]]) -> Figure:
    """Side views of the robot, one for each geometric requirement, in the posture that it refers to."""
    fig, grid = new_figure(1, max(len(drawn), 2), 3.6)
    for axes, (name, (shown, front, rear)) in zip(grid[0], drawn.items(), strict=False):
        step = f": {shown.step / MM:.0f} mm" if shown.step else ""
        draw_silhouette(axes, shown, f"{ASKED[name]}{step}\nfront {front:.0f}°, rear {rear:.0f}°")
    for axes in grid[0][len(drawn) :]:
        axes.axis("off")
    return fig


def draw_rest_and_step(found: Postures) -> Figure:
    """The first run at rest on its slope, and where its centre of mass is over the edge of its highest step."""
    fig, grid = new_figure(1, 2, 3.6)
    pitch, contact, step = (found.table[c][0] for c in ("pitch_deg", "contact_mm", "highest_step_mm"))
    draw_silhouette(grid[0, 0], found.rest, f"At rest: pitch {pitch:.1f}°, contact {contact:.0f} mm")
    draw_silhouette(grid[0, 1], found.step, f"Highest step of this posture: {step:.0f} mm")
    return fig


def draw_highest_steps(over: StepMap) -> Figure:
    """Highest step and margin of tipping over the angles of front and rear levers, with those of the run marked, and
    the posture of the highest step.
    """
    fig, grid = new_figure(2, 2, 7.6)
    maps = ((over.step_mm, "highest step [mm]"), (over.margin_mm, "margin against tipping at rest [mm]"))
    for axes, (values, label) in zip(grid[:, 0], maps, strict=True):
        contours = axes.contourf(over.angles_deg, over.angles_deg, values, levels=12, cmap="cividis")
        colour_bar(fig, contours, axes, label=label)
        axes.plot(over.own_deg[1], over.own_deg[0], "o", color="white", mec=INK, ms=8, label="this run")
        axes.plot(over.rear_deg, over.front_deg, "*", color=VERMILION, mec="white", ms=13, label="highest")
        axes.set(
            xlabel="rear levers [°]", ylabel="front levers [°]", title=f"{label.partition(' [')[0].capitalize()}"
        )
        axes.set_xticks(np.arange(-180, 181, 60))
        axes.set_yticks(np.arange(-180, 181, 60))
    grid[0, 0].legend(loc="upper right", labelcolor=INK, facecolor="white", frameon=True)
    grid[1, 1].axis("off")
    best = f"Highest: {over.step_mm.max():.0f} mm, front {over.front_deg:g}°, rear {over.rear_deg:g}°"
    draw_silhouette(grid[0, 1], over.best, best)
    return fig
