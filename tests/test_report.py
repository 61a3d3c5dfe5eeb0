# ruff: noqa: E402 (double precision is set before anything is imported)
"""The report: complete, offline, true to the numbers it shows, and readable whatever the sweep."""

from __future__ import annotations

import base64
import dataclasses
import re
from html.parser import HTMLParser

import jax

jax.config.update("jax_enable_x64", True)

import numpy as np
import pytest

from calibration.data import runs as records
from calibration.inference import errors as residual
from mmrjax import params
from mmrjax.effects import BY_NAME
from mmrjax.fidelities.steady import steady_batch
from mmrjax.robots import ROBOTS
from sweeps import figures_data, figures_sweep, outputs, report, report_tables

PAPER_FIGURES = {
    "rows",
    "fig28_current_over_slope",
    "fig29_model_errors",
    "fig23_24_from_standstill",
    "energy_split",
    "fig05a_gearbox_efficiency",
    "fig10_battery",
    "fig11_motor_friction",
    "fig18_idle_track",
}
SWEEP_FIGURES = {"sweep_current", "sweep_speed"}


class _Tables(HTMLParser):
    """Rows of cell texts of every table with an id, and all text outside scripts and styles."""

    def __init__(self, page: str) -> None:
        super().__init__()
        self.tables: dict[str, list[list[str]]] = {}
        self.text = ""
        self._name: str | None = None
        self.feed(page)

    def handle_starttag(self, tag, attrs):
        if tag == "table":
            self._name = dict(attrs).get("id") or "-"
            self.tables[self._name] = []
        elif tag == "tr" and self._name:
            self.tables[self._name].append([])
        elif tag in ("td", "th") and self._name:
            self.tables[self._name][-1].append("")

    def handle_endtag(self, tag):
        if tag == "table":
            self._name = None

    def handle_data(self, data):
        self.text += data
        if self._name and self.tables[self._name] and self.tables[self._name][-1]:
            self.tables[self._name][-1][-1] += data.strip()


def _runs(configuration, voltage, payload, slope, robot=None):
    """A finished table of runs, as the command line hands it over."""
    robot = ROBOTS["nominal"]() if robot is None else robot
    axes = [np.atleast_1d(a) for a in (configuration, voltage, payload, slope)]
    kind, voltage, payload, slope = (m.ravel() for m in np.meshgrid(*axes, indexing="ij"))
    asked = {"configuration": kind, "supply_voltage_V": voltage, "payload_kg": payload, "slope_deg": slope}
    points = figures_data.operating_points(
        robot, figures_data.command(robot, configuration=kind, voltage=voltage, payload=payload, slope_deg=slope)
    )
    return asked | points


def _write(folder, runs, robot=None, name="nominal"):
    robot = ROBOTS["nominal"]() if robot is None else robot
    path = report.write(folder, robot=robot, robot_name=name, model="steady", runs=runs, title="A small sweep")
    return path, path.read_text(encoding="utf-8")


def _drawn(page):
    return set(re.findall(r'<figure id="([^"]+)">', page))


@pytest.fixture(scope="module")
def small(tmp_path_factory):
    folder = tmp_path_factory.mktemp("report")
    runs = _runs(("6T2A", "4W2T"), (15.0, 33.0), (0.0, 8.0), (0.0, 10.0, 20.0))
    path, page = _write(folder, runs)
    return path, page, _Tables(page), runs


def test_report_refers_to_nothing_outside(small):
    path, page, _, _ = small
    for document in (page, *(p.read_text() for p in (path.parent / "figures").iterdir())):
        links = re.findall(r'(?:src|href|xlink:href)="([^"]*)"', document)
        assert all(link.startswith(("#", "data:")) for link in links), links
        assert "url(http" not in document and "@import" not in document and "<script" not in document
    assert not re.findall(r"https?://", page)


