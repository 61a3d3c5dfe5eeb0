"""Logs with faults that no reader sees: one sentence each. Sound logs have none."""

from dataclasses import dataclass, replace
from types import SimpleNamespace

import numpy as np
import pytest
from numpy.random import default_rng
from test_log_kinds import carriage, servo, written
from test_weak_form import RIG, motor

from calibration.data.columns import Layout
from calibration.data.input_errors import BadData
from calibration.data.rig_facts import log_doubts, swapped_sentence
from calibration.data.row_checks import split_at_jumps
from calibration.data.runs import Runs, read_runs
from calibration.data.unused_readings import without_held
from calibration.described import describe
from calibration.discovery import discover, result_remarks
from calibration.discovery.loop_input import LoopInput, prepare_loop, settled_input
from calibration.discovery.verdict import LoopStages
from calibration.inference import calibration
from calibration.inference.conduct import error_after_steps
from calibration.inference.fit_notes import Remark
from calibration.inference.foresight import predict_identifiability
from calibration.inference.shown_states import missing_states_remarks
from mmrjax.model import channels
from tests.commands import read_rig


@pytest.fixture(scope="module")
def robot(tmp_path_factory):
    return read_rig(tmp_path_factory.mktemp("motor"), RIG)


@pytest.fixture
def runs(robot):
    """A sound log of a motor in four runs of 150 rows."""
    return Runs("log.csv", motor()).of(robot)


def steps_of(volts):
    """The first row after each step of the voltage."""
    return np.flatnonzero(np.abs(np.diff(volts)) > 0.1 * np.abs(volts).max()) + 1


def noise_of(runs):
    return 0.02 * default_rng(0).standard_normal((len(runs), 2))


def held(speed):
    of_runs = speed.reshape(4, 150).copy()
    of_runs[:, 80:] = of_runs[:, 80:81]
    return of_runs.ravel()


def swapped(speed):
    return np.where(np.arange(len(speed)) % 150 > 75, -speed, speed)


SPEED, VOLTS = "motor_speed_rpm", "supply_voltage_V"


def test_one_level_in_a_log_is_reported_before_a_fit(robot, runs):
    one_level = replace(runs, columns={**runs.columns, VOLTS: np.full(len(runs), 12.0)})
    doubts = predict_identifiability(one_level, robot).doubts
    assert Remark("constant", column=VOLTS, value=12.0, alike="voltage") in doubts


@pytest.mark.parametrize("column, fault, words", [
    (SPEED, swapped, "row 377,"),  # of the first run with so much of both signs
])  # fmt: skip
def test_a_fault_of_a_log_is_reported_and_only_that(robot, runs, column, fault, words):
    assert log_doubts(runs, robot) == ()
    runs.columns[column] = fault(runs[column])
    (text,) = log_doubts(runs, robot)
    assert words in text and column in text


def wrapped(tmp_path, kind, make, column, length):
    """A log as it is read, and the same log with an encoder that wraps."""
    log = make(default_rng(1))
    robot = written(tmp_path, kind, log)
    yield read_runs(tmp_path / "log.csv", robot=robot)
    written(tmp_path, kind, {**log, column: log[column] % length})
    yield read_runs(tmp_path / "log.csv", robot=robot)


def test_a_position_that_wraps_undeclared_is_refused_at_its_first_jump(tmp_path):
    words = "jumps by -4.* like a position that wraps or .*; expected a position that"
    logs = wrapped(tmp_path, "carriage", carriage, "position_mm", 50)
    assert next(logs).has("position_mm")
    with pytest.raises(BadData, match=words):
        next(logs)


@pytest.mark.parametrize("length", [360, 300])
def test_an_angle_of_one_turn_keeps_counting(tmp_path, length):
    logs = wrapped(tmp_path, "servo", servo, "output_angle_deg", length)
    log = next(logs)
    if length != 360:  # no turn
        with pytest.raises(BadData, match=r"jumps by -29.* like an angle that wraps or "):
            next(logs)
        return
    again = next(logs)
    np.testing.assert_allclose(again["output_angle_deg"], log["output_angle_deg"], atol=1e-6)
    assert [n for n in again.notes if n not in log.notes] == [
        f"{again.source} row 254, output_angle_deg: wraps at 360 deg. The wraps are removed"
    ]


def test_parts_are_numbered_within_each_recording():
    time = np.concatenate([0.1 * np.arange(60) + 50.0 * (np.arange(60) >= 30)] * 2)
    runs = Runs("log.csv", {"time_s": time, "run_id": np.repeat(["a", "b"], 60)})
    parts = split_at_jumps(runs, at_rest=False)["run_id"]
    assert list(dict.fromkeys(parts)) == ["a", "a part 2", "b", "b part 2"]


