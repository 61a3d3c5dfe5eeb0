"""Data logs of WPILib, spreadsheets, comments of MATLAB, JSON of episodes, and groups of files."""

import json
import struct
import zipfile

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from calibration.data import contents, delimited, presets_file, runs
from calibration.data.sources import json_records, opening, reading
from tests.commands import refused, text_file


def signals_of(path):
    name = path.name
    return {s.path: s for s in opening.open_signals(path, "", name, opening.format_of(path, name)).signals}


def read_as(path, preset):
    """Columns of a file that a preset reads, by their names."""
    table, mapped = reading.read_columns(path, runs.Layout.of(None), presets_file.find_preset(preset))
    columns = dict(zip(table.header, table.values, strict=True))
    return columns | {mine: columns[theirs] for mine, theirs, _ in mapped}


# --- WPILOG -------------------------------------------------------------------------------------------------------


def wpilog(*records):
    """Bytes of a log: (entry, stamp [µs], payload). A payload of text starts an entry, (name, type)."""
    content = b"WPILOG" + struct.pack("<HI", 0x100, 3) + b"abc"
    for entry, stamp, payload in records:
        if isinstance(payload, tuple):
            texts = b"".join(struct.pack("<I", len(t)) + t.encode() for t in (*payload, ""))
            entry, payload = 0, b"\0" + struct.pack("<I", entry) + texts
        content += bytes([0x20]) + struct.pack("<BB", entry, len(payload)) + stamp.to_bytes(3, "little") + payload
    return content


def sysid_log():
    records = [(1, 0, ("sysid-test-state-arm", "string")), (5, 0, ("tags", "int64[]"))]
    records += [(k, 0, (f"{q}-arm-arm", "double")) for k, q in ((2, "voltage"), (3, "position"), (4, "velocity"))]
    for test, first in (("quasistatic-forward", 0), ("dynamic-reverse", 500_000)):
        for k in range(10):
            stamp = first + 20_000 * k
            records.append((1, stamp, test.encode()))
            records += [(entry, stamp, struct.pack("<d", entry * 10 + k)) for entry in (2, 3, 4)]
        records.append((1, stamp, b"none"))
    return [*records, (5, 10, b"12345678")]


def test_sysid_log_of_wpilib_becomes_one_run_for_each_test(tmp_path):
    file = tmp_path / "robot.wpilog"
    file.write_bytes(wpilog(*sysid_log()))
    signals = signals_of(file)
    assert signals["tags"].refused and len({id(s.clock) for s in signals.values() if s.clock}) == 1
    assert presets_file.recognise_preset([*signals]) == "sysid"
    names = read_as(file, "sysid,rotations=1")
    assert list(dict.fromkeys(names["run_id"])) == ["quasistatic-forward", "dynamic-reverse"]
    assert_array_equal(names["supply_voltage_V"], [*range(20, 30)] * 2)
    assert_array_equal(names["output_speed_turns_s"], [*range(40, 50)] * 2)
    assert_allclose(np.diff(names["time_s"])[:9], 0.02)


def test_advantagekit_names_a_module(tmp_path):
    names = ("DriveAppliedVolts", "DrivePositionRad", "DriveVelocityRadPerSec", "DriveCurrentAmps")
    entries = [f"/Drive/Module{k}/{name}" for k in (0, 1) for name in names] + ["/SystemStats/BatteryVoltage"]
    records = [(k, 0, (name, "double")) for k, name in enumerate(entries, 1)]
    records += [(k, 20_000 * t, struct.pack("<d", 10 * k + t)) for t in range(5) for k in range(1, len(entries) + 1)]
    (tmp_path / "akit.wpilog").write_bytes(wpilog(*records))
    assert presets_file.recognise_preset(entries) == "advantagekit"
    found = read_as(tmp_path / "akit.wpilog", "advantagekit,module=1")
    expected = ("supply_voltage_V", "output_angle_rad", "output_speed_rad_s", "motor_current_A")
    for k, mine in enumerate(expected, 5):
        assert_array_equal(found[mine], 10 * k + np.arange(5))


