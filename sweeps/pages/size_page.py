"""The report of a sizing: the best design, what binds where, the front, and every motor's best."""

from __future__ import annotations

import dataclasses
from functools import partial
from pathlib import Path
from typing import Any

from calibration.data.robot_file import RobotFile
from calibration.sizing.chart import chart_extent, margin_chart
from calibration.sizing.design import OBJECTIVES
from calibration.sizing.design_search import SizedDesign
from sweeps.pages import size_figures
from sweeps.pages.page import Album, named, render, words_shown
from sweeps.results.check_results import label, reached, wanted
from sweeps.results.size_results import SizeResult, missed, verdict


def write(folder: Path, found: SizeResult, file: RobotFile) -> Path:
    """Write `report.html` and `figures/` of a sizing; returns the path of the page."""
    album, best, left_out = Album(folder), found.sizing.best, found.sizing.unmeetable
    most = chart_extent(found.asked)
    charts = {f"as it is: {words_shown(file.name)}": margin_chart(found.robot, found.asked, most)}
    if best is not None:
        charts = {
            f"best: {best.drive.motor.name}, ratio {best.ratio:.4g}": margin_chart(best.robot, found.asked, most),
            **charts,
        }
    album.add("limits", partial(size_figures.limits, found, charts))
    if found.sizing.front:
        album.add("front", partial(size_figures.front, found))
    return render(
        folder,
        "size.html.j2",
        album,
        title="Sizing",
        statement=found.statement(),
        source=found.asked.source,
        start=words_shown(file.name),
        objectives=", ".join(OBJECTIVES[name][1] for name in found.objectives),
        starts=found.sizing.starts,
        evaluated=f"{found.sizing.evaluated:,}",
        designs=[] if best is None else [_row(f, left_out) for f in (best, *found.sizing.alternatives)],
        motors=[_row(f, left_out) for f in found.sizing.motors.values()],
        front=[_row(f, left_out) for f in found.sizing.front],
        sheet=[
            {
                "met": o.met,
                "label": label(o),
                "wanted": wanted(o),
                "reached": reached(o),
            }
            for o in found.outcomes
        ],
        **named(file if best is None else dataclasses.replace(file, robot=best.robot)),
    )


def _row(f: SizedDesign, unmeetable: tuple[str, ...]) -> dict[str, Any]:
    return {
        "feasible": f.feasible and not unmeetable,
        "verdict": verdict(f, unmeetable),
        "motor": f.drive.motor.name,
        "gearbox": f"{f.drive.family}, {f.drive.stages} stage{'s' if f.drive.stages > 1 else ''}",
        "ratio": f"{f.ratio:.4g}",
        "radius": f"{1000 * f.radius:.1f}",
        "cells": f"{f.in_series} × {f.parallel:.3g} {f.cell.name}",
        "objectives": [f"{f.objectives[k]:.4g}" if k in f.objectives else "–" for k in OBJECTIVES],
        "binds": ", ".join(f.binds if f.feasible else missed(f)) or "nothing",
    }
