"""Files that come in: what opens them, which are refused, and in which words."""

import os
import re

import pytest
from numpy.testing import assert_array_equal

from calibration.data import input_files
from calibration.data.input_errors import BadConfiguration, BadData, InputError
from calibration.data.runs import Path, read_runs
from calibration.discovery.loop_input import remove_copies
from calibration.inference.checks import _check_stuck_channels
from calibration.inference.fit_notes import Remark
from tests.commands import read_rig, read_table

RIG = """
base = "none"
channels = ["motor_current", "output_speed"]
{more}
[motor]
resistance = 1.0
torque_constant = 0.05
[gearbox]
ratio = 1
efficiency_load = 1.0
[shaft]
load = "shaft"
inertia = 1e-4
loss_coulomb = 0.01
"""


def bench(tmp_path, more=""):
    return read_rig(tmp_path, RIG.format(more=more))


def table(tmp_path, text, robot):
    return read_table(tmp_path, text, robot, "t.csv")


DEEP = "a." * 4_999 + "a"
TOML = {
    "nested": ("x = " + "[" * 5000 + "]" * 5000, "nested too deeply; expected at most 16 levels"),
    "400 digits": ("[motor]\nresistance = 1" + "0" * 400, "a whole number beyond 64 bits"),
    "5000 digits": ("[motor]\nresistance = 1" + "0" * 5000, "not a readable TOML file"),
    "a long header": (f"[{DEEP}]\nx = 1", "nested too deep"),
    "many keys": ("".join(f"k{k} = 1\n" for k in range(2_001)), "more than 2,000 keys; is it the right file"),
    "a long value": ('base = "' + "x" * 100_000 + '"', "100,000 characters"),
    "empty": ("# nothing\n", "is empty; expected parameter tables"),
    "a channel twice": (
        RIG.format(more="").replace('"motor_current"', '"output_speed"'),
        "output_speed is repeated",
    ),
}


@pytest.mark.parametrize("case", TOML)
def test_toml_that_cannot_be_is_refused_in_one_short_sentence(tmp_path, case):
    text, says = TOML[case]
    with pytest.raises(BadConfiguration, match=says) as refusal:
        read_rig(tmp_path, text, "r.toml")
    assert len(str(refusal.value)) < 400 and "\n" not in str(refusal.value)


TABLES = {
    "JSON": (b'{"time": [0, 1]', "cannot be read as JSON"),
    "a list of JSON": (b'\n[[0, "a"]]', "column supply_voltage_V is missing"),
    "deep JSON": (b"[" * 100_000, "cannot be read as JSON"),
    "Parquet": (b"PAR1\x15\x04", "cannot be read as a Parquet file"),
    "Excel": (b"PK\x03\x04\x14\x00", "is an Excel workbook or a zip file; expected CSV"),
    "HDF5": (b"\x89HDF\r\n\x1a\n\0", "cannot be read as an HDF5 file"),
    "a bag": (b"#ROSBAG V2.0\n", "cannot be read as a ROS bag"),
    "a web page": (b"<!DOCTYPE html>\n", "is a web page"),
    "a long cell": (b'supply_voltage_V,output_speed_rpm\n1,"' + b"9" * 140_000 + b'"', "a cell of more than 131,072"),
    "a long number": (b"supply_voltage_V,output_speed_rpm\n1," + b"9" * 100_000, "100,000 characters"),
}


@pytest.mark.parametrize("case", TABLES)
def test_what_is_no_table_is_refused_in_one_short_sentence(tmp_path, case):
    content, says = TABLES[case]
    (tmp_path / "t.csv").write_bytes(content)
    with pytest.raises(BadData, match=says) as refusal:
        read_runs(tmp_path / "t.csv", robot=bench(tmp_path))
    assert len(str(refusal.value)) < 400 and "\n" not in str(refusal.value)


