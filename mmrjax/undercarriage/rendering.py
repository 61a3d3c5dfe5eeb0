"""Pictures of the track model: the robot on its slope with running track and drawn forces, headless."""

from __future__ import annotations

from pathlib import Path as File
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from mmrjax.fidelities.track import TrackTrajectory
from mmrjax.model import params
from mmrjax.model.conditions import Conditions
from mmrjax.model.paper_tables import BODY_HEIGHT
from mmrjax.model.robot import Robot
from mmrjax.model.signals import GRAVITY
from mmrjax.undercarriage.running_gear import GROUSERS, TEETH_BELT, BeltPath, tips_on_path
from mmrjax.undercarriage.side_contacts import lever_tips

FORCE = 1 / 800  # length of an arrow [m/N]

_INK, _BODY, _BELT, _GROUND = "#1f2933", "#5b8db8", "#2f3437", "#b8a98f"
_NORMAL, _TRACTION, _RESISTANCE, _GUIDE, _WEIGHT = "#d1495b", "#2e933c", "#b07d12", "#7048a8", "#1f2933"


class RunScene(NamedTuple):
    """Data for pictures of one run.

    Attributes:
        slope: [rad].
        name: name of the configuration.
        wheeled: True on wheels.
        axle: half the wheelbase [m].
        wheel: radius of the wheels [m].
        path: path of the belt.
        levers: tips in the chassis frame, empty on wheels.
        run: motion, signals and reactions of one side.
        weight: weight of half the robot [N].
    """

    slope: float
    name: str
    wheeled: bool
    axle: float
    wheel: float
    path: BeltPath
    levers: list[tuple[float, float]]
    run: Any  # TrackTrajectory, of one run
    weight: float

    def sheet(self, k: int) -> Any:
        """Figure of sample `k`: the robot above, current and speeds of the whole run below."""
        from matplotlib.figure import Figure
        from matplotlib.lines import Line2D

        time, signals = self.run.time, self.run.signals
        figure = Figure(figsize=(9.6, 7.2), dpi=100, layout="constrained")
        picture, current, speed = figure.subplots(3, 1, gridspec_kw=dict(height_ratios=[4.6, 1, 1]))
        draw_sample(picture, self, k)
        span, rise = 0.31, 0.31 * np.sin(abs(self.slope))
        picture.set(xlim=(-span, span), ylim=(-0.15 - rise * 0.55, 0.16 + rise * 0.55), aspect="equal")
        picture.axis("off")
        picture.set_title(
            f"{self.name}, slope {np.degrees(self.slope):.0f}°, t = {time[k]:.3f} s, x = {self.run.q[k, 0]:.3f} m, "
            f"V = {signals.speed[k]:.2f} m/s",
            fontsize=11,
        )
        legend_entries = [entry for entry in _LEGEND if not (self.wheeled and "guide" in entry[0])]
        handles = [Line2D([], [], color=colour, lw=2.5, label=label) for label, colour in legend_entries]
        picture.legend(handles=handles, loc="upper left", fontsize=8, frameon=False, ncols=len(legend_entries))
        scale_height = -0.14 - rise * 0.5
        picture.plot([span - 0.02 - 50 * FORCE, span - 0.02], [scale_height] * 2, color=_INK, lw=2)
        picture.text(span - 0.02 - 25 * FORCE, scale_height + 0.004, "50 N", fontsize=8, va="bottom", ha="center")
        current.plot(time, signals.total_current, color=_NORMAL, lw=0.9)
        current_most = 1.3 * np.percentile(signals.total_current, 98)
        current.set(ylabel="I, A", ylim=(0.0, max(current_most, 0.1)), xlim=(time[0], time[-1]), xticklabels=[])
        speed.plot(time, signals.speed_theoretical, color="#888888", lw=0.9, label="theoretical")
        speed.plot(time, signals.speed, color=_TRACTION, lw=1.2, label="robot")
        speed.set(xlabel="time, s", ylabel="V, m/s", xlim=(time[0], time[-1]))
        speed.legend(fontsize=8, frameon=False, loc="lower right")
        for axes in (current, speed):
            axes.axvline(time[k], color=_INK, lw=0.8)
            axes.grid(alpha=0.25)
            axes.spines[["top", "right"]].set_visible(False)
        return figure


