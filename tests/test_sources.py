"""Files of every format and tables in memory: each is read equal to the arrays that it was made of."""

import json
import os
import sqlite3
import sys
import zipfile

import numpy as np
import pandas as pd
import polars as pl
import pytest
import samples
import xarray as xr
from numpy.testing import assert_allclose, assert_array_equal

from calibration.data import contents, delimited, input_files, profiles, robot_file, terrains
from calibration.data import runs as records
from calibration.data.input_errors import BadData
from calibration.data.named_arrays import column_numbers
from calibration.data.sources import one_clock, opening
from calibration.data.sources.recorded_signals import Clock, Signal, find_signal
from sweeps.commands import inspect as command
from tests.commands import refused, text_file

RIG = """
base = "none"
channels = ["total_current", "motor_speed"]
[motor]
resistance = "2 ± 20 %"
torque_constant = "0.05 ± 20 %"
[gearbox]
ratio = 1
efficiency_load = "1 ± 0"
[bench]
load = "shaft"
inertia = 0.001
loss_coulomb = "0.01 ± 50 %"
"""
COLUMNS = {"time_s": "t", "supply_voltage_V": "volts", "total_current_A": "amps", "motor_speed_rpm": "rpm"}
#: Formats of one table: name of the file, and how its writer is called.
TABLES = {
    "log.parquet": samples.parquet, "log.feather": samples.feather, "log.arrows": samples.arrow, "log.npz": samples.npz,
    "records.json": samples.json_records, "arrays.json": samples.json_arrays, "v5.mat": samples.mat5,
    "v73.mat": samples.mat73,
}  # fmt: skip
#: Formats of two rates: file, writer, names of voltage, current and speed, and the accuracy of the speed's numbers.
LOGS = {
    "log.h5": (samples.hdf5, ("/drive/volts", "/drive/amps", "/encoder/rpm"), 0.0),
    "log.mf4": (samples.mdf, ("volts", "amps", "rpm"), 0.0),
    "log.ulg": (samples.ulog, ("battery_status.voltage_v", "battery_status.current_a", "rpm.rpm_estimate"), 1e-4),
    "log.bag": (samples.ros1, ("/volts.data", "/drive/amps.data", "/joint_states.velocity[2]"), 0.0),
    "ros2": (samples.ros2, ("/volts.data", "/drive/amps.data", "/joint_states.velocity[2]"), 0.0),
    "mcap": (samples.mcap, ("/volts.data", "/drive/amps.data", "/joint_states.velocity[2]"), 0.0),
}
FORMS = {
    "a dict": dict, "pandas": pd.DataFrame, "polars": pl.DataFrame, "Arrow": lambda t: pl.DataFrame(t).to_arrow(),
    "records": lambda t: pd.DataFrame(t).to_dict("records"),
    "an index": lambda t: pd.DataFrame(t).set_index("t"),
    "a Dataset": lambda t: xr.Dataset({n: ("row", v) for n, v in t.items()}),
    "a dimension": lambda t: xr.Dataset({n: ("t", v) for n, v in t.items() if n != "t"}, coords={"t": t["t"]}),
}  # fmt: skip


@pytest.fixture(scope="module")
def robot(tmp_path_factory):
    return robot_file.read_robot(text_file(tmp_path_factory.mktemp("rig") / "rig.toml", RIG))


def opened(path, within=""):
    return opening.open_signals(path, within, path.name, opening.format_of(path, path.name))


def same(runs, table):
    for column, name in COLUMNS.items():
        assert_array_equal(runs[column], table[name])


@pytest.mark.parametrize("file", TABLES)
def test_a_table_is_read_equal_to_its_arrays(tmp_path, robot, file):
    table = samples.table()
    TABLES[file](tmp_path / file, table)
    same(records.read_runs(tmp_path / file, robot, columns=COLUMNS), table)


