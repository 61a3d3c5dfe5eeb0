"""Pictures and video of a turning track model from above: its path, loaded and sliding contacts, both currents."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from mmrjax.fidelities.track import TrackTrajectory
from mmrjax.model import channels
from mmrjax.model.conditions import Conditions
from mmrjax.model.robot import Robot
from mmrjax.turning.two_sides import SIDES
from mmrjax.undercarriage import both_sides
from mmrjax.undercarriage.belt import BeltPath
from mmrjax.undercarriage.rendering import belt_outline, check_finite

#: Length of an arrow per sliding speed [s], and number of arrows per track.
SPEED, ARROWS = 0.15, 5
#: Half the width of a grouser [m], and line width at the largest load of the run [points].
GROUSER, LOADED = 0.014, 7.0
#: Extent of the visible ground around the middle of the robot [m].
AROUND = 0.45

_INK, _BODY, _PATH, _SLIDES = "#1f2933", "#5b8db8", "#8fa3b0", "#d1495b"
_SIDES = ("#0072b2", "#d55e00")


class TopViewScene(NamedTuple):
    """Data for pictures of one run from above, as plain arrays. The side axis is left, right.

    Attributes:
        name: name of the configuration.
        slope: [rad].
        length: wheelbase, width: between the contact lines [m].
        time, q, v: time, coordinates and velocities over the run, see `both_sides`.
        current: current of each side's motor [A].
        belt: speed of each side's movers [m/s].
        along: distance of each contact ahead of the middle [m].
        load: load on it [N].
    """

    name: str
    slope: float
    length: float
    width: float
    time: Float[np.ndarray, " n"]
    q: Float[np.ndarray, "n 10"]
    v: Float[np.ndarray, "n 10"]
    current: Float[np.ndarray, "n 2"]
    belt: Float[np.ndarray, "n 2"]
    along: Float[np.ndarray, "n 2 contacts"]
    load: Float[np.ndarray, "n 2 contacts"]

    def sheet(self, k: int) -> Any:
        """Figure of sample `k`."""
        return figure_of_sample(self, k)


def scene_of_run(robot: Robot, conditions: Conditions, run: TrackTrajectory) -> TopViewScene:
    """Collects the data of one run for drawing (scalar conditions, one member of a batch).

    Raises:
        ValueError: the run holds numbers that are not finite (a failed member).
    """
    check_finite(run)
    gear, chassis = robot.running_gear, robot.chassis(conditions.configuration)
    path, length = BeltPath(robot.radius_pulley, gear), float(gear.wheelbase)
    place = np.asarray(run.reactions.place)
    if chassis.on_tracks > 0.5:
        load = np.asarray(run.reactions.grouser)
        along = belt_outline(path, float(gear.grouser_height), place.ravel())[:, 0].reshape(place.shape)
    else:
        load = np.asarray(run.reactions.support)
        along = np.broadcast_to(np.array([0.5, -0.5]) * length, load.shape)
    v = np.asarray(run.v)
    return TopViewScene(
        name=robot.configurations.names[int(conditions.configuration)],
        slope=float(conditions.slope),
        length=length,
        width=float(chassis.turning.width),
        time=np.asarray(run.time),
        q=np.asarray(run.q),
        v=v,
        current=np.asarray(run.signals.current),
        belt=v[:, both_sides.PULLEYS[:, 0]] * float(chassis.radius),
        along=along,
        load=load,
    )


def draw_sample(axes: Any, view: TopViewScene, k: int) -> None:
    """Draws sample `k` of a scene into Matplotlib `axes`, uphill to the top and left to the left."""
    from matplotlib.patches import Polygon

    q, v = view.q[k], view.v[k]
    yaw = q[both_sides.YAW]
    cos, sin = np.cos(yaw), np.sin(yaw)

    def page(points: Any) -> np.ndarray:  # frame of the robot -> ground -> page
        x, y = np.asarray(points, float).T
        return np.stack([-(q[1] + sin * x + cos * y), q[0] + cos * x - sin * y], axis=-1)

    axes.plot(-view.q[: k + 1, 1], view.q[: k + 1, 0], color=_PATH, lw=1.5, zorder=1)
    half, inner = view.length / 2, view.width / 2 - 2 * GROUSER
    body = [(half, inner), (half, -inner), (-half, -inner), (-half, inner)]
    axes.add_patch(Polygon(page(body), facecolor=_BODY, edgecolor=_INK, lw=1, alpha=0.5, zorder=2))
    axes.annotate(
        "", *page([(half, 0.0), (-half / 2, 0.0)]), arrowprops={"arrowstyle": "-|>", "color": _INK}, zorder=3
    )
    largest_load = max(float(view.load.max()), 1e-9)
    ahead, aside = cos * v[0] + sin * v[1], cos * v[1] - sin * v[0]
    for side, colour in enumerate(_SIDES):
        y = SIDES[side] * view.width
        edge = [(half, y - GROUSER), (half, y + GROUSER), (-half, y + GROUSER), (-half, y - GROUSER)]
        axes.add_patch(Polygon(page(edge), facecolor="none", edgecolor=colour, lw=1.2, zorder=3))
        for x, load in zip(view.along[k, side], view.load[k, side], strict=True):
            if load > 0:
                ends = page([(x, y - GROUSER), (x, y + GROUSER)])
                axes.plot(
                    *ends.T, color=colour, lw=0.8 + LOADED * load / largest_load, zorder=4, solid_capstyle="butt"
                )
        for x in np.linspace(-half, half, min(ARROWS, view.along.shape[-1])):
            slides = np.array([ahead - v[both_sides.YAW] * y - view.belt[k, side], aside + v[both_sides.YAW] * x])
            tail, head = page([(x, y), np.array([x, y]) + SPEED * slides])
            if np.hypot(*(head - tail)) > 3e-3:
                axes.annotate("", head, tail, arrowprops={"arrowstyle": "-|>", "color": _SLIDES, "lw": 1.3}, zorder=6)


def figure_of_sample(view: TopViewScene, k: int) -> Any:
    """Figure of sample `k`: the robot from above, currents and yaw rate of the whole run below."""
    from matplotlib.figure import Figure
    from matplotlib.lines import Line2D

    sheet = Figure(figsize=(7.2, 8.4), dpi=100, layout="constrained")
    upper, current, rate = sheet.subplots(3, 1, gridspec_kw={"height_ratios": [5.2, 1, 1]})
    draw_sample(upper, view, k)
    x, y, heading_deg = view.q[k, 0], view.q[k, 1], np.degrees(view.q[k, both_sides.YAW])
    upper.set(xlim=(-y - AROUND, -y + AROUND), ylim=(x - AROUND, x + AROUND), aspect="equal")
    upper.set_xlabel("to the right of the start, m")
    upper.set_ylabel("uphill, or ahead of the start, m")
    upper.grid(alpha=0.25)
    upper.set_title(
        f"{view.name}, slope {np.degrees(view.slope):.0f}°, t = {view.time[k]:.3f} s, yaw {heading_deg:.0f}°",
        fontsize=11,
    )
    handles = [
        Line2D([], [], color=c, lw=4, label=f"{name} side, contacts under load")
        for c, name in zip(_SIDES, channels.SIDES, strict=True)
    ]
    handles.append(
        Line2D([], [], color=_SLIDES, lw=1.5, label=f"sliding over the ground, {1e3 * SPEED:.0f} mm: 1 m/s")
    )
    upper.legend(handles=handles, loc="upper left", fontsize=8, frameon=False)
    for side, colour in enumerate(_SIDES):
        current.plot(view.time, view.current[:, side], color=colour, lw=0.9)
    axis_limit = 1.3 * np.percentile(np.abs(view.current), 95)
    current.set(
        ylabel="I, A", ylim=(min(0.0, 1.3 * np.percentile(view.current, 5)), max(axis_limit, 0.1)), xticklabels=[]
    )
    rate.plot(view.time, view.v[:, both_sides.YAW], color=_INK, lw=1.0)
    rate.set(xlabel="time, s", ylabel="yaw rate, rad/s")
    for axes in (current, rate):
        axes.set_xlim(view.time[0], view.time[-1])
        axes.axvline(view.time[k], color=_INK, lw=0.8)
        axes.grid(alpha=0.25)
        axes.spines[["top", "right"]].set_visible(False)
    return sheet
