"""First sentence of each page: it states the result, and mentions an exceeded limit."""

import numpy as np
from pages import recorded

from mmrjax.model import channels
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


def answers():
    """First sentence of each page, by its subject."""
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
    }  # fmt: skip


def test_first_sentences_are_as_recorded():
    text = "".join(f"{page}: {answer}\n" for page, answer in answers().items())
    assert text == recorded("answers", text)