@pytest.mark.parametrize("orient", ["records", "columns", "split", "list", "lines"])
def test_json_of_every_form_is_read_equal_to_its_arrays(tmp_path, robot, orient):
    table, frame = samples.table(), pd.DataFrame(samples.table())
    text = json.dumps(frame.to_dict("list")) if orient == "list" else None
    stated = {"orient": "records", "lines": True} if orient == "lines" else {"orient": orient}
    text = text or frame.to_json(double_precision=15, **stated)
    runs = records.read_runs(text_file(tmp_path / "log.json", text), robot, columns=COLUMNS)
    for column, name in COLUMNS.items():
        assert_allclose(runs[column], table[name], rtol=1e-13, atol=1e-15)


@pytest.mark.parametrize("form", FORMS)
def test_a_table_in_memory_is_read_equal_to_its_arrays(robot, form):
    table = samples.table()
    same(records.read_runs(FORMS[form](table), robot, columns=COLUMNS), table)


@pytest.mark.parametrize("file", LOGS)
def test_a_log_of_two_rates_is_read_equal_to_its_arrays(tmp_path, robot, file):
    write, (volts, amps, rpm), off = LOGS[file]
    fast, slow = samples.fast(), samples.slow()
    write(tmp_path / file, fast, slow)
    signals = opened(tmp_path / file).signals
    for path, values, time in (
        (volts, fast["volts"], fast["t"]),
        (amps, fast["amps"], fast["t"]),
        (rpm, slow["rpm"], slow["t"]),
    ):
        signal = find_signal(signals, path, file)
        assert_allclose(signal.load(), values, rtol=0, atol=off)
        elapsed = one_clock.clock_seconds(signal.clock)[0]
        assert_allclose(elapsed, time - time[0], rtol=0, atol=1e-9)
    speed = "motor_speed_rad_s" if "velocity" in rpm else "motor_speed_rpm"
    one_rpm = 30 / np.pi if "velocity" in rpm else 1.0
    runs = records.read_runs(
        tmp_path / file, robot, columns={"supply_voltage_V": volts, "total_current_A": amps, speed: rpm}
    )
    read = np.isfinite(runs["motor_speed_rpm"])
    line = np.interp(fast["t"], slow["t"], slow["rpm"]) * one_rpm
    assert_allclose(runs["motor_speed_rpm"][read], line[read], rtol=1e-6)
    assert_allclose(runs["supply_voltage_V"], fast["volts"])
    assert len(slow["t"]) - 3 <= read.sum() <= len(slow["t"])  # each reading in one row
    assert any("each used once" in note for note in runs.notes)


def test_commands_are_held_and_readings_on_one_clock_stay_as_they_are():
    def signal(time, values):
        return Signal("x", len(time), lambda: np.array(values), clock=Clock("c", lambda: np.array(time), "s"))

    shared = Clock("fast", lambda: np.arange(6.0), "s")
    chosen = {
        "current": Signal("current", 6, lambda: np.arange(6.0) ** 2, clock=shared),
        "speed": Signal("speed", 6, lambda: np.arange(6.0) ** 3, clock=shared),
        "command": signal([0.5, 2.5], [7.0, 8.0]),
        "slow": signal([1.25, 3.75], [10.0, 20.0]),
    }
    measured = {"current", "speed", "slow"}
    time, values, notes = one_clock.signals_on_one_grid("log", chosen, {"command"}, measured, "")
    assert_array_equal(time, np.arange(5.0))  # the row before the first command is left out
    assert_array_equal(values["current"], np.arange(1.0, 6) ** 2)
    assert_array_equal(values["command"], [7, 7, 8, 8, 8])
    assert_allclose(values["slow"], [np.nan] * 5)  # no sample lies on its line within two rows
    assert "1 row" in notes[1] and "fast (1 Hz)" in notes[0]


