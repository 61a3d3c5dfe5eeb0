"""Presets of loggers: names, units and signs of their columns, and the numbers that they ask for."""

import json

import numpy as np
import pandas as pd
import pytest
from numpy.testing import assert_allclose

from calibration.data import presets_file
from calibration.data import runs as records
from calibration.data.input_errors import BadConfiguration
from calibration.data.sources import reading
from tests.commands import csv_text, read_rig, refused, text_file

RIG = """
base = "none"
imposed = "{imposed}"
channels = [{channels}]
[motor]
resistance = 2.0
torque_constant = 0.05
[gearbox]
ratio = 1
efficiency_load = 1.0
[bench]
load = "shaft"
inertia = 0.001
loss_coulomb = 0.01
"""
VESC = {
    "ms_today": [52895688, 52895828, 52895968], "input_voltage": [50.8, 50.8, 50.7], "current_motor": [0.31, 0.4, 0.5],
    "current_in": [0.08, 0.1, 0.2], "erpm": [700.0, 1400.0, 2100.0], "duty_cycle": [0.1, 0.2, 0.3],
    "ms_today_setup": [52844318, 52844318, 52844318],
}  # fmt: skip


def robot(tmp_path, *channels, imposed="voltage"):
    return read_rig(tmp_path, RIG.format(imposed=imposed, channels=", ".join(f'"{c}"' for c in channels)))


@pytest.mark.parametrize("name", presets_file.PACKAGED)
def test_every_packaged_preset_can_be_read(name):
    given = ",".join([name, *(f"{key}=2" for key in presets_file.numbers_to_state(name))])
    found = presets_file.find_preset(given)
    assert found.columns and all(column.factor and column.source_columns for column in found.columns)


def test_vesc_counts_electrical_turns_and_has_two_clocks(tmp_path):
    pd.DataFrame(VESC).to_csv(tmp_path / "log.csv", index=False, sep=";")
    rig = robot(tmp_path, "total_current", "motor_current", "motor_speed")
    found = records.read_runs(tmp_path / "log.csv", rig, columns="vesc,pole_pairs=7")
    assert_allclose(found["motor_speed_rpm"], [100, 200, 300])
    assert_allclose(found["time_s"], [0, 0.14, 0.28])
    assert_allclose(found["duty"], [0.1, 0.2, 0.3])
    assert_allclose(found["motor_current_A"], np.sqrt(0.75) * np.array(VESC["current_motor"]))
    assert any("erpm, read as motor_speed_rpm, is electrical" in note for note in found.notes)
    with refused(r"pole_pairs is missing, the pairs of poles .* --columns vesc,pole_pairs=7", BadConfiguration):
        records.read_runs(tmp_path / "log.csv", rig, columns="vesc")


def test_a_three_phase_motor_is_the_dc_motor_of_the_same_power_and_torque(tmp_path):
    resistance, flux, poles, supply = 0.05, 0.01, 7, 40.0  # of a phase
    duty, amplitude = np.array([0.3, 0.6, 0.9]), np.array([5.0, 10.0, 20.0])
    voltage = duty * supply / np.sqrt(3)  # amplitude of a phase
    speed = (voltage - resistance * amplitude) / (flux * poles)
    log = {
        "input_voltage": supply + 0 * duty, "duty_cycle": duty, "current_motor": amplitude,
        "current_in": 1.5 * voltage * amplitude / supply, "erpm": speed * poles * 30 / np.pi,
    }  # fmt: skip
    rig = robot(tmp_path, "total_current", "motor_current", "motor_speed")
    found = records.read_runs(log, rig, columns=f"vesc,pole_pairs={poles}")
    current, constant = found["motor_current_A"], np.sqrt(3) * flux * poles
    assert_allclose(found["total_current_A"], duty * current, rtol=1e-6)
    assert_allclose(constant * current, 1.5 * poles * flux * amplitude, rtol=1e-6)  # torque
    at_motor = 2 * resistance * current + constant * found["motor_speed_rpm"] * np.pi / 30
    assert_allclose(at_motor, duty * supply, rtol=1e-6)
    assert any("equivalent DC motor" in note for note in found.notes)


@pytest.mark.parametrize("along_d, noted", [(0.1, False), (3.0, True)])
def test_a_weakened_field_is_noted(tmp_path, along_d, noted):
    log = {**VESC, "d_axis_current": [along_d, -along_d, along_d]}
    rig = robot(tmp_path, "total_current", "motor_current", "motor_speed")
    notes = records.read_runs(log, rig, columns="vesc,pole_pairs=7").notes
    assert any("field weakening" in note for note in notes) == noted


