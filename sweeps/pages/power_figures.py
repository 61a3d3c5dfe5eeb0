"""Figures of the power of runs from the supply to the slope, and the chart of motor and gear."""

from __future__ import annotations

import dataclasses
import itertools
import warnings
from collections.abc import Sequence

import numpy as np
from matplotlib.figure import Figure

from calibration.data import Columns, Json
from calibration.data.table import Runs
from mmrjax.fidelities.outputs import output_columns
from mmrjax.fidelities.simulation import simulate
from mmrjax.model.conditions import Conditions
from mmrjax.model.quantities import RPM
from mmrjax.model.robot import Configurations, Robot
from mmrjax.model.shaft import Shaft
from mmrjax.model.signals import is_done
from sweeps.export.joint import UNLIMITED
from sweeps.pages.figure_style import BLUE, FAINT, GREEN, INK, ORANGE, PURPLE, SKY, new_figure, outer_legend
from sweeps.report.run_tables import operating_points

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
    losses = [above - below for above, below in itertools.pairwise(chain)]
    ends = [np.maximum(chain[-1], 0.0), np.maximum(-chain[0], 0.0)]
    return dict(zip(ITEMS, [*losses, *ends], strict=True))


def power_sources(runs: Columns) -> tuple[np.ndarray, np.ndarray]:
    """Power [W] from the supply, and from the slope in runs downhill."""
    return np.maximum(runs["power_supply_W"], 0.0), np.maximum(-runs["power_lift_W"], 0.0)


def drawable_runs(runs: Columns) -> np.ndarray:
    """Mask of runs with numbers and without negative losses."""
    parts, supplied_power = np.stack(list(power_by_item(runs).values())), sum(power_sources(runs))
    return (
        np.isfinite(parts).all(0) & (parts >= -1e-6 * np.maximum(supplied_power, 1.0)).all(0) & (supplied_power > 0)
    )


#: Name of an item if the load is a shaft, which receives all output power of the gearboxes.
ON_SHAFT = {"track and slip": "load"}


def draw_power_chain(runs: Columns, names: list[str], has_ground: bool = True) -> Figure:
    """One bar for each run [W], from the motor's losses to the power that lifts the robot or that the load takes."""
    fig, ((axes,),) = new_figure(1, 1, 1.15 + 0.42 * len(names))
    supply, slope = power_sources(runs)
    total, places, left = supply + slope, np.arange(len(names)), np.zeros(len(names))
    for item, power in power_by_item(runs).items():
        if power.max() > 1e-6:
            power, colour = np.maximum(power, 0.0), ITEMS[item]
            label = item if has_ground else ON_SHAFT.get(item, item)
            bars = axes.barh(places, power, left=left, height=0.7, color=colour, label=label, ec="white", lw=0.6)
            numbers = [f"{width:.1f}" if width >= 0.04 * total.max() else "" for width in power]
            axes.bar_label(bars, numbers, label_type="center", color="white" if colour in _DARK else "black")
            left = left + power
    for y, (watts, falls) in enumerate(zip(supply, slope, strict=True)):
        text = f"{watts:.1f} W" + (f" + {falls:.1f} W from the slope" if falls > 1e-6 else "")
        axes.text(watts + falls, y, f"  {text}", va="center")
    axes.set_yticks(places, names)
    axes.invert_yaxis()
    axes.grid(False)
    axis_factor = 1.35 if (slope > 1e-6).any() else 1.1
    axes.set(xlabel="power [W]", xlim=(0, axis_factor * float(total.max())))
    outer_legend(axes, "upper center")
    return fig


#: Loads of a drive curve, and balances whose effects it includes.
LOADS = 60
INSIDE = ("duty", "supply", "electrical", "motor", "gearbox")


def _on_a_shaft(robot: Robot) -> Robot:
    """The robot's drive with a frictionless shaft as its load."""
    shaft = Shaft(inertia=1e-3, loss_coulomb=0.0)
    inside = tuple(e for e in robot.effects if e.balance in INSIDE and e.acts_everywhere)
    return dataclasses.replace(robot, configurations=Configurations({"shaft": shaft}), effects=inside)


