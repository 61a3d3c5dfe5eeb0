"""Curves and operating points of a motor and its gear, simulated for charts."""

from __future__ import annotations

import dataclasses
import warnings
from collections.abc import Iterable, Sequence

import numpy as np

from calibration.data import Columns, Json
from calibration.data.table import Runs
from mmrjax.fidelities.outputs import output_columns
from mmrjax.fidelities.results import Results
from mmrjax.fidelities.simulation import simulate
from mmrjax.model.conditions import Conditions
from mmrjax.model.quantities import RPM
from mmrjax.model.robot import Configurations, Robot
from mmrjax.model.shaft import Shaft
from mmrjax.model.signals import is_done


def lost_by_load(robot: Robot) -> bool:
    """True if an effect of the robot loses a share of the load in the gearbox."""
    return any(e.balance == "gearbox" and e.driver == "load" for e in robot.effects)


def operating_points(robot: Robot, runs: Columns) -> Columns:
    """Torque at the gearbox output, speed and current of one motor in settled runs, from columns of `runs.csv`.

    The current is left out if it is imposed.
    """
    radius = np.array([float(robot.configurations[name].radius) for name in runs["configuration"]])
    output = runs["theoretical_speed_mm_s"] / 1e3 / radius
    with np.errstate(divide="ignore", invalid="ignore"):
        torque = runs["power_gear_W"] / float(robot.sides) / output
    speed = output * float(robot.gearbox.ratio) / RPM
    points = {"torque_Nm": torque, "motor_rpm": speed}
    if "total_current_A" in runs:
        points["motor_A"] = runs["total_current_A"] / float(robot.sides)
    return points


#: Loads of a drive curve, and balances whose effects it includes.
LOADS = 60
DRIVE_BALANCES = ("duty", "supply", "electrical", "motor", "gearbox")


def _runs_on_a_shaft(robot: Robot, voltage: float, load: np.ndarray) -> tuple[Results, np.ndarray]:
    """Steady runs of the robot's drive with a frictionless shaft as its load, and a mask of runs that turn forward.

    Args:
        load: torques of the load [N·m].
    """
    shaft = Configurations({"shaft": Shaft(inertia=1e-3, loss_coulomb=0.0)})
    drive_effects = tuple(e for e in robot.effects if e.balance in DRIVE_BALANCES and e.acts_everywhere)
    drive = dataclasses.replace(robot, configurations=shaft, effects=drive_effects)
    runs = simulate(drive, Conditions(0, voltage, load_torque=load))
    return runs, np.asarray(is_done(np.asarray(runs.status))) & (np.asarray(runs.motor_speed) * voltage > 0)


def drive_curves(robot: Robot, voltages: Iterable[float]) -> dict[float, Columns]:
    """Curves of one motor and gear by supply voltage, the highest first: torque at the gearbox output, speed, current
    and efficiency. They extend from no load to the current limit or to stall.
    """
    motor = robot.motor
    ratio = float(robot.gearbox.ratio)
    curves = {}
    for voltage in sorted(voltages, reverse=True):
        current = min(float(motor.current_stall(voltage)), float(robot.driver.current_limit))
        torque = np.linspace(0, 1, LOADS, endpoint=False) ** 2 * float(motor.torque_constant) * ratio * current
        runs, runs_forward = _runs_on_a_shaft(robot, voltage, torque)
        speed = np.asarray(runs.motor_speed)
        current_drawn = np.asarray(runs.total_current) / float(robot.sides)
        efficiency = 100 * torque * speed / ratio / np.maximum(voltage * current_drawn, 1e-9)
        curve = {
            "torque_Nm": torque,
            "motor_rpm": speed / RPM,
            "motor_A": current_drawn,
            "efficiency_percent": efficiency,
        }
        curves[voltage] = {name: values[runs_forward] for name, values in curve.items()}
    return curves


def chart_of_corners(robot: Robot, corners: Sequence[Json]) -> tuple[Robot, dict[float, Columns], Columns | None]:
    """Arguments of the chart of motor and gear at corners of an envelope, on the robot's own ground."""
    keys = ("configuration", "payload_kg", "slope_deg", "state_of_charge", "supply_voltage_V")
    cells = [tuple(corner.get(key) for key in keys) for corner in corners]
    rows = dict.fromkeys(
        cell for cell in cells if None not in cell[:3] and not any(isinstance(x, list | tuple) for x in cell)
    )
    full_voltage = float(robot.battery.cells * robot.battery.voltage_no_load(0.0))
    points = None
    supply = np.array([full_voltage if voltage is None else voltage for *_, voltage in rows] or [full_voltage])
    if rows:
        names, payload, slope, charge, voltage = zip(*rows, strict=True)
        on_battery = np.array([v is None for v in voltage])
        discharge = float(robot.battery.capacity) * np.array([0.0 if c is None else 1 - max(c, 1e-9) for c in charge])
        conditions = Conditions(
            list(names), supply, slope_deg=np.array(slope), payload=np.array(payload),
            battery=on_battery.astype(float), discharge=on_battery * discharge,
        )  # fmt: skip
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # a cut-off that rarely acts
            runs = simulate(robot, conditions)
        done = np.asarray(is_done(np.asarray(runs.status)))
        columns = {"configuration": np.array(names), **output_columns(runs.result, robot.channels)}
        points = operating_points(robot, {name: values[done] for name, values in columns.items()})
    return robot, drive_curves(robot, sorted(set(supply.tolist()))[-3:]), points


def drive_plane(robot: Robot, runs: Runs) -> tuple[Columns, Columns]:
    """Torques at the gearbox [N·m] of load and motor, as curves and as points.

    The curves are simulated in both directions at the largest voltage of the runs. The points are the runs, with the
    load from the simulation and the motor's torque from the measured current.
    """
    results = simulate(robot, runs.conditions(robot))
    speed = np.asarray(results.motor_speed)
    ratio = float(robot.gearbox.ratio)
    sides = float(robot.sides)
    channel = next(c for c in robot.channels if c.name in ("motor_current", "total_current"))
    motors = sides if channel.name == "total_current" else 1.0
    excess_current = (runs[channel.column] * channel.factor - np.asarray(getattr(results, channel.name))) / motors
    with np.errstate(divide="ignore", invalid="ignore"):
        simulated = ratio * np.asarray(results.power_motor) / sides / speed
    measured = simulated + ratio * float(robot.motor.torque_constant) * excess_current
    largest_torque = np.nanmax(np.abs(simulated))
    voltage = float(np.nanmax(np.abs(runs["supply_voltage_V"])))
    load = np.linspace(-largest_torque, largest_torque, 2 * LOADS + 1)
    forward, backward = (motor_torque(robot, signed_voltage, load) for signed_voltage in (voltage, -voltage))
    loads = [np.interp(simulated, curve, load) for curve in (forward, backward)]
    points = {"load": np.where(speed > 0, *loads), "motor": measured}
    return {"load": load, "forward": forward, "backward": backward}, points


def motor_torque(robot: Robot, voltage: float, load: np.ndarray) -> np.ndarray:
    """Torque of a motor at the gearbox input, times the ratio [N·m], for each torque of the load. NaN at rest."""
    runs, runs_forward = _runs_on_a_shaft(robot, voltage, load)
    speed = np.where(runs_forward, np.asarray(runs.motor_speed), np.nan)
    return np.asarray(float(robot.gearbox.ratio) * np.asarray(runs.power_motor) / float(robot.sides) / speed)
