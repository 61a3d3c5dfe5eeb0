"""Packaged parts: every value has a source, and each sheet agrees with itself."""

import csv
import dataclasses
import math
import tomllib

import pytest

from calibration.sizing import part_options
from mmrjax.effects.voltage_effects import ThermalDrift
from mmrjax.model.gearmotor import Gearbox, Motor
from mmrjax.model.power import Battery
from tests.commands import ROOT, refused

TABLES = {
    "motors.csv": part_options.packaged_motors,
    "gearboxes.csv": part_options.packaged_gearboxes,
    "cells.csv": part_options.packaged_cells,
}
#: What a motor has to state to be sized with.
NEEDED = (
    "voltage_nominal",
    "resistance",
    "inductance",
    "torque_constant",
    "speed_no_load",
    "current_no_load",
    "current_nominal",
    "inertia",
    "speed_max",
    "resistance_thermal_housing",
    "resistance_thermal_winding",
    "mass",
)


def given(sheet):
    """Numbers that a sheet states."""
    values = {f.name: getattr(sheet, f.name) for f in dataclasses.fields(sheet)}
    return {name: v for name, v in values.items() if isinstance(v, float) and not math.isnan(v)}


def inconsistency(sheet):
    """Relative departures of a sheet's values from each other, NaN where it does not state them."""
    s = sheet
    return {
        "no load": s.speed_no_load * s.torque_constant / (s.voltage_nominal - s.current_no_load * s.resistance) - 1,
        "constants": s.torque_constant * s.speed_constant - 1,
        "stall current": s.current_stall * s.resistance / s.voltage_nominal - 1,
        "stall torque": s.torque_stall / (s.torque_constant * s.current_stall) - 1,
        "nominal torque": s.torque_nominal / (s.torque_constant * (s.current_nominal - s.current_no_load)) - 1,
    }


def inconsistent(sheet):
    """What is off by more than 3 % (no load) or 1 % (the rest, rounding)."""
    return [k for k, v in inconsistency(sheet).items() if abs(v) > (0.03 if k == "no load" else 0.01)]


@pytest.mark.parametrize("file", TABLES)
def test_parts_have_sources_and_finite_positive_values(file):
    sheets = TABLES[file]()
    names = [s.name for s in sheets]
    assert len(set(names)) == len(names)
    for sheet in sheets:
        assert sheet.source and sheet.maker, sheet.name
        for name, value in given(sheet).items():
            assert math.isfinite(value) and value > 0, (sheet.name, name)


def test_parts_motors_are_enough_and_state_what_sizing_needs():
    assert len(part_options.packaged_motors()) >= 8
    assert {m.maker for m in part_options.packaged_motors()} >= {"maxon", "Faulhaber"}
    for motor in part_options.packaged_motors():
        assert set(NEEDED) <= set(given(motor)), motor.name
        power = motor.torque_constant * (motor.current_nominal - motor.current_no_load) * motor.speed_no_load
        assert 10 < power < 200, motor.name


@pytest.mark.parametrize("motor", part_options.packaged_motors(), ids=lambda m: m.name)
def test_parts_motor_sheet_is_consistent(motor):
    assert inconsistent(motor) == []
    assert motor.current_no_load < 0.2 * motor.current_nominal
    # At its nominal voltage the A-max runs faster without load (6460 rpm) than its page permits (6000 rpm).
    assert motor.speed_no_load < motor.speed_max or motor.order_number == "236662"


def test_parts_winding_stays_cool_at_the_nominal_current():
    """In still air at 25 °C with hot copper, where the sheet states a limit. No sheet rates itself beyond it."""
    for m in part_options.packaged_motors():
        if math.isnan(m.temperature_winding_max):
            continue
        hot = m.resistance * (1 + 0.00393 * (m.temperature_winding_max - 25))
        rise = m.current_nominal**2 * hot * (m.resistance_thermal_housing + m.resistance_thermal_winding)
        assert 25 + rise < m.temperature_winding_max, m.name


