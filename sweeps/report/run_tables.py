"""Blocks that reports of simulated runs share: statuses, limits, and quantities with names from the registries."""

from __future__ import annotations

import dataclasses
import math
import warnings
from collections.abc import Iterable, Mapping, Sequence
from types import MappingProxyType
from typing import Any

import numpy as np

from calibration.data import Columns, Json
from calibration.data.columns import IMPOSED
from calibration.data.robot_file import RobotFile
from calibration.data.table import Runs
from mmrjax import effects
from mmrjax.fidelities.outputs import output_columns
from mmrjax.fidelities.results import Results
from mmrjax.fidelities.simulation import simulate
from mmrjax.model import channels
from mmrjax.model.channels import Channel
from mmrjax.model.conditions import Conditions
from mmrjax.model.quantities import RPM, SET, TABLE, Condition
from mmrjax.model.robot import Configurations, Robot
from mmrjax.model.shaft import Shaft
from mmrjax.model.signals import is_done
from sweeps import capabilities
from sweeps.capabilities import UNLIMITED
from sweeps.pages import words
from sweeps.points import run
from sweeps.report import catalogue
from sweeps.report.document import Cell, Column, Note, Table, columns, table_from_cells

#: Columns of quantities that may be imposed on a run.
_IMPOSED = {column for column, _ in IMPOSED.values()}


def imposed_column(runs: Iterable[str]) -> str:
    """Column of the imposed quantity of runs: conditions precede readings."""
    return next(column for column in runs if column in _IMPOSED)


def _column(condition: Condition) -> str:
    """Column of a condition. For an imposed speed or current, that of its channel."""
    return next((c.column for c in channels.EVERY if c.name == condition.name), condition.column)


#: Each condition in a table of runs, by column.
_CONDITIONS = {_column(c): columns(f"{c.heading} | {c.shown}")[0] for c in SET if c.heading}


def condition_columns(table: Columns, *, mass: bool = False) -> dict[str, Column]:
    """Columns of the conditions of a table, by name, without those that are readings.

    Args:
        mass: True to include the total mass.
    """
    return {
        name: column
        for name, column in _CONDITIONS.items()
        if name in table and not {f"simulated_{name}", f"after_{name}"} & table.keys()
        and (mass or name != "total_mass_kg")
    }  # fmt: skip


#: Quantities by column. If several have the same column, that of runs.
_REGISTERED = {
    q.column: q
    for place in ("derived", "mission of sides", "mission", "run", "channel of a turn", "channel")
    for q in TABLE[place]
}
#: Columns of runs without a row in a registry.
_OTHERS = {
    "configuration": Column("configuration"),
    "status": Column("status"),
    "flags": Column("limits exceeded"),
    "time_end_s": Column("time at the end", "s", "{:.6g}"),
    "permissible_time_s": Column("permissible time at this current", "s", "{:.3g}"),
}
#: Text for infinite or missing numbers in some columns.
_ENDLESS = {"permissible_time_s": words.FOR_EVER}
_MISSING = {"supply_voltage_V": "battery", "flags": "none"}


def quantity_column(name: str, group: str = "") -> Column:
    """Column of a quantity in a report, from the name of its column in a table of runs."""
    if name in _REGISTERED:
        q = _REGISTERED[name]
        return Column(q.label, q.unit_shown.replace("-", ""), f"{{:.{q.resolution}f}}", group)
    return dataclasses.replace(_CONDITIONS.get(name) or _OTHERS[name], group=group)


def axis_title(column: str) -> str:
    """Label of an axis over a condition or reading, with its unit."""
    return "supply voltage [V]" if column == "supply_voltage_V" else quantity_column(column).title


def quantity_cells(table: Columns, name: str) -> list[Any]:
    """Cells of a column, each with its standard deviation if the table has one. Infinite numbers are in words."""
    values, spread = table[name], table.get(name + run.SD)
    if spread is not None:
        digits = _REGISTERED[name].resolution
        return [None if math.isnan(v) else run.with_sd(v, s, digits) for v, s in zip(values, spread, strict=True)]
    if name == "status":
        return [Cell(s, "" if s in words.SETTLED else "slides") for s in map(str, values)]
    if values.dtype.kind != "f":
        return [_MISSING.get(name, "") if v == "" else v for v in values]
    endless, missing = _ENDLESS.get(name, words.NONE_SETTLES), _MISSING.get(name)
    return [missing if math.isnan(v) else endless if math.isinf(v) else v for v in values]


