"""Figures of the components: gearbox (Fig. 5a), battery (Fig. 10), motor (Fig. 11), idling track (Fig. 18)."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from mmrjax.model.paper_tables import TRACKED, WHEELED
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
    label_line_end,
    new_figure,
)
from sweeps.pages.words import displayed_robot_name
from sweeps.paper import data

CONFIGURATION = {TRACKED: BLUE, WHEELED: VERMILION}
MODEL = {"nominal": BLUE, "sm1": ORANGE, "sm2": GREEN}


#: No-load speed [rpm] and current [A] in the maker's sheet of RE30 310007.
SHEET_NO_LOAD = (8810.0, 0.165)
_GEAR_SPEEDS = {"15 V": 5000.0, "33 V": 11_500.0}  # approximate motor speeds of the measured rows


def draw_gearbox_efficiency(robots: dict[str, Robot], rows: data.PaperRows | None) -> Figure:
    """Fig. 5a: efficiency over output torque. The first robot at two speeds, the others if they differ."""
    fig, grid = new_figure(1, 1, 3.9)
    axes = grid[0, 0]
    name, robot = next(iter(robots.items()))
    colour = MODEL.get(name, PURPLE)
    torques = [2.0] if rows is None else [2.0, *_gear_torque(robot, rows)]
    top = 1.25 * float(np.nanmax(torques))
    for (volts, speed), line in zip(_GEAR_SPEEDS.items(), ("-", "--"), strict=True):
        idle = float(robot.gearbox.torque_idle(speed * data.RPM, 1.0))
        inputs = idle + np.geomspace(1e-5, top / float(robot.gearbox.ratio * robot.gearbox.efficiency_load), 300)
        torque, efficiency = data.gear_efficiency(robot, speed, inputs)
        axes.plot(torque, efficiency, line, color=colour)
        place = int(np.searchsorted(torque, 0.18 * top))
        words = f"{displayed_robot_name(name)}, {speed:,.0f} rpm (about {volts})"
        offset = (-4, 6) if volts == "15 V" else (8, -14)
        ha = "right" if volts == "15 V" else "left"
        if volts == "15 V":
            axes.annotate(
                words,
                (torque[place], efficiency[place]),
                xytext=(40, 26),
                textcoords="offset points",
                color=colour,
                fontsize=8.5,
                arrowprops={"arrowstyle": "-", "color": colour, "lw": 0.8},
            )
        else:
            axes.annotate(
                words,
                (torque[place], efficiency[place]),
                xytext=offset,
                textcoords="offset points",
                color=colour,
                fontsize=8.5,
                ha=ha,
            )
    limit = float(robot.gearbox.efficiency_load)
    axes.axhline(limit, color=FAINT, lw=0.9, ls=":", label=f"limit at high load $\\eta_{{rm}}$ = {limit:.2f}")
    for other, model in robots.items():
        if other in ("sm1", "sm2") and other != name:
            constant = float(model.gearbox.efficiency_load)
            axes.axhline(constant, color=MODEL["sm1"], lw=1.6)
            axes.text(
                top,
                constant + 0.008,
                f"SM-1 and SM-2: constant {constant:.2f}",
                color=MODEL["sm1"],
                fontsize=8.5,
                ha="right",
                va="bottom",
            )
            break
    if rows is not None:
        _mark_rows(axes, robot, rows)
    axes.legend(loc="lower right")
    axes.set(xlabel="torque at the gearbox output, one side [N·m]", ylabel=r"efficiency $\eta_r$ [-]", ylim=(0, 0.9))
    axes.set_xlim(0, top)
    return fig


def _gear_torque(robot: Robot, rows: data.PaperRows) -> np.ndarray:
    table = rows.raised
    wheels = table["theoretical_speed_mm_s"] * data.MM
    radius = np.array([float(robot.configurations[str(c)].radius) for c in _kind(rows)])
    with np.errstate(divide="ignore", invalid="ignore"):
        return table["power_gear_W"] / robot.sides / (wheels / radius)


def _kind(rows: data.PaperRows) -> np.ndarray:
    return rows.conditions["configuration"]


def _mark_rows(axes: Axes, robot: Robot, rows: data.PaperRows) -> None:
    torque = _gear_torque(robot, rows)
    with np.errstate(divide="ignore", invalid="ignore"):
        efficiency = rows.raised["power_gear_W"] / rows.raised["power_motor_W"]
    for kind in rows.ratio:
        pick = (_kind(rows) == kind) & np.isfinite(torque)
        axes.plot(
            torque[pick],
            efficiency[pick],
            "o" if kind == TRACKED else "s",
            ms=5,
            mec="white",
            color=CONFIGURATION[kind],
            label=f"the measured conditions, {kind}",
        )


def draw_battery(robots: dict[str, Robot]) -> Figure:
    """Fig. 10: cell voltage over load current (a), no-load voltage (b) with the capacity."""
    from mmrjax.model.paper_tables import COULOMB_PER_MAH

    fig, grid = new_figure(1, 2, 3.7)
    name, robot = next(iter(robots.items()))
    colour = MODEL.get(name, PURPLE)
    capacity = float(robot.battery.capacity) / COULOMB_PER_MAH
    current = np.linspace(0, 12, 50)
    left, right = grid[0]
    for share, line in ((0.0, "-"), (0.5, "--"), (1.0, ":")):
        voltage = data.cell_voltage(robot, current, share * capacity)
        left.plot(current, voltage, line, color=colour)
        words = {0.0: "full", 0.5: "half discharged", 1.0: "at capacity"}[share]
        label_line_end(left, current, voltage, words, colour)
    constant = [m for m in ("sm1", "sm2") if m in robots]
    if constant:
        constant_voltage = data.cell_voltage(robots[constant[0]], current, 0.0)
        left.plot(current, constant_voltage, color=MODEL["sm1"])
        left.text(
            11.9, constant_voltage[-1] + 0.02, "SM-1, SM-2: constant", color=MODEL["sm1"], fontsize=8.5, ha="right"
        )
    left.set(xlabel="load current $I_b$ [A]", ylabel="cell voltage [V]", xlim=(0, 12))
    left.set_title(f"a) cell under load: R = {float(robot.battery.resistance) * 1e3:.0f} mΩ a cell")
    left.set_ylim(top=4.35)

    charge = np.linspace(0, 1.9 * capacity, 200)
    volts = data.cell_no_load(robot, charge)
    inside = charge <= capacity
    right.plot(charge[inside], volts[inside], color=colour)
    right.plot(charge[~inside], volts[~inside], color=FAINT, ls="--", lw=1.2)
    right.axvline(capacity, color=INK, lw=1)
    right.axvspan(capacity, charge[-1], color="#f0f0f0", zorder=0)
    low = int(np.argmin(volts))
    right.text(capacity * 0.97, volts.max(), f"capacity {capacity:.0f} mAh", ha="right", va="top", fontsize=8.5)
    if 0 < low < len(charge) - 1:
        right.plot(charge[low], volts[low], "v", color=FAINT)
        right.annotate(
            f"parabola (13) turns up\nat {charge[low]:.0f} mAh",
            (charge[low], volts[low]),
            xytext=(-2, 26),
            textcoords="offset points",
            fontsize=8.5,
            color=INK,
            ha="center",
        )
    right.text(1.03 * capacity, volts.max(), "beyond: status battery_empty", fontsize=8.5, color=INK, va="top")
    right.set(xlabel="discharge $C_b$ [mAh]", ylabel="no-load cell voltage [V]", xlim=(0, charge[-1]))
    right.set_title("b) no-load voltage")
    return fig


def draw_motor_friction(robots: dict[str, Robot]) -> Figure:
    """Fig. 11: motor friction torque over speed, with the maker's no-load point."""
    fig, grid = new_figure(1, 1, 3.4)
    axes = grid[0, 0]
    speed = np.linspace(0, 12_500, 60)
    drawn_curves: set[bytes] = set()
    for name, robot in robots.items():
        torque = data.motor_friction(robot, speed)
        if torque.tobytes() in drawn_curves:
            continue
        drawn_curves.add(torque.tobytes())
        colour = MODEL.get(name, PURPLE)
        axes.plot(speed, torque, color=colour)
        words = "SM-1, SM-2 (constant)" if name in ("sm1", "sm2") else displayed_robot_name(name)
        label_line_end(axes, speed, torque, words, colour)
    first_robot = next(iter(robots.values()))
    rpm, current = SHEET_NO_LOAD
    sheet = 1e3 * current * float(first_robot.motor.torque_constant)
    axes.plot(rpm, sheet, "D", color=INK, ms=6)
    axes.annotate(
        f"maker's sheet, no load at 24 V:\n{rpm:.0f} rpm, {current * 1e3:.0f} mA, so {sheet:.2f} mN·m",
        (rpm, sheet),
        xytext=(-10, 14),
        textcoords="offset points",
        fontsize=8.5,
        ha="right",
    )
    limit = float(first_robot.motor.speed_limit) / data.RPM
    axes.axvline(limit, color=FAINT, lw=1, ls=":")
    axes.text(limit - 60, 0.15, f"permissible {limit:,.0f} rpm", color=INK, fontsize=8.5, ha="right")
    axes.set(xlabel="motor speed [rpm]", ylabel=r"friction torque $M_{df}$ [mN·m]", xlim=(0, 12_500), ylim=(0, 5.4))
    return fig