def test_parts_hold_the_robot_of_the_paper():
    (motor,) = (m for m in part_options.packaged_motors() if m.name == "RE 30 24 V")
    ours = Motor()
    for name in ("resistance", "inductance", "torque_constant", "inertia"):
        assert getattr(motor, name) == pytest.approx(float(getattr(ours, name)), rel=1e-12), name
    thermal = motor.resistance_thermal_housing + motor.resistance_thermal_winding
    assert thermal == pytest.approx(float(ours.resistance_thermal), rel=1e-12)
    assert motor.time_constant_winding == pytest.approx(float(ThermalDrift().time_constant), rel=1e-12)
    (gearbox,) = (g for g in part_options.packaged_gearboxes() if g.order_number == "166936")
    assert gearbox.ratio == pytest.approx(576 / 25) and gearbox.family in motor.gearboxes
    assert abs(gearbox.efficiency - Gearbox().efficiency_load) < 0.02  # measured 0.74, catalogue 0.75
    cell = part_options.packaged_cells()[0]
    assert cell.capacity == pytest.approx(float(Battery().capacity))
    assert cell.resistance == pytest.approx(float(Battery().resistance))


def test_parts_gearboxes_are_consistent():
    for g in part_options.packaged_gearboxes():
        assert g.torque_intermittent_max > g.torque_max and 0.5 < g.efficiency < 1, g.name
        assert 3 <= g.ratio ** (1 / g.stages) <= 9, g.name
        assert g.name.startswith(g.family) and float(g.name.split()[-1][:-2]) == pytest.approx(g.ratio, rel=0.04)
        if g.maker == "maxon" and g.family.startswith(
            "GP "
        ):  # those print the power of each ratio, not of the stages
            shaft = g.torque_max * g.speed_input_max / g.ratio
            assert math.isnan(g.power_max) == bool(g.note), g.name
            assert math.isnan(g.power_max) or g.power_max < 1.1 * shaft, g.name
    families = {g.family for g in part_options.packaged_gearboxes()}
    assert all(set(m.gearboxes) <= families and m.gearboxes for m in part_options.packaged_motors())


def test_parts_cells_weigh_what_cells_weigh():
    weighed = [c for c in part_options.packaged_cells() if not math.isnan(c.mass)]
    assert len(weighed) >= 3
    for cell in weighed:
        grams_per_amp_hour = 1e3 * cell.mass / cell.cells / (cell.capacity / 3600)
        assert 13 < grams_per_amp_hour < 30, cell.name


def test_parts_columns_are_those_of_the_sheets(tmp_path, monkeypatch):
    folder = tmp_path / "data/parts"
    folder.mkdir(parents=True)
    monkeypatch.setattr(part_options.resources, "files", lambda package: tmp_path)
    with (ROOT / "calibration/data/parts/cells.csv").open(encoding="utf-8", newline="") as lines:
        header, first, *_ = csv.reader(lines)

    def write(*rows):
        with (folder / "cells.csv").open("w", encoding="utf-8", newline="") as out:
            csv.writer(out).writerows(rows)

    read = part_options.packaged_cells.__wrapped__
    write(header, first)
    assert read()[0].name == "XP2200SL"
    write(header, [v if c != "capacity_mAh" else "2.2 Ah" for c, v in zip(header, first, strict=True)])
    with refused(r"cells.csv row 2, capacity_mAh: got '2.2 Ah'; expected a number or nothing"):
        read()
    write(header, first[:-1])
    with refused(r"cells\.csv row 2: the number of cells differs from the number of columns, 14"):
        read()
    write(header[:-1], first[:-1])
    with refused(r"cells\.csv: got the columns"):
        read()


def test_parts_are_package_data():
    patterns = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["tool"]["setuptools"]["package-data"]
    packed = {p.name for pattern in patterns["calibration"] for p in (ROOT / "calibration").glob(pattern)}
    assert set(TABLES) <= packed