def quantity_table(
    name: str, table: Columns, names: Iterable[str], first: Sequence[tuple[Column, Sequence[Any]]] = (), **fields: Any
) -> Table:
    """Table with one row for each run, of those quantities `names` that the table of runs has.

    Args:
        name: name of the table.
        first: first columns with their cells.
        fields: further fields of the table.
    """
    empty = {n for n, x in table.items() if x.dtype.kind == "f" and np.isnan(x).all()} - {"supply_voltage_V"}
    shown_names = [n for n in dict.fromkeys(names) if n in table and n not in empty]
    cells = [(quantity_column(n), quantity_cells(table, n)) for n in shown_names]
    return table_from_cells(name, [*first, *cells], **fields)


def reading_form(channel: Channel) -> str:
    """Format of readings, with one digit less than their channel's resolution."""
    return f"{{:.{max(channel.resolution - 1, 0)}f}}"


def reading_text(value: Any, channel: Channel) -> str:
    """Reading as text. A dash if it is missing."""
    return Column("", form=reading_form(channel)).text(value)


def note_on_robot(file: RobotFile, model: str = "", more: str = "") -> Note:
    """Line below the answer: robot, fidelity and a further sentence."""
    parts = [f"Robot: **{capabilities.displayed_name(file)}**.", f"Fidelity: **{model}**." * bool(model), more]
    return Note(" ".join(filter(None, parts)), "lead")


def lost_by_load(robot: Robot) -> bool:
    """True if an effect of the robot loses a share of the load in the gearbox."""
    return any(e.balance == "gearbox" and e.driver == "load" for e in robot.effects)


def curve_warning(robot: Robot) -> tuple[Note, ...]:
    """Warning if the robot has curves for unexplained discrepancies."""
    names = " and ".join(f"`{e.name}`" for e in robot.effects if e.name in effects.UNNAMED)
    return (catalogue.note("run.curves", names),) if names else ()


def endings_table(
    counts: Mapping[str, int],
    things: str = "runs",
    model: str = "",
    meanings: Mapping[str, str] = MappingProxyType({}),
    **more: Json,
) -> Table:
    """Table of the statuses of runs or points that occurred, in words, with their number.

    Args:
        counts: number by status.
        meanings: meanings of statuses that do not come from a fidelity.
        more: further columns, with values by status.
    """
    order = [*words.STATUSES, *counts]
    total, reached = sum(counts.values()), sorted((s for s, n in counts.items() if n), key=order.index)
    further = (f"~{name.replace('_', ' ')}" for name in more)
    heads = columns("ended", f"{things} | ,", "share [%] | .3g", "~status", "meaning", *further)
    meant = {s: meanings.get(s) or words.VERDICTS.get((model, s)) or words.status_meaning(s) for s in reached}
    rows = [
        (
            Cell(words.short_status(s), "good" if s in words.SETTLED else "bad"), counts[s], 100 * counts[s] / total,
            f"`{s}`", meant[s], *(m.get(s) for m in more.values()),
        )
        for s in reached
    ]  # fmt: skip
    return Table("statuses", heads, rows)


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
INSIDE = ("duty", "supply", "electrical", "motor", "gearbox")


def _runs_on_a_shaft(robot: Robot, voltage: float, load: np.ndarray) -> tuple[Results, np.ndarray]:
    """Steady runs of the robot's drive with a frictionless shaft as its load, and True for those that turn forward.

    Args:
        load: torques of the load [N·m].
    """
    shaft = Configurations({"shaft": Shaft(inertia=1e-3, loss_coulomb=0.0)})
    inside = tuple(e for e in robot.effects if e.balance in INSIDE and e.acts_everywhere)
    drive = dataclasses.replace(robot, configurations=shaft, effects=inside)
    runs = simulate(drive, Conditions(0, voltage, load_torque=load))
    return runs, np.asarray(is_done(np.asarray(runs.status))) & (np.asarray(runs.motor_speed) * voltage > 0)