def scene_of_run(robot: Robot, conditions: Conditions, run: TrackTrajectory) -> RunScene:
    """Collects the data of one run for drawing (scalar conditions, one member of a batch).

    Raises:
        ValueError: the run holds numbers that are not finite (a failed member).
    """
    gear = robot.running_gear
    if not np.isfinite(np.asarray(run.q)).all():
        raise ValueError("run: its coordinates are not finite; expected a run that ended")
    chassis = robot.chassis(conditions.configuration)
    path = BeltPath(robot.radius_pulley, gear)
    wheeled = bool(chassis.on_tracks < 0.5)
    levers = [] if wheeled else lever_tips(gear, conditions)
    return RunScene(
        slope=float(conditions.slope),
        name=robot.configurations.names[int(conditions.configuration)],
        wheeled=wheeled,
        axle=float(gear.wheelbase) / 2,
        wheel=float(chassis.radius),
        path=path,
        levers=[(float(x), float(z)) for x, z in levers],
        run=run,
        weight=float(np.asarray(run.signals.mass)[0]) / float(robot.sides) * GRAVITY,
    )


def _rotate(points: Any, angle: float, about: tuple[float, float] = (0.0, 0.0)) -> np.ndarray:
    cos, sin = np.cos(angle), np.sin(angle)
    return np.asarray(points) @ np.array([[cos, sin], [-sin, cos]]) + np.asarray(about)


def belt_outline(path: BeltPath, height: float, places: np.ndarray) -> np.ndarray:
    """Points of the belt (height 0) or of grouser tips in the chassis frame [m], at positions on its path."""
    gear = params.replace(path.gear, {"grouser_height": jnp.asarray(height)})
    tips = tips_on_path(BeltPath(path.radius, gear), jnp.asarray(places))
    return np.stack([np.asarray(tips.forward), np.asarray(tips.up)], axis=1)


def draw_sample(axes: Any, scene: RunScene, k: int) -> None:
    """Draws sample `k` of a scene into Matplotlib `axes`, uphill to the right."""
    from matplotlib.collections import LineCollection
    from matplotlib.patches import Circle, Polygon

    q = scene.run.q[k]
    radius = float(scene.path.radius)
    axle_x = q[0]
    height = q[1]
    place = np.asarray(scene.run.reactions.place[k])

    def world(points: Any) -> np.ndarray:  # chassis frame -> slope -> page
        return _rotate(_rotate(points, -q[2], (0.0, height)), scene.slope)

    def ground(points: Any) -> np.ndarray:
        return _rotate(points, scene.slope)

    strip = ground([(-0.6, 0.0), (0.6, 0.0), (0.6, -0.2), (-0.6, -0.2)])
    axes.add_patch(Polygon(strip, color=_GROUND, alpha=0.45, lw=0))
    axes.plot(*ground([(-0.6, 0), (0.6, 0)]).T, color=_INK, lw=1)
    first_mark = np.ceil((axle_x - 0.6) / 0.05) * 0.05
    marks = np.arange(first_mark, axle_x + 0.6, 0.05) - axle_x  # fixed to the ground: they show the travel
    axes.add_collection(LineCollection([ground([(m, 0), (m - 0.008, -0.012)]) for m in marks], colors=_INK, lw=0.8))

    gear = scene.path.gear
    underside = float(gear.clearance - scene.path.radius - gear.grouser_height)
    top = underside + BODY_HEIGHT
    body = [(-scene.axle, underside), (scene.axle, underside), (scene.axle + 0.01, top), (-scene.axle - 0.01, top)]
    body = [(x, max(z, -radius + 0.008)) for x, z in body]
    axes.add_patch(Polygon(world(body), facecolor=_BODY, edgecolor=_INK, lw=1, alpha=0.85))
    for (x, z), start in zip(scene.levers, (scene.axle, -scene.axle), strict=False):
        axes.plot(*world([(start, 0), (x, z)]).T, color="#8fa3b0", lw=7, solid_capstyle="round", alpha=0.7, zorder=2)
    belt = world(belt_outline(scene.path, 0.0, np.linspace(0.0, float(scene.path.length), 400)))
    axes.plot(*belt.T, color=_BELT, lw=2.2, zorder=3)
    if scene.wheeled:
        for x, phi in ((scene.axle, q[3]), (-scene.axle, q[4])):
            _draw_disc(axes, Circle, world, x, scene.wheel, phi, "#9aa5ad")
    else:
        base = world(belt_outline(scene.path, 0.0, place))
        tip = world(belt_outline(scene.path, float(scene.path.gear.grouser_height), place))
        axes.add_collection(LineCollection(list(np.stack([base, tip], axis=1)), colors=_BELT, lw=4, zorder=3))
    teeth = (place[:, None] + np.arange(7) * float(scene.path.pitch) / 7).ravel() % float(scene.path.length)
    root, inner = (world(belt_outline(scene.path, h, teeth[:TEETH_BELT])) for h in (0.0, -0.0022))
    axes.add_collection(LineCollection(list(np.stack([root, inner], axis=1)), colors=_BELT, lw=0.9, zorder=3))
    for x, phi in ((scene.axle, q[3]), (-scene.axle, q[4])):
        _draw_disc(axes, Circle, world, x, radius - 0.003, phi, "#d9dee2")
    _draw_forces(axes, scene, k, ground)


