# ruff: noqa: E402 (double precision is set before anything is imported)
"""The reports of runs, sweeps and comparisons: they show these, offline, true to the numbers, whatever the grid."""

import dataclasses
import re

import jax

jax.config.update("jax_enable_x64", True)

import numpy as np
import pytest
from numpy.testing import assert_allclose
from pages import Tables, drawn, outside

from calibration.data import runs as records
from calibration.data.robot_file import RobotFile
from mmrjax.effects import BY_NAME
from mmrjax.fidelities import outputs
from mmrjax.fidelities.steady import steady_batch
from mmrjax.model import channels, params
from mmrjax.model.paper_robots import ROBOTS
from mmrjax.model.signals import GRAVITY
from sweeps.commands import compare
from sweeps.pages import power_figures, words
from sweeps.points import run
from sweeps.report import comparison_report, drive_curves, page_renderer, runs_report, sweep_report
from sweeps.report.comparison_report import Comparison

SWEEP_FIGURES = {f"sweep_{name}" for name in channels.USUAL}


def _asked(configuration, voltage, payload, slope):
    axes = [np.atleast_1d(a) for a in (configuration, voltage, payload, slope)]
    kind, voltage, payload, slope = (m.ravel() for m in np.meshgrid(*axes, indexing="ij"))
    return records.Runs("the test", {"configuration": kind, "supply_voltage_V": voltage, "payload_kg": payload,
                                     "slope_deg": slope})  # fmt: skip


def _table(asked, robot=None):
    """A finished table of runs, as the command line hands it over."""
    robot = ROBOTS["nominal"]() if robot is None else robot
    outcome = outputs.output_columns(jax.device_get(steady_batch(robot, asked.conditions(robot))), robot.channels)
    return {**run.condition_table(robot, asked), **outcome}


def _runs(configuration, voltage, payload, slope):
    return _table(_asked(configuration, voltage, payload, slope))


def _write(folder, runs, robot=None, name="nominal", document=sweep_report.sweep_document):
    file = RobotFile(ROBOTS["nominal"]() if robot is None else robot, name)
    path = page_renderer.write_report_page(folder, document(file, "steady", runs), file)
    return path, path.read_text(encoding="utf-8")


@pytest.fixture(scope="module")
def small(tmp_path_factory):
    folder = tmp_path_factory.mktemp("report")
    runs = _runs(("6T2A", "4W2T"), (15.0, 33.0), (0.0, 8.0), (0.0, 10.0, 20.0))
    path, page = _write(folder, runs)
    return path, page, Tables(page), runs


def test_report_refers_to_nothing_outside(small):
    assert outside(small[0].parent) == []


def test_report_has_every_figure_inline_and_as_a_file(small):
    path, page, _, _ = small
    assert drawn(page) == SWEEP_FIGURES
    assert {p.stem for p in (path.parent / "figures").glob("*.svg")} == SWEEP_FIGURES
    assert page.count("<svg ") == page.count("</svg>") == len(SWEEP_FIGURES) and drawn(page) == SWEEP_FIGURES
    ids = re.findall(r' id="([^"]+)"', page)
    assert len(ids) == len(set(ids))  # figures have none in common
    assert path.stat().st_size < 5e6


def test_report_explains_every_status_with_its_count(small):
    _, _, tables, runs = small
    shown = {row[3]: row for row in tables.tables["statuses"][1:]}
    assert shown.keys() == set(runs["status"])
    for status, row in shown.items():
        assert int(row[1]) == (runs["status"] == status).sum()
        assert (row[0], row[4]) == words.STATUSES[status]
    assert (runs["status"] == "slides").any()


def test_limits_table_counts_the_flags(small):
    _, _, tables, runs = small
    shown = {re.search(r"\((\w+)\)", row[0]).group(1): int(row[1]) for row in tables.tables["limits"][1:]}
    flags = [f for word in runs["flags"] for f in word.split(";") if f]
    assert shown == {f: flags.count(f) for f in set(flags)}


def test_extremes_are_those_of_the_settled_runs(small):
    _, _, tables, runs = small
    settled = runs["status"] == "converged"
    shown = {row[0]: row[1] for row in tables.tables["extremes"][1:]}
    for channel in channels.usual_channels():
        largest = runs[channel.column][settled].max()
        assert float(shown[f"largest {channel.label}"].split()[0]) == pytest.approx(largest, rel=5e-3)


@pytest.mark.slow
@pytest.mark.parametrize(
    "grid",
    [
        ("4W2T", 24.0, 2.0, np.linspace(-10, 25, 8)),
        ("6T2A", np.linspace(2.0, 36.0, 6), 0.0, 3.0),
        (("6T2A", "4W2T"), np.linspace(10, 36, 5), np.linspace(0, 20, 40), np.linspace(0, 20, 50)),
    ],
    ids=["line over slope", "line over voltage", "large grid"],
)
def test_other_grids_are_drawn(grid, tmp_path):
    runs = _runs(*grid)
    path, page = _write(tmp_path, runs)
    assert drawn(page) == SWEEP_FIGURES
    assert f"<h1>Sweep of {len(runs['status']):,} runs</h1>" in page
    assert path.stat().st_size < 5e6


