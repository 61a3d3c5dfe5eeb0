"""The first sentence of a page: it answers, and does not call a run fine that exceeds a limit."""

from types import SimpleNamespace

import numpy as np
from pages import recorded

from calibration.sensitivity.result import OperatingPoints
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


def limits(percent):
    """Limits of a run, the motor speed at so much of its own."""
    return [
        {"words": "motor speed", "percent": percent, "limit": "8000 rpm"},
        {"words": "inrush", "percent": None, "limit": "not stated"},
        {"words": "adhesion", "percent": 20.0, "limit": "1.00"},
    ]


MISSION = {f"energy_to_{name}_Wh": 0.0 for name in mission_report.SINKS} | {
    "energy_to_other_Wh": 7.0, "energy_to_track_Wh": 2.0, "energy_drawn_Wh": 10.0, "energy_Wh": 9.5,
    "distance_m": 120.0, "endurance_s": 3600.0, "status": "converged",
}  # fmt: skip


def study(*studied, method="local"):
    """A sensitivity study of two outputs at 3 slopes and 2 voltages, with a mask of the points of each output."""
    slopes, volts = np.tile([0.0, 10.0, 20.0], 2), np.repeat([15.0, 33.0], 3)
    outputs = [
        SimpleNamespace(row=SimpleNamespace(label=label), studied=np.array(mask))
        for label, mask in zip(("total current", "slip"), studied, strict=True)
    ]
    return SimpleNamespace(
        method=method, points=OperatingPoints(np.full(6, "6T2A"), volts, np.zeros(6), slopes), negligible=("b",),
        outputs=dict(enumerate(outputs)), leaders=lambda: {"6T2A.share": [("total current", 0.56), ("slip", 0.4)]},
        inputs={
            "6T2A.share": SimpleNamespace(meaning="share of the weight (the rest is elsewhere), eq. (26)"),
            "b": SimpleNamespace(meaning=""),
        },
    )  # fmt: skip


def fitted(adequate, rows):
    """A fit whose readings reach so many of three rows before it, and all of them after it."""

    def reading(before, after, reached):
        missing = np.arange(3) >= reached
        return SimpleNamespace(
            measured=np.ones(3), before=np.where(missing, np.nan, before), after=np.full(3, after)
        )  # after reaches every row

    return SimpleNamespace(
        channels=() if adequate is None else SHOWN, adequacy=SimpleNamespace(adequate=adequate),
        readings={"total_current": reading(1.2, 1.05, rows[0]), "speed": reading(0.9, 0.98, rows[1])},
    )  # fmt: skip


def reproduced():
    def of(rms, rows, group="all"):
        cells = [{"rms_percent": rms + k} for k in range(3)]
        return {"variant": "", "group": group, "rows": rows, "of": 20, "cells": cells}

    return [of(9, 13), of(9, 13, "6T2A"), of(8, 20), of(5, 20), of(5, 10, "6T2A"), of(3, 20)]


LEVEL, EVERY = [True, True, False] * 2, [True] * 6
SOME, ODD = [True, False, False, True, True, False], [True, False] * 3


def answers():
    """What a page is of → its first sentence."""
    return {
        "sweep, some beyond a limit": sweep_report.sweep_answer(
            table(["converged"] * 3 + ["slides"], ["", "gearbox_overspeed", "gearbox_overspeed;slips", ""])
        ),
        "sweep, all within": sweep_report.sweep_answer(table(["converged"] * 2, ["", ""])),
        "sweep, none": sweep_report.sweep_answer(table(["slides"], [""])),
        "run beyond a limit": runs_report.runs_answer(table(["converged"], [""]), SHOWN, limits(106.0)),
        "run within": runs_report.runs_answer(table(["converged"], [""]), SHOWN, limits(60.0)),
        "run, none": runs_report.runs_answer(table(["slides"], [""]), SHOWN, []),
        "runs": runs_report.runs_answer(
            table(["converged", "converged", "slides"], ["", "slips", ""]), SHOWN, []
        ),
        "mission": mission_report.mission_answer(MISSION),
        "sensitivity, a slope left out": sensitivity_words.sensitivity_statement(study(LEVEL, LEVEL)),
        "sensitivity, points of one output left out": sensitivity_words.sensitivity_statement(study(SOME, EVERY, method="sobol")),
        "sensitivity": sensitivity_words.sensitivity_statement(study(EVERY, EVERY)),
        "sensitivity, odd points left out": sensitivity_words.sensitivity_statement(study(ODD, ODD)),
        "calibration": fit_words.calibration_answer(fitted(False, (3, 3))),
        "calibration, a row reached after it alone": fit_words.calibration_answer(fitted(False, (2, 3))),
        "calibration, undecided": fit_words.calibration_answer(fitted(None, (3, 3))),
        "reproduce": report.error_answer(reproduced()),
    }  # fmt: skip


def test_first_sentences_are_as_recorded():
    text = "".join(f"{page}: {answer}\n" for page, answer in answers().items())
    assert text == recorded("answers", text)
