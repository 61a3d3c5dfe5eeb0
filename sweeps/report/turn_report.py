"""Report of a turn: demands of each side, path from above, and demands of other turns."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np

from calibration.data import Columns
from calibration.data.robot_file import RobotFile
from mmrjax.fidelities.base import History
from mmrjax.model.channels import SIDES, channels_named
from mmrjax.model.robot import Robot
from sweeps import capabilities
from sweeps.pages import words
from sweeps.report import catalogue, run_tables
from sweeps.report.document import Document, Section, Table, remarks
from sweeps.report.runs_report import run_headings
from sweeps.report.words import turn_words

#: Quantities of each side: name, column, format.
_ROWS = (
    ("voltage [V]", "motor_voltage_{}_V", "z.2f"),
    ("current [A]", "motor_current_{}_A", "z.3f"),
    ("motor speed [rpm]", "motor_speed_{}_rpm", "z.0f"),
    ("electrical power [W]", "power_{}_W", "z.1f"),
    ("winding, long running [°C]", "winding_{}_C", "z.0f"),
)


def turn_document(
    file: RobotFile,
    model: str,
    run: Columns,
    ended: Mapping[str, float] | None,
    history: History | None,
    turns: Columns | None,
    notes: Sequence[str],
) -> Document:
    """Report of a turn.

    Args:
        run: row of the turn in `runs.csv`.
        ended: time, distance and angle at the end of a run over time.
        history: history over time, if the fidelity keeps it.
        turns: settled turns at other duties of the slower side.
        notes: further remarks.
    """
    robot, row = file.robot, {name: values[0] for name, values in run.items()}
    sides, going = sides_table(robot, row), turn_words.has_motion(row)
    sections = []
    if sides.rows and history is not None:
        path = (np.asarray(history.reading[name])[0] for name in ("place_x", "place_y", "yaw"))
        sections.append(Section("From above", (catalogue.figure("turn.path", robot, row, *path),)))
    if history is not None:
        names = [f"motor_{what}_{side}" for what in ("current", "speed") for side in SIDES]
        shown = channels_named((*names, "yaw_rate"))
        rows = {c.column: np.asarray(history.reading[c.name])[0] / c.factor for c in shown}
        rows["time_s"] = np.asarray(history.time)[0]
        sections.append(Section("Over time", (catalogue.figure("turn.course", rows),)))
    elif turns is not None:
        sections.append(Section("Other turns", (catalogue.figure("turn.turns", turns, row),)))
    return Document(
        f"Turn of {run_headings(run)[0]}",
        turn_words.turn_answer(row, ended),
        (
            run_tables.note_on_robot(file, model),
            sides,
            *remarks([*(turn_words.turn_notes(robot, row) if going else []), *notes]),
        ),
        tuple(sections),
    )


def sides_table(robot: Robot, row: Columns) -> Table:
    """Table of both sides, without rows if no motion is known."""
    idle, yaw_known = capabilities.inapplicable_columns(robot), math.isfinite(float(row["yaw_rate_rad_s"]))
    rows = []
    for label, column, form in _ROWS if yaw_known else ():
        values = [float(row[column.format(side)]) for side in SIDES]
        if column.format(SIDES[0]) not in idle:
            rows.append((label, *(words.NONE_SETTLES if math.isinf(v) else format(v, form) for v in values)))
    return catalogue.table("turn.sides", rows)
