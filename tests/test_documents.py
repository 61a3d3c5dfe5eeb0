"""Reports as documents: page, terminal and CSV show the same cells. One text of each document is kept."""

import csv
import importlib
import io
import json
import re
import urllib.parse
from dataclasses import replace

import numpy as np
import pytest
from numpy.random import default_rng
from pages import Tables, as_text, drawn, outside, recorded

from calibration.data import settling
from calibration.data.requirements_file import parse_requirements
from calibration.data.robot_file import RobotFile
from calibration.data.runs import Runs, read_runs
from calibration.inference.conduct import rows_after_steps
from calibration.sizing.design_search import SizedDesign, SizingResult
from calibration.sizing.part_options import drive_options, packaged_sheets
from calibration.sizing.sheet import ParameterChange, RequirementOutcome
from mmrjax.model import channels
from mmrjax.model.paper_robots import nominal
from sweeps import store
from sweeps.inputs import recorded_fit
from sweeps.report import catalogue, settle_report
from sweeps.report.check_report import CheckResult, SizeResult, check_document, size_document
from sweeps.report.comparison_report import (
    Comparison,
    _over_time,
    compare_readings,
    comparison_document,
)
from sweeps.report.document import Cell, Column, Document, Note, Section, Table, remarks
from sweeps.report.page_renderer import write_report_page
from sweeps.report.terminal_renderer import print_document


def outcomes():
    """A requirement that is met, one missed with two changes, and one without a value."""
    asked = parse_requirements("speed_m_s = 1\nmass_kg = 15\nslope_deg = 20\n", "aims.toml")
    at = {"configuration": "6T2A", "surface": "lacquered_wood", "payload_kg": 8.0, "slope_deg": 10.0}
    changes = (
        ParameterChange("gearbox.ratio", 48.0, 45.27, "-", -0.02),
        ParameterChange("battery.capacity", 7920.0, 16210.0, "C", 1e-5, ("mass_kg",)),
    )
    speed, mass, slope = asked.each
    return (
        RequirementOutcome(speed, 0.947, -0.053, "converged", at, changes),
        RequirementOutcome(mass, 13.1, 1.9, "converged", {k: at[k] for k in ("configuration", "surface")}),
        RequirementOutcome(slope, None, None, "slides", at),
    )


def check():
    asked = parse_requirements("speed_m_s = 1\nmass_kg = 15\nslope_deg = 20\n", "aims.toml")
    return check_document(CheckResult(asked, nominal(), outcomes()), "nominal (PM)")


def size():
    robot, drive = nominal(), drive_options(("RE 40 24 V",))[0]
    asked = parse_requirements("mass_kg = 15\n", "aims.toml")
    best = SizedDesign(
        drive, packaged_sheets("cells")[0], 12.5, 0.0414, 3, 4.0, {"mass": 14.14, "energy": 0.031},
        {"winding": 0.002, "cell current": 0.4}, ("largest ratio",), robot,
    )  # fmt: skip
    short = replace(best, margins={"winding": -0.08}, objectives={"mass": 13.7}, bounds=())
    sizing = SizingResult(
        None, None, "mass", ("steepest slope held",), best, best, (), {"a": best, "b": short}, (), 31000
    )  # fmt: skip
    return size_document(SizeResult(asked, robot, sizing, ("mass",), outcomes()), "nominal (PM)")


def above_the_bench(rise):
    """The bench's rows, and what compares them with a simulation 4 % above them, the first row without one."""
    measured = read_runs("measured")
    error = np.where(np.arange(len(measured)) == 0, np.nan, 1.04 + rise * measured["slope_deg"])
    simulated = {c: measured[c] for c in ("configuration", *measured.axes)}
    simulated |= {c.column: error * measured[c.column] for c in measured.channels}
    simulated["status"] = np.where(np.isnan(error), "slides", "converged")
    return measured, *compare_readings(measured, simulated)


