"""`simulate --profile`, `mm.simulate(profile=...)` and sweeps over a profile: what comes out, and what is refused."""

import numpy as np
import pytest
from numpy.testing import assert_allclose
from pages import Tables

import mmrjax as mm
from mmrjax.missions import mission_batch as missions
from mmrjax.missions.mission_batch import OUTPUTS
from mmrjax.missions.profile import profile
from mmrjax.model import energy
from mmrjax.model.signals import STATUSES
from sweeps.commands.missions import select_course_rows
from tests.commands import columns_of, ends, read_json, text_file

#: Up a slope, to a stop, and back; twice.
MISSION = """\
# There and back.
# cycles = 2
# between_rows = "linear"
time_s,speed_mm_s,mode,slope_deg
0,0,,0
0.5,300,,5
2,300,,5
2.5,0,brake,5
3,0,,5
3.5,-200,,5
4.5,0,brake,0
5,,brake,0
"""
VOLTS = "time_s,voltage_left_V,voltage_right_V\n0,20,10\n2,20,10\n"
FILES = {
    "mission.csv": MISSION, "sides.csv": VOLTS, "volts.csv": "time_s,supply_voltage_V\n0,24\n1,24\n",
    "floors.csv": "time_s,duty,surface\n0,1,asphalt\n1,1,asphalt\n",
}  # fmt: skip
SHORT = profile([0.0, 0.5, 1.5, 2.0], ["speed", "speed", "brake", "brake"], demand=[0.0, 0.3, 0.3, 0.0], linear=True)


@pytest.fixture(scope="module")
def tmp_path(tmp_path_factory):
    """One folder for all commands of this file."""
    folder = tmp_path_factory.mktemp("missions")
    for name, text in FILES.items():
        text_file(folder / name, text)
    return folder


@pytest.fixture
def done(mmrjax, tmp_path):
    """The folder of one mission on the battery, made once."""
    if not (tmp_path / "one").exists():
        _, out, _ = ends(mmrjax("simulate", "--profile", "mission.csv", "--battery", "--out", "one"), code=0)
        (tmp_path / "said.txt").write_text(out)
    return tmp_path / "one"


# --- what comes out -------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_segments_add_up_to_the_mission(done):
    segments, table = columns_of(done / "segments.csv"), columns_of(done / "runs.csv")
    assert list(segments["cycle"]) == [1] * 7 + [2] * 7 and list(segments["segment"]) == [*range(1, 8)] * 2
    assert list(segments["mode"][:7]) == ["speed"] * 3 + ["brake"] + ["speed"] * 2 + ["brake"]
    for column in ("duration_s", "distance_m", "energy_Wh", *(f"energy_to_{name}_Wh" for name in energy.SINKS)):
        assert_allclose(segments[column].sum(), table[column][0], rtol=1e-6, atol=1e-9)
    assert segments["peak_current_A"].max() == pytest.approx(table["peak_current_A"][0])
    assert segments["state_of_charge"][-1] == pytest.approx(table["state_of_charge"][0])
    assert (np.diff(segments["state_of_charge"]) < 0).all()
    assert_allclose(segments["time_s"], np.cumsum(segments["duration_s"]) - segments["duration_s"])


@pytest.mark.slow
def test_runs_of_a_file_follow_the_same_profile(mmrjax, tmp_path):
    (tmp_path / "plan.csv").write_text(
        "run_id,configuration,supply_voltage_V,payload_kg,slope_deg\na,6T2A,33,0,0\nb,4W2T,24,4,0\n"
    )
    words = ("--profile", "mission.csv", "--runs", "plan.csv", "--out", "several")
    _, _, err = ends(mmrjax("simulate", *words), code=0)
    assert "plan.csv, slope_deg: not used, because mission.csv gives it" in err
    folder = tmp_path / "several"
    result = read_json(folder / "result.json")
    assert [m["status"] for m in result["missions"]] == ["converged"] * 2
    assert (
        result["missions"][0]["energy_Wh"] > 1.5 * result["missions"][1]["energy_Wh"]
    )  # tracks cost more than wheels
    assert result["missions"][0]["state_of_charge"] is None
    assert list(columns_of(folder / "segments.csv")["run_id"]) == ["a"] * 14 + ["b"] * 14
    assert Tables((folder / "report.html").read_text()).tables["runs"][0][1].startswith("a: 6T2A")


def test_battery_that_ends_in_the_mission_is_said(mmrjax, tmp_path):
    """The time and the distance up to there, and no segments after it."""
    words = ("--profile", "mission.csv", "--battery", "--discharge", "2198", "--no-report", "--out", "empty")
    ends(mmrjax("simulate", *words), "battery empty", "the battery's capacity is used up", code=0)
    result = read_json(tmp_path / "empty/result.json")
    assert result["status"] == "battery_empty" and 2 < result["duration_s"] < 5
    assert result["endurance_s"] == pytest.approx(result["duration_s"])
    assert result["state_of_charge"] == pytest.approx(0, abs=1e-6)
    segments = columns_of(tmp_path / "empty/segments.csv")
    assert len(segments["status"]) < 7 and segments["status"][-1] == "battery_empty"