def draw_idle_track(robots: dict[str, Robot]) -> Figure:
    """Fig. 18: current of one motor that turns a lifted side, over pulley speed, and R² of a straight line."""
    fig, grid = new_figure(1, 1, 3.6)
    axes = grid[0, 0]
    name, robot = next(iter(robots.items()))
    speed = np.linspace(0.5, 26.0, 60)
    labels = {TRACKED: "three tracks a side", WHEELED: "one track a side"}
    for kind in data.shown_configurations(robot):
        words = f"{labels[kind]} ({kind})" if kind in labels else kind
        current = data.idle_current(robot, kind, speed)
        line, certainty = data.fit_line(speed, current)
        colour = CONFIGURATION.get(kind, PURPLE)
        axes.plot(speed[::4], current[::4], "o", color=colour, ms=4)
        axes.plot(speed, line, color=colour)
        label_line_end(axes, speed, line, f"{words}\nline: R² = {certainty:.4f}", colour)
        for other in ("sm1", "sm2"):
            if other in robots and other != name and kind == TRACKED:
                constant_current = data.idle_current(robots[other], kind, speed)
                axes.plot(speed, constant_current, color=MODEL[other], lw=1.4)
                label_line_end(
                    axes, speed, constant_current, f"{displayed_robot_name(other)}, three tracks", MODEL[other]
                )
    axes.set(xlabel="pulley speed [rad/s]", ylabel="current of one motor [A]", xlim=(0, 26))
    axes.set_ylim(bottom=0)
    add_corner_note(axes, f"dots: {displayed_robot_name(name)}, lines: straight fits")
    return fig
