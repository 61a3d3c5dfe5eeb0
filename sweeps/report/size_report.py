"""The report of `size`: the best design, the limits over its use, the front, and every motor's best."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable

import numpy as np

from calibration.sizing.chart import LIMITS, Chart
from calibration.sizing.design import OBJECTIVES
from calibration.sizing.design_search import SizedDesign
from mmrjax.errors import count_noun
from sweeps.report import catalogue
from sweeps.report.check_report import requirements_sheet
from sweeps.report.document import Cell, Document, Figure, Note, Section, Table, columns
from sweeps.results.size_results import SizeResult, design_verdict, missed_limits, objective_text

_HEADINGS = {"mass": "mass", "energy": "energy", "cost": "price of motors and gearboxes"}
COLUMNS = columns(
    "", "motor", "gearbox", "total ratio | .4g", "radius [mm] | .1f", "cells",
    *(f"{_HEADINGS[name]} [{unit}] | .4g" for name, (unit, _) in OBJECTIVES.items()), "binding limits, or misses",
)  # fmt: skip


#: Motors that the terminal shows.
SHOWN = 5
_DESIGNS = "The best, and the best with other parts, with ratios of the makers' sheets and whole cells."


def size_document(found: SizeResult, robot_name: str) -> Document:
    """The report of a sizing that started from a robot of that name."""
    s, wanted = found.sizing, ", ".join(OBJECTIVES[name][1] for name in found.objectives)
    lead = (
        f"Requirements: **{found.asked.source}**. Starting from: **{robot_name}**. Minimised: **{wanted}**. "
        f"{s.starts} searches evaluated {s.evaluated:,} designs."
    )
    best = () if s.best is None else (s.best, *s.alternatives)
    about = _DESIGNS if best else "No design of these parts meets the requirements."
    tables = _table("best", found, best), requirements_sheet(found.outcomes, terminal=False)
    motors = _table("by_motor", found, s.motors.values(), "best design of each motor, the first five", terminal=True)
    return Document(
        "Sizing",
        found.statement(),
        (Note(lead, "lead"), *_limits(found, robot_name), *_front(found)),
        (
            Section("Designs", (Note(about), *tables), "designs"),
            Section("Every motor", (catalogue.note("size.motors"), motors), "motors"),
        ),
    )


def _table(
    name: str, found: SizeResult, designs: Iterable[SizedDesign], title: str = "", terminal: bool = False
) -> Table:
    left_out = found.sizing.unmeetable
    rows = [
        (
            Cell(design_verdict(f, left_out), ("fair" if left_out else "good") if f.feasible else "bad"),
            f.drive.motor.name,
            f"{f.drive.family}, {count_noun(f.drive.stages, 'stage')}", f.ratio, 1000 * f.radius,
            f"{f.in_series} × {f.parallel:.3g} {f.cell.name}", *(f.objectives.get(k) for k in OBJECTIVES),
            ", ".join(f.binds if f.feasible else missed_limits(f)) or "none",
        )
        for f in designs
    ]  # fmt: skip
    return Table(name, COLUMNS, rows, title, terminal=terminal, brief=range(min(SHOWN, len(rows))))


def _limits(found: SizeResult, robot_name: str) -> tuple[Figure, ...]:
    if not found.charts:
        return ()
    best = found.sizing.best
    names = [] if best is None else [f"best: {best.drive.motor.name}, ratio {best.ratio:.4g}"]
    charts = dict(zip([*names, f"as it is: {robot_name}"], found.charts, strict=True))
    alternative = "; ".join(f"{name}: {_reach(c)}" for name, c in charts.items())
    return (catalogue.figure("size.limits", found, charts, finding=alternative),)


def _reach(c: Chart) -> str:
    """The share of a chart within all limits, and the limit that is most often nearest."""
    (most, _), *_ = Counter(c.nearest.ravel().tolist()).most_common(1)
    within = f"{100 * np.mean(c.margin >= 0):.0f} % of payloads up to {c.payload[-1]:.3g} kg and slopes up to "
    return f"{within}{c.slope[-1]:.3g}° are within all limits, the nearest is mostly {LIMITS[most]}"


def _front(found: SizeResult) -> tuple[Figure | Note, ...]:
    front = found.sizing.front
    if not front:
        return ()
    first, second = found.objectives
    text = (
        f"{count_noun(len(front), 'design')} on the Pareto front of {first} and {second}, from "
        f"{objective_text(front[0], first)} to {objective_text(front[-1], second)}"
    )
    return (
        Note(f"{text}.", terminal=True),
        catalogue.figure("size.front", found, finding=text),
    )
