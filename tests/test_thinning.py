"""Logs with many rows: readings of some of them are used, and what drives the runs in all of them."""

import dataclasses

import jax
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from calibration.data import columns, input_files
from calibration.data.input_errors import BadConfiguration
from calibration.data.runs import Runs
from calibration.data.unused_readings import FIRST, thin_rows
from calibration.described import describe
from calibration.discovery import discover
from calibration.inference import calibration as calibrate
from calibration.inference.fit_notes import Remark
from calibration.inference.noise import infer_noise
from calibration.inference.observers import Histories, SettledRuns
from mmrjax.model import paper_robots
from tests.commands import refused, with_columns

EVERY, ROWS = 0.01, 300


def log(runs=2, rows=ROWS, voltage=None):
    """Runs of a robot, the rows of all in one random order, with readings that are numbers of their rows."""
    rng = np.random.default_rng(3)
    time = np.tile(EVERY * np.arange(rows), runs)
    stairs = np.repeat(rng.uniform(10.0, 30.0, -(-rows // 37)), 37)[:rows]
    mixed = rng.permutation(rows * runs)
    columns = {
        "run_id": np.repeat([f"run{k}" for k in range(runs)], rows),
        "time_s": time,
        "configuration": np.full(rows * runs, "6T2A"),
        "supply_voltage_V": np.tile(stairs if voltage is None else voltage, runs),
        "slope_deg": np.zeros(rows * runs),
        "payload_kg": np.zeros(rows * runs),
        "total_current_A": time,
        "motor_speed_rpm": 100.0 * time,
        "speed_mm_s": 10.0 * time,
    }
    return Runs("log.csv", {name: values[mixed] for name, values in columns.items()})


def settled(runs):
    """Its rows as settled runs."""
    return dataclasses.replace(runs, columns={k: v for k, v in runs.columns.items() if k not in ("time_s", "run_id")})


def test_of_few_rows_all_are_read():
    runs = log()
    assert thin_rows(runs, len(runs)) is runs and thin_rows(settled(runs), len(runs)).log is None


def test_rows_of_a_table_are_taken_evenly_over_its_conditions():
    rng = np.random.default_rng(4)
    slopes, volts = np.repeat([0.0, 5.0, 10.0], 1000), rng.uniform(10, 30, 3000)
    table = settled(log(1, 3000))
    mixed = rng.permutation(3000)
    table = with_columns(table, slope_deg=slopes[mixed], supply_voltage_V=volts[mixed])
    some = thin_rows(table, 300)
    assert 250 < len(some) <= 310 and some.whole is table
    for slope in (0.0, 5.0, 10.0):
        assert 0.2 < np.mean(some["slope_deg"] == slope) < 0.45
    share = np.histogram(some["supply_voltage_V"], np.linspace(10, 30, 9))[0] / len(some)
    assert share.min() > 0.1 and share.max() < 0.15  # an eighth in each
    kept = np.flatnonzero(np.isin(table["supply_voltage_V"], some["supply_voltage_V"]))
    assert_array_equal(table["supply_voltage_V"][kept], some["supply_voltage_V"])  # in the file's order
    notes = [
        n for n in SettledRuns.check(some, infer_noise(some, SettledRuns.sizes(some))) if n.code == "thinned_table"
    ]
    assert notes == [Remark("thinned_table", source="log.csv", rows=3000, kept=len(some))]
    assert f"{len(some)} of 3000 rows" in describe(notes[0])


def test_more_settled_rows_than_memory_holds_are_refused(monkeypatch):
    table = settled(log(1, 3000))
    monkeypatch.setattr(input_files, "available_memory", lambda: 2e8)
    with refused(r"log.csv: 3,000 rows need 0.3 GB, and 0.2 GB of memory are free, enough for 2000 rows"):
        thin_rows(table)
    assert len(thin_rows(table, 2000)) <= 2010


def test_rows_are_taken_evenly_of_each_run():
    runs = log()
    some = thin_rows(runs, 100)
    assert some.log is runs and some.whole is runs and runs.whole is runs
    for name in ("run0", "run1"):
        time = np.sort(some["time_s"][some.run_names == name])
        assert_allclose(time[:FIRST], EVERY * np.arange(FIRST), atol=1e-12)
        assert_allclose(time[FIRST:-1], EVERY * np.arange(6, ROWS - 1, 6), atol=1e-12)
        assert time[-1] == pytest.approx(EVERY * (ROWS - 1))
    assert_array_equal(some["total_current_A"], some["time_s"])


def test_channels_that_are_read_by_turns_are_all_kept():
    """A speed at every third row, a current at the rows after: steps of six rows would meet one of them alone."""
    runs = log(1)
    row = np.round(runs["time_s"] / EVERY).astype(int)
    columns = dict(runs.columns)
    columns["motor_speed_rpm"] = np.where(row % 3 == 0, columns["motor_speed_rpm"], np.nan)
    columns["total_current_A"] = np.where(row % 3 == 1, columns["total_current_A"], np.nan)
    columns["speed_mm_s"] = np.full(len(row), np.nan)
    some = thin_rows(dataclasses.replace(runs, columns=columns), 50)
    read = np.isfinite(some.measured()).sum(0)
    assert abs(read[0] - read[1]) <= 2 and read[:2].min() >= len(some) // 2 - FIRST and read[2] == 0


DRIVES = {
    "a staircase": None,
    "a noisy voltage": 20.0 + np.random.default_rng(5).standard_normal(ROWS),
    "a slow ramp": np.linspace(15.0, 20.0, ROWS),
}


def held(observed, at):
    """The voltage that acts at instants of the one run."""
    times = np.asarray(observed.times[0])
    return np.asarray(observed.conditions.voltage[0])[np.searchsorted(times, at, side="right") - 1]


@pytest.mark.parametrize("drive", DRIVES)
def test_what_drives_a_run_is_that_of_the_log(drive):
    whole = log(1, voltage=DRIVES[drive])
    some = thin_rows(whole, 40)
    every, few, alone = (
        Histories.of(x, paper_robots.nominal()) for x in (whole, some, dataclasses.replace(some, log=None))
    )
    between = EVERY * (np.arange(ROWS - 1) + 0.5)
    assert_array_equal(held(few, between), held(every, between))
    done = [float(np.asarray(o.conditions.voltage[0])[:-1] @ np.diff(o.times[0])) for o in (every, few)]
    assert done[1] == pytest.approx(done[0], rel=1e-12)
    assert (held(alone, between) != held(every, between)).mean() > 0.05
    steps = [int((np.diff(o.times) > 0).sum()) for o in (every, few)]
    assert steps[1] < (0.7 if drive == "a staircase" else 1.01) * steps[0] and len(few.run) == len(some) < 50
    assert_allclose(few.time, some["time_s"], atol=1e-12)


def test_a_slope_that_changes_between_readings_acts_from_its_row_on():
    """Rows are a little off their clock, or the steps between readings would meet them by themselves."""
    whole = log(1)
    row = np.round(whole["time_s"] / EVERY).astype(int)
    time = EVERY * (row + np.where(row > 0, 0.2 * np.random.default_rng(7).random(ROWS)[row], 0.0))
    whole = with_columns(whole, time_s=time)
    read = set((thin_rows(whole, 40)["time_s"] / EVERY).astype(int))
    change = next(k for k in range(100, ROWS) if not read & {k - 1, k, k + 1})
    columns = {**whole.columns, "slope_deg": np.where(row < change, 0.0, 5.0)}
    few = Histories.of(thin_rows(dataclasses.replace(whole, columns=columns), 40), paper_robots.nominal())
    times, slopes, at = np.asarray(few.times[0]), np.asarray(few.conditions.slope[0]), time[row == change]
    assert_allclose(np.rad2deg(slopes), np.where(times < at - 1e-9, 0.0, 5.0), atol=1e-9)
    assert np.abs(times - at).min() < 1e-9


def test_that_a_log_is_thinned_is_said():
    runs = log()
    some = thin_rows(runs, 100)
    said = [
        n for x in (some, runs) for n in Histories.check(x, infer_noise(x, Histories.sizes(x))) if n.code == "thinned"
    ]
    assert said == [Remark("thinned", source="log.csv", rows=len(runs), kept=len(some))]
    assert f"{len(some)} of {len(runs)} rows" in describe(said[0])


@pytest.mark.parametrize("rows", [100, None])
@pytest.mark.parametrize(
    "way",
    [
        (calibrate.calibrate, "calibration.inference.calibration.prepare_input"),
        (discover.discover, "calibration.discovery.loop_input.preparation.prepare_input"),
    ],
)
def test_python_takes_as_many_rows_as_the_command_line(monkeypatch, way, rows):
    """Of the same log the same rows, whoever asks. Each row once thinned is still of the whole log."""
    call, before = way
    runs, seen = log(rows=2500), []

    def prepared(table, *_, **__):
        seen.append(table)
        raise InterruptedError

    monkeypatch.setattr(before, prepared)
    with pytest.raises(InterruptedError):
        call(runs, paper_robots.nominal(), **({} if rows is None else {"rows": rows}))
    (used,) = seen
    wanted = thin_rows(runs, columns.ROWS if rows is None else rows)
    assert_array_equal(used["time_s"], wanted["time_s"])
    assert len(used) < len(runs) == len(used.whole) == len(thin_rows(used, 50).whole)
    with refused("rows: got 0; expected 1 or more", BadConfiguration):
        call(runs, paper_robots.nominal(), rows=0)


@pytest.mark.nightly
@pytest.mark.parametrize("drive", DRIVES)
def test_a_run_shows_what_it_shows_in_the_whole_log(drive):
    """Its readings are those of the whole log at the same rows, to what its longer steps make."""
    whole, robot = log(1, voltage=DRIVES[drive]), paper_robots.nominal()
    some = thin_rows(whole, 40)
    shown = [np.asarray(jax.jit(lambda o: o(robot).reading)(Histories.of(x, robot))) for x in (whole, some)]
    at = [int(np.flatnonzero(whole["time_s"] == t)[0]) for t in some["time_s"]]
    off = np.abs(shown[1] - shown[0][at]) / np.abs(shown[0]).max(0)
    assert off.max() < 2e-3
