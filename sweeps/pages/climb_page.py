"""The report of a climb: the answer, silhouettes, what it took on the way, and how sizes that were tried ended."""

from __future__ import annotations

from functools import partial
from pathlib import Path

from calibration.data.robot_file import RobotFile
from mmrjax.climbing.climb_derivatives import OUTPUTS
from sweeps.pages import climb_figures
from sweeps.pages.page import Album, render_page, robot_section
from sweeps.results.climb_results import VERDICTS, ClimbResult


def write_climb_page(folder: Path, found: ClimbResult, file: RobotFile) -> Path:
    """Write `report.html` and `figures/` of a climb; returns the path of the page."""
    album = Album(folder)
    album.add("silhouettes", partial(climb_figures.draw_silhouettes, found))
    album.add("course", partial(climb_figures.draw_climb_course, found))
    if found.tried:
        album.add("search", partial(climb_figures.draw_size_search, found))
    return render_page(
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
        margins=[
            {"name": name.removeprefix("margin_"), "percent": f"{100 * value:.3g}", "meaning": OUTPUTS[name][1]}
            for name, value in found.margins.items()
        ],
        outputs=[
            {
                "name": name,
                "unit": unit,
                "meaning": meaning,
                "value": f"{derivatives.found[name]:.4g}",
                "by": [
                    {"derivative": f"{d:.3g}", "slope": f"{s:.3g}", "sd": f"{sd:.1g}"}
                    for d, s, sd in zip(
                        derivatives.by[name], derivatives.slope[name], derivatives.slope_sd[name], strict=True
                    )
                ],
            }
            for derivatives in ([found.derivatives] if found.derivatives else [])
            for name, (unit, meaning) in OUTPUTS.items()
        ],
        by=[{"name": n, "unit": u, "value": f"{v:.4g}", "width": f"{w:.2g}"} for n, u, v, w in found.along.rows]
        if found.along
        else [],
        verdicts=[{"name": name, "short": short, "meaning": meaning} for name, (short, meaning) in VERDICTS.items()],
        **robot_section(file),
    )
