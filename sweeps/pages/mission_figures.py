"""Figures of missions and turns: readings over time, both sides, the path, and current and power of other turns."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from scipy.integrate import cumulative_trapezoid

from calibration.data import Columns, Json
from mmrjax.model.channels import SIDES
from mmrjax.model.robot import Robot
from sweeps.pages.figure_style import (
    BLUE,
    FAINT,
    GREEN,
    INK,
    ORANGE,
    PURPLE,
    VERMILION,
    add_corner_note,
    new_figure,
)

_SIDE_COLOURS = (("left", BLUE), ("right", VERMILION))


def _time_unit(seconds: float) -> tuple[float, str]:
    """Unit of a time axis of this length: its size [s] and name."""
    return (3600.0, "h") if seconds >= 7200 else (60.0, "min") if seconds >= 600 else (1.0, "s")


def draw_mission_course(rows: Columns, cycle: float | None, limit: float, linear: bool, sides: float) -> Figure:
    """A run over its profile, one row for each subject. With several cycles, the first one is also drawn.

    Args:
        rows: rows of history.csv of one run.
        cycle: end of the first cycle [s]. None if there is only one.
        limit: limit of the winding's temperature [°C].
        linear: True if the profile is linear between rows.
        sides: number of motors.
    """
    spans = {"the mission": float(rows["time_s"][-1])} | ({} if cycle is None else {"its first cycle": cycle})
    fig, grid = new_figure(4, len(spans), 9.6, width_ratios=[1.5, 1.0][: len(spans)], sharex="col")
    for (speed_axes, current_axes, temperature_axes, source_axes), (title, span) in zip(
        grid.T, spans.items(), strict=True
    ):
        unit_seconds, unit = _time_unit(span)
        shown_rows = {key: value[rows["time_s"] <= span] for key, value in rows.items()}
        time = shown_rows["time_s"] / unit_seconds
        speed_axes.set_title(f"{title}: speed" + (" and slope" if np.any(rows.get("slope_deg", 0.0)) else ""))
        _draw_speed(speed_axes, time, shown_rows, linear)
        current_axes.set_title(f"current of all motors, and duty{', sizes' if 'duty_left' in rows else ''}")
        _draw_current(current_axes, time, shown_rows, sides)
        temperature_axes.set_title("temperatures")
        _draw_temperatures(temperature_axes, time, shown_rows, limit)
        _draw_source(source_axes, time, shown_rows)
        source_axes.set(xlabel=f"time [{unit}]", xlim=(0, span / unit_seconds))
    return fig


def draw_sides(rows: Columns) -> Figure:
    """Current of each side, its duty or motor speed, and the yaw rate, over time.

    Args:
        rows: rows of history.csv of one run with sides.
    """
    fig, ((current_axes,), (drive_axes,), (yaw_axes,)) = new_figure(3, 1, 6.4, sharex=True)
    unit_seconds, unit = _time_unit(float(rows["time_s"][-1]))
    time = rows["time_s"] / unit_seconds
    column, factor, label = ("duty_{}", 100.0, "duty [%]") if "duty_left" in rows else (
        "motor_speed_{}_rpm", 1.0, "motor speed [rpm]"
    )  # fmt: skip
    limit = 0.1
    for side, colour in _SIDE_COLOURS:
        current = rows[f"motor_current_{side}_A"]
        current_axes.plot(time, current, color=colour, lw=1.0, label=side)
        drive_axes.plot(time, factor * rows[column.format(side)], color=colour, lw=1.0)
        limit = max(limit, float(np.nanmax(np.abs(current[time > 0.1 * time[-1]]), initial=0.0)))
    yaw_axes.plot(time, rows["yaw_rate_rad_s"], color=INK, lw=1.2)
    low, high = current_axes.get_ylim()
    current_axes.set(ylabel="current of a motor [A]", ylim=(max(low, -2.5 * limit), min(high, 2.5 * limit)))
    current_axes.legend(ncols=2)
    drive_axes.set_ylabel(label)
    yaw_axes.set(ylabel="yaw rate [rad/s]", xlabel=f"time [{unit}]", xlim=(0, time[-1]))
    return fig


def _right_axes(axes: Axes, label: str, colour: str) -> Axes:
    """Axes with their own scale at the right."""
    right = axes.twinx()
    right.grid(False)
    right.spines["right"].set_visible(True)
    right.tick_params(axis="y", colors=colour)
    right.set_ylabel(label, color=colour)
    return right


def _draw_legend(axes: Axes, *others: Axes) -> None:
    handles = [h for a in (axes, *others) for h in a.get_legend_handles_labels()[0]]
    axes.legend(handles=handles, loc="upper center", ncols=len(handles))
    low, high = axes.get_ylim()
    axes.set_ylim(low, high + 0.22 * (high - low))  # room for the label


#: Reversals above which a curve is drawn as its envelope, and number of time parts of the envelope: so few that it
#: has no gaps.
REVERSALS, ENVELOPE_PARTS = 200, 40


def _draw_curve(
    axes: Axes, time: np.ndarray, values: np.ndarray, colour: str, label: str, width: float = 1.0
) -> None:
    """A curve over time, or its range and mean in each part of the time if many cycles would fill the panel."""
    if np.count_nonzero(np.diff(np.sign(np.diff(values)))) <= REVERSALS:
        axes.plot(time, values, color=colour, lw=width, label=label)
        return
    parts = np.array_split(np.arange(len(time)), ENVELOPE_PARTS)
    ends = np.linspace(time[0], time[-1], ENVELOPE_PARTS + 1)
    means = np.diff(np.interp(ends, time, cumulative_trapezoid(values, time, initial=0))) / np.diff(ends)
    least, greatest = ([extreme(values[rows]) for rows in parts] for extreme in (np.min, np.max))
    middle = [time[rows].mean() for rows in parts]
    axes.fill_between(middle, least, greatest, color=colour, alpha=0.15, lw=0)
    axes.plot((ends[1:] + ends[:-1]) / 2, means, color=colour, lw=width, label=label)


def _draw_speed(axes: Axes, time: np.ndarray, rows: Columns, linear: bool) -> None:
    is_shaft = "demanded_motor_speed_rpm" in rows  # a shaft's
    speed = rows["motor_speed_rpm"] if is_shaft else rows.get("speed_mm_s", rows["theoretical_speed_mm_s"])
    _draw_curve(axes, time, speed, BLUE, "speed", 1.4)
    demanded = rows["demanded_motor_speed_rpm" if is_shaft else "demanded_speed_mm_s"]
    if np.isfinite(demanded).any() and np.count_nonzero(np.diff(np.sign(np.diff(demanded)))) <= REVERSALS:
        axes.plot(time, demanded, color=INK, lw=0.9, ls=(0, (4, 2)), label="demanded")
    axes.set_ylabel("motor speed [rpm]" if is_shaft else "speed [mm/s]")
    if is_shaft or not np.any(rows["slope_deg"]):
        add_corner_note(
            axes, "" if is_shaft else "level ground", x=0.98, y=0.04, va="bottom", ha="right", color=FAINT
        )
        _draw_legend(axes)
        return
    slope_axes = _right_axes(axes, "slope [°]", GREEN)
    style = "default" if linear else "steps-post"
    slope_axes.plot(time, rows["slope_deg"], color=GREEN, lw=1.0, label="slope", drawstyle=style)
    largest_slope = max(1.0, 1.3 * float(np.max(np.abs(rows["slope_deg"]))))
    slope_axes.set_ylim(-largest_slope, largest_slope)
    _draw_legend(axes, slope_axes)


def _draw_current(axes: Axes, time: np.ndarray, rows: Columns, sides: float) -> None:
    current = sides * mean_of_motors(rows, "motor_current", "_A")
    duty = mean_of_motors(rows, "duty", "")
    _draw_curve(axes, time, current, VERMILION, "current")
    peak_row = int(np.argmax(np.abs(current)))
    axes.plot(
        time[peak_row],
        current[peak_row],
        marker="o",
        ms=4,
        color=INK,
        ls="none",
        label=f"peak {current[peak_row]:.2f} A",
    )
    axes.set_ylabel("current [A]")
    duty_axes = _right_axes(axes, "duty [%]", PURPLE)
    _draw_curve(duty_axes, time, 100 * duty, PURPLE, "duty", 0.9)
    duty_axes.set_ylim(-110 if (duty < 0).any() else 0, 110)
    _draw_legend(axes, duty_axes)


def mean_of_motors(rows: Columns, name: str, unit: str) -> np.ndarray:
    """Mean over motors. For two sides, which cancel each other when turning on the spot, mean of the magnitudes."""
    of_sides = [np.abs(rows[f"{name}_{side}{unit}"]) for side in SIDES if f"{name}_{side}{unit}" in rows]
    return np.asarray(np.mean(of_sides, axis=0) if of_sides else rows[f"{name}{unit}"])


def _draw_temperatures(axes: Axes, time: np.ndarray, rows: Columns, limit: float) -> None:
    if "housing_temperature_C" not in rows:
        add_corner_note(axes, "not computed: the robot's file lacks\nthe thermal resistance of the windings")
        axes.set_yticks([])
        return
    winding, housing = rows["winding_temperature_C"], rows["housing_temperature_C"]
    _draw_curve(axes, time, winding, VERMILION, "winding", 1.4)
    axes.plot(time, housing, color=ORANGE, lw=1.4, label="housing")
    top, bottom = float(np.max(winding)), float(np.min(housing))
    if top > 0.6 * limit:  # a far limit would flatten the curve
        axes.axhline(limit, color=INK, lw=1.0, ls="--", label=f"limit {limit:.0f} °C")
        axes.set_ylim(bottom - 2, 1.1 * max(top, limit))
    else:
        axes.set_ylim(bottom - 0.5, top + max(1.0, 0.3 * (top - bottom)))
    axes.set_ylabel("temperature [°C]")
    _draw_legend(axes)


def _draw_source(axes: Axes, time: np.ndarray, rows: Columns) -> None:
    charge, volts = rows["state_of_charge"], rows["source_voltage_V"]
    if not np.isfinite(charge).any():
        axes.plot(time, volts, color=BLUE, lw=1.3)
        axes.set(title="voltage of the supply", ylabel="voltage [V]")
        return
    axes.set_title("state of charge, and voltage of the battery")
    axes.plot(time, 100 * charge, color=GREEN, lw=1.8)
    axes.set_ylabel("charge [%]", color=GREEN)
    if np.ptp(charge) > 0.05:
        axes.set_ylim(0, 105)
    _draw_curve(_right_axes(axes, "voltage [V]", BLUE), time, volts, BLUE, "voltage", 0.8)
    for k in np.flatnonzero(rows["event"] == "below_cut_off")[-1:]:
        axes.axvline(time[k], color=VERMILION, lw=1.0, ls="--")
        add_corner_note(axes, "broken line: cells fall below their cut-off", y=0.06, va="bottom", color=FAINT)


#: Largest change of yaw between two drawn points of a path [rad].
BEND = 0.05


def _draw_outline(axes: Axes, robot: Robot, row: Json, position: complex, yaw: float, colour: str) -> None:
    """Draws the robot from above: contact lines and an arrow ahead. `position`: ahead + i · left [m]."""
    length = float(robot.running_gear.wheelbase)
    width = float(robot.configurations[str(row["configuration"])].turning.width)
    ahead = np.exp(1j * yaw)
    for side in (0.5j, -0.5j):
        line_ends = position + ahead * (side * width + length * np.array([0.5, -0.5]))
        axes.plot(-line_ends.imag, line_ends.real, color=colour, lw=3.5, solid_capstyle="round")
    tip = position + 0.5 * length * ahead
    arrow = {"arrowstyle": "-|>", "color": colour}
    axes.annotate("", (-tip.imag, tip.real), (-position.imag, position.real), arrowprops=arrow)


def path_arcs(
    x: np.ndarray, y: np.ndarray, yaw: np.ndarray
) -> tuple[Float[np.ndarray, " points"], Float[np.ndarray, " points"]]:
    """Points of a path of circular arcs through given positions. Steps of a run may be too long for straight lines.

    Args:
        x, y: positions [m].
        yaw: yaw at the positions, not wrapped at a full turn [rad], shape (rows,).
    """
    position = x + 1j * y
    yaw_changes = np.diff(yaw)
    piece_counts = np.ceil(np.abs(yaw_changes) / BEND).clip(1, 100).astype(int)
    piece = np.repeat(np.arange(len(piece_counts)), piece_counts)
    share = (np.arange(len(piece)) - np.repeat(np.cumsum(piece_counts) - piece_counts, piece_counts)) / piece_counts[
        piece
    ]
    bend = np.where(piece_counts[piece] > 1, yaw_changes[piece], BEND)  # else share is 0 and any will do
    between = position[piece] + np.diff(position)[piece] * np.expm1(1j * share * bend) / np.expm1(1j * bend)
    path_points = np.append(between, position[-1])
    return path_points.real, path_points.imag


def draw_path(robot: Robot, row: Json, x: np.ndarray, y: np.ndarray, yaw: np.ndarray) -> Figure:
    """The path of a run over time from above, with the robot at its start, at its end and in between."""
    finite = np.isfinite(x)
    x, y, yaw = x[finite], y[finite], yaw[finite]
    fig, ((axes,),) = new_figure(1, 1, 4.6)
    path_x, path_y = path_arcs(x, y, yaw)
    axes.plot(-path_y, path_x, color=BLUE)
    for k, colour in ((0, FAINT), (len(x) // 2, FAINT), (-1, INK)):
        _draw_outline(axes, robot, row, complex(x[k], y[k]), yaw[k], colour)
    axes.set_aspect("equal", adjustable="datalim")
    axes.set(xlabel="to the right of the start [m]", ylabel="uphill of the start, or ahead of it [m]")
    return fig


def draw_yaw_rates(turns: Columns, row: Json) -> Figure:
    """Currents of both sides and power over the yaw rate of settled turns. The requested turn is marked.

    The yaw rate is finite when a robot turns on the spot, unlike the curvature.
    """
    fig, ((current_axes, power_axes),) = new_figure(1, 2, 3.4)
    rate = np.asarray(turns["yaw_rate_rad_s"], float)
    order = 1 + np.argsort(rate[1:])  # the first is the requested turn
    lines = [(current_axes, f"motor_current_{side}_A", colour, side) for side, colour in _SIDE_COLOURS]
    for axes, column, colour, label in (*lines, (power_axes, "power_supply_W", INK, None)):
        axes.plot(rate[order], np.asarray(turns[column])[order], color=colour, label=label)
        axes.plot(float(row["yaw_rate_rad_s"]), float(row[column]), "o", color=colour)
    current_axes.legend()
    for axes, label in ((current_axes, "current of a motor [A]"), (power_axes, "power of the supply [W]")):
        axes.axhline(0, color=FAINT, lw=0.8)
        axes.set(xlabel="yaw rate, positive to the left [rad/s]", ylabel=label)
    return fig