def commented(table, summary, **more):
    """The document of a comparison with the bench's rows."""
    return comparison_document(
        Comparison(table, summary, read_runs("measured").channels, "measured", "steady", "nominal (PM)", **more)
    )


def comparison(log=False):
    """A simulation above the bench. Of a log as its first 2.8 s."""
    measured, table, summary = above_the_bench(rise=0.001)
    time = {"time_s": 0.1 * np.arange(len(measured))} if log else {}
    return commented(table | time, summary, fit="" if log else "these", notes=("a note",), sampled=log)


def comparison_two():
    """The same with a second robot, 2 % below the readings, which reaches the first row but not the second."""
    measured, table, summary = above_the_bench(rise=0.0)
    error = np.where(np.arange(len(measured)) == 1, np.nan, 0.98)
    table = table | {f"against_{c.column}": error * measured[c.column] for c in measured.channels}
    return commented(table, summary, against="found/robot.toml")


def test_fits_of_a_log_keep_the_samples_after_steps_apart():
    """Readings taken before the command make a good model look hopeless."""
    volts = np.repeat([0.0, 12.0, 6.0], 40)
    runs = Runs("log.csv", {"time_s": 0.01 * np.arange(120), "supply_voltage_V": volts})
    steps = np.logical_or(*rows_after_steps(runs))
    assert np.flatnonzero(steps).tolist() == [40, 41, 80, 81]
    speed, measured = channels.find_channel("motor_speed"), volts + np.sin(np.arange(120))
    table = {
        "time_s": runs["time_s"], speed.column: measured, f"simulated_{speed.column}": measured + 9.0 * steps,
        f"error_{speed.name}_percent": 9.0 * steps, "status": np.full(120, "ended"),
    }  # fmt: skip
    found = Comparison(
        table,
        {"all": {speed.name: {"rows": 0}}},
        (speed,),
        "log.csv",
        "drive",
        "ours",
        sampled=True,
        after_steps=steps,
    )
    _, fits = _over_time(found)[0].blocks
    (_, every, with_steps), (_, rest, without) = fits.rows
    assert (every, rest) == ("simulated", "simulated, without the two samples after each step")
    assert with_steps < 75 and without == pytest.approx(100.0)


def comparison_log():
    return comparison(log=True)


def settle():
    """A log of two levels, the first of which still changes at its beginning, and of a third that is too short."""
    rng, row = default_rng(3), np.arange(412)
    volts = np.repeat([6.0, 12.0, 18.0], (200, 200, 12))
    lag = np.where(row < 200, np.exp(-row / 40), 0.0)
    columns = {
        "configuration": np.repeat("6T2A", 412), "time_s": 0.01 * row, "supply_voltage_V": volts,
        "payload_kg": 0.0 * volts, "slope_deg": 0.0 * volts,
        "total_current_A": 1.2 + volts / 20 + 0.01 * rng.standard_normal(412),
        "motor_speed_rpm": 350 * volts * (1 - 0.5 * lag) + 3 * rng.standard_normal(412),
    }  # fmt: skip
    log = settling.settle_log(Runs("log.csv", columns))
    return settle_report.settle_document(log, "Too few for the loop.", ("a further note",))


DOCUMENTS = {
    "check": check, "size": size, "comparison": comparison, "comparison_log": comparison_log, "comparison_two": comparison_two,
    "settle": settle,
}  # fmt: skip


@pytest.mark.parametrize("name", DOCUMENTS)
def test_a_document_reads_as_recorded(name):
    text = as_text(DOCUMENTS[name]())
    assert text == recorded(name, text)


SMALL = Document(
    "A & B",
    "Speed **0.5 m/s**.",
    (Note("page only"), *remarks(("one `x_m`", "two"))),
    (
        Section("Rows", (
            Table("rows", (
                Column("run"), Column("measured", "A", "{:.1f}", "current"), Column("error", "%", "{:+.2f}", "current"),
                Column("source", terminal=False),
            ), [("a", 1.25, Cell(-0.001, "good"), "<hand>"), ("b", None, Cell(float("nan")), "log")], "all rows"),
        )),
    ),
)  # fmt: skip