def _draw_disc(axes: Any, circle: Any, world: Any, x: float, radius: float, angle: float, colour: str) -> None:
    centre = world([(x, 0.0)])[0]
    axes.add_patch(circle(centre, radius, facecolor=colour, edgecolor=_INK, lw=1, zorder=4))
    for turn in (0.0, np.pi / 2):  # spokes turn clockwise when it rolls uphill to the right
        arm = radius * np.array([np.cos(turn - angle), np.sin(turn - angle)])
        axes.plot(*world(np.array([arm, -arm]) + np.array([x, 0.0])).T, color=_INK, lw=0.8, zorder=4)


def _draw_forces(axes: Any, scene: RunScene, k: int, ground: Any) -> None:
    def arrow(start: Any, along: Any, colour: str) -> None:
        tail, head = ground([start])[0], ground([np.asarray(start) + np.asarray(along) * FORCE])[0]
        if np.hypot(*(head - tail)) > 2e-3:
            style = dict(arrowstyle="-|>", color=colour, lw=1.6, shrinkA=0, shrinkB=0, mutation_scale=9)
            axes.annotate("", head, tail, arrowprops=style, zorder=6)

    q = scene.run.q[k]
    signals = scene.run.signals
    reactions = scene.run.reactions
    if scene.wheeled:
        for x, force in zip((scene.axle, -scene.axle), reactions.support[k], strict=True):
            arrow((x, -force * FORCE), (0.0, force), _NORMAL)
    else:
        tip = belt_outline(scene.path, float(scene.path.gear.grouser_height), reactions.place[k])
        for j in range(GROUSERS):
            force = reactions.grouser[k, j]
            x = _rotate([tip[j]], -q[2])[0, 0]
            arrow((x, -force * FORCE), (0.0, force), _NORMAL)
        arrow((-scene.axle / 2, 0.012), (0.0, reactions.guided[k].sum()), _GUIDE)
    arrow((0.0, -0.012), (signals.traction[k], 0.0), _TRACTION)
    arrow((0.0, -0.024), (-signals.resistance[k], 0.0), _RESISTANCE)
    down = _rotate([(0.0, -scene.weight)], -scene.slope)[0]
    arrow((0.0, q[1]), down, _WEIGHT)


_LEGEND = (
    ("normal reactions", _NORMAL),
    ("traction", _TRACTION),
    ("motion resistance", _RESISTANCE),
    ("load on the lower guide", _GUIDE),
    ("weight", _WEIGHT),
)


def check_picture(file: File, time: float, length: float) -> None:
    """Rejects a picture that `render` cannot draw of a run of `length` [s]. Called before a run, it reports errors
    early.

    Raises:
        ValueError: the suffix is not .png, or `time` is not within the run.
    """
    if file.suffix != ".png":
        raise ValueError(f"file: got {file.name}; expected a name that ends in .png")
    if not 0 <= time <= length:
        raise ValueError(f"time: got {time:g} s; expected a time within the run, 0 to {length:g} s")


def render(scene: RunScene, file: str | File, time: float = 0.0) -> File:
    """Writes a picture (.png) of a scene at a time [s].

    Raises:
        ValueError: as for `check_picture`.
    """
    file = File(file)
    check_picture(file, time, float(scene.run.time[-1]))
    import matplotlib

    with matplotlib.rc_context():
        matplotlib.rcdefaults()  # a file matplotlibrc of the working folder could run LaTeX
        scene.sheet(int(np.argmin(np.abs(scene.run.time - time)))).savefig(file)
    return file
