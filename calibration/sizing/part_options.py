"""Parts to choose from: drives (motor and gearbox) and cells from the packaged data sheets, as arrays.

If a sheet lacks a number that the model needs, the paper's robot is scaled (docs/howto/size.md). Friction of a motor
is scaled by its no-load torque, efficiency of a gearbox by the sheet's largest, and resistance and mass of a cell by
its capacity. For winding and speeds, the robot's own ratings apply.
"""

from __future__ import annotations

import dataclasses
import math
from typing import NamedTuple

import numpy as np

from calibration.data import Columns, Names
from calibration.data.parts import (
    CellSheet,
    GearboxSheet,
    MotorSheet,
    packaged_cells,
    packaged_gearboxes,
    packaged_motors,
)
from mmrjax.model.robot import Robot

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
