"""Units of columns against a table written out by hand, and quantities that are one row each."""

import math
import os
import subprocess
import sys

import pytest

from calibration.data import runs as records
from mmrjax.fidelities import outputs
from mmrjax.model import channels, quantities
from sweeps.commands import explain
from tests.commands import ROOT, columns_of, read_json, read_rig, read_table, refused, text_file

#: One of each unit, in SI.
BY_HAND = {
    "A": 1.0, "mA": 0.001, "V": 1.0, "mV": 0.001, "Nm": 1.0, "mNm": 0.001, "kNm": 1000.0, "C": 1.0,
    "rpm": 2 * math.pi / 60, "rad/s": 1.0, "turns/s": 2 * math.pi, "deg/s": math.pi / 180,
    "mm/s": 0.001, "m/s": 1.0, "cm/s": 0.01, "km/h": 1000 / 3600, "m/min": 1 / 60,
    "kg": 1.0, "g": 0.001, "s": 1.0, "ms": 0.001, "us": 1e-6, "ns": 1e-9, "min": 60.0, "h": 3600.0, "": 1.0, "percent": 0.01, "rad/s^2": 1.0,
    "mm": 0.001, "m": 1.0, "cm": 0.01, "um": 1e-6,
    "deg": math.pi / 180, "rad": 1.0, "turns": 2 * math.pi,
}  # fmt: skip


@pytest.mark.parametrize("channel", channels.EVERY, ids=lambda c: c.name)
def test_units_of_a_channel_are_those_of_the_table_by_hand(channel):
    for unit, factor in channel.sizes.items():
        assert factor == pytest.approx(BY_HAND[unit], rel=1e-12), unit


@pytest.mark.parametrize("condition", quantities.SET, ids=lambda c: c.column)
def test_units_of_a_condition_are_those_of_the_table_by_hand(condition):
    for unit, factor in condition.sizes.items():
        assert factor == pytest.approx(BY_HAND[unit], rel=1e-12), unit
        assert condition.value(2.0, quantities.unit_in_column(unit)) == pytest.approx(2.0 * factor / condition.factor)


def test_per_cent_of_a_slope_are_those_of_its_tangent():
    slope = quantities.CONDITIONS["slope_deg"]
    assert slope.value(100.0, "percent") == pytest.approx(45.0)
    assert slope.limits("percent") == pytest.approx((-100.0, 100.0))


@pytest.mark.parametrize(
    "written, column",
    [("U/min", "rpm"), ("1/min", "rpm"), ("min-1", "rpm"), ("°/s", "deg_s"), ("Nmm", "mNm"), ("N·m", "Nm"), ("%", "percent"),
     ("RPM", "rpm"), ("Deg/s", "deg_s"), ("N-m", "Nm"), ("N m", "Nm"), ("mN.m", "mNm"), ("torque", "torque"),
     ("MNm", "MNm"), ("G", "G")],
)  # fmt: skip
def test_units_as_people_write_them_are_those_of_columns(written, column):
    assert quantities.unit_in_column(written) == column


@pytest.mark.parametrize(
    "name, unit",
    [("speed_RPM", "rpm"), ("torque_nm", "Nm"), ("omega_rad_s", "rad_s"), ("phase_a", None), ("torque_kNm", "kNm")],
)
def test_unit_at_the_end_of_a_name_may_have_other_capitals(name, unit):
    assert quantities.unit_at_end(name, ("rpm", "Nm", "kNm", "A", "V", "rad_s", "rad")) == unit


# --- a quantity is one row -----------------------------------------------------------------------------------

CHANNEL = quantities.Channel(
    "terminal_voltage", "V", "terminal voltage", (0.0, 100.0), 10.0, word="terminal", signal="voltage"
)
CONDITION = quantities.Condition("depth", "mm", "depth of the water", (50.0, 120.0), field="", in_tables=True)
TABLE = (
    "configuration,supply_voltage_V,total_mass_kg,payload_kg,slope_deg,{}\n"
    "6T2A,15,13.1,0,5,{},2000\n6T2A,24,13.1,0,5,0.1013,4000\n"
)