def drive_curves(robot: Robot, voltage: float) -> Columns:
    """Torque at the gearbox output, speed, current and efficiency of one motor and gear at a supply voltage, from no
    load to the current limit or to stall.
    """
    motor, gearbox = robot.motor, robot.gearbox
    current = min(float(motor.current_stall(voltage)), float(robot.driver.current_limit))
    torque = np.linspace(0, 1, LOADS, endpoint=False) ** 2 * float(motor.torque_constant * gearbox.ratio) * current
    runs = simulate(_on_a_shaft(robot), Conditions(0, voltage, load_torque=torque))
    speed, drawn = np.asarray(runs.motor_speed), np.asarray(runs.total_current) / float(robot.sides)
    settled = np.asarray(is_done(np.asarray(runs.status))) & (speed > 0)
    efficiency = 100 * torque * speed / float(gearbox.ratio) / np.maximum(voltage * drawn, 1e-9)
    columns = {"torque_Nm": torque, "motor_rpm": speed / RPM, "motor_A": drawn, "efficiency_percent": efficiency}
    return {name: values[settled] for name, values in columns.items()}


def draw_chart_of_corners(robot: Robot, corners: Sequence[Json]) -> Figure:
    """Chart of motor and gear with operating points at corners of an envelope, on the robot's own ground."""
    keys = ("configuration", "payload_kg", "slope_deg", "state_of_charge", "supply_voltage_V")
    cells = [tuple(corner.get(key) for key in keys) for corner in corners]
    rows = dict.fromkeys(
        cell for cell in cells if None not in cell[:3] and not any(isinstance(x, list | tuple) for x in cell)
    )
    full, points = float(robot.battery.cells * robot.battery.voltage_no_load(0.0)), None
    supply = np.array([full if volts is None else volts for *_, volts in rows] or [full])
    if rows:
        names, payload, slope, charge, volts = zip(*rows, strict=True)
        on_battery = np.array([v is None for v in volts])
        used = float(robot.battery.capacity) * np.array([0.0 if c is None else 1 - max(c, 1e-9) for c in charge])
        conditions = Conditions(
            list(names), supply, slope_deg=np.array(slope), payload=np.array(payload),
            battery=on_battery.astype(float), discharge=on_battery * used,
        )  # fmt: skip
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # a cut-off that rarely acts
            runs = simulate(robot, conditions)
        done = np.asarray(is_done(np.asarray(runs.status)))
        columns = {"configuration": np.array(names), **output_columns(runs.result, robot.channels)}
        points = operating_points(robot, {name: values[done] for name, values in columns.items()})
    return draw_drive_chart(robot, sorted(set(supply.tolist()))[-3:], points)


def draw_drive_chart(robot: Robot, voltages: Sequence[float], points: Columns | None) -> Figure:
    """Speed, current and efficiency of one motor and gear over the torque at the output.

    Shaded areas are torques up to the winding's continuous current, and up to the driver's current limit.
    """
    fig, (panels,) = new_figure(1, 3, 3.0, sharex=True)
    labels = {
        "motor_rpm": "motor speed [rpm]", "motor_A": "current of one motor [A]",
        "efficiency_percent": "efficiency [%]",
    }  # fmt: skip
    limit, largest_torque = float(robot.driver.current_limit), 0.0
    for voltage, style in zip(sorted(voltages, reverse=True), ("-", "--", ":"), strict=False):
        curves = drive_curves(robot, voltage)
        torque = curves["torque_Nm"]
        if torque.size < 2:
            continue
        if not largest_torque:
            continuous = float(np.interp(float(robot.motor.current_continuous), curves["motor_A"], torque))
            reached = 0.0 if points is None else np.nanmax(points["torque_Nm"], initial=0.0)
            largest_torque = min(max(2.5 * continuous, 1.2 * reached), torque[-1])
            continuous = min(continuous, largest_torque)
            for axes in panels:
                axes.axvspan(0, continuous, color=GREEN, alpha=0.18, lw=0, label="continuous")
                axes.axvspan(continuous, largest_torque, color=ORANGE, alpha=0.12, lw=0, label="short time")
                axes.set_xlim(0, largest_torque)
        shown = torque <= largest_torque
        for axes, (name, label) in zip(panels, labels.items(), strict=True):
            axes.plot(torque[shown], curves[name][shown], style, color=BLUE, label=f"{voltage:.3g} V")
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