def test_a_robot_is_fitted_to_the_rows_that_its_folder_records(tmp_path):
    robot, runs = tmp_path / "robot.toml", read_runs("measured")
    robot.write_text("# a robot\n")
    file = RobotFile(nominal(), str(robot))
    hashes = {"robot": store.sha256_hex(robot.read_bytes()), "x.csv": runs.digest}

    def fitted(command, text="# a robot\n", runs=runs):
        robot.write_text(text)
        (tmp_path / "manifest.json").write_text(json.dumps({"arguments": [command, "x.csv"], "hashes": hashes}))
        return recorded_fit(file, runs)

    assert recorded_fit(file, runs) == "" == recorded_fit(RobotFile(nominal(), "nominal"), runs)
    assert fitted("loop") == "these" and fitted("loop", runs=Runs("other", runs.columns)) == "others"
    assert fitted("loop", "# changed by hand\n") == fitted("compare") == ""


def test_page_terminal_and_csv_show_the_same_cells(tmp_path, capsys):
    page = write_report_page(tmp_path, SMALL).read_text(encoding="utf-8")
    rows = Tables(page).tables["rows"]
    assert rows == [
        ["run", "current", "source"], ["measured [A]", "error [%]"], ["a", "1.2", "0.00", "<hand>"], ["b", "–", "–", "log"],
    ]  # fmt: skip
    (link,) = re.findall(r'download="rows.csv" href="data:text/csv;charset=utf-8,([^"]*)"', page)
    assert [*csv.reader(io.StringIO(urllib.parse.unquote(link)))] == [
        ["run", "current: measured [A]", "current: error [%]", "source"], ["a", "1.25", "-0.001", "<hand>"], ["b", "", "", "log"],
    ]  # fmt: skip
    assert (
        "A &amp; B" in page
        and "Speed <b>0.5 m/s</b>." in page
        and "<code>x_m</code>" in page
        and not outside(tmp_path)
    )
    print_document(SMALL)
    shown = capsys.readouterr().out
    assert (
        shown.startswith("Speed 0.5 m/s.\n- one x_m\n- two\n") and "page only" not in shown and "<hand>" not in shown
    )
    assert [line.split() for line in shown.splitlines()[-2:]] == [["a", "1.2", "0.00"], ["b", "–", "–"]]


def test_a_long_table_is_cut_and_names_its_file(tmp_path, capsys):
    table = Table("rows", (Column("run", form="{}"),), [(k,) for k in range(250)], file="runs.csv")
    document = Document("T", "A.", (), (Section("Rows", (table,)),))
    page = write_report_page(tmp_path, document).read_text(encoding="utf-8")
    assert len(Tables(page).tables["rows"]) == 201 and "The first 200 of 250 rows" in page
    assert '<a class="csv" download href="runs.csv">' in page
    print_document(document)
    assert capsys.readouterr().out == "A.\n250 rows: see runs.csv\n"


def test_the_page_of_check_draws_motor_and_gear(tmp_path):
    page = write_report_page(tmp_path, check()).read_text(encoding="utf-8")
    assert drawn(page) == {"chart_of_corners"}


def test_every_figure_of_the_catalogue_can_be_drawn():
    """A figure of turning missions named a function that was gone."""
    draws = [e["draws"] for room in catalogue._content().values() for e in room.values() if "draws" in e]
    assert len(draws) > 40
    for path in draws:
        module, _, name = path.rpartition(".")
        room = importlib.import_module(
            f"sweeps.{module}" if module.startswith("paper.") else f"sweeps.pages.{module}"
        )
        assert callable(getattr(room, name, None)), path
