"""Units of columns against a table written out by hand, and quantities that are one row each."""

import math

import pytest

from calibration.data import robot_file
from calibration.data import runs as records
from calibration.data.input_errors import BadData
from mmrjax.fidelities import outputs
from mmrjax.model import channels, quantities
from sweeps.commands import explain

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
    for unit, factor in ((channel.unit, channel.factor), *channel.other_units):
        assert factor == pytest.approx(BY_HAND[unit], rel=1e-12), unit


@pytest.mark.parametrize("condition", quantities.SET, ids=lambda c: c.column)
def test_units_of_a_condition_are_those_of_the_table_by_hand(condition):
    for unit, factor in ((condition.unit, condition.factor), *condition.other_units):
        assert factor == pytest.approx(BY_HAND[unit], rel=1e-12), unit
        assert condition.value(2.0, quantities.unit_in_column(unit)) == pytest.approx(2.0 * factor / condition.factor)


def test_per_cent_of_a_slope_are_those_of_its_tangent():
    slope = quantities.CONDITIONS["slope_deg"]
    assert slope.value(100.0, "percent") == pytest.approx(45.0)
    assert slope.limits("percent") == pytest.approx((-100.0, 100.0))


@pytest.mark.parametrize(
    ("written", "column"),
    [("U/min", "rpm"), ("1/min", "rpm"), ("min-1", "rpm"), ("°/s", "deg_s"), ("Nmm", "mNm"), ("N·m", "Nm"), ("%", "percent")],
)  # fmt: skip
def test_units_as_people_write_them_are_those_of_columns(written, column):
    assert quantities.unit_in_column(written) == column


# --- a quantity is one row -----------------------------------------------------------------------------------

CHANNEL = channels.Channel(
    name="terminal_voltage", unit="V", factor=1.0, label="terminal voltage", word="terminal", range=(0.0, 100.0),
    sd_largest=10.0, read=lambda robot, signals: signals.voltage, sd_share=0.01, other_units=(("mV", 1e-3),),
)  # fmt: skip
CONDITION = quantities.Condition(
    "air_pressure", "kPa", 1e3, "pressure of the air", (50.0, 120.0), in_tables=True, other_units=(("Pa", 1.0),)
)
TABLE = (
    "configuration,supply_voltage_V,total_mass_kg,payload_kg,slope_deg,{}\n"
    "6T2A,15,13.1,0,5,{},2000\n6T2A,24,13.1,0,5,101300,4000\n"
)


@pytest.fixture
def two_rows_more(monkeypatch):
    monkeypatch.setattr(channels, "EVERY", (*channels.EVERY, CHANNEL))
    monkeypatch.setattr(quantities, "SET", (*quantities.SET, CONDITION))


def test_a_quantity_is_read_written_and_explained_by_its_row(two_rows_more, tmp_path):
    path = tmp_path / "runs.csv"
    path.write_text(TABLE.format("air_pressure_Pa,terminal_voltage_mV", 98000))
    runs = records.read_runs(path)
    assert runs.unknown == () and runs.channels[-1] is CHANNEL
    assert runs["air_pressure_kPa"].tolist() == [98.0, 101.3] and runs["terminal_voltage_V"].tolist() == [2.0, 4.0]
    path.write_text(TABLE.format("air_pressure_kPa,terminal_voltage_V", 40))
    with pytest.raises(BadData, match=r"row 1, air_pressure_kPa: got 40; expected 50 to 120; also row 1, terminal_"):
        records.read_runs(path)
    path.write_text(TABLE.format("Air_Pressure_Pa,terminal_voltage_mV", 98000))
    assert "Air_Pressure_Pa is read as air_pressure_Pa" in records.read_runs(path).notes[0]
    (output,) = (o for o in outputs.output_table(runs.channels) if o.name == CHANNEL.name)
    assert (output.column, output.unit, output.label) == ("terminal_voltage_V", "V", "terminal voltage")
    for kind, name in (("channel", "terminal_voltage"), ("condition", "air_pressure_kPa")):
        assert dict(explain.EXPLAINED[kind](name, {}))["column"].startswith(f"{name.removesuffix('_kPa')}_")


def test_a_rig_states_a_channel_by_its_row(two_rows_more, tmp_path):
    path = tmp_path / "rig.toml"
    path.write_text('channels = ["terminal_voltage"]\n[columns]\nair_pressure_Pa = "p"\nterminal_voltage_mV = "Ut"\n')
    robot = robot_file.read_robot(path)
    (tmp_path / "runs.csv").write_text(TABLE.format("p,Ut", 98000))
    runs = records.read_runs(tmp_path / "runs.csv", robot=robot)
    assert runs["air_pressure_kPa"].tolist() == [98.0, 101.3] and runs.measured().tolist() == [[2.0], [4.0]]
    assert robot.channels == (CHANNEL,) and runs.headings["terminal_voltage_V"] == "Ut"
