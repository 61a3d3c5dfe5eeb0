"""Packaged data sheets of motors, gearboxes and cells, and the drives and cells to choose from, as arrays.

The tables are in `calibration/data/parts/*.csv` in the units of the sheets. The reader converts to SI. Values that a
sheet lacks are NaN. `docs/reference/parts.md` has the origin of the sheets, and checks of their consistency.

If a sheet lacks a number that the model needs, the paper's robot is scaled (docs/howto/size.md). Friction of a motor
is scaled by its no-load torque, efficiency of a gearbox by the sheet's largest, and resistance and mass of a cell by
its capacity. For winding and speeds, the robot's own ratings apply.
"""

from __future__ import annotations

import csv
import dataclasses
import functools
import io
import math
from collections.abc import Iterator
from fractions import Fraction
from importlib import resources
from typing import Any, NamedTuple, TypeVar

import numpy as np

from calibration.data import Columns, Names
from calibration.data.input_errors import BadData
from mmrjax.model.paper_tables import COULOMB_PER_MAH
from mmrjax.model.quantities import RPM
from mmrjax.model.robot import Robot

MILLI = 1e-3
GRAM_CM2 = 1e-7  # kg·m²


def _number_field(name: str, factor: float = 1.0) -> Any:
    """Field read from a numeric column. Cells times `factor` are in SI, NaN for an empty cell."""
    return dataclasses.field(metadata={"column": name, "factor": factor})


def _text_field(name: str) -> Any:
    return dataclasses.field(metadata={"column": name, "text": True})


def _list_field(name: str) -> Any:
    """Field read from a column with several names in a cell, separated by semicolons."""
    return dataclasses.field(metadata={"column": name, "list": True})


@dataclasses.dataclass(frozen=True)
class MotorSheet:
    """Data sheet of a brushed DC motor at 25 °C. NaN marks values that the sheet does not give.

    Attributes:
        name, maker, order_number: name, maker and order number of the winding.
        voltage_nominal: voltage of the no-load and stall values [V].
        resistance, inductance: terminal resistance [ohm] and inductance [H].
        torque_constant: torque constant C_m [N·m/A].
        speed_constant: speed constant [rad/(s·V)], the inverse of C_m except for rounding.
        speed_no_load, current_no_load: no-load speed [rad/s] and current [A] at the nominal voltage.
        speed_nominal, torque_nominal, current_nominal: speed [rad/s], torque [N·m] and current [A] at the largest
            continuous torque.
        torque_stall, current_stall: stall torque [N·m] and current [A] at the nominal voltage.
        inertia: inertia of the rotor [kg·m²].
        speed_max: largest permissible speed [rad/s].
        resistance_thermal_housing, resistance_thermal_winding: thermal resistances from housing to ambient, and from
            winding to housing [K/W].
        time_constant_winding, time_constant_motor: thermal time constants of winding and motor [s].
        temperature_winding_max: largest permissible winding temperature [°C].
        mass: mass [kg].
        price: price of one piece without tax [EUR of 2020].
        gearboxes: families of packaged gearboxes that its maker combines with it.
        source: data sheet, and where it was read.
        note: further facts.
    """

    name: str = _text_field("name")
    maker: str = _text_field("maker")
    order_number: str = _text_field("order_number")
    voltage_nominal: float = _number_field("nominal_voltage_V")
    resistance: float = _number_field("terminal_resistance_ohm")
    inductance: float = _number_field("terminal_inductance_mH", MILLI)
    torque_constant: float = _number_field("torque_constant_mNm_per_A", MILLI)
    speed_constant: float = _number_field("speed_constant_rpm_per_V", RPM)
    speed_no_load: float = _number_field("no_load_speed_rpm", RPM)
    current_no_load: float = _number_field("no_load_current_mA", MILLI)
    speed_nominal: float = _number_field("nominal_speed_rpm", RPM)
    torque_nominal: float = _number_field("nominal_torque_mNm", MILLI)
    current_nominal: float = _number_field("nominal_current_A")
    torque_stall: float = _number_field("stall_torque_mNm", MILLI)
    current_stall: float = _number_field("stall_current_A")
    inertia: float = _number_field("rotor_inertia_gcm2", GRAM_CM2)
    speed_max: float = _number_field("max_speed_rpm", RPM)
    resistance_thermal_housing: float = _number_field("thermal_resistance_housing_ambient_K_per_W")
    resistance_thermal_winding: float = _number_field("thermal_resistance_winding_housing_K_per_W")
    time_constant_winding: float = _number_field("thermal_time_constant_winding_s")
    time_constant_motor: float = _number_field("thermal_time_constant_motor_s")
    temperature_winding_max: float = _number_field("max_winding_temperature_C")
    mass: float = _number_field("weight_g", MILLI)
    price: float = _number_field("price_EUR")
    gearboxes: tuple[str, ...] = _list_field("gearboxes")
    source: str = _text_field("source")
    note: str = _text_field("note")


