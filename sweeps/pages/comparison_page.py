"""The report of `compare`: a simulation set against a table of measured runs."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from calibration.data.columns import Layout
from calibration.data.robot_file import RobotFile
from sweeps.pages import comparison_figures
from sweeps.pages.page import Album, columns, conditions, first_rows, named, render, statuses


def write(
    folder: Path,
    file: RobotFile,
    *,
    model: str,
    data_name: str,
    table: dict[str, np.ndarray],
    summary: dict[str, dict[str, dict[str, Any]]],
    notes: list[str],
    over: Mapping[str, str] | None = None,
) -> Path:
    """Write `report.html` and `figures/` for a simulation set against a table of measured runs.

    Args:
        folder: an existing run folder.
        file: of the robot that was simulated; model: fidelity.
        data_name: of the table; of a file only the last part is shown.
        table: conditions, `<column>` measured, `simulated_<column>`, `error_<channel>_percent`, `status`.
        summary: group (`all`, each configuration) → channel → rows, rms_percent, max_percent, r2.
        notes: what to say of readings that are missing.
        over: of time histories, further columns over which errors are shown, with their words.

    Returns:
        The path of the page.
    """
    album, robot = Album(folder), file.robot
    sized = Layout.of(robot).crosses_zero or over is not None
    album.add("parity", lambda: comparison_figures.parity(table, robot.channels, band=not sized))
    album.add("errors", lambda: comparison_figures.errors_over(table, robot.channels, in_units=sized, beside=over))
    known = named(file)
    return render(
        folder,
        "comparison.html.j2",
        album,
        of_channels=robot.channels,
        title=f"{known['robot']} against {Path(data_name).name}",
        model=model,
        data_name=Path(data_name).name,
        rows=first_rows(table),
        conditions=conditions(table, mass=True),
        total=len(table["status"]),
        statuses=statuses(table),
        summary=summary,
        notes=notes,
        columns=columns(robot.channels),
        sized=sized,
        **known,
    )
