"""Figures of the components: gearbox (Fig. 5a), battery (Fig. 10), motor (Fig. 11), idling track (Fig. 18)."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from matplotlib.figure import Figure

from mmrjax.model.paper_tables import COULOMB_PER_MAH, TRACKED, WHEELED
from mmrjax.model.quantities import MM, RPM
from mmrjax.model.robot import Robot
from sweeps.pages.figure_style import BLUE, FAINT, GREEN, INK, ORANGE, PURPLE, VERMILION, new_figure
from sweeps.pages.words import displayed_robot_name
from sweeps.paper import data

CONFIGURATION = {TRACKED: BLUE, WHEELED: VERMILION}
MODEL = {"nominal": BLUE, "sm1": ORANGE, "sm2": GREEN}
#: Name of a robot with constant losses, and of both in legends.
CONSTANT, CONSTANTS = "sm2", "SM-1, SM-2 (constant)"
#: No-load speed [rpm] and current [A] in the maker's sheet of RE30 310007.
SHEET_NO_LOAD = (8810.0, 0.165)


def draw_gearbox_efficiency(robots: dict[str, Robot], rows: data.PaperRows | None) -> Figure:
    """Fig. 5a: efficiency (19) over output torque of the first robot at two speeds, with the measured conditions."""
    fig, grid = new_figure(1, 1, 3.9)
    axes = grid[0, 0]
    name, robot = next(iter(robots.items()))
    gear = robot.gearbox
    largest_torque = 2.5
    if rows is not None:
        configurations = rows.conditions["configuration"]
        table = rows.raised
        radius = np.array(
            [float(robot.configurations[str(configuration)].radius) for configuration in configurations]
        )
        with np.errstate(divide="ignore", invalid="ignore"):
            torque = table["power_gear_W"] / robot.sides / (table["theoretical_speed_mm_s"] * MM / radius)
            efficiency = table["power_gear_W"] / table["power_motor_W"]
        largest_torque = max(largest_torque, 1.25 * float(np.nanmax(torque)))
        for configuration in rows.ratio:
            marker = "o" if configuration == TRACKED else "s"
            label = f"the measured conditions, {configuration}"
            axes.plot(
                torque[configurations == configuration],
                efficiency[configurations == configuration],
                marker,
                ms=5,
                color=CONFIGURATION[configuration],
                label=label,
            )
    for volts, rpm, style in ((15, 5000.0, "-"), (33, 11_500.0, "--")):  # approximate speeds of the measured rows
        transmitted = jnp.geomspace(1e-5, largest_torque / float(gear.ratio * gear.efficiency_load), 300)
        efficiencies = gear.efficiency(transmitted + gear.torque_idle(rpm * RPM, 1.0), rpm * RPM)
        label = f"{displayed_robot_name(name)}, {rpm:,.0f} rpm (about {volts} V)"
        axes.plot(
            gear.torque_output(transmitted, 1.0), efficiencies, style, color=MODEL.get(name, PURPLE), label=label
        )
    limit = float(gear.efficiency_load)
    axes.axhline(limit, color=FAINT, lw=0.9, ls=":", label=f"limit at high load $\\eta_{{rm}}$ = {limit:.2f}")
    constant = float(robots[CONSTANT].gearbox.efficiency_load)
    axes.axhline(constant, color=MODEL["sm1"], lw=1.6, label=f"{CONSTANTS}: {constant:.2f}")
    axes.legend(loc="lower right")
    axes.set(xlabel="torque at the gearbox output, one side [N·m]", ylabel=r"efficiency $\eta_r$ [-]")
    axes.set(xlim=(0, largest_torque), ylim=(0, 0.9))
    return fig


def draw_battery(robots: dict[str, Robot]) -> Figure:
    """Fig. 10: cell voltage over load current I_b (12), and no-load voltage over discharge (13) with the capacity."""
    fig, grid = new_figure(1, 2, 3.7)
    name, robot = next(iter(robots.items()))
    colour = MODEL.get(name, PURPLE)
    battery = robot.battery
    current = jnp.linspace(0, 12, 50)
    left, right = grid[0]
    for charge_label, share, style in (("full", 0.0, "-"), ("half discharged", 0.5, "--"), ("at capacity", 1.0, ":")):
        volts = battery.voltage(current - battery.current_other, share * battery.capacity) / battery.cells
        left.plot(current, volts, style, color=colour, label=charge_label)
    constant_battery = robots[CONSTANT].battery
    volts = constant_battery.voltage(current - constant_battery.current_other, 0.0) / constant_battery.cells
    left.plot(current, volts, color=MODEL["sm1"], label=CONSTANTS)
    left.set(xlabel="load current $I_b$ [A]", ylabel="cell voltage [V]", xlim=(0, 12))
    left.set_title(f"a) cell under load: R = {float(battery.resistance) * 1e3:.0f} mΩ a cell")
    left.legend()

    capacity = float(battery.capacity) / COULOMB_PER_MAH
    charge = jnp.linspace(0, 1.9 * capacity, 200)
    no_load = np.broadcast_to(battery.voltage_no_load(charge * COULOMB_PER_MAH), charge.shape)
    right.plot(charge, no_load, color=colour)
    right.axvline(capacity, color=INK, lw=1, label=f"capacity {capacity:.0f} mAh, beyond: status battery_empty")
    right.axvspan(capacity, charge[-1], color="#f0f0f0", zorder=0)
    low = int(np.argmin(no_load))
    if 0 < low < len(charge) - 1:
        label = f"parabola (13) turns up at {charge[low]:.0f} mAh"
        right.plot(charge[low], no_load[low], "v", color=FAINT, label=label)
    right.set(xlabel="discharge $C_b$ [mAh]", ylabel="no-load cell voltage [V]", xlim=(0, charge[-1]))
    right.set_title("b) no-load voltage")
    right.legend()
    return fig


def draw_motor_friction(robots: dict[str, Robot]) -> Figure:
    """Fig. 11: motor friction torque (14) over speed, with the maker's no-load point."""
    fig, grid = new_figure(1, 1, 3.4)
    axes = grid[0, 0]
    motor = next(iter(robots.values())).motor
    rpm = jnp.linspace(0, 12_500, 60)
    for name in (name for name in robots if name != "sm1"):  # SM-1 has the same curve as SM-2
        torque = 1e3 * np.broadcast_to(robots[name].motor.torque_loss(rpm * RPM, 1.0), rpm.shape)
        label = CONSTANTS if name == CONSTANT else displayed_robot_name(name)
        axes.plot(rpm, torque, color=MODEL.get(name, PURPLE), label=label)
    speed, current = SHEET_NO_LOAD
    sheet = 1e3 * current * float(motor.torque_constant)
    label = f"maker's sheet, no load at 24 V: {speed:.0f} rpm, {current * 1e3:.0f} mA, so {sheet:.2f} mN·m"
    axes.plot(speed, sheet, "D", color=INK, ms=6, label=label)
    limit = float(motor.speed_limit) / RPM
    axes.axvline(limit, color=FAINT, lw=1, ls=":", label=f"permissible {limit:,.0f} rpm")
    axes.set(xlabel="motor speed [rpm]", ylabel=r"friction torque $M_{df}$ [mN·m]", xlim=(0, 12_500), ylim=(0, 5.4))
    axes.legend(loc="lower left")
    return fig