@pytest.mark.parametrize("step", [7.0, -2.0])
def test_rows_after_a_jump_of_the_clock_are_a_run_that_begins_at_their_readings(tmp_path, step):
    log = carriage(default_rng(1))
    late = np.arange(len(log["time_s"])) >= 700
    robot = written(tmp_path, "carriage", {**log, "time_s": log["time_s"] + step * late})
    runs = read_runs(tmp_path / "log.csv", robot=robot)
    assert (runs.run_names == "part 2").tolist() == late.tolist()
    np.testing.assert_allclose(np.diff(runs["time_s"])[701:], np.diff(log["time_s"])[701:], atol=1e-6)
    assert runs["time_s"][700] == 0 and any("row 701, time_s" in n and "new run" in n for n in runs.notes)


@pytest.mark.parametrize("column, left_out", [(SPEED, 276), ("motor_current_A", 276), ("output_angle_deg", 0)])
def test_readings_that_are_held_at_the_last_value_are_left_out(robot, column, left_out):
    """The last 70 of 150 rows of each run repeat one reading, over steps of 1.8 to 15 V. An angle may rest."""
    shown = tuple(channels.find_channel(n) for n in ("motor_speed", "motor_current", "output_angle"))
    columns = motor()
    columns["output_angle_deg"] = np.cumsum(columns[SPEED])
    runs = Runs("log.csv", columns, layout=replace(Layout.of(robot), channels=shown))
    assert without_held(runs).notes == ()
    columns[column] = held(columns[column])
    found = without_held(runs)
    lost = {c.column: np.isnan(found[c.column]) for c in shown}
    assert {name: rows.sum() for name, rows in lost.items()} == dict.fromkeys(lost, 0) | {column: left_out}
    assert lost[column].reshape(4, 150)[:, 81:].all() == bool(left_out)
    (note,) = found.notes
    assert note.startswith(f"log.csv rows 531 to 600, {column}: the same reading while {VOLTS} changes")
    assert ("left out" in note) == bool(left_out)


@pytest.mark.parametrize("kind, make, column", [("servo", servo, "duty"), ("carriage", carriage, "motor_current_A")])
def test_a_sign_that_is_reversed_half_way_is_seen_in_an_angle(tmp_path, kind, make, column):
    log = make(default_rng(1), levels=(0.9, -0.8, 0.7, -0.9, 0.8, -0.7), hold=0.5)

    def said():
        return swapped_sentence(read_runs(tmp_path / "log.csv", robot=written(tmp_path, kind, log)))

    assert said() == ""
    half = len(log[column]) // 2
    log[column][half:] *= -1
    text = said()
    assert f"opposite to {column}" in text and abs(int(text.split()[2].strip(",")) - half) < 30


@pytest.mark.parametrize("delay, stated, words", [
    (0.149, True, "no longer delay is searched"), (-0.2, False, "earlier than its column states, and no longer delay"),
    (0.1, False, "the rig file gives no delay. To start"), (0.1, True, ""), (0.003, False, ""),
])  # fmt: skip
def test_a_delay_at_the_end_of_its_search_is_reported(runs, delay, stated, words):
    assert runs["time_s"].max() == pytest.approx(1.49)
    remarks = result_remarks.delay_remarks(runs, SimpleNamespace(after=delay, sd_after=1e-3), stated)
    assert words in "".join(map(describe, remarks)) and bool(remarks) == bool(words)


@pytest.mark.parametrize("late", [0, 1])
def test_an_error_in_the_first_sample_after_each_step_is_named_with_its_share(runs, late):
    """Current was missed by 48.6 %, of which 24 of 6 000 readings, each the first after a step, made 93 %."""
    after = steps_of(runs[VOLTS])
    after = after[after % 150 != 0] + late  # within a run
    off = noise_of(runs)
    assert error_after_steps(runs, off) == []
    off[after, 1] = 5.0
    (note,) = error_after_steps(runs, off)
    share = np.sum(off[after, 1] ** 2) / np.sum(off[:, 1] ** 2)
    assert (note.channel, note.rows, note.share) == (runs.channels[1].name, len(after), pytest.approx(share))
    fall = np.linalg.norm(np.delete(off[:, 1], after)) / np.linalg.norm(off[:, 1])
    assert f"the rms error falls to {100 * fall:.0f} %" in describe(note)
    off[:, 1] = 5.0
    assert error_after_steps(runs, off) == []  # an error everywhere


