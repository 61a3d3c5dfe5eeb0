"""The report of the loop: verdict, residual before and after, and the next experiment on one page; then the rest."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from calibration.discovery import result as loop_outcome
from calibration.discovery.discrepancy import Discrepancy
from calibration.discovery.loop import Finding, Loop
from sweeps import figures_loop
from sweeps.report import COLUMNS, Album, render, words_shown


def write(
    folder: Path,
    looped: Loop,
    found: Finding,
    seen: loop_outcome.Readings,
    document: dict[str, Any],
    curve: Discrepancy | None = None,
    *,
    robot_name: str,
) -> Path:
    """Write `report.html` and `figures/` for a pass of the loop.

    Args:
        folder: an existing run folder.
        looped, found, seen, document: the loop, what it found, and what `loop_outcome` made of it.
        curve: of an `unnamed` discrepancy.
        robot_name: name or file of the robot that it began with.

    Returns:
        The path of the page.
    """
    table = loop_outcome.rows_table(looped, found, seen)
    album = Album(Path(folder))
    series = looped.engine.series
    album.add(
        "before_after",
        lambda: (figures_loop.over_time if series else figures_loop.before_after)(table, found.verdict),
    )
    album.add("errors", lambda: figures_loop.errors(document))
    if series:
        album.add("series", lambda: figures_loop.series(document))
    else:
        album.add("defects", lambda: figures_loop.defects(table, document))
    if curve is not None:
        album.add("curve", lambda: figures_loop.curve(table, curve))
    album.add("ladder", lambda: figures_loop.ladder(document))
    album.add("null", lambda: figures_loop.null(found))
    album.add("look_alikes", lambda: figures_loop.look_alikes(looped, found, document))
    album.add("base_shift", lambda: figures_loop.base_shift(document))
    rows = min(len(looped.runs), 200)
    return render(
        Path(folder),
        "loop.html.j2",
        album,
        title=f"What {words_shown(Path(robot_name).name)} lacks against {Path(looped.runs.source).name}",
        document=document,
        rows=[{k: v[i] for k, v in table.items()} for i in range(rows)],
        columns=COLUMNS,
        shift=lambda z: "bad" if abs(z) > 3 else "fair" if abs(z) > 2 else "",
    )
