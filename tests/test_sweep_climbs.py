"""Sweeps of climbs: the search of many points side by side, points as single climbs, the store, what is refused."""

import time

import numpy as np
import pytest
import zarr

from mmrjax.climbing.climb_simulation import NAMES, OVER, SLIDES, TIPS
from mmrjax.fidelities.variation import STATUS, Variation
from mmrjax.model.conditions import Conditions
from mmrjax.model.paper_robots import nominal
from sweeps.config_campaign import Obstacle
from sweeps.pages.sweep_figures import draw_grid_statuses
from sweeps.points import scale, tasks
from sweeps.report.sweep_report import VariedQuantity
from tests.commands import ends, read_json
from tests.pages import Tables, drawn

ROBOT = nominal()


def test_search_of_many_points_ends_within_a_millimetre_of_each_ones_limit():
    limits = np.array([0.0, 10.0, 87.3, 301.0, 1000.0])
    calls = []

    class Ended:
        def __init__(self, sizes):
            calls.append(sizes)
            self.verdict = np.where(sizes <= limits, OVER, np.where(sizes > 200, TIPS, SLIDES))

    found = tasks._search_all(
        Obstacle(kind="step", find=True), 5, lambda sizes, told: Ended(sizes), lambda share: None
    )
    largest = found[tasks.LARGEST]
    assert (
        largest[0] == 0 and np.all(largest <= limits) and np.all(limits[1:4] - largest[1:4] <= tasks.SEARCH_TOLERANCE)
    )
    assert largest[4] > tasks.SEARCH_INTERVALS["step"][1] - tasks.SEARCH_TOLERANCE
    assert [NAMES[k] for k in found[tasks.VERDICT]] == ["slides", "slides", "slides", "tips", "over"]
    assert len(calls) == 10


def test_each_point_has_its_own_robot_levers_and_obstacle(monkeypatch):
    asked = {}

    def recorded(robot, conditions, ground, sequence, **options):
        asked.update(robot=robot, conditions=conditions, ground=ground, sequence=sequence)
        raise StopIteration

    monkeypatch.setattr(tasks, "climb_batch", recorded)
    variation = Variation(ROBOT, ("levers_front_deg", "motor.resistance"))
    conditions = Conditions(np.zeros(2, int), voltage=np.full(2, 24.0)).resolved(ROBOT)
    with pytest.raises(StopIteration):
        tasks.compute_climbs(
            Obstacle(kind="stairs", tread_mm=300, count=2, levers_voltage_V=8.0), variation, conditions,
            np.array([[30.0, 0.6], [50.0, 1.5]]), np.array([60.0, 90.0]), lambda share: None,
        )  # fmt: skip
    assert np.asarray(asked["robot"].motor.resistance) == pytest.approx([0.6, 1.5])
    assert np.asarray(asked["robot"].motor.inertia) == pytest.approx([33.5e-7] * 2)
    assert np.degrees(np.asarray(asked["sequence"].front)) == pytest.approx(np.array([[30.0], [50.0]]))
    assert np.degrees(np.asarray(asked["sequence"].rear)) == pytest.approx(180.0)
    assert np.asarray(asked["sequence"].supply) == pytest.approx([8.0, 8.0])
    assert np.asarray(asked["ground"].points)[:, 2] == pytest.approx(np.array([[0.0, 0.06], [0.0, 0.09]]))
    assert np.asarray(asked["ground"].finish) == pytest.approx([0.3, 0.3])


def test_map_of_verdicts_has_each_point_in_its_colour():
    angles, sizes = np.meshgrid([0.0, 30.0, 60.0], [50.0, 100.0], indexing="ij")
    codes = np.array([OVER, SLIDES, OVER, TIPS, OVER, OVER])
    figure = draw_grid_statuses(
        codes, NAMES, VariedQuantity(angles.ravel(), "angle [deg]"), VariedQuantity(sizes.ravel(), "obstacle_mm [mm]")
    )
    (axes,) = figure.axes
    shown = axes.collections[0].get_array().reshape(2, 3)
    assert shown.tolist() == [[OVER, OVER, OVER], [SLIDES, TIPS, OVER]]
    assert [text.get_text() for text in axes.get_legend().get_texts()] == ["over", "tips", "slides"]
    assert axes.get_ylabel() == "obstacle_mm [mm]"


MAP = """
chunk = 2
report = false
[obstacle]
kind = "step"
[axes]
levers_front_deg = [0, 30, 60]
obstacle_mm = [60, 500]
"""


