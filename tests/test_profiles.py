"""Profiles from files: columns, units, modes and settings. Everything wrong is said in one sentence."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from calibration.data import profiles
from calibration.data.input_errors import BadConfiguration
from mmrjax.missions.mission import mission
from mmrjax.missions.profile import MODES
from mmrjax.model.conditions import Conditions
from mmrjax.model.paper_tables import adhesion_ratio
from tests.commands import refused, text_file


@pytest.fixture
def read(tmp_path):
    """Read a profile from text."""
    return lambda text: profiles.read_profile(text_file(tmp_path / "mission.csv", text))


# --- what is read ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", profiles.PACKAGED)
def test_packaged_profile_is_read_by_its_name_and_makes_a_profile(name, robot):
    table = profiles.read_profile(name)
    made = table.profile(robot, Conditions(configuration=np.array([0, 1])))
    assert (made.segment_count, made.cycles, made.linear) == (table.segment_count, table.cycles, table.linear)
    assert made.duration == pytest.approx(table.duration)
    assert tuple(MODES[k] for k in made.mode) == table.modes


def test_packaged_names_are_the_packaged_files():
    from importlib import resources

    folder = resources.files("calibration") / "data/profiles"
    assert {p.name for p in folder.iterdir()} == {f"{name}.csv" for name in profiles.PACKAGED}


def test_packaged_patrol_is_an_hour_with_120_starts():
    table = profiles.read_profile("patrol")
    assert table.duration == 3600
    begins = [a == "speed" and table.demand[k] == 0 for k, a in enumerate(table.modes[:-1])]
    assert table.cycles * sum(begins) == 120


def test_range_of_other_consumers_is_the_batterys(robot):
    from mmrjax.model import params

    (found,) = (p for p in params.walk_parameters(robot) if p.name == "battery.current_other")
    assert profiles.QUANTITIES["current_other"].range == found.spec.bounds


def test_columns_and_settings(read):
    table = read(
        "# a remark\n# cycles = 40\n# between_rows = 'linear'\n"
        "time_s,supply_voltage_V,slope_deg,payload_kg,current_other_A\n0,24,0,0,1\n2,-12,5,3,0.5\n5,0,-5,3,0.5\n"
    )
    assert (table.cycles, table.linear, table.duration) == (40, True, 200)
    assert table.modes == ("voltage",) * 3
    assert_allclose(table.values["voltage"], [24, -12, 0])  # negative: backward
    assert_allclose(table.values["payload"], [0, 3, 3])
    assert table.stated == ("supply_voltage_V", "slope_deg", "payload_kg")


@pytest.mark.parametrize(
    "column, cell, field, value",
    [
        ("speed_km_h", "1.8", "demand", 0.5),
        ("speed_m_s", "0.5", "demand", 0.5),
        ("speed_mm_s", "500", "demand", 0.5),
        ("motor_speed_rpm", "60", "demand", 2 * np.pi),
        ("motor_speed_rad_s", "7", "demand", 7.0),
        ("slope_rad", "0.1", "slope_deg", np.degrees(0.1)),
        ("slope_percent", "10", "slope_deg", np.degrees(np.arctan(0.1))),
        ("duty_percent", "-50", "duty", -0.5),
        ("payload_g", "1500", "payload", 1.5),
        ("current_other_mA", "700", "current_other", 0.7),
        ("supply_voltage_mV", "24000", "voltage", 24.0),
    ],
)
def test_units_in_names(read, column, cell, field, value):
    table = read(f"time_min,{column}\n0,{cell}\n0.5,{cell}\n")
    assert table.duration == 30
    found = table.demand if field == "demand" else table.values[field]
    assert_allclose(found, value, rtol=1e-12)


def test_mode_is_that_of_the_demand_that_is_filled_in(read):
    table = read(
        "time_s,duty,motor_speed_rpm,speed_mm_s,mode\n0,0.5,,,\n1,,3000,,\n2,,,400,\n3,,,,brake\n4,,,,coast\n5,,,,\n"
    )
    assert table.modes == ("voltage", "motor_speed", "speed", "brake", "coast", "coast")
    assert_allclose(table.demand[:3], [0, 100 * np.pi, 0.4])
    assert table.values["duty"][0] == 0.5


def test_sides_and_yaw_rates_are_read(read):
    found = read("time_s,voltage_left_V,voltage_right_V\n0,10,-5\n2,12,12\n4,,\n")
    assert found.turns and set(found.modes) == {"voltage"}
    assert found.values["voltage_right"].tolist()[:2] == [-5.0, 12.0]
    found = read(
        "# between_rows = 'linear'\ntime_s,speed_mm_s,yaw_rate_deg_s,mode\n0,0,0,\n1,300,90,\n2,0,0,brake\n3,,,\n"
    )
    assert found.modes == ("speed", "speed", "brake", "brake") and "duty" not in found.values
    assert_allclose(found.values["yaw_rate"], [0, np.pi / 2, 0, 0])
    assert not read("time_s,speed_mm_s\n0,300\n5,300\n").turns


def test_ramp_ends_at_the_cell_of_the_row_that_brakes_or_else_is_held(read):
    head = "# between_rows = 'linear'\ntime_s,speed_mm_s,mode\n0,0,\n1,400,\n"
    assert_allclose(read(head + "2,0,brake\n3,,brake\n").demand[:3], [0, 0.4, 0])
    assert_allclose(read(head + "2,,brake\n3,,brake\n").demand[:3], [0, 0.4, 0.4])
    duties = read("# between_rows = 'linear'\ntime_s,duty,mode\n0,0,\n1,0.8,\n2,,coast\n3,,coast\n").values["duty"]
    assert_allclose(duties[:3], [0, 0.8, 0.8])


def test_surface_scales_the_adhesion_of_each_runs_movers(read, robot):
    table = read("time_s,speed_mm_s,surface\n0,400,asphalt\n5,400,linoleum\n9,,\n")
    made = table.profile(robot, Conditions(configuration=np.array([0, 1, 0])))
    wanted = [[adhesion_ratio(s, t) for s in ("asphalt", "linoleum", "linoleum")] for t in (True, False, True)]
    assert_allclose(made.adhesion, wanted)


def test_supply_voltage_beside_the_battery_is_refused(read):
    table = read("time_s,supply_voltage_V\n0,24\n1,24\n")
    table.check_supply(battery=False)
    with refused(r"--battery cannot be combined with mission.csv, which gives supply_voltage_V", BadConfiguration):
        table.check_supply(battery=True)


# --- what is refused ------------------------------------------------------------------------------------------------


def test_a_mission_may_begin_in_motion_and_warm(read):
    table = read("# start_speed_mm_s = 400\n# start_winding_C = 60\ntime_s,mode\n0,coast\n1,\n")
    assert table.start is not None and table.begins == {"speed": 0.4, "temperature_winding": 60.0}
    assert read("time_s,mode\n0,coast\n1,\n").start is None


@pytest.mark.slow
def test_a_mission_begins_as_its_profile_says(read, robot):
    table = read("# start_speed_mm_s = 400\n# start_winding_C = 60\ntime_s,mode\n0,coast\n1,\n")
    found = mission(
        robot,
        Conditions(voltage=24.0),
        table.profile(robot, Conditions([0])),
        table.start,
    )
    assert float(found.total.of["distance"]) > 0.01 and 59.0 < float(found.peaks["temperature"]) <= 60.0
