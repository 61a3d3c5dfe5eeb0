"""Records as people have them lead from the file to a first statement, with the columns that `inspect` proposes."""

from dataclasses import replace

import numpy as np
import pytest
from commands import command
from miniatures import RECORDS

from calibration.data import contents, rig_facts, robot_file, row_checks, runs
from tests.commands import read_json

#: Columns that `inspect` proposes, with the factor to the unit of the column.
PROPOSED = {
    "odrive": {"time_s", "supply_voltage_V", "output_angle_turns", "output_speed_turns_s"},
    "emps": set(),
    "drivetrain": {"time_s", "supply_voltage_V", "position_m", "speed_m_s", "output_angle_deg"},
    "car": {"time_ns", "duty", "speed_m_s", "supply_voltage_V", "motor_current_A", "position_m"},
    "neo_dyno": set(),
    "micromouse": {"time_ms", "supply_voltage_mV", "duty", "motor_speed_rpm"},
}
#: Rows of each that are read, and True if each is a settled run.
READ = {
    "odrive": (400, False), "emps": (1200, False), "drivetrain": (600, False), "car": (500, False),
    "neo_dyno": (13, True), "micromouse": (86, True),
}  # fmt: skip


def made(name, folder):
    """The files of a record: its data, and the rig with proposed columns after a user's corrections."""
    write, rig, corrected = RECORDS[name]
    data = write(folder / f"{name}.csv")
    lines = dict(line.split(" = ", 1) for line in contents.inspect_source(data).proposed)
    lines |= corrected
    file = folder / "rig.toml"
    file.write_text(
        rig.replace("[motor]", "[columns]\n" + "".join(f"{c} = {v}\n" for c, v in lines.items()) + "[motor]", 1)
    )
    return data, file


@pytest.mark.parametrize("name", RECORDS)
def test_a_record_is_read_with_the_columns_that_inspect_proposes(name, tmp_path):
    data, file = made(name, tmp_path)
    columns = {line.partition(" = ")[0] for line in contents.inspect_source(data).proposed}
    assert columns == PROPOSED[name]
    read_file = robot_file.read_robot(file)
    read = runs.read_runs(data, read_file)
    assert (len(read), not read.sampled) == READ[name]
    assert not rig_facts.doubtful_time(read, read_file)


#: Columns of a table whose names are this program's.
OWN = {"output_speed_rpm": "output_speed_rpm"}


def table(step, late):
    """Nine settings, three to a step. Readings follow the setting of their row, or of the row before (`late`)."""
    volts = np.array([6.0, 11.0, 8.0, 14.0, 7.0, 12.0, 9.0, 13.0, 10.0])
    shown = np.roll(volts, late)
    return {"time_s": step * np.arange(9.0), "supply_voltage_V": volts, "output_speed_rpm": 90 * shown - 100}


@pytest.mark.parametrize(
    "step, late, settled", [(3.0, 0, True), (0.01, 0, False), (3.0, 1, False), (0.6, 0, True), (0.4, 0, False)]
)
def test_settled_points_that_have_a_time_are_settled_runs(step, late, settled, tmp_path):
    """Case t5-17: nine points three seconds apart were a log that starts at rest, and too short for one."""
    _, file = made("micromouse", tmp_path)
    read = runs.read_runs(table(step, late), robot_file.read_robot(file), columns=OWN)
    assert read.sampled == (not settled)
    assert any("each row is read as a settled run" in note for note in read.notes) == settled


def test_points_that_the_motors_do_not_settle_between_are_a_log(tmp_path):
    """The wheel's inertia is raised until five time constants are more than a step."""
    _, file = made("micromouse", tmp_path)
    robot = robot_file.read_robot(file)
    read = runs.read_runs(table(3.0, 0), robot, columns=OWN)
    log = replace(read, columns=table(3.0, 0))
    assert log.sampled and not row_checks.without_time_of_settled_rows(log, robot).sampled
    file.write_text(file.read_text().replace("inertia = 1e-6", "inertia = 0.2"))
    heavy = robot_file.read_robot(file)
    assert row_checks.CONSTANTS_APART * row_checks.time_constant(heavy) > 3.0
    assert runs.read_runs(table(3.0, 0), heavy, columns=OWN).sampled


def test_rows_that_nothing_was_recorded_in_are_left_out(tmp_path):
    data, file = made("odrive", tmp_path)
    read = runs.read_runs(data, robot_file.read_robot(file))
    assert any("left out: 2 rows without any reading" in note for note in read.notes)
    assert any("left out: 5 rows at the end, because the clock restarts at 0" in note for note in read.notes)
    assert (np.diff(read["time_s"]) > 0).all() and read["time_s"][-1] == pytest.approx(399 * 0.00625, rel=0.05)


#: Records whose search ends before it converges, as the page says: level ground does not determine the adhesion.
UNSETTLED = {"drivetrain", "car"}
#: Largest rms error of the fit of each, in percent of the channel's rms reading.
MISSED = {"odrive": 0.5, "emps": 1.0, "drivetrain": 1.0, "car": 6.0, "neo_dyno": 1.0, "micromouse": 2.0}


@pytest.mark.slow
@pytest.mark.parametrize("name", RECORDS)
def test_a_record_is_checked_and_calibrated(name, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    data, file = made(name, tmp_path)
    assert command(["rig", "check", file, data]) == 0
    assert "These data determine" in capsys.readouterr().out
    assert command(["calibrate", data, "--robot", file, "--out", "fit"]) == (3 if name in UNSETTLED else 0)
    found = read_json(tmp_path / "fit/result.json")
    assert found["optimizer"]["status"] == ("not_converged" if name in UNSETTLED else "converged")
    errors = {channel: e["rms_percent"] for channel, e in found["errors"]["after"]["fitted"].items()}
    assert errors and max(errors.values()) < MISSED[name], errors