def draw_idle_track(robots: dict[str, Robot]) -> Figure:
    """Fig. 18: current of one motor that turns a lifted side, over pulley speed, and R² of a straight line."""
    fig, grid = new_figure(1, 1, 3.6)
    axes = grid[0, 0]
    name, robot = next(iter(robots.items()))
    speed = np.linspace(0.5, 26.0, 60)
    labels = {TRACKED: "three tracks a side", WHEELED: "one track a side"}
    for configuration in data.shown_configurations(robot):
        current = data.idle_current(robot, configuration, speed)
        colour = CONFIGURATION.get(configuration, PURPLE)
        line, r_squared = data.fit_line(speed, current)
        description = f"{labels[configuration]} ({configuration})" if configuration in labels else configuration
        axes.plot(speed[::4], current[::4], "o", color=colour, ms=4)
        axes.plot(
            speed, line, color=colour, label=f"{displayed_robot_name(name)}, {description}: R² = {r_squared:.4f}"
        )
    for other_name in ("sm1", "sm2"):
        current = data.idle_current(robots[other_name], TRACKED, speed)
        axes.plot(
            speed,
            current,
            color=MODEL[other_name],
            lw=1.4,
            label=f"{displayed_robot_name(other_name)}, {labels[TRACKED]}",
        )
    axes.set(xlabel="pulley speed [rad/s]", ylabel="current of one motor [A]", xlim=(0, 26), ylim=(0, None))
    axes.legend()
    return fig
