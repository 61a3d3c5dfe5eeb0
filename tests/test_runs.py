"""Tables of runs: what is read, and the sentence for everything that is refused."""

import functools

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from calibration.data import column_names
from calibration.data import runs as records
from calibration.data.input_errors import BadData
from calibration.data.named_arrays import NamedArrays
from mmrjax.model import channels
from mmrjax.model.conditions import Conditions
from sweeps.pages.comparison_figures import time_overlay
from tests.commands import read_table, refused, text_file

HEADER = (
    "configuration,supply_voltage_V,total_mass_kg,payload_kg,slope_deg,total_current_A,motor_speed_rpm,speed_mm_s"
)
ROW = "6T2A,15,13.1,0,5,2.75,4800,400"


read = functools.partial(read_table, name="runs.csv")


def test_packaged_tables_are_tables_a1_and_a2():
    measured, simulated = records.read_runs("measured"), records.read_runs("simulated_by_paper")
    assert len(measured) == len(simulated) == 20
    assert measured["total_current_A"][0] == 2.30 and simulated["speed_mm_s"][-1] == 1241
    # The paper's own error (35): rms 4.0, 4.5, 4.6 %, worst 6.8 % (design, section 4).
    errors = 100 * (simulated.measured() - measured.measured()) / simulated.measured()
    assert np.sqrt(np.mean(errors**2, 0)) == pytest.approx([4.0, 4.5, 4.6], abs=0.05)
    assert np.abs(errors).max() == pytest.approx(6.8, abs=0.05)


def test_conditions_are_those_of_the_robot(tmp_path, robot):
    runs = read(tmp_path, f"{HEADER},surface\n{ROW},linoleum\n4W2T,33,21.1,8,20,4,11000,1200,asphalt\n")
    conditions = runs.conditions(robot)
    assert isinstance(conditions, Conditions) and conditions.shape == (2,)
    assert conditions.slope == pytest.approx(np.radians([5, 20]))
    assert conditions.configuration.tolist() == [0, 1]
    assert conditions.total_mass.tolist() == [13.1, 21.1]
    assert conditions.adhesion == pytest.approx([0.42 / 0.32, 0.60 / 0.38])
    assert runs.measured()[0] == pytest.approx([2.75, 4800 * 2 * np.pi / 60, 0.4])


def test_a_configuration_that_the_robot_lacks_is_refused_with_those_it_has(tmp_path, robot):
    runs = read(tmp_path, f"{HEADER}\n{ROW}\n{ROW.replace('6T2A', '6T2')}\n")
    says = r"runs\.csv row 2, configuration: got 6T2; expected one of these; did you mean 6T2A\? allowed: 6T2A, 4W2T"
    with refused(says):
        runs.conditions(robot)


def test_columns_without_a_name_are_nothing_or_called_by_their_place(tmp_path):
    plain = read(tmp_path, f"{HEADER}\n{ROW}\n")
    for text in (f"{HEADER},\n{ROW},\n", f"{HEADER}\n{ROW},,\n", f"{HEADER},,\n{ROW}\n"):
        runs = read(tmp_path, text)
        assert runs.unknown == () and set(runs.columns) == set(plain.columns)
    assert read(tmp_path, f",{HEADER}\n7,{ROW}\n").unknown == ("column 1",)
    with refused(r"row 1: got 10 cells; the header has 8 columns"):
        read(tmp_path, f"{HEADER}\n{ROW},,9\n")


def test_missing_readings_are_nan(tmp_path):
    header = HEADER.replace(",motor_speed_rpm", "")
    runs = read(tmp_path, f"{header}\n6T2A,15,13.1,0,5,2.75,400\n6T2A,15,13.1,0,5,,400\n")
    assert_array_equal(np.isnan(runs.measured()), [[False, True, False], [True, True, False]])
    assert np.isnan(runs.deviations()).all()


