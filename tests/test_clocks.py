"""Clocks that wrap, repeat or count from 1970, and readings that a log repeats: recognised, and reported."""

import numpy as np
import pandas as pd
import pytest
import samples
from numpy.random import default_rng
from numpy.testing import assert_allclose, assert_array_equal

from calibration.data import robot_file
from calibration.data.clock import spread_shared_stamps, unwrap_counter
from calibration.data.row_checks import drop_repeated_readings, reading_period
from calibration.data.runs import read_runs
from tests.commands import text_file

RIG = """
base = "none"
channels = ["total_current", "motor_speed"]
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
TABLE = samples.table()
SINCE = np.round(1e6 * TABLE["t"]).astype(np.int64)
#: Column of time and its numbers of one log, and what the note says.
CLOCKS = {
    "microseconds that wrap": ("time_us", (SINCE + 2**32 - 700_000) % 2**32, "wraps at 4294967296"),
    "milliseconds that wrap": ("time_ms", (SINCE // 1000 + 2**32 - 500) % 2**32, "wraps at 4294967296"),
    "a tick of 15 bits": ("time_ms", (SINCE // 1000 + 32_000) % 2**15, "wraps at 32768"),
    "wrapped before it was seconds": ("time_s", (SINCE + 2**32 - 700_000) % 2**32 * 1e-6, "wraps at 4294.967296"),
    "nanoseconds since 1970": ("time_ns", SINCE * 1000 + 17 * 10**17, "is a time of day"),
    "milliseconds since 1970, called seconds": ("time_s", SINCE // 1000 + 17 * 10**11, "is read as ms since 1970"),
    "since boot": ("time_ms", SINCE // 1000 + 3_600_000, "begins at 3.6e+06"),
    "coarser than the rows": ("time_ms", SINCE // 20_000 * 20, "repeats, 2 rows per time stamp"),
}


@pytest.fixture(scope="module")
def robot(tmp_path_factory):
    return robot_file.read_robot(text_file(tmp_path_factory.mktemp("rig") / "rig.toml", RIG))


def frame(**columns):
    known = {"supply_voltage_V": TABLE["volts"], "total_current_A": TABLE["amps"], "motor_speed_rpm": TABLE["rpm"]}
    return pd.DataFrame({**known, **columns})


@pytest.mark.parametrize("case", CLOCKS)
@pytest.mark.parametrize("as_text", [False, True], ids=["numbers", "text"])
def test_a_clock_is_counted_from_the_first_row(tmp_path, robot, case, as_text):
    column, stamps, says = CLOCKS[case]
    source = frame(**{column: stamps})
    if as_text:
        source.to_csv(tmp_path / "log.csv", index=False)
        source = tmp_path / "log.csv"
    found = read_runs(source, robot)
    assert_allclose(found["time_s"], TABLE["t"], rtol=0, atol=1e-6)
    assert any(says in note for note in found.notes)


def test_each_recording_has_wraps_of_its_own():
    once = (np.arange(60.0) * 1000 + 2**32 - 20_000) % 2**32
    found, period = unwrap_counter(np.concatenate([once, once]), np.repeat([0, 1], 60))
    assert period == 2**32 and found[60] == once[0]
    for part in (found[:60], found[60:]):
        assert_array_equal(part - part[0], np.arange(60) * 1000)


@pytest.mark.parametrize(
    "time",
    [np.tile(np.arange(50.0), 2), np.arange(100.0)[::-1], np.r_[np.arange(50.0), 20.0, np.arange(51.0, 100.0)]],
    ids=["two recordings", "backward", "a step back"],
)
def test_a_clock_that_does_not_wrap_stays_as_it_is(time):
    run = np.zeros(len(time), int)
    assert unwrap_counter(time, run)[1] == 0 and spread_shared_stamps(time, run)[1] == 0


def test_stamps_that_are_rarely_shared_are_not_spread():
    time = np.sort(np.r_[np.arange(100.0), 40.0])
    assert spread_shared_stamps(time, np.zeros(101, int))[1] == 0


def test_a_row_that_stands_twice_is_left_out(robot):
    twice = frame(time_s=TABLE["t"]).iloc[np.sort(np.r_[np.arange(200), 77, 120])]
    found = read_runs(twice, robot)
    assert len(found) == 200 and any(
        "2 rows, the first row 79, are a repetition of the row before" in n for n in found.notes
    )
    other = frame(time_s=TABLE["t"])
    other.loc[len(other) / 2 - 1, "time_s"] = other["time_s"][len(other) // 2]
    assert len(read_runs(other, robot)) == 200


# --- readings that repeat ---------------------------------------------------------------------------


def held(values, rows):
    return np.asarray(values)[(np.arange(int(len(values) * rows)) / rows).astype(int)]


RNG = default_rng(3)
WALK = 10 + np.cumsum(RNG.normal(size=200))
T = np.arange(3000)
#: Channels that are read in every row, though they repeat numbers.
EVERY_ROW = {
    "noise": RNG.normal(size=3000),
    "coarse and noisy": np.round(np.sin(T / 300) + 0.3 * RNG.normal(size=3000), 1),
    "coarse and smooth": np.round(10 * np.sin(T / 300), 1),
    "counts of an encoder at one speed": np.floor(T / 7.3),
    "a warming winding": np.round(20 + T / 500 + 0.02 * RNG.normal(size=3000), 1),
    "a staircase": np.repeat([1.0, 2.0, 3.0], 1000),
    "nothing": np.full(3000, np.nan),
}


@pytest.mark.parametrize("rows", [2, 2.5, 15, 40.4])
def test_the_period_of_a_slow_sensor_is_found(rows):
    assert reading_period(held(WALK, rows)) == pytest.approx(rows, rel=0.02)


@pytest.mark.parametrize("case", EVERY_ROW)
def test_coarse_readings_are_no_repeats(case):
    values = EVERY_ROW[case]
    found, rows = drop_repeated_readings(values, np.arange(len(values)))
    assert rows == 0 and found is values


def test_each_reading_of_a_slow_sensor_is_used_once():
    walk = WALK.copy()
    walk[50] = walk[49]  # the same reading twice is two readings
    found, rows = drop_repeated_readings(held(walk, 15), np.arange(3000))
    assert rows == 15
    assert_array_equal(np.flatnonzero(np.isfinite(found)), np.arange(0, 3000, 15))
    assert_array_equal(found[::15], walk)


def test_repeats_are_reported_and_weigh_nothing(robot):
    slow = held(TABLE["rpm"][::10], 10)
    found = read_runs(frame(time_s=TABLE["t"], motor_speed_rpm=slow), robot)
    assert any("motor_speed_rpm repeats each reading in 10 rows" in note for note in found.notes)
    assert np.isfinite(found["motor_speed_rpm"]).sum() == 20 and np.isfinite(found["total_current_A"]).all()
    settled = read_runs(frame(motor_speed_rpm=slow), robot)  # without time they are runs
    assert np.isfinite(settled["motor_speed_rpm"]).all()