def test_report_has_every_figure_inline_and_as_a_file(small):
    path, page, _, _ = small
    assert _drawn(page) == PAPER_FIGURES | SWEEP_FIGURES
    assert {p.stem for p in (path.parent / "figures").glob("*.svg")} == PAPER_FIGURES | SWEEP_FIGURES
    pictures = re.findall(r'<img src="data:image/svg\+xml;base64,([^"]+)"', page)
    assert len(pictures) == len(PAPER_FIGURES | SWEEP_FIGURES)
    for picture in pictures:
        assert base64.b64decode(picture).decode().rstrip().endswith("</svg>")
    assert path.stat().st_size < 5e6


def test_report_explains_every_status_with_its_count(small):
    _, page, tables, runs = small
    for status in np.unique(runs["status"]):
        card = re.search(rf'data-status="{status}"><b>(\d+)</b>', page)
        assert int(card.group(1)) == (runs["status"] == status).sum()
        assert report_tables.STATUS_MEANING[status] in tables.text
    assert (runs["status"] == "slides").any()


def test_limits_table_counts_the_flags(small):
    _, _, tables, runs = small
    shown = {re.search(r"\((\w+)\)", row[0]).group(1): int(row[1]) for row in tables.tables["limits"][1:]}
    flags = [f for word in runs["flags"] for f in word.split(";") if f]
    assert shown == {f: flags.count(f) for f in set(flags)}


def test_error_table_equals_equation_35(small):
    _, _, tables, _ = small
    measured, paper = (figures_data.stacked(records.read(n).columns) for n in ("measured", "simulated_by_paper"))
    points = outputs.columns(steady_batch(ROBOTS["nominal"](), records.read("measured").command()))
    ours = residual.relative_error(figures_data.stacked(points), measured)
    kind = records.read("measured")["configuration"]
    rows = tables.tables["errors"][2:]
    for first, errors in ((0, ours), (len(rows) - 3, residual.relative_error(paper, measured))):
        for row, pick in zip(rows[first : first + 3], (kind != "", kind == "6T2A", kind == "4W2T"), strict=True):
            there = np.isfinite(errors[pick, 0])
            assert row[2] == f"{there.sum()} of {pick.sum()}"
            for k in range(3):
                values = errors[pick, k][there]
                assert row[3 + 2 * k] == f"{np.sqrt(np.mean(values**2)):.1f}"
                assert row[4 + 2 * k] == f"{np.abs(values).max():.1f}"


def test_error_table_gives_the_papers_own_errors(small):
    _, _, tables, _ = small
    last = tables.tables["errors"][-3]
    assert last[0] == "the paper's own simulation"
    assert [last[k] for k in (3, 5, 7)] == ["4.0", "4.5", "4.6"]


def test_row_table_shows_bench_paper_and_own_numbers(small):
    _, _, tables, _ = small
    measured = records.read("measured")
    points = outputs.columns(steady_batch(ROBOTS["nominal"](), measured.command()))
    rows = [r for r in tables.tables["rowtable"][2:] if r[0]]
    assert len(rows) == 20
    for k, row in enumerate(rows):
        assert row[:4] == [
            measured["configuration"][k],
            f"{measured['supply_voltage_V'][k]:.0f}",
            f"{measured['total_mass_kg'][k]:.1f}",
            f"{measured['slope_deg'][k]:.0f}",
        ]
        assert row[4] == f"{measured['total_current_A'][k]:.2f}"
        own = points["total_current_A"][k]
        assert row[6] == (f"{own:.2f}" if np.isfinite(own) else "slides")
        assert float(row[10]) == measured["motor_speed_rpm"][k]
        assert float(row[16]) == measured["speed_mm_s"][k]
        assert ("A" in row[-1].split()) == (points["status"][k] == "slides")
    assert [r[1] for r in tables.tables["rowtable"][2:] if not r[0]] == [""] * 10  # 4W2T with Table 7's mass


def test_raised_adhesion_makes_every_measured_row_climb():
    rows = figures_data.rows(ROBOTS["nominal"]())
    assert (rows.plain["status"] == "slides").sum() == 6
    assert (rows.raised["status"] == "converged").all()
    assert rows.ratio["6T2A"] * 0.32 == pytest.approx(0.45) and rows.ratio["4W2T"] * 0.38 == pytest.approx(0.60)