def test_cells_of_a_sound_table_are_read_at_once(tmp_path, monkeypatch):
    """A log may have a million rows: a sentence is made of a cell alone only where it is refused, and of few."""
    looked_at = []

    def refusal(where, *told):
        looked_at.append(where)
        return f"{where}: refused"

    monkeypatch.setattr(column_names, "refused_cell_sentence", refusal)
    runs = read(tmp_path, f"{HEADER},speed_sd_mm_s\n{ROW},4\n{ROW[:-3]}n/a,\n")
    assert runs["payload_kg"].tolist() == [0, 0] and runs["configuration"].tolist() == ["6T2A"] * 2
    assert_array_equal(runs["speed_mm_s"], [400, np.nan])
    assert not looked_at
    with refused(r"row 2: refused; also row 3, speed_sd_mm_s, .*; and 12 more$"):
        read(tmp_path, "\n".join([f"{HEADER},speed_sd_mm_s", f"{ROW},4", *[f"{ROW},0"] * 20]))
    assert len(looked_at) == 1


ARRAYS = {
    "configuration": ["6T2A", "4W2T"], "supply_voltage_V": np.array([15.0, 33.0]), "total_mass_g": [13100, 21100],
    "payload_kg": [0, 8], "slope_percent": [100.0, 0.0], "total_current_A": [np.nan, 4.0], "motor_speed_rpm": [4800, 11000],
    "speed_km_h": [1.44, 4.32], "run_id": [1, 2], "room_C": [21.5, np.nan],
}  # fmt: skip


def of_arrays(columns, **stated):
    values = tuple(v if isinstance(v, list) and isinstance(v[0], str) else np.asarray(v) for v in columns.values())
    return NamedArrays("log.bag", tuple(columns), values, **stated)


def test_arrays_of_numbers_are_read_as_their_texts_are(tmp_path):
    numbers = records.runs_of_arrays(of_arrays(ARRAYS))
    rows = zip(*([str(x) for x in np.asarray(values).tolist()] for values in ARRAYS.values()), strict=True)
    texts = read(tmp_path, "\n".join([",".join(ARRAYS), *map(",".join, rows)]))
    assert numbers.unknown == texts.unknown == ("room_C",) and numbers.headings == texts.headings
    for column in texts.columns:
        assert_array_equal(numbers[column], texts[column], column)
    assert_array_equal(numbers.extras["room_C"], texts.extras["room_C"])
    assert numbers["slope_deg"] == pytest.approx([45.0, 0.0]) and numbers["total_mass_kg"].tolist() == [13.1, 21.1]
    assert [note.removeprefix("log.bag") for note in numbers.notes] == [
        n.removeprefix("runs.csv") for n in texts.notes
    ]


@pytest.mark.parametrize(
    "column, values, says",
    [
        ("slope_percent", [0.0, 101.0], "log.bag row 2, slope_percent: got 101; expected -100 to 100"),
        ("payload_kg", [0, 400], "log.bag row 2, payload_kg: got 400; expected 0 to 300"),
        ("supply_voltage_V", [15.0, np.nan], "log.bag row 2, supply_voltage_V: got nan; expected -10000 to 10000"),
        ("speed_km_h", ["fast", "1"], r"log.bag row 1, speed_km_h: got fast; expected a number, -36 to 36"),
        ("total_mass_g", [13100, 7000], r"row 2, total_mass_kg: got 7; expected more than the payload of 8"),
    ],
)
def test_arrays_out_of_range_are_refused_with_their_row(column, values, says):
    with refused(says):
        records.runs_of_arrays(of_arrays(ARRAYS | {column: values}))


