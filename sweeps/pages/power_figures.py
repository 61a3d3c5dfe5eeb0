"""Figures of the power of runs from the supply to the slope, and the chart of motor and gear."""

from __future__ import annotations

import itertools
from collections.abc import Mapping

import numpy as np
from matplotlib.figure import Figure

from calibration.data import Columns
from mmrjax.model.robot import Robot
from sweeps.export.joint import UNLIMITED
from sweeps.pages.figure_style import BLUE, FAINT, GREEN, INK, ORANGE, PURPLE, SKY, new_figure, outer_legend

#: Uses of power and their colours: losses in the order of the drivetrain, then useful power.
ITEMS = {
    "winding and motor friction": ORANGE,
    "gearbox": PURPLE,
    "track and slip": BLUE,
    "rolling resistance": SKY,
    "lift": GREEN,
    "back to the supply": INK,
}
_DARK = (PURPLE, BLUE, GREEN, INK)


def power_by_item(runs: Columns) -> Columns:
    """Power [W] of each item in every run, from the powers in `runs.csv`. If a run has not settled, rolling
    resistance includes the acceleration.
    """
    chain = [runs[f"power_{place}_W"] for place in ("supply", "motor", "gear", "ground", "lift")]
    losses = [power_in - power_out for power_in, power_out in itertools.pairwise(chain)]
    useful_powers = [np.maximum(chain[-1], 0.0), np.maximum(-chain[0], 0.0)]
    return dict(zip(ITEMS, [*losses, *useful_powers], strict=True))


def power_sources(runs: Columns) -> tuple[np.ndarray, np.ndarray]:
    """Power [W] from the supply, and from the slope in runs downhill."""
    return np.maximum(runs["power_supply_W"], 0.0), np.maximum(-runs["power_lift_W"], 0.0)


def drawable_runs(runs: Columns) -> np.ndarray:
    """Mask of runs with numbers and without negative losses."""
    parts = np.stack(list(power_by_item(runs).values()))
    supplied_power = sum(power_sources(runs))
    return (
        np.isfinite(parts).all(0) & (parts >= -1e-6 * np.maximum(supplied_power, 1.0)).all(0) & (supplied_power > 0)
    )


#: Name of an item if the load is a shaft, which receives all output power of the gearboxes.
ON_SHAFT = {"track and slip": "load"}


def draw_power_chain(runs: Columns, names: list[str], has_ground: bool = True) -> Figure:
    """One bar for each run [W], from the motor's losses to the power that lifts the robot or that the load takes."""
    fig, ((axes,),) = new_figure(1, 1, 1.15 + 0.42 * len(names))
    supply, slope = power_sources(runs)
    total = supply + slope
    bar_positions = np.arange(len(names))
    bar_starts = np.zeros(len(names))
    for item, power in power_by_item(runs).items():
        if power.max() > 1e-6:
            power = np.maximum(power, 0.0)
            colour = ITEMS[item]
            label = item if has_ground else ON_SHAFT.get(item, item)
            bars = axes.barh(
                bar_positions, power, left=bar_starts, height=0.7, color=colour, label=label, ec="white", lw=0.6
            )
            bar_labels = [f"{width:.1f}" if width >= 0.04 * total.max() else "" for width in power]
            axes.bar_label(bars, bar_labels, label_type="center", color="white" if colour in _DARK else "black")
            bar_starts = bar_starts + power
    for y, (from_supply, from_slope) in enumerate(zip(supply, slope, strict=True)):
        text = f"{from_supply:.1f} W" + (f" + {from_slope:.1f} W from the slope" if from_slope > 1e-6 else "")
        axes.text(from_supply + from_slope, y, f"  {text}", va="center")
    axes.set_yticks(bar_positions, names)
    axes.invert_yaxis()
    axes.grid(False)
    axis_factor = 1.35 if (slope > 1e-6).any() else 1.1
    axes.set(xlabel="power [W]", xlim=(0, axis_factor * float(total.max())))
    outer_legend(axes, "upper center")
    return fig