def test_raised_adhesion_leaves_a_robot_that_climbs_alone():
    values = {f"{c}.ground.friction.static": 0.9 for c in ("tracked", "wheeled")}
    rows = figures_data.rows(params.replace(ROBOTS["nominal"](), values))
    assert rows.ratio == {"6T2A": 1.0, "4W2T": 1.0}


def test_energy_split_sums_to_the_supply():
    robot = ROBOTS["nominal"]()
    effects = (BY_NAME["series_resistance"](amplitude=0.4), BY_NAME["churning"](amplitude=1e-3))
    for member in (robot, dataclasses.replace(robot, effects=effects)):
        kind = np.array(["6T2A", "4W2T", "6T2A"])
        points, split = figures_data.energy_split(
            member, figures_data.command(member, configuration=kind, slope_deg=np.array([0.0, 10.0, 10.0]))
        )
        assert all((split[item] >= 0).all() for item in figures_data.SPLIT)
        np.testing.assert_allclose(split["other"] / points["power_supply_W"], 0, atol=1e-9)


def test_idle_current_balances_the_losses_by_hand():
    speed = np.array([5.0, 20.0])
    motor = speed * 48.0
    for kind, coulomb, viscous in (("6T2A", 0.350, 0.016), ("4W2T", 0.070, 0.003)):
        at_motor = (coulomb + viscous * speed) / 48.0 / 0.74 + 0.3e-3 + 1.4e-6 * motor + 2.7e-3 + 5.5e-7 * motor
        found = figures_data.idle_current(ROBOTS["nominal"](), kind, speed)
        np.testing.assert_allclose(found, at_motor / 25.9e-3, rtol=1e-9)


def test_stages_follow_the_slide():
    for start in figures_data.starts(ROBOTS["nominal"]()):
        assert 0 < start.starting < start.slipping < start.time[-1]
        sliding = start.theoretical - start.speed
        assert np.all(sliding[start.time > start.slipping] <= 20.0 + 1e-6)  # V_s [mm/s]
        assert sliding[np.searchsorted(start.time, start.starting)] == sliding.max()


def test_single_point_is_a_table(tmp_path):
    runs = _runs("6T2A", 33.0, 0.0, 5.0)
    _, page = _write(tmp_path, runs)
    assert _drawn(page) == PAPER_FIGURES
    row = _Tables(page).tables["single"][1]
    assert row[0] == "6T2A, 33 V, 0 kg, 5°"
    assert row[2] == f"{runs['total_current_A'][0]:.2f}" and row[4] == f"{runs['speed_mm_s'][0]:.0f}"


def test_sweep_that_slides_everywhere_says_so(tmp_path):
    runs = _runs("6T2A", (15.0, 33.0), (0.0, 4.0), (25.0, 30.0))
    assert (runs["status"] == "slides").all()
    _, page = _write(tmp_path, runs)
    assert re.search(r'data-status="slides"><b>8</b>', page) and 'data-status="converged"' not in page
    assert _drawn(page) == PAPER_FIGURES | SWEEP_FIGURES


@pytest.mark.parametrize(
    "shape",
    [
        "line over slope",
        "scattered",
        *(pytest.param(s, marks=pytest.mark.slow) for s in ("line over voltage", "large grid")),
    ],
)
def test_other_grids_are_drawn(shape, tmp_path):
    runs = {
        "line over slope": lambda: _runs("4W2T", 24.0, 2.0, np.linspace(-10, 25, 8)),
        "line over voltage": lambda: _runs("6T2A", np.linspace(2.0, 36.0, 6), 0.0, 3.0),
        "large grid": lambda: _runs(
            ("6T2A", "4W2T"), np.linspace(10, 36, 5), np.linspace(0, 20, 40), np.linspace(0, 20, 50)
        ),
        "scattered": _scattered,
    }[shape]()
    path, page = _write(tmp_path, runs)
    assert _drawn(page) == PAPER_FIGURES | SWEEP_FIGURES
    assert re.search(rf"<b>{len(runs['status'])}</b> runs simulated", page)
    assert path.stat().st_size < 5e6