SYSID = [[0.02 * k, 0.5 * k, 0.1 * k, 1.0 * k] for k in range(4)]
ENTRIES = [
    {"position": 0.1 * k, "speed": 1.0 * k, "load": 102.3 * k, "input_volts": 15.0, "timestamp": 0.01 * k}
    for k in range(4)
]
EPISODES = {
    "observation.state": [[1.0 * k, 10.0 * k] for k in range(4)], "timestamp": [0.0, 0.1, 0.0, 0.1],
    "episode_index": [0, 0, 1, 1], "supply_voltage_V": 12.0,
}  # fmt: skip
#: Preset → log, channels of the robot, and columns that are read. A log is a text, a frame, or columns of a CSV file.
LOGS = {
    "simplefoc": (  # milliamperes, and no header
        "2.0\t2.00\t0\t150\t0\t10.0\t0.1\n3.0\t3.00\t0\t250\t0\t15.0\t0.2\n",
        ("motor_current", "motor_speed"),
        {"motor_current_A": np.sqrt(0.75) * np.array([0.15, 0.25]),
         "motor_speed_rpm": np.array([10.0, 15.0]) * 30 / np.pi, "supply_voltage_V": np.sqrt(3) * np.array([2, 3])},
    ),
    "sysid": (  # a run for each test
        json.dumps({"sysid": True, "slow-forward": SYSID, "fast-forward": SYSID}),
        ("output_speed",),
        {"run_id": ["slow-forward"] * 4 + ["fast-forward"] * 4, "output_speed_rpm": np.tile([0.0, 60, 120, 180], 2)},
    ),
    "bam,load_limit=1023": (  # entries with a duty
        json.dumps({"mass": 0.5, "entries": ENTRIES}),
        ("output_speed",),
        {"duty": [0, 0.1, 0.2, 0.3], "output_speed_rpm": np.arange(4) * 30 / np.pi},
    ),
    "lerobot,joint=1": (  # a run for each episode
        pd.DataFrame(EPISODES),
        ("output_angle",),
        {"run_id": ["0", "0", "1", "1"], "output_angle_deg": [0, 10, 20, 30]},
    ),
    "rcbenchmark": (  # an optical speed without readings gives way to the electrical one
        {"Time (s)": [0.0, 0.1], "Voltage (V)": [16.0, 16.0], "Current (A)": [1.0, 2.0],
         "Motor Electrical Speed (RPM)": [1000.0, 2000.0], "Motor Optical Speed (RPM)": [0, 0]},
        ("motor_speed",),
        {"motor_speed_rpm": [1000, 2000]},
    ),
}  # fmt: skip


@pytest.mark.parametrize("preset", LOGS)
def test_a_log_of_a_preset_is_read(tmp_path, preset):
    log, shown, expected = LOGS[preset]
    if isinstance(log, str):
        log = text_file(tmp_path / ("log.json" if log.startswith("{") else "log.txt"), log)
    elif isinstance(log, pd.DataFrame):
        log.to_parquet(tmp_path / "file-000.parquet")
        log = tmp_path / "file-000.parquet"
    else:
        log = text_file(tmp_path / "log.csv", csv_text(log))
    found = records.read_runs(log, robot(tmp_path, *shown), columns=preset)
    for column, values in expected.items():
        if column == "run_id":
            assert found[column].tolist() == values
        else:
            assert_allclose(found[column], values, atol=1e-12)


def test_columns_of_ones_own_win_over_those_of_the_robots_file(tmp_path):
    mine = {"supply_voltage_V": "u", "motor_speed_rad_s": {"column": "w", "factor": -1.0}}
    log = {"u": [1.0, -2.0], "w": [-3.0, 4.0], "speed": [1.0, 1.0]}
    found = records.read_runs(log, robot(tmp_path, "motor_speed"), columns=mine)
    assert_allclose(found["motor_speed_rpm"], np.array([3.0, -4.0]) * 30 / np.pi)


def test_feetech_signs_are_bits(tmp_path):
    dump = {
        "t": [0.0, 0.01, 0.02, 0.03], "Present_Voltage": [120, 121, 119, 120], "Present_Load": [0, 500, 1024 + 250, -250],
        "Present_Current": [0, 100, 32768 + 20, -20], "Present_Velocity": [0, 4096, 32768 + 1024, -1024],
        "Present_Position": [2048, 4095, 32768 + 2048, -2048],
    }  # fmt: skip
    pd.DataFrame(dump).to_csv(tmp_path / "log.csv", index=False)
    rig = robot(tmp_path, "motor_current", "output_speed", "output_angle")
    for source in (tmp_path / "log.csv", {name: np.array(values) for name, values in dump.items()}):
        found = records.read_runs(source, rig, columns="feetech")
        assert_allclose(found["supply_voltage_V"], [12.0, 12.1, 11.9, 12.0])
        assert_allclose(found["duty"], [0, 0.5, -0.25, -0.25])
        assert_allclose(found["motor_current_A"], [0, 0.65, -0.13, -0.13])
        assert_allclose(found["output_speed_rpm"], [0, 60, -15, -15])
        assert_allclose(found["output_angle_deg"], [180, 4095 * 360 / 4096, -180, -180])


