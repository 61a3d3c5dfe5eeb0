"""Figures of a turn: the path from above, the course over time, and what other turns take."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from calibration.data import Columns, Json
from mmrjax.model.robot import Robot
from sweeps.pages.figure_style import BLUE, FAINT, INK, VERMILION, new_figure

SIDES = (("left", BLUE), ("right", VERMILION))
#: A path bends by no more between two points that are drawn [rad].
BEND = 0.05


def _draw_outline(axes: Axes, robot: Robot, row: Json, x: float, y: float, yaw: float, color: str) -> None:
    """The robot from above: its contact lines, a bar between them and an arrow pointing ahead."""
    length = float(robot.running_gear.wheelbase)
    width = float(robot.configurations[str(row["configuration"])].turning.width)
    ahead, sideways = np.array([np.cos(yaw), np.sin(yaw)]), np.array([-np.sin(yaw), np.cos(yaw)])
    middle = np.array([x, y])
    for side in (0.5, -0.5):
        ends = [middle + side * width * sideways + s * length * ahead for s in (0.5, -0.5)]
        axes.plot([-e[1] for e in ends], [e[0] for e in ends], color=color, lw=3.5, solid_capstyle="round")
    tip = middle + 0.5 * length * ahead
    axes.annotate("", (-tip[1], tip[0]), (-y, x), arrowprops={"arrowstyle": "-|>", "color": color})


def _set_plan_axes(axes: Axes) -> None:
    axes.set_aspect("equal", adjustable="datalim")
    axes.set_xlabel("to the right of the start [m]", color=INK)
    axes.set_ylabel("uphill of the start, or ahead of it [m]", color=INK)


def path_arcs(
    x: np.ndarray, y: np.ndarray, yaw: np.ndarray
) -> tuple[Float[np.ndarray, " points"], Float[np.ndarray, " points"]]:
    """A path between places, each stretch at a speed and yaw rate of its own: an arc. Steps of a run may be long.

    Args:
        x, y: places [m].
        yaw: there, counted on over a turn [rad], shape (rows,).
    """
    place, yaw_changes = x + 1j * y, np.diff(yaw)
    pieces = np.ceil(np.abs(yaw_changes) / BEND).clip(1, 100).astype(int)
    k = np.repeat(np.arange(len(pieces)), pieces)
    share = (np.arange(len(k)) - np.repeat(np.cumsum(pieces) - pieces, pieces)) / pieces[k]
    bent = np.where(pieces[k] > 1, yaw_changes[k], BEND)  # else share is 0 and any will do
    between = place[k] + np.diff(place)[k] * np.expm1(1j * share * bent) / np.expm1(1j * bent)
    path_points = np.append(between, place[-1])
    return path_points.real, path_points.imag


def draw_path(robot: Robot, row: Json, x: np.ndarray, y: np.ndarray, yaw: np.ndarray) -> Figure:
    """The path of a run over time from above, with the robot at its start, at its end and in between."""
    finite = np.isfinite(x)
    x, y, yaw = x[finite], y[finite], yaw[finite]
    fig, grid = new_figure(1, 1, 4.6)
    axes = grid[0, 0]
    ahead, aside = path_arcs(x, y, yaw)
    axes.plot(-aside, ahead, color=BLUE)
    for k, color in ((0, FAINT), (len(x) // 2, FAINT), (len(x) - 1, INK)):
        _draw_outline(axes, robot, row, x[k], y[k], yaw[k], color)
    _set_plan_axes(axes)
    return fig


def draw_yaw_rates(turns: Columns, row: Json) -> Figure:
    """Currents of both sides and power over the yaw rate of settled turns. The requested turn is marked."""
    fig, grid = new_figure(1, 2, 3.4)

    def rate(motion: Json) -> np.ndarray:
        # On the spot the curvature is without limit, the yaw rate is not.
        return np.asarray(motion["yaw_rate_rad_s"], float)

    other_turns = {name: np.asarray(values)[1:] for name, values in turns.items()}
    order = np.argsort(rate(other_turns))
    for side, color in SIDES:
        column = f"motor_current_{side}_A"
        grid[0, 0].plot(rate(other_turns)[order], other_turns[column][order], color=color, label=side)
        grid[0, 0].plot(rate(row), float(row[column]), marker="o", color=color, ls="none")
    grid[0, 0].set_ylabel("current of a motor [A]", color=INK)
    grid[0, 0].legend()
    grid[0, 1].plot(rate(other_turns)[order], other_turns["power_supply_W"][order], color=INK)
    grid[0, 1].plot(rate(row), float(row["power_supply_W"]), marker="o", color=INK, ls="none")
    grid[0, 1].set_ylabel("power of the supply [W]", color=INK)
    for axes in grid[0]:
        axes.axhline(0, color=FAINT, lw=0.8)
        axes.set_xlabel("yaw rate, positive to the left [rad/s]", color=INK)
    return fig