@dataclasses.dataclass(frozen=True)
class GearboxSheet:
    """Data sheet of a planetary gearbox. NaN marks values that the sheet does not give.

    Attributes:
        name, maker, order_number, family: identification. A family has one row for each ratio.
        stages: number of stages.
        ratio: gear ratio, exact if the sheet gives a fraction.
        torque_max, torque_intermittent_max: largest continuous and intermittent output torque [N·m].
        efficiency: largest efficiency, as stated in the sheet.
        inertia: inertia at the input shaft [kg·m²].
        speed_input_max: largest continuous input speed [rad/s].
        power_max: largest continuous power [W].
        mass: mass [kg].
        price: price of one piece without tax [EUR of 2020].
        source, note: as in `MotorSheet`.
    """

    name: str = _text_field("name")
    maker: str = _text_field("maker")
    order_number: str = _text_field("order_number")
    family: str = _text_field("family")
    stages: float = _number_field("stages")
    ratio: float = _number_field("ratio")
    torque_max: float = _number_field("max_continuous_torque_Nm")
    torque_intermittent_max: float = _number_field("max_intermittent_torque_Nm")
    efficiency: float = _number_field("max_efficiency_percent", 1e-2)
    inertia: float = _number_field("inertia_gcm2", GRAM_CM2)
    speed_input_max: float = _number_field("max_continuous_input_speed_rpm", RPM)
    power_max: float = _number_field("max_continuous_power_W")
    mass: float = _number_field("weight_g", MILLI)
    price: float = _number_field("price_EUR")
    source: str = _text_field("source")
    note: str = _text_field("note")


@dataclasses.dataclass(frozen=True)
class CellSheet:
    """Data sheet of a battery cell, or of a pack of `cells` in series. NaN marks values that the sheet does not give.

    Attributes:
        name, maker, chemistry: name, maker and chemistry of the cell.
        cells: number of cells in series.
        capacity: capacity [C].
        voltage_full, voltage_cut_off: voltage of one full cell, and cut-off voltage of one cell [V].
        current_max, current_charge_max: largest continuous discharge and charge currents [A].
        resistance: DC resistance of one cell [ohm].
        impedance: impedance of one cell at 1 kHz [ohm]. It is smaller than the resistance.
        mass: mass of all cells [kg].
        source, note: as in `MotorSheet`.
    """

    name: str = _text_field("name")
    maker: str = _text_field("maker")
    chemistry: str = _text_field("chemistry")
    cells: float = _number_field("cells")
    capacity: float = _number_field("capacity_mAh", COULOMB_PER_MAH)
    voltage_full: float = _number_field("full_voltage_V")
    voltage_cut_off: float = _number_field("cut_off_voltage_V")
    current_max: float = _number_field("max_continuous_current_A")
    current_charge_max: float = _number_field("max_charge_current_A")
    resistance: float = _number_field("resistance_mohm", MILLI)
    impedance: float = _number_field("impedance_1kHz_mohm", MILLI)
    mass: float = _number_field("weight_g", MILLI)
    source: str = _text_field("source")
    note: str = _text_field("note")


