"""The first sentence of a page: it answers, and does not call a run fine that exceeds a limit."""

import numpy as np
import pytest

from mmrjax.model import channels
from sweeps.pages import mission_page, runs_page, sweep_page

SHOWN = [channels.find_channel("total_current"), channels.find_channel("speed")]


def table(statuses, flags):
    return {
        "status": np.array(statuses), "flags": np.array(flags),
        "total_current_A": np.full(len(flags), 2.5), "speed_mm_s": np.full(len(flags), 400.0),
    }  # fmt: skip


def test_sweep_counts_the_runs_beyond_a_limit():
    runs = table(["converged"] * 3 + ["slides_back"], ["", "gearbox_overspeed", "gearbox_overspeed;slips", ""])
    assert sweep_page.answer(runs) == (
        "3 of 4 runs have an operating point; 2 of them exceed a limit, most often: "
        "gearbox input faster than its catalogue permits (2 runs)."
    )
    assert sweep_page.answer(table(["converged"] * 2, ["", ""])).endswith("; all within every limit.")
    assert sweep_page.answer(table(["slides_back"], [""])) == "0 of 1 run has an operating point."


@pytest.mark.parametrize(
    ("percent", "says"),
    [(106.0, "motor speed exceeds its limit (106 % of 8000 rpm)"), (60.0, "motor speed is the nearest limit")],
)
def test_run_names_its_nearest_limit(percent, says):
    limits = [
        {"words": "motor speed", "percent": percent, "limit": "8000 rpm"},
        {"words": "inrush", "percent": None, "limit": "not stated"},
        {"words": "adhesion", "percent": 20.0, "limit": "1.00"},
    ]
    said = runs_page.answer(table(["converged"], [""]), SHOWN, limits)
    assert says in said and said.startswith("Total current 2.50 A, speed 400 mm/s; ")


def test_runs_without_an_operating_point_say_why():
    assert runs_page.answer(table(["slides_back"], [""]), SHOWN, []).startswith("No operating point: ")
    several = table(["converged", "converged", "slides_back"], ["", "slips", ""])
    assert runs_page.answer(several, SHOWN, []) == "2 of 3 runs have an operating point; 1 of them exceeds a limit."


def test_mission_says_where_most_energy_goes():
    run = {f"energy_to_{name}_Wh": 0.0 for name in mission_page.SINKS} | {
        "energy_to_other_Wh": 7.0, "energy_to_track_Wh": 2.0, "energy_drawn_Wh": 10.0, "energy_Wh": 9.5,
        "distance_m": 120.0, "endurance_s": 3600.0, "status": "converged",
    }  # fmt: skip
    assert mission_page.answer(run) == (
        "The mission takes 9.5 Wh over 120 m (other consumers 70 %, tracks and guides 20 %); a full battery lasts 60 min."
    )
