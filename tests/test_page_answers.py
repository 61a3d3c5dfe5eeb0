"""The first sentence of a page: it answers, and does not call a run fine that exceeds a limit."""

from types import SimpleNamespace

import numpy as np
import pytest

from calibration.sensitivity.result import Points
from calibration.words import fit_words, sensitivity_words
from mmrjax.model import channels
from sweeps.paper import report
from sweeps.report import mission_report, runs_report, sweep_report

SHOWN = [channels.find_channel("total_current"), channels.find_channel("speed")]


def table(statuses, flags):
    return {
        "status": np.array(statuses), "flags": np.array(flags),
        "total_current_A": np.full(len(flags), 2.5), "speed_mm_s": np.full(len(flags), 400.0),
    }  # fmt: skip


def test_sweep_counts_the_runs_beyond_a_limit():
    runs = table(["converged"] * 3 + ["slides_back"], ["", "gearbox_overspeed", "gearbox_overspeed;slips", ""])
    assert sweep_report.sweep_answer(runs) == (
        "3 of 4 runs have an operating point; 2 of them exceed a limit, most often: "
        "gearbox input faster than its catalogue permits (2 runs)."
    )
    assert sweep_report.sweep_answer(table(["converged"] * 2, ["", ""])).endswith("; all within every limit.")
    assert sweep_report.sweep_answer(table(["slides_back"], [""])) == "0 of 1 run has an operating point."


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
    said = runs_report.runs_answer(table(["converged"], [""]), SHOWN, limits)
    assert says in said and said.startswith("Total current 2.50 A, speed 400 mm/s; ")


def test_runs_without_an_operating_point_say_why():
    assert runs_report.runs_answer(table(["slides_back"], [""]), SHOWN, []).startswith("No operating point: ")
    several = table(["converged", "converged", "slides_back"], ["", "slips", ""])
    assert (
        runs_report.runs_answer(several, SHOWN, [])
        == "2 of 3 runs have an operating point; 1 of them exceeds a limit."
    )


def test_mission_says_where_most_energy_goes():
    run = {f"energy_to_{name}_Wh": 0.0 for name in mission_report.SINKS} | {
        "energy_to_other_Wh": 7.0, "energy_to_track_Wh": 2.0, "energy_drawn_Wh": 10.0, "energy_Wh": 9.5,
        "distance_m": 120.0, "endurance_s": 3600.0, "status": "converged",
    }  # fmt: skip
    assert mission_report.mission_answer(run) == (
        "The mission takes 9.5 Wh over 120 m (other consumers 70 %, tracks and guides 20 %); a full battery lasts 60 min."
    )


def study(*studied, method="local"):
    """A sensitivity study of two outputs at 3 slopes and 2 voltages, with a mask of the points of each output."""
    slopes, volts = np.tile([0.0, 10.0, 20.0], 2), np.repeat([15.0, 33.0], 3)
    outputs = [
        SimpleNamespace(row=SimpleNamespace(label=label), studied=np.array(mask))
        for label, mask in zip(("total current", "slip"), studied, strict=True)
    ]
    return SimpleNamespace(
        method=method, points=Points(np.full(6, "6T2A"), volts, np.zeros(6), slopes), negligible=("b",),
        outputs=dict(enumerate(outputs)), leaders=lambda: {"6T2A.share": [("total current", 0.56), ("slip", 0.4)]},
        inputs={
            "6T2A.share": SimpleNamespace(meaning="share of the weight (the rest is elsewhere), eq. (26)"),
            "b": SimpleNamespace(meaning=""),
        },
    )  # fmt: skip


def test_sensitivity_names_the_points_left_out_and_what_its_inputs_mean():
    level, all_of_them = [True, True, False] * 2, [True] * 6
    causes = "share of the weight (6T2A) causes 56 % of the variance of total current, 40 % of slip"
    assert sensitivity_words.sensitivity_statement(study(level, level)) == (
        f"At 4 of 6 operating points (20° left out, where the robot does not travel): {causes} (to first order). "
        "1 of 2 inputs do not matter."
    )
    said = sensitivity_words.sensitivity_statement(
        study([True, False, False, True, True, False], all_of_them, method="sobol")
    )
    assert said.startswith(
        "At 3 of 6 operating points (20° and 1 more left out, where too many robots of the sample do not travel; "
        "all 6 for slip): "
    )
    assert f"{causes}. " in said
    assert sensitivity_words.sensitivity_statement(study(all_of_them, all_of_them)).startswith(
        "At 6 operating points: "
    )
    assert "(3 left out, " in sensitivity_words.sensitivity_statement(study([True, False] * 3, [True, False] * 3))


@pytest.mark.parametrize("rows", [(3, 3), (2, 3)])
def test_calibration_compares_errors_on_the_same_rows(rows):
    measured, gone = np.array([1.0, 1.0, 1.0]), np.nan

    def reading(before, after, reached):
        missing = np.arange(3) >= reached
        return SimpleNamespace(
            measured=measured, before=np.where(missing, gone, before), after=np.full(3, after)
        )  # after reaches every row

    found = SimpleNamespace(
        channels=SHOWN, adequacy=SimpleNamespace(adequate=False),
        readings={"total_current": reading(1.2, 1.05, rows[0]), "speed": reading(0.9, 0.98, rows[1])},
    )  # fmt: skip
    n = ("the same 3 rows", "", "") if rows[0] == 3 else ("the same rows", " (2 rows)", " (3 rows)")
    assert fit_words.calibration_answer(found) == (
        f"The fit is not adequate; rms error before → after on {n[0]}: total current 20.0 → 5.0 %{n[1]}, "
        f"speed 10.0 → 2.0 %{n[2]}."
    )
    found.adequacy.adequate, found.channels = None, ()
    assert fit_words.calibration_answer(found) == "Adequacy undecided; no row is reached both before and after."


def test_reproduce_compares_with_the_bench_and_the_paper():
    def of(rms, rows, group="all"):
        cells = [{"rms_percent": rms + k} for k in range(3)]
        return {"variant": "", "group": group, "rows": rows, "of": 20, "cells": cells}

    every = [of(9, 13), of(9, 13, "6T2A"), of(8, 20), of(5, 20), of(5, 10, "6T2A"), of(3, 20)]
    assert report.error_answer(every) == (
        "rms error against 20 of 20 measured rows: 5.0 % total current, 6.0 % motor speed, 7.0 % speed, with adhesion "
        "raised (13 rows settle on its own). The paper's own simulation: 3.0 % total current, 4.0 % motor speed, "
        "5.0 % speed."
    )