def torque_of_motor(robot: Robot, voltage: float, load: np.ndarray) -> np.ndarray:
    """Torque of a motor at the gearbox input, times the ratio [N·m], for each torque of the load. NaN at rest."""
    runs = simulate(_on_a_shaft(robot), Conditions(0, voltage, load_torque=load))
    speed = np.asarray(runs.motor_speed)
    moves = np.asarray(is_done(np.asarray(runs.status))) & (speed * np.sign(voltage) > 0)
    torque = np.asarray(runs.power_motor) / float(robot.sides) / np.where(moves, speed, np.nan)
    return np.asarray(float(robot.gearbox.ratio) * torque)


def draw_drive_plane(robot: Robot, voltage: float, points: Columns | None = None) -> Figure:
    """Torque of the motor against that of the load, and the efficiency of the gearbox each way.

    Args:
        voltage: supply voltage at which the gearbox runs.
        points: torques of the motor in runs, simulated and measured, and their direction. The simulated one gives
            the torque of the load.
    """
    motor, gearbox = robot.motor, robot.gearbox
    if points is None:
        bears = min(float(motor.current_continuous), 0.5 * float(motor.current_stall(voltage)))
        most = float(motor.torque_constant * gearbox.ratio * gearbox.efficiency_load) * bears
    else:
        most = float(np.nanmax(np.abs(points["simulated_Nm"])))
    load = np.linspace(-most, most, 2 * LOADS + 1)
    forward, backward = (torque_of_motor(robot, v, load) for v in (voltage, -voltage))
    fig, ((plane, share),) = new_figure(1, 2, 3.6)
    plane.fill_between(load, backward, forward, color="#e3e3e3", lw=0, label="at rest, friction holds the load")
    for efficiency in EFFICIENCIES:
        plane.plot([-most, 0, most], [-most * efficiency, 0, most / efficiency], ":", color=FAINT, lw=1)
        plane.annotate(f"{100 * efficiency:.0f} %", (most, most / efficiency), (2, 0), textcoords="offset points",
                       va="center", annotation_clip=False)  # fmt: skip
    plane.plot(load, load, "--", color=FAINT, lw=1, label="without losses")
    plane.plot(load, forward, color=BLUE, label="runs forward")
    plane.plot(load, backward, color=ORANGE, label="runs backward")
    if points is not None:
        at_load = [np.interp(points["simulated_Nm"], way, load) for way in (forward, backward)]
        x = np.where(points["forward"], *at_load)
        plane.plot(x, points["measured_Nm"], "o", ms=4, color=INK, label="measured")
    label = "torque of the load [N·m]"
    plane.set(xlabel=label, ylabel="motor torque × ratio [N·m]", title="drive and back-drive", xlim=(-most, most))
    ahead, behind = load > 0, load < 0
    share.plot(load[ahead], 100 * load[ahead] / forward[ahead], color=BLUE, label="motor drives the load")
    returned = 100 * np.maximum(forward[behind] / load[behind], 0)
    share.plot(-load[behind], returned, "--", color=BLUE, label="load drives the motor")
    share.set(xlabel=label, ylabel="efficiency [%]", ylim=(0, 103), title="efficiency each way")
    share.legend(loc="lower right")
    outer_legend(plane, "upper left")
    return fig


def draw_measured_drive_plane(robot: Robot, runs: Runs) -> Figure:
    """The plane of drive and back-drive with settled runs, at the voltage of the fastest."""
    results = simulate(robot, runs.conditions(robot))
    speed, ratio = np.asarray(results.motor_speed), float(robot.gearbox.ratio)
    channel = next(c for c in robot.channels if c.name in ("motor_current", "total_current"))
    motors = float(robot.sides) if channel.name == "total_current" else 1.0
    beyond = (runs[channel.column] * channel.factor - np.asarray(getattr(results, channel.name))) / motors
    with np.errstate(divide="ignore", invalid="ignore"):
        simulated = ratio * np.asarray(results.power_motor) / float(robot.sides) / speed
    measured = simulated + ratio * float(robot.motor.torque_constant) * beyond
    points = {"forward": speed > 0, "simulated_Nm": simulated, "measured_Nm": measured}
    return draw_drive_plane(robot, float(np.nanmax(np.abs(runs["supply_voltage_V"]))), points)
