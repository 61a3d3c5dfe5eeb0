"""Packaged data sheets of motors, gearboxes and cells, and the drives and cells to choose from, as arrays.

The tables are in `calibration/data/parts/*.csv` in the units of the sheets, which end the names of the columns. The
reader converts to SI. Values that a sheet lacks are NaN. `docs/reference/parts.md` has the origin of the sheets, and
checks of their consistency.

If a sheet lacks a number that the model needs, the paper's robot is scaled (docs/howto/size.md). Friction of a motor
is scaled by its no-load torque, efficiency of a gearbox by the sheet's largest, and resistance and mass of a cell by
its capacity. For winding and speeds, the robot's own ratings apply.
"""

from __future__ import annotations

import csv
import dataclasses
import functools
import io
import itertools
import math
import types
from fractions import Fraction
from importlib import resources
from typing import Any, NamedTuple

import numpy as np

from calibration.data import Columns, Names
from mmrjax.model.paper_tables import COULOMB_PER_MAH
from mmrjax.model.quantities import RPM
from mmrjax.model.robot import Robot

#: Factors to SI of the units with which names of columns end.
UNITS = {
    **dict.fromkeys(("A", "C", "EUR", "K_per_W", "Nm", "V", "W", "ohm", "s"), 1.0),
    **dict.fromkeys(("g", "mA", "mH", "mNm", "mNm_per_A", "mohm"), 1e-3),
    "gcm2": 1e-7, "mAh": COULOMB_PER_MAH, "percent": 1e-2, "rpm": RPM, "rpm_per_V": RPM,
}  # fmt: skip
#: Columns of numbers without a unit, and the column whose cells list several names.
UNITLESS_COLUMNS = ("cells", "ratio", "stages")
LIST_COLUMN = "gearboxes"
#: A data sheet: values by the names of its columns, without their units.
Sheet = types.SimpleNamespace


def _value_in_si(column: str, text: str) -> tuple[str, Any]:
    """Name of a column without its unit, and the value of a cell in SI. NaN for a number that is missing."""
    if column == LIST_COLUMN:
        return column, tuple(part.strip() for part in text.split(";") if part.strip())
    unit = max((u for u in UNITS if column.endswith(f"_{u}")), key=len, default="")
    if not unit and column not in UNITLESS_COLUMNS:
        return column, text
    return column.removesuffix(f"_{unit}"), float(Fraction(text)) * UNITS.get(unit, 1.0) if text else math.nan


@functools.cache
def packaged_sheets(table: str) -> tuple[Sheet, ...]:
    """Data sheets of a packaged table: `motors`, `gearboxes` or `cells`. The first cell is that of the paper."""
    text = (resources.files("calibration") / "data" / "parts" / f"{table}.csv").read_text("utf-8")
    return tuple(
        Sheet(**dict(itertools.starmap(_value_in_si, row.items())))
        for row in csv.DictReader(io.StringIO(text), strict=True)
    )


#: The paper's parts among the sheets.
MOTOR, GEARBOX, CELL = "RE 30 24 V", "GP 32 C 23:1", "XP2200SL"
#: Ratio of the belt stage between gearbox and driving wheel, which is not changed (docs/explanation/paper-notes.md).
BELT_STAGE = 25 / 12
#: Current above any limit [A].
NO_LIMIT = 1e9


class DriveOption(NamedTuple):
    """A motor with one size of gearbox (family and number of stages), which has several gear ratios.

    Attributes:
        motor: data sheet of the motor.
        family, stages: family and stages of the gearbox.
        ratios: total gear ratios, ascending.
        gearbox: one of the data sheets of that gearbox.
    """

    motor: Sheet
    family: str
    stages: int
    ratios: tuple[float, ...]
    gearbox: Sheet

    @property
    def name(self) -> str:
        """Displayed name."""
        return f"{self.motor.name}, {self.family}, {self.stages} stage{'s' if self.stages > 1 else ''}"


def drive_options(names: Names) -> tuple[DriveOption, ...]:
    """All motors (or those named) with all gearbox sizes that their maker combines with them."""
    options = []
    for motor in packaged_sheets("motors"):
        if names and motor.name not in names:
            continue
        for family in motor.gearboxes:
            for stages in sorted({g.stages for g in packaged_sheets("gearboxes") if g.family == family}):
                by_ratio = sorted(
                    (g for g in packaged_sheets("gearboxes") if (g.family, g.stages) == (family, stages)),
                    key=lambda g: g.ratio,
                )
                ratios = tuple(BELT_STAGE * g.ratio for g in by_ratio)
                options.append(DriveOption(motor, family, int(stages), ratios, by_ratio[0]))
    return tuple(options)