def test_pipes_devices_and_folders_are_not_read(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    for path, what in ((tmp_path / "pipe", "a pipe"), (tmp_path, "a folder"), ("/dev/zero", "a device")):
        with pytest.raises(BadData, match=f"is {what}; expected a file"):
            read_runs(path)
        with pytest.raises(BadConfiguration, match=f"is {what}; expected a file"):
            input_files.toml_text(Path(path), "x")


@pytest.mark.parametrize("word", ["NaN", "nan", "NA", "N/A", "null", "None"])
def test_words_for_no_reading_are_empty_cells(tmp_path, word):
    robot = bench(tmp_path)
    text = "supply_voltage_V,motor_current_A,output_speed_rpm,room_C\n4,0.3,700,20\n6,{},1100,{}\n8,0.5,1500,22\n"
    named, empty = (table(tmp_path, text.format(x, x), robot) for x in (word, ""))
    assert named.notes == empty.notes and "1 of 3 cells of motor_current_A are empty" in named.notes[0]
    assert_array_equal(named.measured(), empty.measured())
    assert_array_equal(named.extras["room_C"], empty.extras["room_C"])
    with pytest.raises(BadData, match=f"row 1, supply_voltage_V: got {word}; expected "):
        table(tmp_path, f"supply_voltage_V,output_speed_rpm\n{word},700\n", robot)


def test_a_factor_of_few_digits_reaches_the_limit(tmp_path):
    robot = bench(tmp_path, '[columns]\nduty = {column = "pwm", factor = 0.00392157}')
    head = "supply_voltage_V,pwm,output_speed_rpm\n8,100,700\n8,"
    found = table(tmp_path, f"{head}255,1800\n8,-255,-1800\n", robot)
    assert found["duty"].tolist() == pytest.approx([0.392157, 1.0, -1.0], rel=1e-12)
    with pytest.raises(BadData, match=r"row 2, pwm: got 256; expected -255 to 255"):
        table(tmp_path, f"{head}256,1800\n", robot)


@pytest.mark.parametrize("imposed, column", [("voltage", "supply_voltage_V"), ("motor_speed", "motor_speed_rpm")])
def test_a_row_that_nothing_drives_is_left_out_with_a_note(tmp_path, imposed, column):
    robot = bench(tmp_path, f'imposed = "{imposed}"')
    found = table(tmp_path, f"{column},motor_current_A,room_C\n0,0,20\n4,0.3,21\n8,0.4,22\n", robot)
    assert found[column].tolist() == [4.0, 8.0] and found.extras["room_C"].tolist() == [21.0, 22.0]
    assert [n for n in found.notes if f"row 1 is left out, since nothing drives the motors ({column} is 0)" in n]


ROWS = "4,0.3,700{}\n6,0.4,1100{}\n6,0.4,1100{}\n"


@pytest.mark.parametrize(
    "head, rows, kept",
    [
        ("", ROWS.format("", "", ""), 3),  # repeats on a coarse display
        (",run_id", ROWS.format(",a", ",b", ",c"), 3),
        (",run_id", ROWS.format(",a", ",b", ",b"), 2),
        (",order", ROWS.format(",1", ",2", ",2"), 2),
        ("", 2 * ROWS.format("", "", ""), 3),  # the whole table twice
    ],
)
def test_rows_alike_are_repeats_and_the_same_run_twice_is_a_copy(tmp_path, head, rows, kept):
    found = table(tmp_path, f"supply_voltage_V,motor_current_A,output_speed_rpm{head}\n{rows}", bench(tmp_path))
    assert len(remove_copies(found)[0]) == kept


def test_a_stiff_supply_is_no_stuck_instrument(tmp_path):
    robot = read_rig(
        tmp_path, RIG.format(more='imposed = "motor_speed"').replace('"output_speed"', '"motor_voltage"')
    )
    rows = "".join(f"{speed},{0.01 * k},24\n" for k, speed in enumerate((4500, 4400, 4300, 4200)))
    found = table(tmp_path, f"motor_speed_rpm,motor_current_A,motor_voltage_V\n{rows}", robot)
    assert _check_stuck_channels(found) == [Remark("stiff_supply", column="motor_voltage_V", value=24.0)]


def test_echoes_of_input_are_short():
    said = str(InputError(f"t.csv row 1, x: got {'ab' * 50_000}; expected a number"))
    assert re.fullmatch(r"t\.csv row 1, x: got (ab){20}… \(100,000 characters\); expected a number", said)
    long = str(InputError("got " + "word " * 1000 + "; expected less"))
    assert len(long) < 1000 and long.startswith("got word") and long.endswith("expected less")
    path = f"/tmp/{'folder/' * 20}t.csv: is empty"
    assert str(InputError(path)) == path
