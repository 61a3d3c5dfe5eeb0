"""Packaged parts: every value has a source, and each sheet agrees with itself."""

import math

import pytest

from calibration.sizing import part_options
from mmrjax.effects.voltage_effects import ThermalDrift
from mmrjax.model.gearmotor import Gearbox, Motor
from mmrjax.model.power import Battery

TABLES = ("motors", "gearboxes", "cells")
#: What a motor has to state to be sized with.
NEEDED = (
    "nominal_voltage",
    "terminal_resistance",
    "terminal_inductance",
    "torque_constant",
    "no_load_speed",
    "no_load_current",
    "nominal_current",
    "rotor_inertia",
    "max_speed",
    "thermal_resistance_housing_ambient",
    "thermal_resistance_winding_housing",
    "weight",
)


def given(sheet):
    """Numbers that a sheet states."""
    return {name: v for name, v in vars(sheet).items() if isinstance(v, float) and not math.isnan(v)}


def inconsistency(sheet):
    """Relative departures of a sheet's values from each other, NaN where it does not state them."""
    s = sheet
    return {
        "no load": s.no_load_speed
        * s.torque_constant
        / (s.nominal_voltage - s.no_load_current * s.terminal_resistance)
        - 1,
        "constants": s.torque_constant * s.speed_constant - 1,
        "stall current": s.stall_current * s.terminal_resistance / s.nominal_voltage - 1,
        "stall torque": s.stall_torque / (s.torque_constant * s.stall_current) - 1,
        "nominal torque": s.nominal_torque / (s.torque_constant * (s.nominal_current - s.no_load_current)) - 1,
    }


def inconsistent(sheet):
    """What is off by more than 3 % (no load) or 1 % (the rest, rounding)."""
    return [k for k, v in inconsistency(sheet).items() if abs(v) > (0.03 if k == "no load" else 0.01)]


@pytest.mark.parametrize("table", TABLES)
def test_parts_have_sources_and_finite_positive_values(table):
    sheets = part_options.packaged_sheets(table)
    names = [s.name for s in sheets]
    assert len(set(names)) == len(names)
    for sheet in sheets:
        assert sheet.source and sheet.maker, sheet.name
        for name, value in given(sheet).items():
            assert math.isfinite(value) and value > 0, (sheet.name, name)


def test_parts_motors_are_enough_and_state_what_sizing_needs():
    assert len(part_options.packaged_sheets("motors")) >= 8
    assert {m.maker for m in part_options.packaged_sheets("motors")} >= {"maxon", "Faulhaber"}
    for motor in part_options.packaged_sheets("motors"):
        assert set(NEEDED) <= set(given(motor)), motor.name
        power = motor.torque_constant * (motor.nominal_current - motor.no_load_current) * motor.no_load_speed
        assert 10 < power < 200, motor.name


@pytest.mark.parametrize("motor", part_options.packaged_sheets("motors"), ids=lambda m: m.name)
def test_parts_motor_sheet_is_consistent(motor):
    assert inconsistent(motor) == []
    assert motor.no_load_current < 0.2 * motor.nominal_current
    # At its nominal voltage the A-max runs faster without load (6460 rpm) than its page permits (6000 rpm).
    assert motor.no_load_speed < motor.max_speed or motor.order_number == "236662"


def test_parts_winding_stays_cool_at_the_nominal_current():
    """In still air at 25 °C with hot copper, where the sheet states a limit. No sheet rates itself beyond it."""
    for m in part_options.packaged_sheets("motors"):
        if math.isnan(m.max_winding_temperature):
            continue
        hot = m.terminal_resistance * (1 + 0.00393 * (m.max_winding_temperature - 25))
        rise = (
            m.nominal_current**2 * hot * (m.thermal_resistance_housing_ambient + m.thermal_resistance_winding_housing)
        )
        assert 25 + rise < m.max_winding_temperature, m.name


def test_parts_hold_the_robot_of_the_paper():
    (motor,) = (m for m in part_options.packaged_sheets("motors") if m.name == "RE 30 24 V")
    ours = Motor()
    of_sheet = motor.terminal_resistance, motor.terminal_inductance, motor.torque_constant, motor.rotor_inertia
    of_paper = ours.resistance, ours.inductance, ours.torque_constant, ours.inertia
    assert of_sheet == pytest.approx([float(x) for x in of_paper], rel=1e-12)
    thermal = motor.thermal_resistance_housing_ambient + motor.thermal_resistance_winding_housing
    assert thermal == pytest.approx(float(ours.resistance_thermal), rel=1e-12)
    assert motor.thermal_time_constant_winding == pytest.approx(float(ThermalDrift().time_constant), rel=1e-12)
    (gearbox,) = (g for g in part_options.packaged_sheets("gearboxes") if g.order_number == "166936")
    assert gearbox.ratio == pytest.approx(576 / 25) and gearbox.family in motor.gearboxes
    assert abs(gearbox.max_efficiency - Gearbox().efficiency_load) < 0.02  # measured 0.74, catalogue 0.75
    cell = part_options.packaged_sheets("cells")[0]
    assert cell.capacity == pytest.approx(float(Battery().capacity))
    assert cell.resistance == pytest.approx(float(Battery().resistance))


def test_parts_gearboxes_are_consistent():
    for g in part_options.packaged_sheets("gearboxes"):
        assert g.max_intermittent_torque > g.max_continuous_torque and 0.5 < g.max_efficiency < 1, g.name
        assert 3 <= g.ratio ** (1 / g.stages) <= 9, g.name
        assert g.name.startswith(g.family) and float(g.name.split()[-1][:-2]) == pytest.approx(g.ratio, rel=0.04)
        if g.maker == "maxon" and g.family.startswith(
            "GP "
        ):  # those print the power of each ratio, not of the stages
            shaft = g.max_continuous_torque * g.max_continuous_input_speed / g.ratio
            assert math.isnan(g.max_continuous_power) == bool(g.note), g.name
            assert math.isnan(g.max_continuous_power) or g.max_continuous_power < 1.1 * shaft, g.name
    families = {g.family for g in part_options.packaged_sheets("gearboxes")}
    assert all(set(m.gearboxes) <= families and m.gearboxes for m in part_options.packaged_sheets("motors"))


def test_parts_cells_weigh_what_cells_weigh():
    weighed = [c for c in part_options.packaged_sheets("cells") if not math.isnan(c.weight)]
    assert len(weighed) >= 3
    for cell in weighed:
        grams_per_amp_hour = 1e3 * cell.weight / cell.cells / (cell.capacity / 3600)
        assert 13 < grams_per_amp_hour < 30, cell.name