def test_a_slow_reading_is_on_the_straight_line_in_the_row_nearest_to_its_sample():
    rows, time = np.arange(9.0), np.array([0.9, 4.2, 7.9])
    found = one_clock.readings_used_once(rows, time, 10 * time)
    assert_allclose(found, [np.nan, 10, np.nan, np.nan, 40, np.nan, np.nan, np.nan, np.nan])


def test_samples_that_are_recorded_late_are_sorted_by_their_stamps():
    time = np.r_[0.0, 1, 2, 4, 3, 5, 6, 7]
    late = Signal("late", 8, lambda: 10 * time, clock=Clock("c", lambda: time, "s"))
    found, values, notes = one_clock.signals_on_one_grid("log", {"late": late}, set(), {"late"}, "")
    assert_array_equal(values["late"], 10 * np.arange(8.0))
    assert found.tolist() == list(range(8)) and "1 sample of c arrived late" in notes[0]
    back = Signal("back", 60, lambda: np.zeros(60), clock=Clock("c", lambda: np.tile(np.arange(30.0), 2), "s"))
    with refused("log, c: goes back from 29 to 0 s at sample 31"):
        one_clock.signals_on_one_grid("log", {"back": back}, set(), {"back"}, "")


@pytest.mark.parametrize(
    "stamps, unit",
    [
        (np.arange(50) * 0.01, "s"), (np.arange(50) * 10, "ms"), (np.arange(50) * 10_000, "us"),
        (np.arange(50) * 10**7, "ns"), (1.7e9 + np.arange(50), "s"), (1_700_000_000_000 + np.arange(50), "ms"),
        (1_700_000_000_000_000 + np.arange(50), "us"), (1_700_000_000_000_000_000 + np.arange(50), "ns"),
    ],
)  # fmt: skip
def test_the_unit_of_a_clock_is_found_from_its_numbers(stamps, unit):
    assert one_clock.guessed_unit(stamps) == unit


def test_a_clock_of_its_own_may_wrap_and_start_at_boot(tmp_path, robot):
    fast, slow = samples.fast(), samples.slow()
    ticks = np.round((fast["t"] + 4294.0) * 1e6).astype(np.int64) % 2**32
    samples.hdf5(tmp_path / "log.h5", {**fast, "t": ticks}, {**slow, "t": slow["t"] + 4294.0})
    runs = records.read_runs(tmp_path / "log.h5", robot, columns=COLUMNS)
    assert_allclose(runs["time_s"], fast["t"], rtol=0, atol=1e-6)
    assert any("/drive/t wraps at 4294967296" in note for note in runs.notes)
    assert any("/drive/t has no unit. Its numbers are read as us (100 Hz)" in note for note in runs.notes)
    read = np.isfinite(runs["motor_speed_rpm"])
    assert_allclose(runs["motor_speed_rpm"][read], np.interp(fast["t"], slow["t"], slow["rpm"])[read], rtol=1e-6)


def test_a_missing_topic_is_named_with_the_nearest(tmp_path, robot):
    samples.ros2(tmp_path / "bag", samples.fast(), samples.slow())
    columns = {
        "supply_voltage_V": "/volts.data",
        "total_current_A": "/drive/amps.data",
        "motor_speed_rpm": "/joint_state.velocity[2]",
    }
    runs = records.read_runs(tmp_path / "bag", robot, columns=columns)
    assert any(
        "no signal /joint_state.velocity[2], from which motor_speed_rpm is read; did you mean /joint_states.velocity[2]"
        in note
        for note in runs.notes
    )


def test_a_unit_that_a_source_states_is_not_read_as_another(tmp_path, robot):
    samples.ros2(tmp_path / "bag", samples.fast(), samples.slow())
    columns = {"supply_voltage_V": "/volts.data", "motor_speed_rpm": "/joint_states.velocity[2]"}
    with refused(r"states rad_s in the source, and is read in rpm"):
        records.read_runs(tmp_path / "bag", robot, columns=columns)


