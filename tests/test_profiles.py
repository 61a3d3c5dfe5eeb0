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

_LINEAR = "# between_rows = 'linear'\n"
WRONG = {
    "a start that is no number": (
        "# start_speed_mm_s = 'fast'\ntime_s,duty\n0,1\n1,1\n",
        "mission.csv, start_speed_mm_s: got 'fast'; expected a number",
    ),
    "time that goes back": ("time_s,duty\n0,1\n5,1\n4,1\n", r"mission.csv row 3, time_s: got 4; expected more than 5"),
    "time that stands": ("time_min,duty\n0,1\n0,1\n", r"row 2, time_min: got 0; expected more than 0 of the row before"),
    "gap in a slope": ("time_s,duty,slope_deg\n0,1,0\n5,1,\n9,1,3\n", r"row 2, slope_deg: got an empty cell; expected a number, -45 to 45"),
    "gap in the time": ("time_s,duty\n0,1\n,1\n9,1\n", r"row 2, time_s: got an empty cell; expected a number, 0 to 1e\+06"),
    "gap at a ramp's end": (_LINEAR + "time_s,duty,slope_deg\n0,1,0\n5,1,\n", r"row 2, slope_deg: got an empty cell"),
    "gap in the surface": ("time_s,duty,surface\n0,1,asphalt\n5,1,\n9,1,\n", r"row 2, surface: got an empty cell; expected one of"),
    "two demands": ("time_s,motor_speed_rpm,speed_mm_s\n0,3000,\n5,3000,400\n6,3000,\n", r"row 2, speed_mm_s: got 400 in addition to motor_speed_rpm; expected one demand per row"),
    "duty beside a speed": ("time_s,duty,speed_mm_s\n0,0.5,400\n5,,400\n", r"row 1, speed_mm_s: got 400 in addition to duty; expected one demand per row"),
    "demand beside another mode": ("time_s,speed_mm_s,mode\n0,400,brake\n5,,brake\n", r"row 1, speed_mm_s: got 400 in addition to mode brake"),
    "no demand": ("time_s,duty,speed_mm_s\n0,1,\n5,,\n9,,400\n", r"row 2: got no demand; expected a value in one of duty, speed_mm_s, or brake or coast"),
    "mode without its column": ("time_s,mode\n0,speed\n5,speed\n", r"row 1, mode: got speed; expected a column with that demand, such as speed_mm_s"),
    "mode without its demand": ("time_s,speed_mm_s,mode\n0,400,\n5,,speed\n9,,\n", r"row 2, speed_mm_s: got an empty cell; expected the demand of mode speed"),
    "unknown mode": ("time_s,mode\n0,breke\n5,\n", r"row 1, mode: got breke; expected one of these; .*brake"),
    "from one demanded speed to another": (_LINEAR + "time_s,motor_speed_rpm,speed_mm_s\n0,3000,\n5,,400\n9,,400\n", r"row 2: goes from a demanded motor_speed to a demanded speed"),
    "duty above 1": ("time_s,duty\n0,1\n5,1.2\n", r"row 2, duty: got 1.2; expected -1 to 1"),
    "duty above 100 %": ("time_s,duty_percent\n0,101\n5,100\n", r"row 1, duty_percent: got 101; expected -100 to 100"),
    "speed out of range in its unit": ("time_s,speed_km_h\n0,40\n5,1\n", r"row 1, speed_km_h: got 40; expected -36 to 36"),
    "slope too steep": ("time_s,slope_percent\n0,120\n5,1\n", r"row 1, slope_percent: got 120; expected -100 to 100"),
    "unknown column": ("time_s,dutty\n0,1\n5,1\n", r"mission.csv: unknown column dutty; .*duty"),
    "column without a name": ("time_s,,duty\n0,1,1\n5,1,1\n", r"unknown column column 2"),
    "unknown unit": ("time_s,speed_kmh\n0,1\n5,1\n", r"unknown column speed_kmh; did you mean speed_km_h, "),
    "no unit": ("time,duty\n0,1\n5,1\n", r"unknown column time; did you mean time_s, time_ms, time_us\? allowed: time_s, "),
    "unit of another quantity": ("time_s,motor_speed_mm_s\n0,1\n5,1\n", r"unknown column motor_speed_mm_s; did you mean .*motor_speed_r"),
    "a quantity twice": ("time_s,speed_mm_s,speed_m_s\n0,1,1\n5,1,1\n", r"got columns speed_mm_s and speed_m_s; expected one of them"),
    "a column twice": ("time_s,duty,duty\n0,1,1\n5,1,1\n", r"got column duty twice"),
    "no time": ("duty\n1\n1\n", r"column time_s is missing"),
    "NaN": ("time_s,duty\n0,nan\n5,1\n", r"row 1, duty: got nan; expected -1 to 1"),
    "infinite time": ("time_s,duty\n0,1\ninf,1\n", r"row 2, time_s: got inf; expected 0 to 1e\+06"),
    "a word": ("time_s,slope_deg\n0,steep\n5,1\n", r"row 1, slope_deg: got steep; expected a number, -45 to 45"),
    "empty file": ("", r"mission.csv: the file is empty; expected a header that includes time_s"),
    "comments only": ("# cycles = 3\n", r"mission.csv: the file is empty"),
    "header only": ("time_s,duty\n", r"got a header and no rows; expected at least two rows"),
    "one row only": ("time_s,duty\n0,1\n", r"got one row; expected at least two rows, the last of which ends the mission"),
    "a short row": ("time_s,duty\n0,1\n5\n", r"row 2: got 1 cell; the header has 2 columns"),
    "commas and points": ("time_s;duty\n0;0,5\n5;0.5\n", r"duty: got 0,5 and 0\.5; expected decimal commas or decimal points"),
    "unknown surface": ("time_s,duty,surface\n0,1,ice\n5,1,ice\n", r"row 1, surface: got ice; expected one of these; .*asphalt"),
    "no cycles": ("# cycles = 0\ntime_s,duty\n0,1\n5,1\n", r"mission.csv, cycles: got 0; expected a whole number from 1 to 1000000"),
    "half a cycle": ("# cycles = 1.5\ntime_s,duty\n0,1\n5,1\n", r"cycles: got 1.5; expected a whole number"),
    "too many cycles": ("# cycles = 1000000\ntime_s,duty\n0,1\n5,1\n", r"got 2 rows times 1000000 cycles; expected at most"),
    "unknown way between rows": ("# between_rows = 'spline'\ntime_s,duty\n0,1\n5,1\n", r"between_rows: got spline; .*allowed: held, linear"),
    "unknown setting": ("# cycle = 4\ntime_s,duty\n0,1\n5,1\n", r"got the setting cycle; .*cycles"),
    "setting that is no TOML": ("# between_rows = held\ntime_s,duty\n0,1\n5,1\n", r"got the line # between_rows = held; expected TOML"),
    "one side's duty": ("time_s,duty_left\n0,1\n5,1\n", r"mission.csv: got duty_left without duty_right; expected both"),
    "one side's voltage": ("time_s,voltage_right_V\n0,1\n5,1\n", r"got voltage_right_V without voltage_left_V; expected both"),
    "duties and voltages": ("time_s,duty_left,duty_right,voltage_left_V,voltage_right_V\n0,1,1,,\n5,1,1,,\n", r"got duty_left together with voltage_left_V; expected one of the two"),
    "duty beside duties": ("time_s,duty,duty_left,duty_right\n0,,1,1\n5,,1,1\n", r"got duty together with duty_left; expected one"),
    "gap in a side": ("time_s,duty_left,duty_right\n0,1,\n5,1,1\n", r"row 1, duty_right: got an empty cell; expected a value for each side"),
    "duties beside a speed": ("time_s,duty_left,duty_right,speed_mm_s\n0,1,1,300\n5,1,1,\n", r"row 1, speed_mm_s: got 300 in addition to duty_left; expected one demand per row"),
    "yaw rate without a speed": ("time_s,yaw_rate_rad_s,duty\n0,1,1\n5,1,1\n", r"got yaw_rate_rad_s without speed_mm_s; expected a demanded ground speed"),
    "gap in the yaw rate": ("time_s,speed_mm_s,yaw_rate_deg_s\n0,300,\n5,300,10\n", r"row 1, yaw_rate_deg_s: got an empty cell; expected the demanded yaw rate, 0 for straight travel"),
    "yaw rate of a braked robot": ("time_s,speed_mm_s,yaw_rate_rad_s,mode\n0,,1,brake\n5,,,\n", r"row 1, yaw_rate_rad_s: got 1; expected an empty cell: a yaw rate needs a demanded speed, not mode brake"),
    "setting twice": ("# cycles = 4\n# cycles = 4\ntime_s,duty\n0,1\n5,1\n", r"cycles is set twice"),
}  # fmt: skip


@pytest.mark.parametrize("case", WRONG)
def test_wrong_profile_is_refused_in_one_sentence(read, case):
    text, message = WRONG[case]
    with refused(message):
        read(text)


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
