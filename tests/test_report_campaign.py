"""The page of a sweep into a store: offline, true to the store, also where nothing settles or much is left out."""

import numpy as np
import pytest
import xarray as xr
from pages import Tables, drawn, outside
from test_sweep_store import CONFIG

from sweeps.pages import sweep_figures
from sweeps.points import zarr_store
from sweeps.report import sweep_report
from tests.commands import read_json

REPORTED = CONFIG.replace("report = false\n", "")


@pytest.fixture
def page(mmrjax, tmp_path):
    def write(config=REPORTED):
        (tmp_path / "plan.toml").write_text(config)
        assert mmrjax("sweep plan.toml --out s --force")[0] == 0
        return Tables((tmp_path / "s/report.html").read_text())

    return write


@pytest.mark.slow
def test_page_is_offline_and_shows_counts_names_and_ranges_of_the_store(page, tmp_path):
    tables = page()
    store = xr.open_zarr(tmp_path / "s/results.zarr").load()
    assert outside(tmp_path / "s") == []
    assert "Sweep of 300 points" in tables.text
    slides = int((store.status == 2).sum())
    assert ["slides", str(slides)] in [row[:2] for row in tables.tables["statuses"]]
    assert [row[0] for row in tables.tables["names"][1:]] == [
        "configuration",
        "slope_deg",
        "motor.resistance",
        "voltage",
    ]
    assert tables.tables["names"][1][3] == "6T2A, 4W2T" and tables.tables["names"][2][3] == "0, 5, 20"
    ranges = {row[0]: row[1:] for row in tables.tables["ranges"][1:]}
    settled = store.total_current.values[store.status.values == 0]
    numbers = [settled.min(), *np.quantile(settled, (0.05, 0.5, 0.95)), settled.max()]
    assert ranges["total current"] == ["A", *(f"{v:.4g}" for v in numbers)]
    assert drawn((tmp_path / "s/report.html").read_text()) == {
        "spread_" + name for name in read_json(tmp_path / "s/result.json")["outputs"]
    }


@pytest.mark.slow
def test_page_of_a_sweep_in_which_nothing_settles_has_no_figures(page, tmp_path):
    tables = page("[conditions]\nslope_deg = 40\n[axes]\nvoltage = [15, 24, 33]\n")
    assert tables.tables["statuses"][1][:2] == ["slides", "3"] and tables.tables["ranges"][1][2] == "–"
    assert drawn((tmp_path / "s/report.html").read_text()) == set()


@pytest.mark.slow
def test_page_of_one_axis_has_one_band(page):
    page("[axes]\nvoltage = '15:33:1'\n")


@pytest.mark.slow
def test_points_of_the_page_are_drawn_from_all_chunks_where_there_are_many(page, monkeypatch):
    monkeypatch.setattr(zarr_store, "SAMPLED_POINTS", 60)
    monkeypatch.setattr(zarr_store, "SAMPLED_CHUNKS", 6)
    assert "60 settled points drawn at random." in " ".join(page().text.split())


def test_share_is_the_variance_between_levels():
    rng = np.random.default_rng(0)
    x, y = rng.integers(0, 5, 20_000).astype(float), rng.standard_normal(20_000)
    assert sweep_figures.variance_share(x, x) == pytest.approx(1)
    assert sweep_figures.variance_share(x, y) < 0.01
    assert sweep_figures.variance_share(y, y) > 0.98
    assert sweep_figures.variance_share(x, 3 * x + y * 3 * x.std()) == pytest.approx(0.5, abs=0.02)


def test_few_points_fill_few_bins():
    """No panel is empty where samples have few points each."""
    resistance, voltage = np.tile(np.linspace(0.5, 0.7, 12), 2), np.repeat([15.0, 33.0], 12)
    varied = {
        "voltage": sweep_report.VariedQuantity(voltage, "V"),
        "r": sweep_report.VariedQuantity(resistance, "r"),
    }
    histogram, *bands = sweep_figures.draw_output_spread(0.1 * voltage + resistance, "I", varied).axes
    assert [len(b.lines[0].get_xdata()) for b in bands] == [2, 6] and len(histogram.patches) == 6