def test_signals_are_named_by_the_end_of_their_path_and_by_their_place(tmp_path, robot):
    samples.hdf5(tmp_path / "log.h5", samples.fast(), samples.slow())
    assert find_signal(opened(tmp_path / "log.h5").signals, "volts", "log.h5").path == "/drive/volts"
    with refused(r"log.h5, t: the name fits 2 signals, /drive/t, /encoder/t"):
        find_signal(opened(tmp_path / "log.h5").signals, "t", "log.h5")
    below = records.read_runs(f"{tmp_path / 'log.h5'}::/drive", robot, columns=COLUMNS)
    assert len(below) == 200 and not below.has("motor_speed_rpm")


def test_profiles_and_terrains_are_read_from_tables_of_every_format(tmp_path):
    pd.DataFrame({"time_s": [0.0, 2.0], "duty": [0.5, 0.0]}).to_parquet(tmp_path / "profile.parquet")
    np.savez(tmp_path / "ground.npz", x_m=[0.0, 1.0, 2.0], z_m=[0.0, 0.1, 0.1])
    assert profiles.read_profile(tmp_path / "profile.parquet").duration == 2.0
    assert terrains.read_terrain(tmp_path / "ground.npz") is not None


def test_a_long_csv_file_is_read_as_a_short_one(tmp_path, monkeypatch):
    text = "run_id,time_s,a,b,c\n1,0.5, 7,1e-3,x\n2,-3.25,,2,\n1,1e5,nan,3,z\n"
    short = delimited.read_csv_columns(text_file(tmp_path / "log.csv", text), "log.csv")
    monkeypatch.setattr(delimited, "LONG", 0)
    long = delimited.read_csv_columns(tmp_path / "log.csv", "log.csv")
    assert isinstance(long.values[1], np.ndarray) and long.header == short.header and long.digest == short.digest
    for mine, theirs in zip(long.values, short.values, strict=True):
        assert_array_equal(column_numbers(mine), column_numbers(theirs))
    assert list(long.values[4]) == short.values[4]
    with refused("row 4: got 2 cells; the header has 5 columns"):
        delimited.read_csv_columns(text_file(tmp_path / "log.csv", text + "1,2\n"), "log.csv")


# --- bad input --------------------------------------------------------------------------------------


def _cut(path, share=0.6):
    path.write_bytes(path.read_bytes()[: int(share * path.stat().st_size)])


@pytest.mark.parametrize("file", ["log.parquet", "log.feather", "log.npz", "v5.mat", "v73.mat", "records.json"])
def test_a_cut_table_is_refused_in_one_sentence(tmp_path, robot, file):
    TABLES[file](tmp_path / file, samples.table())
    _cut(tmp_path / file)
    with refused(rf"^{file}(?!.{{450}}).*cannot be read as .*; it may be cut off"):
        records.read_runs(tmp_path / file, robot, columns=COLUMNS)


@pytest.mark.parametrize("file", ["log.h5", "log.mf4", "log.ulg", "log.bag", "mcap"])
def test_a_cut_log_is_refused_in_one_sentence(tmp_path, robot, file):
    write, (volts, amps, rpm), _ = LOGS[file]
    write(tmp_path / file, samples.fast(), samples.slow())
    if file == "mcap":
        (tmp_path / file / "mcap.mcap").rename(tmp_path / "mcap.mcap")
        file = "mcap.mcap"
    _cut(tmp_path / file, 0.3 if file == "log.bag" else 0.61)
    before = set(os.listdir(tmp_path))
    with refused(f"^{file}"):
        records.read_runs(
            tmp_path / file,
            robot,
            columns={"supply_voltage_V": volts, "total_current_A": amps, "motor_speed_rpm": rpm},
        )
    assert set(os.listdir(tmp_path)) == before


def _with_speeds(path, speeds):
    np.savez(path, **{**samples.table(), "rpm": speeds})