def _scattered():
    robot, rng, n = ROBOTS["nominal"](), np.random.default_rng(0), 600
    asked = {
        "configuration": np.where(rng.random(n) < 0.5, "6T2A", "4W2T"),
        "supply_voltage_V": rng.uniform(10, 33, n),
        "payload_kg": rng.uniform(0, 10, n),
        "slope_deg": rng.uniform(-5, 20, n),
    }
    conditions = figures_data.command(
        robot,
        configuration=asked["configuration"],
        voltage=asked["supply_voltage_V"],
        payload=asked["payload_kg"],
        slope_deg=asked["slope_deg"],
    )
    return asked | figures_data.operating_points(robot, conditions)


def test_blocks_cover_each_cell_once():
    rng = np.random.default_rng(1)
    cells = {(int(i), int(j)) for i, j in rng.integers(0, 9, (40, 2))}
    for joined in (True, False):
        covered = [
            (i + p, j + q)
            for i, j, wide, tall in figures_sweep._blocks(cells, joined)
            for p in range(wide)
            for q in range(tall)
        ]
        assert sorted(covered) == sorted(cells)


def test_report_of_a_file_names_it_without_its_folder_and_lists_what_changed(tmp_path):
    robot = params.replace(ROBOTS["nominal"](), {"motor.resistance": 0.9})
    robot = dataclasses.replace(robot, effects=(BY_NAME["churning"](amplitude=1e-4),))
    _, page = _write(tmp_path, None, robot, "/somewhere/else/mine.toml")
    assert "mine.toml" in page and "somewhere" not in page
    changed = {row[0]: row[1:3] for row in _Tables(page).tables["changed"][1:]}
    assert changed["motor.resistance"] == ["0.9", "0.611"]
    assert changed["effects.churning.amplitude"] == ["0.0001", "not in the paper's model"]


def test_report_escapes_a_title(tmp_path):
    path = report.write_comparison(
        tmp_path,
        robot=ROBOTS["nominal"](),
        robot_name="<b>x.toml",
        model="steady",
        data_name="a&b.csv",
        **_comparison(),
    )
    page = path.read_text()
    assert "<b>x.toml" not in page and "&lt;b&gt;x.toml" in page and "a&amp;b.csv" in page


def _comparison():
    measured = records.read("measured")
    points = outputs.columns(steady_batch(ROBOTS["nominal"](), measured.command()))
    table = {k: measured[k] for k in ("configuration", *records.CONDITIONS, *records.MEASURED)}
    summary = {}
    for channel, column in report.COLUMNS.items():
        table[f"simulated_{column}"] = points[column]
        table[f"error_{channel}_percent"] = residual.relative_error(points[column], measured[column])
    table["status"] = points["status"]
    for group in ("all", "6T2A", "4W2T"):
        pick = np.ones(20, bool) if group == "all" else table["configuration"] == group
        summary[group] = {
            channel: residual.summary(table[f"error_{channel}_percent"][pick])
            | {"r2": residual.certainty(table[column][pick], table[f"simulated_{column}"][pick])}
            for channel, column in report.COLUMNS.items()
        }
    return {"table": table, "summary": summary}


def test_comparison_shows_its_summary_and_rows(tmp_path):
    given = _comparison()
    path = report.write_comparison(
        tmp_path, robot=ROBOTS["nominal"](), robot_name="nominal", model="steady", data_name="measured", **given
    )
    page = path.read_text()
    assert _drawn(page) == {"parity", "errors"} and not re.findall(r"https?://", page)
    tables = _Tables(page).tables
    for row, (group, cells) in zip(tables["errors"][2:], given["summary"].items(), strict=True):
        values = [group]
        for cell in cells.values():
            values += [
                str(cell["rows"]),
                f"{cell['rms_percent']:.1f}",
                f"{cell['max_percent']:.1f}",
                f"{cell['r2']:.3f}",
            ]
        assert row == values
    rows = tables["rowtable"][2:]
    assert len(rows) == 20
    assert sum("slides" in row for row in rows) == 6
    assert rows[0][7] == f"{given['table']['simulated_total_current_A'][0]:.2f}"