_LITHIUM_POLYMER = "lithium-polymer"


@dataclasses.dataclass(frozen=True)
class PartOptions:
    """Numbers of drives and cells by name, one row for each.

    Attributes:
        drives, cells: data sheets.
        drive, cell: columns of numbers, shapes (drives,) and (cells,).
        base_mass: mass of the paper's two motors, two gearboxes and cells, which is part of the robot's mass [kg].
    """

    drives: tuple[DriveOption, ...]
    cells: tuple[Sheet, ...]
    drive: Columns
    cell: Columns
    base_mass: float


def _value_or_default(value: float, default: float) -> float:
    return default if math.isnan(value) else value


def options_for_robot(robot: Robot, names: Names = ()) -> PartOptions:
    """Parts to choose from for a robot.

    Args:
        robot: robot whose friction, efficiencies and cells replace values that data sheets lack.
        names: names of motors, empty for all.
    """
    drives = drive_options(names)
    cells = tuple(
        cell
        for cell in packaged_sheets("cells")
        if cell.cells == 1 and (cell.name == CELL or not math.isnan(cell.cut_off_voltage))
    )
    paper_motor = next(motor for motor in packaged_sheets("motors") if motor.name == MOTOR)
    paper_gearbox = next(gearbox for gearbox in packaged_sheets("gearboxes") if gearbox.name == GEARBOX)
    paper_cell = next(cell for cell in packaged_sheets("cells") if cell.name == CELL)
    sides = float(robot.sides)
    battery = robot.battery
    no_load_torque = paper_motor.torque_constant * paper_motor.no_load_current
    drive_rows = []
    for drive in drives:
        motor, gearbox = drive.motor, drive.gearbox
        friction_ratio = motor.torque_constant * motor.no_load_current / no_load_torque
        drive_rows.append(
            {
                "resistance": motor.terminal_resistance, "torque_constant": motor.torque_constant,
                "friction_coulomb": float(robot.motor.friction_coulomb) * friction_ratio,
                "friction_viscous": float(robot.motor.friction_viscous) * friction_ratio,
                "inertia": motor.rotor_inertia, "inductance": motor.terminal_inductance,
                "resistance_thermal_winding": motor.thermal_resistance_winding_housing,
                "resistance_thermal_housing": motor.thermal_resistance_housing_ambient,
                "efficiency": (
                    float(robot.gearbox.efficiency_load) * gearbox.max_efficiency / paper_gearbox.max_efficiency
                ),
                "mass": sides * (motor.weight + gearbox.weight), "cost": sides * (motor.price + gearbox.price),
                "temperature": _value_or_default(motor.max_winding_temperature, robot.motor.temperature_limit),
                "speed_motor": _value_or_default(motor.max_speed, robot.motor.speed_limit),
                "speed_gearbox": _value_or_default(gearbox.max_continuous_input_speed, robot.gearbox.speed_limit),
                "torque": gearbox.max_continuous_torque * BELT_STAGE,
                "ratio_least": drive.ratios[0], "ratio_most": drive.ratios[-1],
            }
        )  # fmt: skip
    mass_per_charge = next(
        cell.weight / (cell.cells * cell.capacity)
        for cell in packaged_sheets("cells")
        if not math.isnan(cell.weight) and cell.chemistry == _LITHIUM_POLYMER
    )
    resistance_times_capacity = float(battery.resistance) * paper_cell.capacity
    cell_rows = [
        {
            "capacity": cell.capacity, "voltage_full": cell.full_voltage,
            "cutoff": _value_or_default(cell.cut_off_voltage, battery.voltage_cutoff),
            "resistance": _value_or_default(cell.resistance, resistance_times_capacity / cell.capacity),
            "mass": _value_or_default(cell.weight, mass_per_charge * cell.capacity),
            "current": _value_or_default(cell.max_continuous_current, NO_LIMIT),
        }
        for cell in cells
    ]  # fmt: skip
    base_mass = sides * (paper_motor.weight + paper_gearbox.weight) + battery.cells * mass_per_charge * float(
        battery.capacity
    )
    return PartOptions(drives, cells, _columns(drive_rows), _columns(cell_rows), base_mass)


def _columns(rows: list[dict[str, float]]) -> Columns:
    return {key: np.array([row[key] for row in rows]) for key in rows[0]}