@pytest.mark.parametrize("file, options, freed", [
    ("", {}, True), ("", {"fix": ["rig.delay"]}, False), ("", {"free": ["motor.resistance"]}, False),
    ("[rig]\ndelay = \"0 ± 0\"\n", {}, False),
])  # fmt: skip
def test_a_delay_is_freed_if_the_error_lies_after_the_steps(tmp_path, monkeypatch, file, options, freed):
    """Mass and resistance of a robot absorbed 95 % of the error of its current, which was read after each step."""
    robot = read_rig(tmp_path, RIG + file)
    runs, searches = Runs("log.csv", motor()).of(robot), []
    off = noise_of(runs)
    off[steps_of(runs[VOLTS]), 1] = 5.0

    def search(problem, noise, starts, *rest):
        searches.append(problem.coordinates.names)
        best = SimpleNamespace(z=np.ones(len(problem.coordinates)))
        return SimpleNamespace(problem=problem, best=best, shares=None, starts=starts)

    for place, name, stand_in in (
        (calibration.multistart, "search_one_by_one", search),
        (calibration, "_search", lambda setting, posed, *_: (search(posed, None, None), None)),
        (calibration.scans, "place_at_minimum", lambda problem, starts: starts),
        (calibration.optimizers, "observe_at", lambda *_: SimpleNamespace(reading=runs.measured() + off)),
        (calibration, "_calibration_result", lambda setting, search, *_: (setting, search)),
    ):
        monkeypatch.setattr(place, name, stand_in)
    setting, found = calibration.calibrate(runs, robot, **options)
    first, *again = searches
    assert "rig.delay" not in first and [set(x) - set(first) for x in again] == [{"rig.delay"}] * freed
    if freed:
        (z,) = found.starts
        assert dict(zip(again[0], z, strict=True)) == dict.fromkeys(first, 1.0) | {"rig.delay": 0.0}
        assert "so rig.delay is fitted" in describe(setting.prepared.mass_remarks[-1])


@pytest.mark.parametrize("late", [-0.004, 0.01])
def test_readings_that_are_late_or_early_are_named_with_their_shift(runs, late):
    """An ODrive's speed was missed by 3.3 %, and by 0.5 % with its delay of 2 ms free. No note said so."""
    time, k = runs["time_s"], runs.layout.measured_columns.index(SPEED)
    off = noise_of(runs) / 20
    for name in np.unique(runs.run_names):
        rows = runs.in_order(name)
        smooth = np.sin(3 * time[rows]) + 2 * time[rows]
        runs.columns[SPEED][rows] = 1e3 * np.interp(time[rows] - late, time[rows], smooth)
        off[rows, k] += 1e3 * smooth - runs[SPEED][rows]
    off[:, k] *= np.pi / 30
    (note,) = error_after_steps(runs, off)
    assert note.code == "shifted" and note.shift == pytest.approx(late, rel=0.1) and note.share > 0.9


def test_a_log_without_a_motion_is_reported_with_what_to_log(robot, runs):
    assert missing_states_remarks(runs, robot) == []
    runs.columns[SPEED] = np.full(600, np.nan)
    (note,) = missing_states_remarks(runs, robot)
    assert "no channel reads a speed or an angle" in describe(note) and "Log one" in describe(note)


@pytest.mark.parametrize("levels, converged", [(6, False), (6, True), (5, False)])
def test_a_log_without_a_fit_is_answered_on_its_settled_runs_if_they_suffice(robot, monkeypatch, levels, converged):
    volts, told, kept = np.repeat(np.linspace(8, 24, levels), 60), [], []
    noise = default_rng(0).standard_normal((2, len(volts)))
    runs = Runs("log.csv", {
        "configuration": np.full(len(volts), "bench"), "time_s": 0.01 * np.arange(len(volts)), VOLTS: volts,
        SPEED: 200 * volts + 8 * noise[0], "motor_current_A": 0.5 + volts / 20 + 0.03 * noise[1],
        "slope_deg": 0 * volts, "payload_kg": 0 * volts,
    }).of(robot)  # fmt: skip
    bare = SimpleNamespace(observe=SimpleNamespace(long=True))
    base = SimpleNamespace(space=SimpleNamespace(bare=bare), candidate=SimpleNamespace(converged=converged))

    def keep(name, make):
        kept.append(name)
        return (SimpleNamespace(base=base), None) if name == "base" else make()

    @dataclass
    class Table:
        at_first: tuple
        runs: Runs
        keep: object = None
        progress: object = None

        def trace(self, ahead):
            """Stands for the stages of the table."""
            assert ahead and self.keep("ranking", lambda: 1) == self.keep("search 0", lambda: 1) == 1
            return LoopStages("none")

    steps = {stage.name: stage for stage in discover.STAGES}
    windows = steps["windows"]._replace(function=lambda given: None)
    readings = steps["readings"]._replace(function=lambda *_: LoopStages("place"))
    monkeypatch.setattr(discover, "STAGES", (windows, steps["base"], steps["settled"], readings))
    trace_verdict = discover.trace_verdict
    monkeypatch.setattr(discover, "trace_verdict", Table.trace)
    given = LoopInput(
        runs, None, robot, *[None] * 4, keep=keep, progress=lambda note: told.append(describe(note)),
        settled=lambda: settled_input(given, lambda runs, settled: Table(settled, runs)),
    )  # fmt: skip
    found = trace_verdict(given)
    if converged or levels < 6:
        assert (found.verdict, found.settled, kept, told) == ("place", False, ["base"], [])
        return
    assert found.settled and kept == ["base", "ranking", "settled search 0"]
    table, notes = given.settled().runs, given.settled().at_first
    assert told == [describe(note) for note in notes] and "no fit over time converges, so the fit uses" in told[0]
    assert len(table) == levels and not table.sampled
    again = prepare_loop(table, robot, settled=notes)
    assert {*notes} <= {*again.notes} and {*notes} <= {*again.at_first}