def drive_curves(robot: Robot, voltages: Iterable[float]) -> dict[float, Columns]:
    """Torque at the gearbox output, speed, current and efficiency of one motor and gear, from no load to the current
    limit or to stall, by supply voltage, the highest first.
    """
    motor, ratio, curves = robot.motor, float(robot.gearbox.ratio), {}
    for voltage in sorted(voltages, reverse=True):
        current = min(float(motor.current_stall(voltage)), float(robot.driver.current_limit))
        torque = np.linspace(0, 1, LOADS, endpoint=False) ** 2 * float(motor.torque_constant) * ratio * current
        runs, settled = _runs_on_a_shaft(robot, voltage, torque)
        speed, drawn = np.asarray(runs.motor_speed), np.asarray(runs.total_current) / float(robot.sides)
        efficiency = 100 * torque * speed / ratio / np.maximum(voltage * drawn, 1e-9)
        curve = {"torque_Nm": torque, "motor_rpm": speed / RPM, "motor_A": drawn, "efficiency_percent": efficiency}
        curves[voltage] = {name: values[settled] for name, values in curve.items()}
    return curves


def chart_of_corners(robot: Robot, corners: Sequence[Json]) -> tuple[Robot, dict[float, Columns], Columns | None]:
    """Arguments of the chart of motor and gear at corners of an envelope, on the robot's own ground."""
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
    return robot, drive_curves(robot, sorted(set(supply.tolist()))[-3:]), points


def drive_plane(robot: Robot, runs: Runs) -> tuple[Columns, Columns]:
    """Torques at the gearbox [N·m]: of the load and of the motor each way, at the voltage of the fastest run, and of
    settled runs, from the simulated load and the measured current.
    """
    results = simulate(robot, runs.conditions(robot))
    speed, ratio, sides = np.asarray(results.motor_speed), float(robot.gearbox.ratio), float(robot.sides)
    channel = next(c for c in robot.channels if c.name in ("motor_current", "total_current"))
    motors = sides if channel.name == "total_current" else 1.0
    beyond = (runs[channel.column] * channel.factor - np.asarray(getattr(results, channel.name))) / motors
    with np.errstate(divide="ignore", invalid="ignore"):
        simulated = ratio * np.asarray(results.power_motor) / sides / speed
    measured = simulated + ratio * float(robot.motor.torque_constant) * beyond
    most, voltage = np.nanmax(np.abs(simulated)), float(np.nanmax(np.abs(runs["supply_voltage_V"])))
    load = np.linspace(-most, most, 2 * LOADS + 1)
    forward, backward = (motor_torque(robot, volts, load) for volts in (voltage, -voltage))
    at_load = [np.interp(simulated, way, load) for way in (forward, backward)]
    points = {"load": np.where(speed > 0, *at_load), "motor": measured}
    return {"load": load, "forward": forward, "backward": backward}, points


def motor_torque(robot: Robot, voltage: float, load: np.ndarray) -> np.ndarray:
    """Torque of a motor at the gearbox input, times the ratio [N·m], for each torque of the load. NaN at rest."""
    runs, moves = _runs_on_a_shaft(robot, voltage, load)
    speed = np.where(moves, np.asarray(runs.motor_speed), np.nan)
    return np.asarray(float(robot.gearbox.ratio) * np.asarray(runs.power_motor) / float(robot.sides) / speed)


def limits_table(limits: Sequence[Json], what: str) -> Table:
    """Table of the use of each limit: value, limit, and share that is used."""
    rows = []
    for limit in limits:
        share = limit["percent"]
        used = f"not checked: the robot's file has no `{limit['unstated']}`" if share is None else Cell(
            share, "over" if share > 100 else "bar"
        )  # fmt: skip
        rows.append((limit["words"], limit["value"], limit["limit"], used))
    return catalogue.table("run.limits", rows, f"{what} |")


def use_of_limits(asked: Iterable[tuple[str, Any, Any, str]], ambient: float) -> list[Json]:
    """Use of each known limit: name, value, limit, and share of the limit [%]. For windings it is the share of the
    permissible temperature rise.

    Args:
        asked: name, value, limit, and format with unit. NaN: unknown.
        ambient: temperature [°C].
    """
    return [
        {
            "words": name, "value": words.NONE_SETTLES if math.isinf(value) else form.format(float(value)),
            "limit": form.format(float(limit)),
            "percent": warming_share(value, limit, ambient) if "°C" in form else 100 * abs(value) / float(limit),
        }
        for name, value, limit, form in asked
        if not (math.isnan(value) or math.isnan(limit) or limit >= UNLIMITED)
    ]  # fmt: skip


def warming_share(value: float, limit: float, ambient: float) -> float:
    """Share of a winding's permissible temperature rise [%]."""
    return 100 * (value - ambient) / max(limit - ambient, 1.0)