Sheet = TypeVar("Sheet", MotorSheet, GearboxSheet, CellSheet)


def _parse_cell(text: str, where: str, field: dataclasses.Field[Any]) -> Any:
    """Value of a cell in the form of its field."""
    if field.metadata.get("text"):
        return text
    if field.metadata.get("list"):
        return tuple(part.strip() for part in text.split(";") if part.strip())
    if not text:
        return math.nan
    try:
        return float(Fraction(text)) * field.metadata["factor"]
    except (ValueError, ZeroDivisionError) as error:
        raise BadData(f"{where}, {field.metadata['column']}: got {text!r}; expected a number or nothing") from error


def _read_sheets(kind: type[Sheet], file: str) -> Iterator[Sheet]:
    """Data sheets in a packaged table.

    Raises:
        BadData: the columns differ from the fields of the sheet, or a cell is not a number.
    """
    fields = dataclasses.fields(kind)
    column_names = [f.metadata["column"] for f in fields]
    table = resources.files("calibration") / "data" / "parts" / file
    reader = csv.DictReader(io.StringIO(table.read_text("utf-8")), strict=True)
    if list(reader.fieldnames or ()) != column_names:
        raise BadData(f"{file}: got the columns {reader.fieldnames}; expected {column_names}")
    for row in reader:
        if None in row or None in row.values():
            raise BadData(
                f"{file} row {reader.line_num}: the number of cells differs from the number of columns, "
                f"{len(column_names)}"
            )
        yield kind(
            **{f.name: _parse_cell(row[f.metadata["column"]], f"{file} row {reader.line_num}", f) for f in fields}
        )


@functools.cache
def packaged_motors() -> tuple[MotorSheet, ...]:
    """The packaged motors, in the order of `parts/motors.csv`."""
    return tuple(_read_sheets(MotorSheet, "motors.csv"))


@functools.cache
def packaged_gearboxes() -> tuple[GearboxSheet, ...]:
    """The packaged gearboxes of up to three stages, by family and ratio."""
    return tuple(_read_sheets(GearboxSheet, "gearboxes.csv"))


@functools.cache
def packaged_cells() -> tuple[CellSheet, ...]:
    """Packaged cells. The first is the paper's. No data sheet with its mass was found."""
    return tuple(_read_sheets(CellSheet, "cells.csv"))


#: The paper's parts among the sheets.
MOTOR, GEARBOX, CELL = "RE 30 24 V", "GP 32 C 23:1", "XP2200SL"
#: Ratio of the belt stage between gearbox and driving wheel, which is not changed (docs/explanation/paper-notes.md).
BELT_STAGE = 25 / 12
#: Current above any limit [A].
FREE = 1e9


class DriveOption(NamedTuple):
    """A motor with one size of gearbox (family and number of stages), which has several gear ratios.

    Attributes:
        motor: data sheet of the motor.
        family, stages: family and stages of the gearbox.
        ratios: total gear ratios, ascending.
        gearbox: one of the data sheets of that gearbox.
    """

    motor: MotorSheet
    family: str
    stages: int
    ratios: tuple[float, ...]
    gearbox: GearboxSheet

    @property
    def name(self) -> str:
        """Displayed name."""
        return f"{self.motor.name}, {self.family}, {self.stages} stage{'s' if self.stages > 1 else ''}"


def drive_options(names: Names) -> tuple[DriveOption, ...]:
    """All motors (or those named) with all gearbox sizes that their maker combines with them."""
    options = []
    for motor in packaged_motors():
        if names and motor.name not in names:
            continue
        for family in motor.gearboxes:
            for stages in sorted({g.stages for g in packaged_gearboxes() if g.family == family}):
                ranked = sorted(
                    (g for g in packaged_gearboxes() if (g.family, g.stages) == (family, stages)),
                    key=lambda g: g.ratio,
                )
                ratios = tuple(BELT_STAGE * g.ratio for g in ranked)
                options.append(DriveOption(motor, family, int(stages), ratios, ranked[0]))
    return tuple(options)


