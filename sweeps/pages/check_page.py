"""The report of a check: the sheet, its figure, and what would meet what is missed."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

from calibration.data.input_errors import rounded
from calibration.data.robot_file import RobotFile
from sweeps.pages import check_figures, posture_figures
from sweeps.pages.page import Album, named, render
from sweeps.results import check_results
from sweeps.results.check_results import CheckResult


def write(folder: Path, found: CheckResult, file: RobotFile) -> Path:
    """Write `report.html` and `figures/` of a check; returns the path of the page."""
    album = Album(folder)
    album.add("margins", partial(check_figures.margins, found))
    if found.drawn:
        album.add("postures", partial(posture_figures.asked_about, found.drawn))
    return render(
        folder,
        "check.html.j2",
        album,
        title="Requirements",
        statement=found.statement(),
        source=found.asked.source,
        rows=[_row(o) for o in found.outcomes],
        missed=[
            {
                "label": f"{check_results.label(o)} {check_results.wanted(o)}",
                "changes": [_change(c) for c in o.change],
            }
            for o in found.missed
        ],
        **named(file),
    )


def _row(o: check_results.Outcome) -> dict[str, Any]:
    return {
        "met": o.met,
        "label": check_results.label(o),
        "name": o.requirement.name,
        "wanted": check_results.wanted(o),
        "reached": check_results.reached(o),
        "margin": "–" if o.margin is None else f"{'+' if o.margin >= 0 else '−'}{rounded(abs(o.margin))}",
        "corner": check_results.corner(o),
        "place": f"{o.at['configuration']}, {o.at['surface'].replace('_', ' ')}",
        "source": o.requirement.source,
    }


def _change(c: check_results.Change) -> dict[str, Any]:
    return {
        "parameter": c.parameter,
        "before": f"{c.before:.4g}",
        "after": f"{c.after:.6g}",
        "unit": c.unit,
        "percent": f"{100 * (c.after / c.before - 1):+.1f}",
        "breaks": ", ".join(c.breaks),
    }