def test_interrupted_map_resumes_after_its_last_chunk(mmrjax, tmp_path, monkeypatch):
    """Climbs in closed form: what a chunk has is kept, what was under way is climbed again.

    The interrupt comes while the first chunk waits to be written, as on a machine with idle cores.
    """
    fetch = scale.fetch_values

    def later(arrays, count):
        time.sleep(0.3)
        return fetch(arrays, count)

    monkeypatch.setattr(scale, "fetch_values", later)
    climbed, interrupts = [], iter([False, True, False, False])

    def closed(of, variation, conditions, values, sizes, told):
        if next(interrupts):
            raise KeyboardInterrupt
        climbed.append(np.asarray(values)[:, 0].tolist())
        found = {name: np.asarray(values)[:, 0] + sizes for name in tasks.climb_attributes(of)}
        return {**found, tasks.VERDICT: np.zeros(2, np.uint8), STATUS: np.zeros(2, np.uint8)}

    monkeypatch.setattr(tasks, "compute_climbs", closed)
    (tmp_path / "map.toml").write_text(MAP)
    assert mmrjax("sweep map.toml --out map")[0] == 130
    assert climbed == [[0.0, 0.0]] and (tmp_path / "map.partial").is_dir()
    ends(mmrjax("sweep map.toml --out map"), "resumes after 2 of 6 points", "have a verdict", code=0)
    assert climbed == [[0.0, 0.0], [30.0, 30.0], [60.0, 60.0]]
    store = zarr.open_group(tmp_path / "map/results.zarr", mode="r")
    assert store["energy_J"][:].tolist() == [[60, 560 - 60], [90, 530], [120, 560]]


@pytest.mark.slow
def test_page_reports_the_largest_climbed_obstacle_and_its_conditions(mmrjax, tmp_path, monkeypatch):
    """Climbs in closed form: the steeper the levers the higher, up to the last, which falls."""

    def closed(of, variation, conditions, values, sizes, told):
        most = np.array([70, 250, 40])[(np.asarray(values)[:, 0] / 30).astype(int)]
        own = {tasks.LARGEST: most * 1.0} if of.find else {tasks.VERDICT: np.where(sizes <= most, OVER, TIPS)}
        found = {name: np.full(len(most), 1.0) for name in tasks.climb_attributes(of)} | own
        found[tasks.VERDICT] = found[tasks.VERDICT].astype(np.uint8)
        return {**found, STATUS: np.zeros(len(most), np.uint8)}

    monkeypatch.setattr(tasks, "compute_climbs", closed)
    text = MAP.replace("report = false", "")
    (tmp_path / "map.toml").write_text(text)
    (tmp_path / "find.toml").write_text(
        text.replace("obstacle_mm = [60, 500]", "adhesion = [0.5]").replace('"step"', '"step"\nfind = true')
    )
    for name, size in {"map": 60, "find": 250}.items():
        assert mmrjax("sweep", f"{name}.toml", "--out", name)[0] == 0
        page = (tmp_path / name / "report.html").read_text("utf-8")
        where = "levers_front_deg 0 deg" if name == "map" else "levers_front_deg 30 deg, adhesion 0.5"
        assert f"The largest obstacle that the robot gets over: {size} mm, at {where}." in page
    page = (tmp_path / "map/report.html").read_text("utf-8")
    names = {name: (meaning, unit) for name, meaning, unit, _ in Tables(page).tables["names"][1:]}
    assert names["obstacle_mm"] == ("height of the step", "mm") and "endings" in drawn(page)


@pytest.mark.slow
def test_store_of_climbs_is_filled_in_shares_and_its_page_has_the_map(mmrjax, tmp_path):
    (tmp_path / "map.toml").write_text(
        """
chunk = 2
outputs = ["verdict", "furthest_mm", "energy_J"]
[obstacle]
kind = "gap"
time_step_s = 4e-4
duration_s = 3
[conditions]
voltage = 24
[axes]
levers_front_deg = [0, 45]
obstacle_mm = [60, 500]
"""
    )
    for share in ("1/2", "2/2"):
        ends(mmrjax("sweep map.toml --shard", share, "--out", "run"), code=0)
        assert (tmp_path / "run").exists() == (share == "2/2")
    result = read_json(tmp_path / "run/result.json")
    assert result["model"] == "climb" and result["statuses"]["converged"] == 4
    store = zarr.open_group(tmp_path / "run/results.zarr", mode="r")
    verdicts = [[NAMES[k] for k in row] for row in store["verdict"][:]]
    assert [row[0] for row in verdicts] == ["over", "over"] and "over" not in [row[1] for row in verdicts]
    assert (store["furthest_mm"][:, 0] > 60).all() and np.isfinite(store["energy_J"][:]).all()
    page = (tmp_path / "run/report.html").read_text("utf-8")
    assert "gets over" in page and page.count("<svg") == 3
