"""The report of a climb: the answer, silhouettes, what it took on the way, and how sizes that were tried ended."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from sweeps.pages import climb_figures
from sweeps.pages.page import Album, named, render
from sweeps.results.climb import VERDICTS

if TYPE_CHECKING:
    from calibration.data.robot_file import RobotFile
    from sweeps.results.climb import ClimbResult


def write(folder: Path, found: ClimbResult, file: RobotFile) -> Path:
    """Write `report.html` and `figures/` of a climb; returns the path of the page."""
    album = Album(folder)
    album.add("silhouettes", partial(climb_figures.silhouettes, found))
    album.add("course", partial(climb_figures.course, found))
    if found.tried:
        album.add("search", partial(climb_figures.search, found))
    return render(
        folder,
        "climb.html.j2",
        album,
        title="Over an obstacle",
        found=found,
        numbers=[
            {
                "name": name.rpartition("_")[0].replace("_", " "),
                "value": f"{value:.4g}",
                "unit": name.rpartition("_")[2],
            }
            for name, value in found.numbers().items()
        ],
        verdicts=[{"name": name, "short": short, "meaning": meaning} for name, (short, meaning) in VERDICTS.items()],
        **named(file),
    )