def test_a_unit_that_a_source_states_has_to_be_its_columns():
    units = {"speed_km_h": "km_h", "motor_speed_rpm": "rpm"}
    for wrong, says in (
        ({}, ""),
        ({"motor_speed_rpm": "rad_s"}, "states rad_s in the topic, and is read in rpm; name it motor_speed_rad_s"),
        ({"payload_kg": "Nm"}, "log.bag, payload_kg: got Nm in the topic; expected one of kg, g; correct or remove"),
    ):
        stated = tuple((units | wrong).get(column, "") for column in ARRAYS)
        arrays = of_arrays(ARRAYS, units=stated, units_from="the topic")
        if not says:
            assert len(records.runs_of_arrays(arrays)) == 2
            continue
        with refused(says):
            records.runs_of_arrays(arrays)


def test_a_clock_of_numbers_counts_from_the_first_row_of_its_run():
    time = np.array([5.0, 7.5, 1.7e9, 5.25, 1.7e9 + 0.125])
    columns = {name: np.resize(values, 5) for name, values in ARRAYS.items()} | {
        "configuration": ["6T2A"] * 5, "run_id": np.array([1, 1, 2, 1, 2]), "time_s": time,
    }  # fmt: skip
    with refused(r"log.bag row 3, time_s: got 1700000000; is it in us\? .* expected 0 to 1e"):
        records.runs_of_arrays(of_arrays(columns))
    found = records.runs_of_arrays(of_arrays(columns | {"time_s": np.where(time < 1e6, 1.7e9 + time, time)}))
    assert found["time_s"].tolist() == [0.0, 2.5, 0.0, 0.25, 0.125] and found["run_id"].tolist() == list("11212")


def test_unknown_columns_are_reported_and_kept_out(tmp_path):
    runs = read(tmp_path, f"{HEADER},operator\n{ROW},Anna\n")
    assert runs.unknown == ("operator",) and not runs.has("operator")


def test_conditions_alone_suffice_where_nothing_is_compared(tmp_path, robot):
    path = text_file(tmp_path / "runs.csv", "configuration,supply_voltage_V,payload_kg,slope_deg\n6T2A,15,0,5\n")
    assert records.read_runs(path, measured=False).conditions(robot).total_mass is None
    with refused("column total_mass_kg is missing"):
        records.read_runs(path)


# --- as spreadsheets and people write them -----------------------------------------------------------


def test_semicolons_and_decimal_commas_are_taken_and_said(tmp_path):
    usual = read(tmp_path, f"{HEADER}\n{ROW}\n6T2A,33,21.1,8,0,3.2,11590,970\n")
    for text, said in (
        (f"{HEADER}\n{ROW}\n6T2A,33,21.1,8,0,3.2,11590,970\n".replace(",", ";").replace(".", ","), "semicolons, and"),
        (f"{HEADER}\n{ROW}\n6T2A,33,21.1,8,0,3.2,11590,970\n".replace(",", "\t"), "tabs; read so"),
    ):
        found = read(tmp_path, text)
        for column in usual.columns:
            assert_array_equal(found[column], usual[column])
        assert len(found.notes) == 1 and f"runs.csv: columns are separated by {said}" in found.notes[0]
    assert usual.notes == ()


@pytest.mark.parametrize("encoding, said", [("utf-16", "is read as UTF-16"), ("cp1252", "read as Windows-1252")])
def test_tables_in_other_encodings_are_read_and_said(tmp_path, encoding, said):
    text = f"{HEADER},Öl [µm]\n{ROW},1\n"
    usual = read(tmp_path, text)
    (tmp_path / "runs.csv").write_bytes(text.encode(encoding))
    found = records.read_runs(tmp_path / "runs.csv")
    assert found.unknown == ("Öl [µm]",) and usual.notes == () and found.notes[0].endswith(said)
    for column in usual.columns:
        assert_array_equal(found[column], usual[column])


def test_bytes_that_are_no_text_are_refused(tmp_path):
    for content in (b"\x89PNG\r\n\0\0\xff", b"\xff\xfea\0b"):
        (tmp_path / "runs.csv").write_bytes(content)
        with refused(r"runs\.csv: cannot be read as a text file \(.*; save it as CSV in UTF-8"):
            records.read_runs(tmp_path / "runs.csv")