_LIPO = "lithium-polymer"


@dataclasses.dataclass(frozen=True)
class PartOptions:
    """Numbers of drives and cells by name, one row for each.

    Attributes:
        drives, cells: data sheets.
        drive, cell: columns of numbers, shapes (drives,) and (cells,).
        base_mass: mass of the paper's two motors, two gearboxes and cells, which is part of the robot's mass [kg].
    """

    drives: tuple[DriveOption, ...]
    cells: tuple[CellSheet, ...]
    drive: Columns
    cell: Columns
    base_mass: float


def _stated(value: float, otherwise: float) -> float:
    return otherwise if math.isnan(value) else value


def options_for_robot(robot: Robot, names: Names = ()) -> PartOptions:
    """Parts to choose from for a robot.

    Args:
        robot: robot whose friction, efficiencies and cells replace values that data sheets lack.
        names: names of motors, empty for all.
    """
    motor_options, packs = (
        drive_options(names),
        tuple(c for c in packaged_cells() if c.cells == 1 and (c.name == CELL or not math.isnan(c.voltage_cut_off))),
    )
    paper_motor = next(m for m in packaged_motors() if m.name == MOTOR)
    paper_gear = next(g for g in packaged_gearboxes() if g.name == GEARBOX)
    paper_cell = next(c for c in packaged_cells() if c.name == CELL)
    sides, battery = float(robot.sides), robot.battery
    idle = paper_motor.torque_constant * paper_motor.current_no_load
    rows = []
    for d in motor_options:
        m, g = d.motor, d.gearbox
        share = m.torque_constant * m.current_no_load / idle
        rows.append(
            {
                "resistance": m.resistance, "torque_constant": m.torque_constant,
                "friction_coulomb": float(robot.motor.friction_coulomb) * share,
                "friction_viscous": float(robot.motor.friction_viscous) * share,
                "inertia": m.inertia, "inductance": m.inductance,
                "resistance_thermal_winding": m.resistance_thermal_winding,
                "resistance_thermal_housing": m.resistance_thermal_housing,
                "efficiency": float(robot.gearbox.efficiency_load) * g.efficiency / paper_gear.efficiency,
                "mass": sides * (m.mass + g.mass), "cost": sides * (m.price + g.price),
                "temperature": _stated(m.temperature_winding_max, robot.motor.temperature_limit),
                "speed_motor": _stated(m.speed_max, robot.motor.speed_limit),
                "speed_gearbox": _stated(g.speed_input_max, robot.gearbox.speed_limit),
                "torque": g.torque_max * BELT_STAGE,
                "ratio_least": d.ratios[0], "ratio_most": d.ratios[-1],
            }
        )  # fmt: skip
    per_charge = next(
        c.mass / (c.cells * c.capacity) for c in packaged_cells() if not math.isnan(c.mass) and c.chemistry == _LIPO
    )
    resistance = float(battery.resistance) * paper_cell.capacity
    columns = [
        {
            "capacity": c.capacity, "voltage_full": c.voltage_full,
            "cutoff": _stated(c.voltage_cut_off, battery.voltage_cutoff),
            "resistance": _stated(c.resistance, resistance / c.capacity),
            "mass": _stated(c.mass, per_charge * c.capacity),
            "current": _stated(c.current_max, FREE),
        }
        for c in packs
    ]  # fmt: skip
    base = sides * (paper_motor.mass + paper_gear.mass) + battery.cells * per_charge * float(battery.capacity)
    return PartOptions(motor_options, packs, _columns(rows), _columns(columns), base)


def _columns(rows: list[dict[str, float]]) -> Columns:
    return {key: np.array([row[key] for row in rows]) for key in rows[0]}