@pytest.mark.parametrize("change, words", [
    (lambda b: b[:-3], "ends within a record"), (lambda b: b[:7] + b"\x02" + b[8:], "with a version other than 1"),
    (lambda b: b[:12], "without signals"),
])  # fmt: skip
def test_damaged_wpilog_is_refused(tmp_path, change, words):
    file = tmp_path / "robot.wpilog"
    file.write_bytes(change(wpilog(*sysid_log())))
    with refused(words):
        signals_of(file)


# --- spreadsheets -------------------------------------------------------------------------------------------------


def write_xlsx(file, **sheets):
    """A workbook with the rows of each sheet: numbers, texts, or None for an empty cell."""

    def cell(x):
        if x is None:
            return "<c/>"
        if isinstance(x, str):
            return f'<c t="inlineStr"><is><t>{x}</t></is></c>'
        return f"<c><v>{x}</v></c>"

    space = 'xmlns="http://schemas.openxmlformats.org/spreadsheetml/2006/main"'
    relations = 'xmlns="http://schemas.openxmlformats.org/package/2006/relationships"'
    kind = "http://schemas.openxmlformats.org/officeDocument/2006/relationships"
    with zipfile.ZipFile(file, "w") as archive:
        listed, related = "", ""
        for k, (name, rows) in enumerate(sheets.items(), 1):
            listed += f'<sheet name="{name}" sheetId="{k}" r:id="r{k}"/>'
            related += f'<Relationship Id="r{k}" Type="{kind}/worksheet" Target="worksheets/s{k}.xml"/>'
            body = "".join(f"<row>{''.join(map(cell, row))}</row>" for row in rows)
            archive.writestr(
                f"xl/worksheets/s{k}.xml", f"<worksheet {space}><sheetData>{body}</sheetData></worksheet>"
            )
        archive.writestr(
            "xl/workbook.xml", f'<workbook {space} xmlns:r="{kind}"><sheets>{listed}</sheets></workbook>'
        )
        archive.writestr("xl/_rels/workbook.xml.rels", f"<Relationships {relations}>{related}</Relationships>")
        top = f'<Relationship Id="r1" Type="{kind}/officeDocument" Target="xl/workbook.xml"/>'
        archive.writestr("_rels/.rels", f"<Relationships {relations}>{top}</Relationships>")
        archive.writestr("[Content_Types].xml", "<Types/>")


ROWS = [["supply_voltage_V", "I_mot", "n"], ["V", "mA", "1/min"], [12, 410.5, 3000], [24, None, 6000]]


def test_sheet_is_a_table_with_a_row_of_units(tmp_path):
    write_xlsx(tmp_path / "bench.xlsx", Bench=[[None] * 3, *ROWS], Notes=[["made by hand"]])
    signals = signals_of(tmp_path / "bench.xlsx")
    assert [*signals] == ["supply_voltage_V", "I_mot", "n"] and signals["I_mot"].unit == "mA"
    assert_array_equal(signals["I_mot"].load(), [410.5, np.nan])


def test_sheets_of_a_workbook_are_chosen_by_name(tmp_path):
    write_xlsx(tmp_path / "two.xlsx", cold=ROWS, hot=[ROWS[0], [12, 400, "broken"], [1, 2, 3], [1, 2, 3]])
    file = tmp_path / "two.xlsx"
    cold = opening.open_signals(file, "cold", file.name, opening.format_of(file, file.name))
    assert [s.path for s in cold.signals] == ["cold/supply_voltage_V", "cold/I_mot", "cold/n"]
    with refused(r"hot, n: got 'broken' among numbers"):
        signals_of(file)["hot/n"].load()


# --- text ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("sign", ["%", "#", "% "])
def test_header_and_units_stand_in_comments_of_matlab(tmp_path, sign):
    file = tmp_path / "step.csv"
    lines = ["Bench 3", "Date:,03/02/2026", "", "tick,voltage,speed", "[#],[V],[turns/s]"]
    table = delimited.read_csv_columns(
        text_file(file, "".join(f"{sign}{line}\n" if line else "\n" for line in lines) + "0,0.0,0.1;\n1,3.0,0.2;\n"),
        "step.csv",
    )
    assert table.header == ("tick", "voltage", "speed") and table.units[1:] == ("V", "turns_s")
    assert table.values[2] == ["0.1", "0.2"]