# --- rows of the history --------------------------------------------------------------------------------------------


def test_thinning_keeps_the_peak_of_each_segment():
    rng = np.random.default_rng(0)
    segment, current = np.repeat(np.arange(50), 200), rng.normal(size=10_000)
    kept = select_course_rows(segment, current, 400)
    assert len(kept) <= 400 and (np.diff(kept) > 0).all()
    peaks = [k * 200 + np.argmax(np.abs(current[k * 200 : (k + 1) * 200])) for k in range(50)]
    assert set(peaks) <= set(kept) and kept[-1] == 9999
    assert np.diff(kept).max() <= 30  # evenly spread beside them
    assert (select_course_rows(segment, current, 20_000) == np.arange(10_000)).all()
    few = select_course_rows(segment, current, 40)
    assert len(few) <= 40 and np.argmax(np.abs(current)) in few


# --- from Python ----------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def two(robot):
    """Two runs over a short profile, without history."""
    at = mm.Conditions(configuration=["6T2A", "4W2T"], voltage=24.0, battery=[0.0, 1.0])
    return mm.simulate(robot, at, profile=SHORT, history=False)


@pytest.mark.slow
def test_simulate_over_a_profile_has_the_columns_of_the_table(two):
    assert two.model == "drive" and two.shape == (2,) and list(two.statuses) == ["converged"] * 2
    table = two.to_dict()
    assert set(missions.mission_columns()) < set(table) and not {"slip", "total_current_A"} & set(table)
    assert two.energy_Wh.shape == (2,) and (two.energy_Wh > 0).all()
    assert_allclose(two.energy_Wh, two.mission.total.energy / 3600)
    assert np.isnan(two.state_of_charge[0]) and 0.99 < two.state_of_charge[1] < 1
    assert "energy per metre" in str(two) and two.mission.status.shape == (2, 1, 3)


def test_numbers_are_described_once():
    assert len({o.name for o in OUTPUTS}) == len(OUTPUTS) == len(set(missions.mission_columns()))
    assert set(missions.USUAL) < set(missions.mission_columns())
    assert {f"energy_to_{name}" for name in energy.SINKS} < {o.name for o in OUTPUTS}


# --- sweeps ---------------------------------------------------------------------------------------------------------

PLAN = """\
profile = "mission.csv"
outputs = ["energy_Wh", "peak_current_A", "flags"]
[conditions]
battery = true
configuration = "6T2A"
[axes]
payload = [0, 8]
"""


@pytest.mark.slow
def test_sweep_over_a_profile_stores_the_missions_numbers(mmrjax, tmp_path, done):
    import xarray as xr

    (tmp_path / "plan.toml").write_text(PLAN)
    ends(mmrjax("sweep", "plan.toml", "--no-report", "--out", "swept"), code=0)
    found = xr.open_zarr(tmp_path / "swept/results.zarr")
    one = read_json(done / "result.json")
    assert float(found.energy_Wh.sel(payload=0)) == pytest.approx(one["energy_Wh"], rel=1e-6)
    assert float(found.energy_Wh.sel(payload=8)) > one["energy_Wh"] and found.energy_Wh.attrs["units"] == "Wh"
    assert [STATUSES[int(k)] for k in found.status] == ["converged"] * 2 and found.flags.dtype == np.uint16


@pytest.mark.slow
def test_history_follows_the_demand_and_holds_each_segments_peak(done):
    history, segments = columns_of(done / "history.csv"), columns_of(done / "segments.csv")
    assert (np.diff(history["time_s"]) > 0).all() and history["time_s"][-1] == pytest.approx(10)
    cruise = (history["segment"] == 2) & (history["time_s"] % 5 > 1)
    assert_allclose(history["speed_mm_s"][cruise], 300, rtol=0.01)
    assert_allclose(history["demanded_speed_mm_s"][cruise], 300)
    ramp = history["segment"] == 1
    assert_allclose(history["demanded_speed_mm_s"][ramp], 600 * (history["time_s"][ramp] % 5), atol=1e-4)
    assert np.isnan(history["demanded_speed_mm_s"][np.isin(history["segment"], (4, 7))]).all()  # it brakes
    for cycle, segment, peak in zip(segments["cycle"], segments["segment"], segments["peak_current_A"], strict=True):
        own = (history["cycle"] == cycle) & (history["segment"] == segment)
        # the peak of a segment counts the instant that it begins in too
        # (half of it has nine digits in the file, of which the last is rounded)
        assert 2 * np.abs(history["motor_current_A"][own]).max() <= peak * (1 + 1e-8)
    assert 2 * np.abs(history["motor_current_A"]).max() == pytest.approx(segments["peak_current_A"].max())
    assert history["energy_Wh"][-1] == pytest.approx(segments["energy_Wh"].sum(), rel=1e-6)