@pytest.fixture
def two_rows_more(monkeypatch):
    monkeypatch.setattr(channels, "EVERY", (*channels.EVERY, CHANNEL))
    monkeypatch.setattr(quantities, "SET", (*quantities.SET, CONDITION))


def test_a_quantity_is_read_written_and_explained_by_its_row(two_rows_more, tmp_path):
    path = tmp_path / "runs.csv"
    runs = records.read_runs(text_file(path, TABLE.format("depth_m,terminal_voltage_mV", 0.098)))
    assert runs.unknown == () and runs.channels[-1] is CHANNEL
    assert runs["depth_mm"].tolist() == [98.0, 101.3] and runs["terminal_voltage_V"].tolist() == [2.0, 4.0]
    with refused(r"row 1, depth_mm: got 40; expected 50 to 120; also row 1, terminal_"):
        records.read_runs(text_file(path, TABLE.format("depth_mm,terminal_voltage_V", 40)))
    assert (
        "Depth_m is read as depth_m"
        in records.read_runs(text_file(path, TABLE.format("Depth_m,terminal_voltage_mV", 0.098))).notes[0]
    )
    (output,) = (o for o in outputs.output_table(runs.channels) if o.name == CHANNEL.name)
    assert (output.column, output.unit, output.label) == ("terminal_voltage_V", "V", "terminal voltage")
    for kind, name in (("channel", "terminal_voltage"), ("condition", "depth")):
        assert dict(explain.explanations({})[kind][name]())["column"].startswith(f"{name}_")


def test_a_rig_states_a_channel_by_its_row(two_rows_more, tmp_path):
    robot = read_rig(
        tmp_path, 'channels = ["terminal_voltage"]\n[columns]\ndepth_m = "p"\nterminal_voltage_mV = "Ut"\n'
    )
    runs = read_table(tmp_path, TABLE.format("p,Ut", 0.098), robot, "runs.csv")
    assert runs["depth_mm"].tolist() == [98.0, 101.3] and runs.measured().tolist() == [[2.0], [4.0]]
    assert robot.channels == (CHANNEL,) and runs.headings["terminal_voltage_V"] == "Ut"


ROW_MORE = """
import sys
from pathlib import Path
from mmrjax.model import quantities
quantities.TABLE["channel"] += (quantities.Channel(
    "gear_torque", "Nm", "torque of the gearbox", (-100.0, 100.0), 10.0, 0.03, signal="torque_gear"
),)
from sweeps import cli
robot = Path("rig.toml")
robot.write_text(
    'base = "none"\\nchannels = ["motor_speed", "gear_torque"]\\nmotor.torque_constant = 0.05\\n'
    'motor.resistance = 1.0\\ngearbox.ratio = 16\\ngearbox.efficiency_load = 0.8\\n'
    '[bench]\\nload = "shaft"\\ninertia = 0.001\\nloss_coulomb = 0.1\\n'
)
Path("runs.csv").write_text("supply_voltage_V,motor_speed_rpm,gear_torque_mNm\\n12,2200,100\\n24,4400,120\\n")
commands = (
    "compare runs.csv --robot rig.toml --out compared",
    "sweep --robot rig.toml --voltages 12,24 --outputs gear_torque --out swept --no-report --export csv",
    "explain gear_torque",
)
for command in commands:
    sys.argv = ["mmrjax", *command.split()]
    try:
        cli.main()
    except SystemExit as end:
        assert end.code in (0, None), command
"""


def test_a_channel_of_one_row_is_in_tables_sweeps_help_pages_and_json(tmp_path):
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    done = subprocess.run(
        [sys.executable, "-c", ROW_MORE], cwd=tmp_path, env=environment, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    assert "torque of the gearbox [N·m], as shown by its instrument" in done.stdout
    assert columns_of(tmp_path / "swept/runs.csv")["gear_torque_Nm"] == pytest.approx([0.1, 0.1])
    assert "torque of the gearbox" in (tmp_path / "compared/report.html").read_text("utf-8")
    error = read_json(tmp_path / "compared/result.json")["errors"]["bench"]["gear_torque"]
    assert error["unit"] == "Nm" and error["rms"] == pytest.approx(math.sqrt((0.0**2 + 0.02**2) / 2), rel=1e-6)
