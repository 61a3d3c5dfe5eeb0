"""Records as people have them lead from the file to a first statement, with the columns that `inspect` proposes."""

import json

import pytest
from commands import command
from miniatures import RECORDS

from calibration.data import contents, rig_facts, robot_file, runs

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
    assert not rig_facts.doubtful_time(read, read_file) and not rig_facts.doubtful_speed(read, read_file)


@pytest.mark.slow
@pytest.mark.parametrize("name", RECORDS)
def test_a_record_is_checked_and_calibrated(name, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    data, file = made(name, tmp_path)
    assert command(["rig", "check", file, data]) == 0
    assert "These data determine" in capsys.readouterr().out
    assert command(["calibrate", data, "--robot", file, "--out", "fit"]) == 0
    assert json.loads((tmp_path / "fit" / "result.json").read_text("utf-8"))["converged"]
