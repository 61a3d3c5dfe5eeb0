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
#: Columns of numbers without a unit, and of several names in a cell.
PLAIN, LISTED = ("cells", "ratio", "stages"), "gearboxes"
#: A data sheet: values by the names of its columns, without their units.
Sheet = types.SimpleNamespace


def _value_in_si(column: str, text: str) -> tuple[str, Any]:
    """Name of a column without its unit, and the value of a cell in SI. NaN for a number that is missing."""
    if column == LISTED:
        return column, tuple(part.strip() for part in text.split(";") if part.strip())
    unit = max((u for u in UNITS if column.endswith(f"_{u}")), key=len, default="")
    if not unit and column not in PLAIN:
        return column, text
    return column.removesuffix(f"_{unit}"), float(Fraction(text)) * UNITS.get(unit, 1.0) if text else math.nan


@functools.cache
def packaged_sheets(table: str) -> tuple[Sheet, ...]:
    """Data sheets of a packaged table, `motors`, `gearboxes` or `cells`, in its order. The first cell is the
    paper's.
    """
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
FREE = 1e9


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
                ranked = sorted(
                    (g for g in packaged_sheets("gearboxes") if (g.family, g.stages) == (family, stages)),
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
    cells: tuple[Sheet, ...]
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
        tuple(
            c
            for c in packaged_sheets("cells")
            if c.cells == 1 and (c.name == CELL or not math.isnan(c.cut_off_voltage))
        ),
    )
    paper_motor = next(m for m in packaged_sheets("motors") if m.name == MOTOR)
    paper_gear = next(g for g in packaged_sheets("gearboxes") if g.name == GEARBOX)
    paper_cell = next(c for c in packaged_sheets("cells") if c.name == CELL)
    sides, battery = float(robot.sides), robot.battery
    idle = paper_motor.torque_constant * paper_motor.no_load_current
    rows = []
    for d in motor_options:
        m, g = d.motor, d.gearbox
        share = m.torque_constant * m.no_load_current / idle
        rows.append(
            {
                "resistance": m.terminal_resistance, "torque_constant": m.torque_constant,
                "friction_coulomb": float(robot.motor.friction_coulomb) * share,
                "friction_viscous": float(robot.motor.friction_viscous) * share,
                "inertia": m.rotor_inertia, "inductance": m.terminal_inductance,
                "resistance_thermal_winding": m.thermal_resistance_winding_housing,
                "resistance_thermal_housing": m.thermal_resistance_housing_ambient,
                "efficiency": float(robot.gearbox.efficiency_load) * g.max_efficiency / paper_gear.max_efficiency,
                "mass": sides * (m.weight + g.weight), "cost": sides * (m.price + g.price),
                "temperature": _stated(m.max_winding_temperature, robot.motor.temperature_limit),
                "speed_motor": _stated(m.max_speed, robot.motor.speed_limit),
                "speed_gearbox": _stated(g.max_continuous_input_speed, robot.gearbox.speed_limit),
                "torque": g.max_continuous_torque * BELT_STAGE,
                "ratio_least": d.ratios[0], "ratio_most": d.ratios[-1],
            }
        )  # fmt: skip
    per_charge = next(
        c.weight / (c.cells * c.capacity)
        for c in packaged_sheets("cells")
        if not math.isnan(c.weight) and c.chemistry == _LIPO
    )
    resistance = float(battery.resistance) * paper_cell.capacity
    columns = [
        {
            "capacity": c.capacity, "voltage_full": c.full_voltage,
            "cutoff": _stated(c.cut_off_voltage, battery.voltage_cutoff),
            "resistance": _stated(c.resistance, resistance / c.capacity),
            "mass": _stated(c.weight, per_charge * c.capacity),
            "current": _stated(c.max_continuous_current, FREE),
        }
        for c in packs
    ]  # fmt: skip
    base = sides * (paper_motor.weight + paper_gear.weight) + battery.cells * per_charge * float(battery.capacity)
    return PartOptions(motor_options, packs, _columns(rows), _columns(columns), base)


def _columns(rows: list[dict[str, float]]) -> Columns:
    return {key: np.array([row[key] for row in rows]) for key in rows[0]}