def test_three_decimals_everywhere_are_no_thousands(tmp_path):
    text = f"{HEADER}\n6T2A,15.000,13.100,0.000,0.000,2.750,480.125,422.000\n".replace(",", ";")
    assert read(tmp_path, text)["motor_speed_rpm"] == 480.125


def test_copies_of_rows_are_said(tmp_path):
    other = ROW.replace("4800", "4801")
    plain = read(tmp_path, f"{HEADER}\n{ROW}\n{other}\n")
    copied = read(tmp_path, f"{HEADER},run_id\n{ROW},a\n{other},b\n{ROW},c\n{other},d\n{other},e\n")
    assert (
        plain.notes == ()
        and "runs.csv: rows 1 and 3 have the same conditions and readings, as do 1 more. " in copied.notes[0]
    )


def test_all_bad_cells_are_said_at_once_the_first_row_first(tmp_path):
    rows = [ROW, ROW.replace("4800", "fast"), ROW, ROW.replace("15", "-50000").replace("2.75", "inf")]
    with pytest.raises(BadData) as error:
        read(tmp_path, "\n".join([HEADER, *rows]))
    said = str(error.value)
    assert said.startswith("runs.csv row 2, motor_speed_rpm: got fast; expected a number")
    assert said.endswith("; also row 4, supply_voltage_V, row 4, total_current_A")
    with refused(r"expected .* 1e\+06; also row 2, motor_speed_rpm, row 3"):
        read(tmp_path, "\n".join([HEADER, *[ROW.replace("4800", "fast")] * 3]))


def test_capitals_of_columns_and_configurations_are_taken_and_said(tmp_path, robot):
    text = f"{HEADER}\n{ROW}\n".replace("slope_deg", "Slope_Deg").replace("6T2A", "6t2a")
    found = read(tmp_path, text, robot=robot)
    assert found["slope_deg"].tolist() == [5.0] and found["configuration"].tolist() == ["6T2A"]
    assert found.notes == (
        "runs.csv: column Slope_Deg is read as slope_deg", "runs.csv: configuration 6t2a is read as 6T2A",
    )  # fmt: skip


def test_what_a_table_lacks_is_said_before_it_is_used(tmp_path, robot):
    header = f"{HEADER.replace(',motor_speed_rpm', '')},run_id"
    rows = [ROW.replace(",4800", "").replace("2.75", f"2.7{k}") + f",{run}" for k, run in enumerate("abac")]
    rows[1] = rows[1].replace("2.71", "")
    found = read(tmp_path, "\n".join([header, *rows]), robot=robot)
    assert found.notes == (
        "runs.csv: 1 of 4 cells of total_current_A are empty, the first in row 2. They are ignored",
        "runs.csv: no column motor_speed_rpm, so this channel has no readings",
        "runs.csv: run_id a is in rows 1, 3. Without time_s every row is a separate run",
    )


@pytest.mark.parametrize("named", [True, False])
def test_pages_order_the_rows_of_a_run_as_the_table_does(named):
    """Rows of two runs, mixed and backwards in time. Of one run, where there is no `run_id`."""
    time = np.array([3.0, 2.0, 1.0, 0.0, 5.0, 4.0])
    columns = {"run_id": np.array(["a", "b", "a", "b", "a", "b"])} if named else {}
    columns |= {"time_s": time, "total_current_A": time}
    columns |= {"configuration": np.repeat("6T2A", 6), "supply_voltage_V": 5 * time}
    table = columns | {"after_total_current_A": time}
    shown = channels.channels_named(["total_current"])
    fit = time_overlay(table, shown, {"after_": "calibrated"}).draw()
    drawn = [
        np.asarray(line.get_xdata(), float)
        for axes in fit.axes
        for line in axes.lines
        if len(line.get_xdata()) == (3 if named else 6)
    ]
    assert len(drawn) >= 3 and all((np.diff(x) > 0).all() for x in drawn)