@pytest.mark.parametrize("preset, names, bits, limits", [
    ("damiao,v_max=30,t_max=10", ("p_int", "v_int", "t_int"), (16, 12, 12), (12.5, 30, 10)),
    ("robstride,speed_max=44,torque_max=17", ("angle_raw", "velocity_raw", "torque_raw"), (16, 16, 16), (4 * np.pi, 44, 17)),
])  # fmt: skip
def test_integers_of_a_frame_are_a_share_of_their_limits(tmp_path, preset, names, bits, limits):
    values = np.array([[-1, 0.25, 1], [-0.5, 0, 1], [-1, 0.1, 0.9]]) * np.array(limits)[:, None]
    raw = [np.round((x / most + 1) / 2 * (2**n - 1)) for x, most, n in zip(values, limits, bits, strict=True)]
    step = [2 * most / (2**n - 1) for most, n in zip(limits, bits, strict=True)]
    rig = robot(tmp_path, "output_speed", "output_angle", "output_torque", imposed="motor_current")
    log = {"t": [0, 0.1, 0.2], **dict(zip(names, raw, strict=True)), "motor_current_A": [0.0, 1.0, 2.0]}
    found = records.read_runs(log, rig, columns=preset)
    assert_allclose(np.radians(found["output_angle_deg"]), values[0], atol=0.51 * step[0])
    assert_allclose(found["output_speed_rpm"] * np.pi / 30, values[1], atol=0.51 * step[1])
    assert_allclose(found["output_torque_Nm"], values[2], atol=0.51 * step[2])
    assert found["output_torque_Nm"][0] == pytest.approx(-limits[2]), "the least integer is exactly the limit"
    assert any("computed from the current" in note for note in found.notes)


def test_integers_are_decoded_before_they_are_interpolated(tmp_path):
    fast = {"time": np.arange(0, 1, 0.1), "Present_Velocity": np.tile([32768 + 100.0, 100.0], 5)}
    slow = {"time": np.array([0.05, 0.55]), "Present_Position": np.array([2048.0, 2048.0])}
    rates = {f"{group}/{name}": values for group, log in (("a", fast), ("b", slow)) for name, values in log.items()}
    np.savez(tmp_path / "log.npz", **rates, supply_voltage_V=12.0)
    found = records.read_runs(
        tmp_path / "log.npz", robot(tmp_path, "output_speed", "output_angle"), columns="feetech"
    )
    assert_allclose(found["output_speed_rpm"][:4] * 4096 / 60, [-100, 100, -100, 100])


@pytest.mark.parametrize("topic", ["/arm/joint_states", "/dynamic_joint_states"])
@pytest.mark.parametrize("preset, column", [("ros2", "output_torque_Nm"), ("ros2_amperes", "motor_current_mA")])
def test_ros_2_effort_is_what_the_preset_assumes(tmp_path, topic, preset, column):
    from rosbags.rosbag2 import Writer
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE)
    value, state = "control_msgs/msg/InterfaceValue", "control_msgs/msg/DynamicJointState"
    store.register(get_types_from_msg("string[] interface_names\nfloat64[] values", value))
    store.register(get_types_from_msg(
        "std_msgs/Header header\nstring[] joint_names\ncontrol_msgs/InterfaceValue[] interface_values", state
    ))  # fmt: skip
    kind = "sensor_msgs/msg/JointState" if "arm" in topic else state
    with Writer(tmp_path / "bag", version=9) as writer:
        link = writer.add_connection(topic, kind, typestore=store)
        for k in range(4):
            at, joints = 10**9 + 10**7 * k, [np.array([9.0, 9, 9]), np.array([0.5 * k, 2.0 * k, 1.5 * k])]
            header = store.types["std_msgs/msg/Header"](store.types["builtin_interfaces/msg/Time"](1, 10**7 * k), "")
            fields = (
                [*np.array(joints).T.copy()] if kind != state else [[store.types[value](["position", "velocity", "effort"], x) for x in joints]]
            )  # fmt: skip
            writer.write(link, at, store.serialize_cdr(store.types[kind](header, ["a", "b"], *fields), kind))
    table, mapped = reading.read_columns(
        tmp_path / "bag", records.Layout.of(None), presets_file.find_preset(f"{preset},joint=1")
    )
    values = dict(zip(table.header, table.values, strict=True))
    found = {mine: factor * values[theirs] for mine, theirs, factor in mapped}
    assert_allclose(found["output_speed_rad_s"], 2.0 * np.arange(4))
    assert_allclose(found[column], 1.5 * np.arange(4) * (1000 if "mA" in column else 1))
    assert any(f"read as {column}, is assumed to be" in note for note in table.notes)


@pytest.mark.parametrize("imposed", ["voltage", "motor_speed"])
def test_a_supply_without_its_duty_does_not_drive_the_motor(tmp_path, imposed):
    text = "input_voltage,erpm,current_motor\n40,7000,3\n41,8000,4\n"
    (tmp_path / "log.csv").write_text(text)
    channels = ("motor_speed", "motor_current") if imposed == "voltage" else ("motor_current",)
    rig = robot(tmp_path, *channels, imposed=imposed)
    if imposed == "voltage":
        with refused(r"has no duty_cycle; --columns vesc needs it for duty"):
            records.read_runs(tmp_path / "log.csv", rig, columns="vesc,pole_pairs=7")
    else:
        assert len(records.read_runs(tmp_path / "log.csv", rig, columns="vesc,pole_pairs=7")) == 2
