"""Columns that `inspect` proposes: units decide, then behaviour, then names."""

import tomllib

import numpy as np
import pytest
from numpy.testing import assert_allclose

from calibration.data import contents, robot_file, runs

RIG = """
schema = "mmrjax.robot/2"
base = "none"
sides = 1
imposed = "voltage"
start = "measured"
channels = ["motor_current", "total_current", "motor_speed", "output_angle", "motor_voltage"]
[motor]
resistance = 0.4
torque_constant = 0.05
friction_coulomb = 0.01
[gearbox]
ratio = 1
efficiency_load = 1
[drive]
load = "shaft"
inertia = 1e-3
loss_coulomb = 0.0
"""
N = 60
TIME = 0.02 * np.arange(N)
WAVE = np.sin(2 * np.pi * TIME) + 0.3 * np.sin(5.3 * TIME)
#: Values in SI, by quantity.
TRUTH = {
    "supply_voltage": 24 + 0.5 * WAVE, "motor_current": 3 + WAVE, "motor_speed": 400 + 20 * WAVE,
    "output_angle": 2 + 0.4 * WAVE,
}  # fmt: skip
#: Names of a quantity in files, with the unit's factor to SI; {} takes the unit as it is written.
UNITS = {
    "supply_voltage": {"V": 1, "mV": 1e-3}, "motor_current": {"A": 1, "mA": 1e-3},
    "motor_speed": {"rpm": np.pi / 30, "rad/s": 1, "turns/s": 2 * np.pi},
    "output_angle": {"deg": np.pi / 180, "rad": 1, "turns": 2 * np.pi},
}  # fmt: skip
NAMES = {
    "supply_voltage": ("battery voltage [{}]", "vbus_{}", "bus.voltage ({})", "U_Bat [{}]", "dc voltage [{}]"),
    "motor_current": (
        "motor_current_{}",
        "axis q-current [{}]",
        "Motor Current ({})",
        "i_mot [{}]",
        "phase_current_{}",
    ),
    "motor_speed": ("motor velocity [{}]", "n_Mot ({})", "motorSpeed [{}]", "omega [{}]", "rotor speed ({})"),
    "output_angle": ("output angle [{}]", "theta ({})", "joint position [{}]", "outputAngle [{}]"),
}
#: Signals that are no columns.
OTHERS = {
    "motor current cmd [A]": 3 + WAVE, "speed_setpoint [rpm]": 3000 + WAVE, "pwm_enable_flag": np.arange(N) % 2,
    "boot_stamp": 1.8e9 + TIME, "sample_count": np.arange(N), "indicated_airspeed_m_s": 12 + WAVE,
    "limit [A]": np.full(N, 30.0), "target angle [deg]": 100 + WAVE, "latitude": 41 + 1e-3 * WAVE,
    "error_code": (np.arange(N) // 30) * 1.0, "roll_speed_rad_s": WAVE,
}  # fmt: skip


@pytest.fixture(scope="module")
def rig(tmp_path_factory):
    file = tmp_path_factory.mktemp("rig") / "rig.toml"
    file.write_text(RIG)
    return robot_file.read_robot(file)


def proposed(source):
    return tomllib.loads("\n".join(contents.inspect_source(source).proposed))


@pytest.mark.parametrize("seed", range(50))
def test_proposals_of_a_generated_file_are_read_as_they_are(rig, seed):
    random = np.random.default_rng(seed)
    table, signal_of = {"time [s]": TIME}, {}
    for quantity, values in TRUTH.items():
        unit = str(random.choice([*UNITS[quantity]]))
        name = str(random.choice(NAMES[quantity])).format(unit)
        signal_of[quantity] = name
        table[name] = values / UNITS[quantity][unit]
    for name in random.choice([*OTHERS], 4, replace=False):
        table[str(name)] = OTHERS[str(name)]
    order = ["time [s]", *random.permutation([n for n in table if n != "time [s]"])]
    table = {str(name): table[str(name)] for name in order}
    columns = proposed(table)
    assert {*columns.values()} | {n for n in signal_of.values() if n.startswith("motor_current_")} == {
        "time [s]", *signal_of.values()
    }  # fmt: skip
    read = runs.read_runs(table, rig, columns=columns)
    assert_allclose(read.conditions(rig).voltage, TRUTH["supply_voltage"], rtol=1e-9)
    for quantity in ("motor_current", "motor_speed", "output_angle"):
        k = [c.name for c in rig.channels].index(quantity)
        assert_allclose(read.measured()[:, k], TRUTH[quantity], rtol=1e-9)


def test_a_current_of_the_supply_is_told_from_the_motors_by_the_power():
    duty, motor = 0.5 + 0.3 * WAVE, 4 + WAVE
    table = {"time_s": TIME, "duty_pct": 100 * duty, "current_a": duty * motor + 0.01, "current_b": motor}
    columns = proposed(table)
    assert columns["total_current_A"] == "current_a" and columns["motor_current_A"] == "current_b"
    assert columns["duty"] == {"column": "duty_pct", "factor": 0.01}


def test_numbers_without_a_unit_raise_the_question_of_their_size():
    table = {"time_s": TIME, "drive.motor_current": 3000 + 99 * WAVE, "pack.battery_voltage": 16000 + 50 * WAVE}
    lines = contents.inspect_source(table).proposed
    assert 'motor_current_mA = "drive.motor_current"  # numbers up to 3128: mA?' in lines
    assert any(line.startswith("supply_voltage_mV") for line in lines)


def test_one_signal_in_a_unit_needs_no_name_and_two_need_one():
    one = {"t": TIME, "Kanal 1 [V]": 24 + WAVE, "Kanal 2 [1/min]": 3000 + WAVE}
    assert proposed(one)["supply_voltage_V"] == "Kanal 1 [V]" and "motor_speed_rpm" in proposed(one)
    assert "supply_voltage_V" not in proposed({**one, "Kanal 3 [V]": 5 + WAVE})


def test_several_candidates_are_listed_with_their_question():
    table = {"t": TIME, "wheel velocity a [rad/s]": WAVE, "wheel velocity b [rad/s]": 2 * WAVE}
    (line,) = (x for x in contents.inspect_source(table).proposed if "speed" in x)
    assert "or wheel velocity b [rad/s]: which one is the output speed?" in line


def test_results_of_a_calculation_are_no_readings():
    """A student's workbook: its speed had no proposal, and its torque was the prediction of a regression."""
    table = {
        "Tach Reading (RPM)": 100 + WAVE, "Current Draw (A)": 0.4 + 0.1 * WAVE, "Torque (N-m)": 0.2 + 0.1 * WAVE,
        "Applied Voltage (v)": 9 + WAVE, "Predicted_Torque": 0.2 + 0.1 * WAVE, "Residuals": 0.01 * WAVE,
        "Z_Score_Current Draw (A)": WAVE, "Z_Score_Tach Reading (RPM)": WAVE, "Standardized Residuals": WAVE,
    }  # fmt: skip
    assert proposed(table) == {
        "motor_speed_rpm": "Tach Reading (RPM)", "total_current_A": "Current Draw (A)",
        "output_torque_Nm": "Torque (N-m)", "supply_voltage_V": "Applied Voltage (v)",
    }  # fmt: skip


def test_letters_within_a_device_name_mean_nothing():
    """A leg's actuators: `pack` of `Actpack` made the motor's current and voltage those of the supply."""
    device = "knee[DephyActpack]:"
    table = {"t": TIME, f"{device}motor_current": 4000 + 99 * WAVE, f"{device}battery_current": 900 + 9 * WAVE}
    table |= {f"{device}motor_voltage": 7000 + 99 * WAVE, f"{device}battery_voltage": 40000 + 99 * WAVE}
    assert proposed(table) == {
        "time_s": "t", **{f"{q}_m{u}": f"{device}{name}" for q, u, name in (
            ("motor_current", "A", "motor_current"), ("total_current", "A", "battery_current"),
            ("motor_voltage", "V", "motor_voltage"), ("supply_voltage", "V", "battery_voltage"),
        )},
    }  # fmt: skip


def test_volts_of_a_sensor_are_no_supply():
    assert "supply_voltage_V" not in proposed({"t": TIME, "encoder_V": 3 + WAVE, "current_A": 1 + WAVE})


def test_a_column_of_a_channel_that_the_robot_lacks_is_reported(tmp_path):
    entry = 'output_torque_Nm = "Torque [Nm]"'
    (tmp_path / "rig.toml").write_text(RIG.replace("[motor]", f"[columns]\n{entry}\n[motor]"))
    robot = robot_file.read_robot(tmp_path / "rig.toml")
    table = {"supply_voltage_V": 9 + WAVE, "motor_speed_rpm": 900 + WAVE, "Torque [Nm]": 0.2 + 0.1 * WAVE}
    (note,) = (str(n) for n in runs.read_runs(table, robot).notes if "Torque [Nm]" in str(n))
    assert '"channels" does not list output_torque' in note and "load_torque_Nm if a brake" in note
