"""Report of `size`: the best design, the Pareto front, and the best design of each motor."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable

from calibration.data import Json, Names, writing
from calibration.data.requirements_file import Requirements
from calibration.sizing.design import OBJECTIVES
from calibration.sizing.design_search import SizedDesign, SizingResult
from calibration.sizing.sheet import RequirementOutcome
from mmrjax.errors import count_noun
from mmrjax.model.robot import Robot
from sweeps.report import catalogue
from sweeps.report.check_report import requirement_label, requirements_sheet
from sweeps.report.document import Cell, Document, Note, Section, Table, columns


@dataclasses.dataclass(frozen=True)
class SizeResult:
    """Designs for some requirements.

    Attributes:
        asked: the requirements.
        robot: initial robot of the search.
        sizing: result of the search.
        objectives: minimised numbers.
        outcomes: results of `check` for the best design, empty without one.
    """

    asked: Requirements
    robot: Robot
    sizing: SizingResult
    objectives: Names
    outcomes: tuple[RequirementOutcome, ...]

    def statement(self) -> str:
        """The answer: the best design and its binding limits, or the nearest design and the limits that it misses."""
        s = self.sizing
        left_out = f" No parts meet the requirement on {' or '.join(s.unmeetable)} (dropped)." if s.unmeetable else ""
        if s.best is None:
            nearest = min(s.motors.values(), key=margin_shortfall, default=None)
            why = (
                f" The nearest, {describe_design(nearest)}, misses {', '.join(missed_limits(nearest))}."
                if nearest
                else ""
            )
            return f"No design with these parts meets the requirements.{why}{left_out}"
        missing = [requirement_label(o) for o in self.outcomes if not (o.met or requirement_label(o) in s.unmeetable)]
        binds = f" Binding limits: {', '.join(s.best.binds) or 'none'}."
        binds += f" It misses {', '.join(missing)}." if missing else ""
        return f"{describe_design(s.best)}: {objective_text(s.best, s.objective)}.{binds}{left_out}"

    def to_json(self) -> Json:
        """`result.json`."""
        return {
            "schema": "mmrjax.size/1",
            "statement": self.statement(),
            **writing.entries_of(self, "source=asked.source", "objectives"),
            **writing.entries_of(self.sizing, "unmeetable", "best", "ideal", "alternatives"),
            "motors": list(self.sizing.motors.values()),
            **writing.entries_of(self, "pareto=sizing.front", "requirements=outcomes"),
            **writing.entries_of(self.sizing, "starts", "evaluated"),
        }


def design_verdict(found: SizedDesign, unmeetable: Names) -> str:
    """Verdict on a design. `unmeetable`: requirements that no choice of parts meets, which were ignored."""
    return "misses" if not found.feasible else "meets the others" if unmeetable else "meets"


def margin_shortfall(found: SizedDesign) -> float:
    """Sum of the margins that a design misses [-]."""
    return sum(max(-m, 0.0) for m in found.margins.values())


def missed_limits(found: SizedDesign) -> list[str]:
    """Limits that a design misses, with their margins."""
    return [f"{label} ({100 * m:+.1f} %)" for label, m in sorted(found.margins.items(), key=lambda x: x[1]) if m < 0]


def describe_design(found: SizedDesign) -> str:
    """Motor, gearbox, ratio, radius and cells of a design."""
    stages = count_noun(found.drive.stages, "stage")
    return (
        f"{found.drive.motor.name}, {found.drive.family} with {stages}, ratio {found.ratio:.4g}, radius "
        f"{1000 * found.radius:.1f} mm, {found.in_series} × {found.parallel:.3g} {found.cell.name}"
    )


def objective_text(found: SizedDesign, name: str) -> str:
    """Objective with its unit, or `not stated` if no data sheet states it."""
    unit, words = OBJECTIVES[name]
    return f"{words} {found.objectives[name]:.4g} {unit}" if name in found.objectives else f"{words} not stated"


_HEADINGS = {"mass": "mass", "energy": "energy", "cost": "price of motors and gearboxes"}
COLUMNS = columns(
    "", "motor", "gearbox", "total ratio | .4g", "radius [mm] | .1f", "cells",
    *(f"{_HEADINGS[name]} [{unit}] | .4g" for name, (unit, _) in OBJECTIVES.items()), "binding limits, or misses",
)  # fmt: skip


#: Number of motors in the table of a terminal, and of further designs in its few lines.
SHOWN, NEXT = 5, 2
_DESIGNS = "The best design, and the best with other parts, all with makers' gear ratios and whole cells."


def size_document(found: SizeResult, robot_name: str) -> Document:
    """Report of a search that started from the named robot."""
    s, objective_words = found.sizing, ", ".join(OBJECTIVES[name][1] for name in found.objectives)
    lead = (
        f"Requirements: **{found.asked.source}**. Starting from: **{robot_name}**. Minimised: **{objective_words}**. "
        f"{s.starts} searches evaluated {s.evaluated:,} designs."
    )
    best = () if s.best is None else (s.best, *s.alternatives)
    about = _DESIGNS if best else "No design with these parts meets the requirements."
    tables = _table("best", found, best), requirements_sheet(found.outcomes, terminal=False)
    motors = _table("by_motor", found, s.motors.values(), "best design of each motor, the first five", terminal=True)
    designs = [f"{describe_design(f)} ({objective_text(f, s.objective)})" for f in s.alternatives]
    front_words = _front_in_words(found)
    front = [b for x in front_words for b in (Note(x, terminal=True), _table("front", found, s.front))]
    next_best = (f"Next best: {'. '.join(designs[:NEXT])}.",) if designs else ()
    return Document(
        "Sizing",
        found.statement(),
        (Note(lead, "lead"), *front),
        (
            Section("Designs", (Note(about), *tables), "designs"),
            Section("Every motor", (catalogue.note("size.motors"), motors), "motors"),
            *_chart(found),
        ),
        brief=(lead, *next_best, *front_words),
    )


def _chart(found: SizeResult) -> tuple[Section, ...]:
    """Chart of motor and gear for the best design, if there is one."""
    best = found.sizing.best
    if best is None:
        return ()
    corners = [o.at for o in found.outcomes]
    return (Section("Motor and gear", (catalogue.figure("run.chart_of_corners", best.robot, corners),)),)


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


def _front_in_words(found: SizeResult) -> Names:
    """A sentence on the Pareto front, none without one."""
    front = found.sizing.front
    if not front:
        return ()
    first, second = found.objectives
    return (
        f"{count_noun(len(front), 'design')} on the Pareto front of {first} and {second}, from "
        f"{objective_text(front[0], first)} to {objective_text(front[-1], second)}.",
    )
