"""The report of a calibration: one offline page with its parameters, errors and figures."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from calibration.inference import result as outcome
from calibration.inference.calibrate import Calibration
from sweeps import figures_calibration, figures_sweep
from sweeps.report import COLUMNS, Album, render, words_shown


def write(folder: Path, found: Calibration, document: dict[str, Any], *, robot_name: str) -> Path:
    """Write `report.html` and `figures/` for a calibration.

    Args:
        folder: an existing run folder.
        found, document: the calibration, and what `outcome.document` made of it.
        robot_name: name or file of the robot that was calibrated.

    Returns:
        The path of the page.
    """
    table = outcome.rows_table(found)
    after = {**table, **{f"simulated_{column}": table[f"after_{column}"] for column in COLUMNS.values()}}
    album = Album(Path(folder))
    album.add("parameters", lambda: figures_calibration.parameters(found))
    album.add("before_after", lambda: figures_calibration.before_after(document))
    if "time_s" in table:
        album.add("histories", lambda: figures_calibration.histories(table, COLUMNS))
    album.add("parity", lambda: figures_sweep.parity(after, COLUMNS))
    album.add("residuals", lambda: figures_sweep.errors_over(after, COLUMNS))
    if found.profile is not None:
        album.add("profiles", lambda: figures_calibration.profiles(found))
    album.add("correlations", lambda: figures_calibration.correlations(found))
    rows = min(len(found.runs), 200)
    return render(
        Path(folder),
        "calibration.html.j2",
        album,
        title=f"Calibration of {words_shown(Path(robot_name).name)} to {Path(found.runs.source).name}",
        document=document,
        rows=[{k: v[i] for k, v in after.items()} for i in range(rows)],
        columns=COLUMNS,
        shift=lambda z: "bad" if abs(z) > 3 else "fair" if abs(z) > 2 else "",
    )
