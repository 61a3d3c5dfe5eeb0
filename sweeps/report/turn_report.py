"""The report of a turn: what either side takes, the path from above, and what other turns take."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np

from calibration.data.robot_file import RobotFile
from mmrjax.fidelities.base import History
from mmrjax.model.channels import SIDES
from mmrjax.model.robot import Robot
from sweeps import capabilities
from sweeps.pages import words
from sweeps.report import run_tables
from sweeps.report.document import Document, Note, Section, Table, columns, deferred_figure, remarks
from sweeps.report.runs_report import run_headings
from sweeps.report.words import turn_words

#: What either side does: words, column, format.
_ROWS = (
    ("voltage [V]", "motor_voltage_{}_V", "z.2f"),
    ("current [A]", "motor_current_{}_A", "z.3f"),
    ("motor speed [rpm]", "motor_speed_{}_rpm", "z.0f"),
    ("electrical power [W]", "power_{}_W", "z.1f"),
    ("winding, long running [°C]", "winding_{}_C", "z.0f"),
)
_CIRCLE = "**The path** of the centre of mass, and the centre about which the robot rotates."
_PATH = "**The path** of the centre of mass: the robot at the start, half way and at the end."
_TURNS = (
    "**What other turns take** at the same duty of the faster side, from straight travel to turning on the spot; "
    "dots: this one. All of them are in `turns.csv`."
)
_COURSE = "**Over time**; the inrush of the start goes beyond the axis of the current. All of it is in `history.csv`."
_ASSUMED = (
    "Friction of a contact is the law of straight travel, of the size of its whole sliding velocity, on an ellipse "
    "of longitudinal and lateral friction. "
)
_GROUSERS = (
    "Grousers and wheels bear as the ground presses on each, and the robot pitches and rolls on them. See "
    "`docs/explanation/track-model.md`."
)
_RIGID = (
    "Loads are those of a rigid robot in balance. Tracks bear along the whole wheelbase, wheels at its ends. See "
    "`docs/explanation/turning.md`."
)


def turn_document(
    file: RobotFile,
    model: str,
    run: Mapping[str, np.ndarray],
    ended: Mapping[str, float] | None,
    history: History | None,
    turns: dict[str, np.ndarray] | None,
    notes: Sequence[str] = (),
) -> Document:
    """The report of one turn.

    Args:
        run: its row of `runs.csv`; ended: its time, distance and angle at the end, of a run over time.
        history: over time, of a fidelity that keeps it; turns: settled ones of other duties of the slower side.
        notes: further remarks.
    """
    robot, row = file.robot, {name: values[0] for name, values in run.items()}
    sides, going = sides_table(robot, row), turn_words.is_going(row)
    sections = []
    if sides.rows:
        above = "path", "the path of the robot from above"
        circle = (
            deferred_figure(*above, _CIRCLE, "turn_figures.draw_turn_circle", robot, row) if history is None
            else deferred_figure(*above, _PATH, "turn_figures.draw_history_path", robot, row, history)
        )  # fmt: skip
        sections.append(Section("From above", (circle,)))
    if history is not None:
        course = "currents, motor speeds and yaw rate over time"
        figure = deferred_figure("course", course, _COURSE, "turn_figures.draw_turn_course", history)
        sections.append(Section("Over time", (figure,)))
    elif turns is not None:
        others = "current of either side and power over the yaw rate"
        figure = deferred_figure("turns", others, _TURNS, "turn_figures.over_yaw_rate", turns, row)
        sections.append(Section("Other turns", (figure,)))
    assumed = _ASSUMED + (_GROUSERS if model == "track" else _RIGID)
    return Document(
        f"Turn of {run_headings(run)[0]}",
        turn_words.turn_answer(row, ended),
        (
            run_tables.lead_note(file, model),
            sides,
            *remarks([*(turn_words.turn_notes(robot, row) if going else []), *notes]),
        ),
        (*sections, Section("What is assumed", (Note(assumed),))),
    )


def sides_table(robot: Robot, row: Mapping[str, np.ndarray]) -> Table:
    """What the left and the right side do, without rows if no motion is known."""
    idle, known = capabilities.idle_columns(robot), math.isfinite(float(row["yaw_rate_rad_s"]))
    rows = []
    for label, column, form in _ROWS if known else ():
        values = [float(row[column.format(side)]) for side in SIDES]
        if column.format(SIDES[0]) not in idle:
            rows.append((label, *(words.NONE_SETTLES if math.isinf(v) else format(v, form) for v in values)))
    return Table("sides", columns("", "left |", "right |"), rows)