def draw_drive_chart(robot: Robot, curves: Mapping[float, Columns], points: Columns | None) -> Figure:
    """Speed, current and efficiency of one motor and gear over the torque at the output.

    Shaded areas are torques up to the winding's continuous current, and up to the driver's current limit.

    Args:
        curves: curves of `run_tables.drive_curves` by voltage, the highest first.
    """
    fig, (panels,) = new_figure(1, 3, 3.0, sharex=True)
    labels = {
        "motor_rpm": "motor speed [rpm]", "motor_A": "current of one motor [A]",
        "efficiency_percent": "efficiency [%]",
    }  # fmt: skip
    limit = float(robot.driver.current_limit)
    largest_torque = 0.0
    for (voltage, curve), style in zip(curves.items(), ("-", "--", ":"), strict=False):
        torque = curve["torque_Nm"]
        if torque.size < 2:
            continue
        if not largest_torque:
            continuous = float(np.interp(float(robot.motor.current_continuous), curve["motor_A"], torque))
            reached = 0.0 if points is None else np.nanmax(points["torque_Nm"], initial=0.0)
            largest_torque = min(max(2.5 * continuous, 1.2 * reached), torque[-1])
            continuous = min(continuous, largest_torque)
            for axes in panels:
                axes.axvspan(0, continuous, color=GREEN, alpha=0.18, lw=0, label="continuous")
                axes.axvspan(continuous, largest_torque, color=ORANGE, alpha=0.12, lw=0, label="short time")
                axes.set_xlim(0, largest_torque)
        is_shown = torque <= largest_torque
        for axes, (name, label) in zip(panels, labels.items(), strict=True):
            axes.plot(torque[is_shown], curve[name][is_shown], style, color=BLUE, label=f"{voltage:.3g} V")
            axes.set(xlabel="torque at the gearbox output [N·m]", ylabel=label)
            axes.set_ylim(bottom=0)
    if points is not None:
        for axes, name in zip(panels, ("motor_rpm", "motor_A"), strict=False):
            axes.plot(points["torque_Nm"], points[name], "o", ms=5, color=INK, label="operating points")
    if limit < UNLIMITED:
        panels[1].axhline(limit, color=ORANGE, lw=1, label="driver's limit")
    outer_legend(panels[1], "upper left")
    return fig


#: Efficiencies of the lines in the plane of drive and back-drive.
EFFICIENCIES = (0.9, 0.75, 0.5)


def draw_drive_plane(plane: Columns, points: Columns) -> Figure:
    """Torque of the motor against that of the load, and the efficiency of the gearbox each way.

    Args:
        plane: torque of the load, and of the motor that runs forward and backward.
        points: torques of the load and of the motor in measured runs.
    """
    load, forward, backward = plane["load"], plane["forward"], plane["backward"]
    largest_load = load[-1]
    fig, ((axes, efficiency_axes),) = new_figure(1, 2, 3.6)
    axes.fill_between(load, backward, forward, color="#e3e3e3", lw=0, label="at rest, friction holds the load")
    for efficiency in EFFICIENCIES:
        axes.plot(
            [-largest_load, 0, largest_load],
            [-largest_load * efficiency, 0, largest_load / efficiency],
            ":",
            color=FAINT,
            lw=1,
        )
        axes.annotate(f"{100 * efficiency:.0f} %", (largest_load, largest_load / efficiency), (2, 0),
                      textcoords="offset points", va="center", annotation_clip=False)  # fmt: skip
    axes.plot(load, load, "--", color=FAINT, lw=1, label="without losses")
    axes.plot(load, forward, color=BLUE, label="runs forward")
    axes.plot(load, backward, color=ORANGE, label="runs backward")
    axes.plot(points["load"], points["motor"], "o", ms=4, color=INK, label="measured")
    label = "torque of the load [N·m]"
    axes.set(
        xlabel=label,
        ylabel="motor torque × ratio [N·m]",
        title="drive and back-drive",
        xlim=(-largest_load, largest_load),
    )
    is_driving = load > 0
    is_driven = load < 0
    efficiency_axes.plot(
        load[is_driving], 100 * load[is_driving] / forward[is_driving], color=BLUE, label="motor drives the load"
    )
    returned = 100 * np.maximum(forward[is_driven] / load[is_driven], 0)
    efficiency_axes.plot(-load[is_driven], returned, "--", color=BLUE, label="load drives the motor")
    efficiency_axes.set(xlabel=label, ylabel="efficiency [%]", ylim=(0, 103), title="efficiency each way")
    efficiency_axes.legend(loc="lower right")
    outer_legend(axes, "upper left")
    return fig