def test_last_comment_without_units_is_the_header(tmp_path):
    assert delimited.read_csv_columns(
        text_file(tmp_path / "a.csv", "% by me\n% time,voltage\n0,1\n1,2\n"), "a.csv"
    ).header == ("time", "voltage")


# --- JSON ---------------------------------------------------------------------------------------------------------


def content_signals(content):
    return {s.path: s for s in json_records.signals_of_json_content(content, "log.json")}


def test_records_of_lists_are_runs_of_their_own():
    data = [{"kind": k, "mass": m, "u": [*range(n)], "q": [0.5] * n, "notes": []}
            for k, m, n in (("step", 1, 3), ("sine", 2, 4))]  # fmt: skip
    signals = content_signals({"rate_hz": 50, "data": data})
    assert {*signals} == {"data.u", "data.q", "data.kind", "data.mass", "data.run_id", "data.time_s"}
    assert signals["data.run_id"].load().tolist() == ["step"] * 3 + ["sine"] * 4
    assert_allclose(signals["data.time_s"].load(), 0.02 * np.array([0, 1, 2, 0, 1, 2, 3]))
    assert presets_file.recognise_preset([*signals]) == ""


def test_episodes_keep_their_own_clock_and_repeated_names_are_numbered():
    signals = content_signals([{"kind": "a", "t": [0, 1], "u": [1, 2]}, {"kind": "a", "t": [0, 2], "u": [3, 4]}])
    assert signals["run_id"].load().tolist() == ["1", "1", "2", "2"] and "time_s" not in signals
    assert signals["u"].load().tolist() == [1, 2, 3, 4]


# --- groups -------------------------------------------------------------------------------------------------------

TABLE = "configuration,supply_voltage_V,total_mass_kg,payload_kg,slope_deg,total_current_A\n6T2A,{},11.5,0,0,2.3\n"


def test_files_of_a_pattern_are_runs_of_their_own(tmp_path):
    for k, voltage in enumerate((15, 24)):
        (tmp_path / f"run{k}.csv").write_text(TABLE.format(voltage))
    table, _ = reading.read_columns(str(tmp_path / "run*.csv"), runs.Layout.of(None))
    columns = dict(zip(table.header, table.values, strict=True))
    assert columns["run_id"] == ["run0", "run1"] and columns["supply_voltage_V"] == ["15", "24"]
    first = table.digest
    (tmp_path / "run1.csv").write_text(TABLE.format(25))
    assert reading.read_columns(str(tmp_path / "run*.csv"), runs.Layout.of(None))[0].digest != first
    assert len(runs.read_runs(tmp_path / "run*.csv")) == 2
    shown = contents.inspect_source(str(tmp_path / "run*.csv"))  # it was "no such file"
    assert len(shown.signals) == 6 and "2 files, each a run; these are the signals of run0.csv" in shown.notes[0]


def test_files_of_a_pattern_have_the_same_columns(tmp_path):
    (tmp_path / "a.csv").write_text(TABLE.format(15))
    (tmp_path / "b.csv").write_text(TABLE.format(15).replace("slope_deg", "slope_rad"))
    with refused(r"b\.csv and a\.csv differ in slope_deg, slope_rad"):
        runs.read_runs(tmp_path / "*.csv")
    with refused("no such file"):
        runs.read_runs(tmp_path / "*.txt")


def test_json_of_episodes_is_read_from_a_file(tmp_path):
    signals = signals_of(
        text_file(tmp_path / "log.json", json.dumps({"dt": 0.1, "data": [{"u": [1.0, 2.0]}, {"u": [3.0, None]}]}))
    )
    assert_array_equal(signals["data.u"].load(), [1, 2, 3, np.nan])