def _outside(path):
    np.savez(path, **samples.table())
    with zipfile.ZipFile(path, "a") as archive:
        archive.writestr("../../rpm.npy", b"")


BAD_ARCHIVES = {
    "another length": (
        lambda path: _with_speeds(path, np.zeros(7)),
        "rpm: has 7 values, and .* has 200; expected equal lengths",
    ),
    "objects": (
        lambda path: _with_speeds(path, np.array([{}] * 200, object)),
        "rpm: holds objects; expected numbers or words",
    ),
    "a path outside": (_outside, "../../rpm.npy: is a path that points outside the archive"),
}


@pytest.mark.parametrize("case", BAD_ARCHIVES)
def test_an_array_that_cannot_be_is_refused_by_its_name(tmp_path, robot, case):
    write, says = BAD_ARCHIVES[case]
    write(tmp_path / "log.npz")
    with refused(says):
        records.read_runs(tmp_path / "log.npz", robot, columns=COLUMNS)


def test_values_that_a_library_cannot_read_are_refused_by_their_signal(tmp_path, robot):
    samples.parquet(tmp_path / "log.parquet", samples.table())
    content = bytearray((tmp_path / "log.parquet").read_bytes())
    content[40:400] = bytes(360)  # within the first column's pages; the list of columns at the end is sound
    (tmp_path / "log.parquet").write_bytes(content)
    with refused(r"log.parquet, t: cannot be read as a Parquet file .* damaged"):
        records.read_runs(tmp_path / "log.parquet", robot, columns=COLUMNS)


def test_a_link_to_another_file_is_not_followed(tmp_path, robot):
    import h5py

    with h5py.File(tmp_path / "log.h5", "w") as file:
        file["volts"] = h5py.ExternalLink("/etc/passwd", "/")
    with refused(r"volts: is a link to another file, /etc/passwd"):
        records.read_runs(tmp_path / "log.h5", robot)
    samples.ros2(tmp_path / "bag", samples.fast(0.1), samples.slow(0.1))
    (tmp_path / "bag/more.db3").symlink_to("/etc/passwd")
    with refused(r"bag, more.db3: is a link that points outside the bag"):
        records.read_runs(tmp_path / "bag", robot)


def test_a_topic_of_two_types_or_without_definition_is_refused_where_it_is_read(tmp_path, robot):
    from rosbags.rosbag2 import Writer
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE)
    store.register(get_types_from_msg("float64 data", "mine/msg/Own"))
    with Writer(tmp_path / "bag", version=8) as writer:
        for topic, kind in (
            ("/volts", "std_msgs/msg/Float64"),
            ("/volts", "std_msgs/msg/Float32"),
            ("/own", "mine/msg/Own"),
        ):
            link = writer.add_connection(topic, kind, typestore=store)
            writer.write(link, 1, store.serialize_cdr(store.types[kind](1.0), kind))
    with sqlite3.connect(next((tmp_path / "bag").glob("*.db3"))) as database:
        database.execute("delete from message_definitions")
    database.close()
    kinds = {s.path: s.refused for s in opened(tmp_path / "bag").signals}
    assert "messages of type mine/msg/Own, which the bag does not define; record it as MCAP" in kinds["/own"]
    assert "types std_msgs/msg/Float32 and std_msgs/msg/Float64; expected one type" in kinds["/volts"]
    with refused(r"bag, /volts: has messages of types"):
        records.read_runs(tmp_path / "bag", robot, columns={"supply_voltage_V": "/volts"})


def test_an_array_that_changes_its_length_is_refused_with_its_message(tmp_path):
    fast, slow = samples.fast(0.2), samples.slow(0.2)
    samples.ros2(tmp_path / "bag", fast, slow, lose=True)
    signal = find_signal(opened(tmp_path / "bag").signals, "/joint_states.velocity[0]", "bag")
    with refused(r"/joint_states.*: message \d has fewer elements than the first"):
        signal.load()