def test_report_of_a_file_names_it_without_its_folder_and_lists_what_changed(tmp_path):
    robot = params.replace(ROBOTS["nominal"](), {"motor.resistance": 0.9})
    robot = dataclasses.replace(robot, effects=(BY_NAME["churning"](amplitude=1e-4),))
    _, page = _write(
        tmp_path, _runs("6T2A", 33.0, 0.0, 0.0), robot, "/somewhere/else/mine.toml", runs_report.runs_document
    )
    assert "mine.toml" in page and "somewhere" not in page
    changed = {row[0]: row[1:3] for row in Tables(page).tables["changed"][1:]}
    assert changed["motor.resistance"] == ["0.9", "0.611"]
    assert changed["effects.churning.amplitude"] == ["0.0001", "not in the paper's model"]


def test_one_run_is_shown_with_its_readings_limits_and_power(tmp_path):
    runs = _runs("6T2A", 33.0, 0.0, 5.0)
    _, page = _write(tmp_path, runs, document=runs_report.runs_document)
    assert drawn(page) == {"power", "drive_chart"} and outside(tmp_path) == []
    tables = Tables(page).tables
    (_, heading), *rows = tables["runs"]
    shown = dict(rows)
    assert heading == "6T2A, 33 V, 0 kg, 5°" and shown["status"] == "converged"
    assert shown["total current [A]"] == f"{runs['total_current_A'][0]:.3f}"
    assert shown["speed [mm/s]"] == f"{runs['speed_mm_s'][0]:.1f}" and shown["slope [°]"] == "5"
    used = {line[0]: line[3] for line in tables["limits"][1:]}
    assert used["adhesion"] == f"{100 * runs['adhesion_used'][0]:.0f} %"
    assert used["gearbox input speed"] == f"{runs['motor_speed_rpm'][0] / 80:.0f} %"  # of 8000 rpm
    assert page.count('class="bar over"') == 1  # and that one alone is exceeded
    assert "endings" not in tables and 'class="card' not in page  # a run that settles needs no warning


def test_run_without_numbers_says_why(tmp_path):
    _, page = _write(tmp_path, _runs("6T2A", 33.0, 0.0, 40.0), document=runs_report.runs_document)
    assert drawn(page) == set() and words.STATUSES["slides"][1] in page and "No run ends in steady travel" in page


def test_operating_points_lie_on_the_chart_of_motor_and_gear(robot):
    """The chart is of a bench with a brake, the points are of the robot on a slope: one drive."""
    runs = _runs(("6T2A", "4W2T"), 33.0, 8.0, (0.0, 10.0))
    points, curves = drive_curves.operating_points(robot, runs), drive_curves.drive_curves(robot, [33.0])[33.0]
    assert (runs["status"] == "converged").all() and np.ptp(points["torque_Nm"]) > 1.0
    for name in ("motor_rpm", "motor_A"):
        on_curve = np.interp(points["torque_Nm"], curves["torque_Nm"], curves[name])
        assert_allclose(points[name], on_curve, rtol=2e-3)
    lost = 33.0 * curves["motor_A"] - curves["torque_Nm"] * curves["motor_rpm"] * np.pi / 30 / float(
        robot.gearbox.ratio
    )
    assert (lost > 0).all() and curves["efficiency_percent"].max() < 100 * robot.gearbox.efficiency_load


@pytest.mark.slow
def test_power_chain_sums_to_what_supply_and_slope_give():
    runs = _runs(("6T2A", "4W2T"), (15.0, 33.0), 8.0, (-20.0, -5.0, 0.0, 10.0))
    keep = runs["status"] == "converged"
    runs = {key: value[keep] for key, value in runs.items()}
    assert power_figures.drawable_runs(runs).all() and keep.sum() >= 14
    parts, (supply, slope) = power_figures.power_by_item(runs), power_figures.power_sources(runs)
    assert_allclose(sum(parts.values()), supply + slope, rtol=1e-9)
    downhill = runs["slope_deg"] < 0
    fall = runs["total_mass_kg"] * GRAVITY * np.sin(np.radians(-runs["slope_deg"])) * runs["speed_mm_s"] / 1e3
    assert_allclose(slope[downhill], fall[downhill], rtol=1e-9)
    assert (parts["back to the supply"] > 0).any() and (slope[~downhill] == 0).all()


def test_comparison_shows_its_rows_and_escapes_its_title(tmp_path):
    measured = records.read_runs("measured")
    table, summary = compare.compare_readings(measured, _table(measured))
    found = Comparison(table, summary, measured.channels, "a&b.csv", "steady", "<b>x.toml")
    page = page_renderer.write_report_page(tmp_path, comparison_report.comparison_document(found)).read_text()
    assert "<b>x.toml" not in page and "&lt;b&gt;x.toml" in page and "a&amp;b.csv" in page
    assert drawn(page) == {"errors"} and outside(tmp_path) == []
    tables = Tables(page).tables
    assert [row[4] for row in tables["errors"][1:]] == [
        f"{cell['rms_percent']:.1f}" for cells in summary.values() for cell in cells.values()
    ]
    rows = tables["rowtable"][2:]
    assert len(rows) == 20
    assert sum("slides" in row for row in rows) == 6
    assert rows[0][6] == f"{table['simulated_total_current_A'][0]:.2f}"