def test_a_library_that_is_missing_is_named_with_the_extra(tmp_path, robot, monkeypatch):
    samples.hdf5(tmp_path / "log.h5", samples.fast(), samples.slow())
    monkeypatch.setitem(sys.modules, "h5py", None)
    with refused(r"reading it needs h5py, which is not installed: pip install mmrjax\[logs\]"):
        records.read_runs(tmp_path / "log.h5", robot)


def test_a_recording_larger_than_memory_is_refused_before_it_is_read(tmp_path, robot, monkeypatch):
    samples.parquet(tmp_path / "log.parquet", samples.table())
    monkeypatch.setattr(input_files, "available_memory", lambda: 1e4)
    with refused("GB of memory are free"):
        records.read_runs(tmp_path / "log.parquet", robot, columns=COLUMNS)
    monkeypatch.setattr(input_files, "available_memory", lambda: 1e3)
    assert "memory are free" in contents.inspect_source(tmp_path / "log.parquet").signals[0].refused


@pytest.mark.parametrize("source", [3, None, [1, 2], {}, pd.Series([1.0]), pd.DataFrame()])
def test_what_is_no_table_in_memory_is_refused(robot, source):
    with pytest.raises(BadData):
        records.read_runs(source, robot)


# --- contents ---------------------------------------------------------------------------------------


def test_contents_lists_signals_and_proposes_columns(tmp_path):
    samples.hdf5(tmp_path / "log.h5", samples.fast(), samples.slow())
    found = contents.inspect_source(tmp_path / "log.h5")
    speed = next(s for s in found.signals if s.path == "/encoder/rpm")
    assert speed.unit == "rpm" and speed.samples == 80 and round(speed.rate) == samples.SLOW and speed.gaps == 0
    assert speed.least == samples.slow()["rpm"].min() and "2 clocks" in found.notes[0]
    assert 'motor_speed_rpm = "/encoder/rpm"' in found.proposed
    assert {line.partition(" ")[0] for line in found.proposed} >= {"supply_voltage_V", "total_current_A"}


def test_inspect_prints_what_contents_finds(tmp_path, capsys):
    samples.hdf5(tmp_path / "log.h5", samples.fast(), samples.slow())
    assert command.inspect_file(f"{tmp_path / 'log.h5'}::/encoder", True) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["schema"] == "mmrjax.inspect/1" and [s["path"] for s in found["signals"]] == [
        "/encoder/rpm",
        "/encoder/t",
    ]
    assert command.inspect_file(str(tmp_path / "log.h5"), False) == 0
    said = capsys.readouterr().out
    assert 'motor_speed_rpm = "/encoder/rpm"' in said and "log.h5: an HDF5 file, 5 signals" in said


def test_contents_of_an_empty_file_are_an_error_and_empty_cells_are_missing(tmp_path):
    (tmp_path / "log.csv").write_text("t,amps\n0,\n1,\n")
    assert [s.missing for s in contents.inspect_source(tmp_path / "log.csv").signals] == [0, 2]
    with refused("the file is empty"):
        contents.inspect_source(text_file(tmp_path / "log.csv", ""))


def test_a_bags_folder_without_its_metadata_is_named(tmp_path):
    (tmp_path / "bag").mkdir()
    (tmp_path / "bag/bag_0.mcap").touch()
    with refused(r"without metadata\.yaml; .* as .*bag_0\.mcap"):
        contents.inspect_source(tmp_path / "bag")


def test_contents_of_a_presets_log_name_the_preset(tmp_path):
    pd.DataFrame({"ms_today": [1, 2, 3], "input_voltage": 24.0, "duty_cycle": 0.5, "erpm": 100.0}).to_csv(
        tmp_path / "log.csv", index=False
    )
    assert contents.inspect_source(tmp_path / "log.csv").preset == "vesc"
