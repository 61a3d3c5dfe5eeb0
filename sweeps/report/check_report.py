"""Reports of `check` and `size`: margins of a robot's requirements, and designs that meet requirements."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterable, Sequence

import numpy as np

from calibration.data import Json, Names, writing
from calibration.data.input_errors import three_digits
from calibration.data.requirements_file import Requirements
from calibration.sizing import sheet
from calibration.sizing.design import OBJECTIVES
from calibration.sizing.design_search import SizedDesign, SizingResult
from calibration.sizing.sheet import RequirementOutcome
from mmrjax.errors import count_noun
from mmrjax.model.paper_tables import COULOMB_PER_MAH
from mmrjax.model.robot import Robot
from mmrjax.model.signals import NOT_SETTLED, STATUSES
from sweeps.pages import words
from sweeps.report import catalogue, drive_curves
from sweeps.report.document import Cell, Document, Figure, Note, Section, Table, columns

#: Number of missed requirements that the statement names.
NAMED = 3


@dataclasses.dataclass(frozen=True)
class CheckResult:
    """Requirements and their outcomes for one robot.

    Attributes:
        requirements: the requirements.
        robot: the robot.
        outcomes: one for each requirement, in order.
    """

    requirements: Requirements
    robot: Robot
    outcomes: tuple[RequirementOutcome, ...]

    @property
    def missed(self) -> list[RequirementOutcome]:
        return [o for o in self.outcomes if not o.met]

    def statement(self) -> str:
        """The answer: number of requirements that are met, and those missed by the largest share of their limits."""
        number = len(self.outcomes)
        missed = self.missed
        if not missed:
            return f"All {number} requirements are met." if number > 1 else "The requirement is met."
        missed.sort(key=lambda o: -math.inf if o.margin is None else o.margin / max(abs(requirement_limit(o)), 1e-12))
        parts = [
            f"{requirement_label(o)} "
            + (
                f"({reached_value_text(o)})"
                if o.margin is None
                else f"{reached_value_text(o)}, required {required_value_text(o)}"
            )
            for o in missed[:NAMED]
        ]
        others = len(missed) - len(parts)
        count = f"{len(missed)} of {number} requirements {'is' if len(missed) == 1 else 'are'} missed"
        return f"{count}{'. Worst' * (others > 0)}: {'; '.join(parts)}{f'; and {others} more' if others > 0 else ''}."

    def to_json(self) -> Json:
        """`result.json`."""
        return {
            "schema": "mmrjax.check/1",
            "statement": self.statement(),
            "source": self.requirements.source,
            **sheet.count_outcomes(self.outcomes),
            "requirements": self.outcomes,
        }


def requirement_label(outcome: RequirementOutcome) -> str:
    """Name of a requirement, including its duty."""
    corner = outcome.at
    label = outcome.requirement.quantity.label
    if "duty" not in corner:
        return label
    return f"{label} {corner['duty']}" + (
        f" {100 * corner['share']:g} % of the time" if corner["share"] else " still"
    )


def requirement_limit(outcome: RequirementOutcome) -> float:
    """Required value, or the rating of the part."""
    limit = outcome.requirement.limit
    assert limit is not None
    return limit


def required_value_text(outcome: RequirementOutcome) -> str:
    """Required value with its sense and unit, as in `≥ 0.9 m/s`."""
    r = outcome.requirement
    return f"{'≥' if r.least else '≤'} {three_digits(requirement_limit(outcome))} {r.quantity.unit}"


def reached_value_text(outcome: RequirementOutcome) -> str:
    """Value with its unit, or the reason for having none."""
    quantity = outcome.requirement.quantity
    if outcome.value is not None:
        return f"{three_digits(outcome.value)} {quantity.unit}"
    no_turn = quantity.group == "turn" and outcome.status == STATUSES[NOT_SETTLED]
    return words.NO_TURN if no_turn else words.OUTCOMES.get(outcome.status) or words.status_meaning(outcome.status)


_CORNER_FORMS = {
    "payload_kg": "{} kg", "slope_deg": "{}°", "state_of_charge": "{} % charged", "supply_voltage_V": "{} V",
    "ambient_C": "{} °C",
}  # fmt: skip


def worst_corner_text(outcome: RequirementOutcome) -> str:
    """The worst corner in words."""
    parts = []
    for key, form in _CORNER_FORMS.items():
        if key in outcome.at:
            values = np.atleast_1d(outcome.at[key]) * (100 if key == "state_of_charge" else 1)
            parts.append(form.format(" to ".join(f"{v:g}" for v in values[::-1])))
    return ", ".join(parts)


#: Number of changes for each missed requirement on the terminal.
CHANGES_SHOWN = 3


def check_document(result: CheckResult, robot_name: str, changes: bool = True) -> Document:
    """The report. `changes`: True if changes were searched for."""
    lead = f"Robot: **{robot_name}**. Requirements: **{result.requirements.source}**."
    sections = []
    if changes and result.missed:
        sections.append(Section("Changes that would meet them", _blocks_of_changes(result), "changes"))
    sections.append(Section("Motor and gear", (_chart(result.robot, result.outcomes),)))
    blocks = Note(lead, "lead"), requirements_sheet(result.outcomes), catalogue.note("check.corners")
    return Document("Requirements", result.statement(), blocks, tuple(sections))


def _chart(robot: Robot, outcomes: Sequence[RequirementOutcome]) -> Figure:
    """Chart of motor and gear with the worst corners."""
    corners = [o.at for o in outcomes]
    return catalogue.figure("run.chart_of_corners", values=lambda: drive_curves.chart_of_corners(robot, corners))


def requirements_sheet(outcomes: Sequence[RequirementOutcome], terminal: bool = True) -> Table:
    """Table of requirements with required and reached values, margins and worst corners."""
    rows = [
        (
            Cell(*(("met", "good") if o.met else ("missed", "bad"))), requirement_label(o), required_value_text(o),
            reached_value_text(o),
            None if o.margin is None else f"{'+' if o.margin >= 0 else '−'}{three_digits(abs(o.margin))}",
            worst_corner_text(o), f"{o.at['configuration']}, {o.at['surface'].replace('_', ' ')}",
            o.requirement.source,
        )
        for o in outcomes
    ]  # fmt: skip
    return catalogue.table("check.requirements", rows, terminal=terminal)


def _blocks_of_changes(result: CheckResult) -> tuple[Note | Table, ...]:
    """Table of the single changes that would meet a missed requirement."""
    rows = list[tuple[object, ...]]()
    brief = list[int]()
    out_of_reach = list[str]()
    for o in result.missed:
        requirement = f"{requirement_label(o)} {required_value_text(o)}"
        brief += range(len(rows), len(rows) + min(len(o.change), CHANGES_SHOWN))
        for c in o.change:
            unit = f"C ({c.after / COULOMB_PER_MAH:.0f} mAh)" if c.unit == "C" else c.unit
            percent, breaks = 100 * (c.after / c.before - 1), ", ".join(c.breaks) or "nothing more"
            rows.append((requirement, f"`{c.parameter}`", c.before, c.after, unit, percent, breaks))
        out_of_reach += [requirement] * (not o.change)
    more = f", {len(rows) - len(brief)} more in result.json" if len(rows) > len(brief) else ""
    title = f"changes of a single parameter that would meet them{more}"
    out_of_reach_sentence = f"No change of a single parameter within its bounds meets {', '.join(out_of_reach)}."
    return (
        catalogue.note("check.changes"),
        catalogue.table("check.change", rows, title=title, brief=brief),
        *[Note(out_of_reach_sentence, terminal=True)] * bool(out_of_reach),
    )


@dataclasses.dataclass(frozen=True)
class SizeResult:
    """Designs for some requirements.

    Attributes:
        requirements: the requirements.
        robot: initial robot of the search.
        sizing: result of the search.
        objectives: minimised numbers.
        outcomes: results of `check` for the best design, empty without one.
    """

    requirements: Requirements
    robot: Robot
    sizing: SizingResult
    objectives: Names
    outcomes: tuple[RequirementOutcome, ...]

    def statement(self) -> str:
        """The answer: the best design and its binding limits, or the nearest design and the limits that it misses."""
        sizing = self.sizing
        dropped_sentence = (
            f" No parts meet the requirement on {' or '.join(sizing.unmeetable)} (dropped)."
            if sizing.unmeetable
            else ""
        )
        if sizing.best is None:

            def shortfall(design: SizedDesign) -> float:
                return sum(max(-m, 0.0) for m in design.margins.values())

            nearest = min(sizing.motors.values(), key=shortfall, default=None)
            nearest_sentence = "" if nearest is None else (
                f" The nearest, {describe_design(nearest)}, misses {', '.join(missed_limits(nearest))}."
            )  # fmt: skip
            return f"{catalogue.text('size.none')}{nearest_sentence}{dropped_sentence}"
        missing = [
            requirement_label(o) for o in self.outcomes if not (o.met or requirement_label(o) in sizing.unmeetable)
        ]
        limits_sentence = f" Binding limits: {', '.join(sizing.best.binds) or 'none'}."
        limits_sentence += f" It misses {', '.join(missing)}." if missing else ""
        design = f"{describe_design(sizing.best)}: {objective_text(sizing.best, sizing.objective)}."
        return f"{design}{limits_sentence}{dropped_sentence}"

    def to_json(self) -> Json:
        """`result.json`."""
        return {
            "schema": "mmrjax.size/2",
            "statement": self.statement(),
            **writing.entries_of(self, "source=requirements.source", "objectives"),
            **writing.entries_of(self.sizing, "unmeetable", "best", "ideal", "alternatives"),
            "motors": list(self.sizing.motors.values()),
            **writing.entries_of(self, "pareto=sizing.front", "requirements=outcomes"),
            "evaluated": self.sizing.evaluated,
        }


def design_verdict(design: SizedDesign, unmeetable: Names) -> str:
    """Verdict on a design. `unmeetable`: requirements that no choice of parts meets, which were ignored."""
    return "misses" if not design.feasible else "meets the others" if unmeetable else "meets"


def missed_limits(design: SizedDesign) -> list[str]:
    """Limits that a design misses, with their margins."""
    return [f"{label} ({100 * m:+.1f} %)" for label, m in sorted(design.margins.items(), key=lambda x: x[1]) if m < 0]


def describe_design(design: SizedDesign) -> str:
    """Motor, gearbox, ratio, radius and cells of a design."""
    stages = count_noun(design.drive.stages, "stage")
    return (
        f"{design.drive.motor.name}, {design.drive.family} with {stages}, ratio {design.ratio:.4g}, radius "
        f"{1000 * design.radius:.1f} mm, {design.in_series} × {design.parallel:.3g} {design.cell.name}"
    )


def objective_text(design: SizedDesign, name: str) -> str:
    """Objective with its unit, or `not stated` if no data sheet states it."""
    unit, label = OBJECTIVES[name]
    return f"{label} {design.objectives[name]:.4g} {unit}" if name in design.objectives else f"{label} not stated"


_HEADINGS = {"mass": "mass", "energy": "energy", "cost": "price of motors and gearboxes"}
COLUMNS = columns(
    "", "motor", "gearbox", "total ratio | .4g", "radius [mm] | .1f", "cells",
    *(f"{_HEADINGS[name]} [{unit}] | .4g" for name, (unit, _) in OBJECTIVES.items()), "binding limits, or misses",
)  # fmt: skip


#: Number of motors in the table of a terminal, and of further designs in its few lines.
ALTERNATIVES, NEXT = 5, 2


def size_document(result: SizeResult, robot_name: str) -> Document:
    """Report of a search that started from the named robot."""
    sizing = result.sizing
    objective_words = ", ".join(OBJECTIVES[name][1] for name in result.objectives)
    lead = (
        f"Requirements: **{result.requirements.source}**. Starting from: **{robot_name}**. Minimised: "
        f"**{objective_words}**. {sizing.evaluated:,} designs were evaluated."
    )
    best = () if sizing.best is None else (sizing.best, *sizing.alternatives)
    introduction = catalogue.note("size.designs" if best else "size.none")
    tables = _table("best", result, best), requirements_sheet(result.outcomes, terminal=False)
    motors = _table(
        "by_motor", result, sizing.motors.values(), "best design of each motor, the first five", terminal=True
    )
    designs = [
        f"{describe_design(design)} ({objective_text(design, sizing.objective)})" for design in sizing.alternatives
    ]
    next_best = (f"Next best: {'. '.join(designs[:NEXT])}.",) if designs else ()
    front_sentences: Names = ()
    if sizing.front:
        (first, second) = result.objectives
        (low, *_, high) = (sizing.front[0], *sizing.front)
        front_sentences = (
            f"{count_noun(len(sizing.front), 'design')} on the Pareto front of {first} and {second}, from "
            f"{objective_text(low, first)} to {objective_text(high, second)}.",
        )
    front = [b for x in front_sentences for b in (Note(x, terminal=True), _table("front", result, sizing.front))]
    sections = [
        Section("Designs", (introduction, *tables), "designs"),
        Section("Every motor", (catalogue.note("size.motors"), motors), "motors"),
    ]
    if sizing.best is not None:
        sections.append(Section("Motor and gear", (_chart(sizing.best.robot, result.outcomes),)))
    return Document(
        "Sizing", result.statement(), (Note(lead, "lead"), *front), tuple(sections),
        brief=(lead, *next_best, *front_sentences),
    )  # fmt: skip


def _table(
    name: str, result: SizeResult, designs: Iterable[SizedDesign], title: str = "", terminal: bool = False
) -> Table:
    unmeetable = result.sizing.unmeetable
    rows = [
        (
            Cell(design_verdict(d, unmeetable), ("fair" if unmeetable else "good") if d.feasible else "bad"),
            d.drive.motor.name,
            f"{d.drive.family}, {count_noun(d.drive.stages, 'stage')}", d.ratio, 1000 * d.radius,
            f"{d.in_series} × {d.parallel:.3g} {d.cell.name}", *(d.objectives.get(k) for k in OBJECTIVES),
            ", ".join(d.binds if d.feasible else missed_limits(d)) or "none",
        )
        for d in designs
    ]  # fmt: skip
    return Table(name, COLUMNS, rows, title, terminal=terminal, brief=range(min(ALTERNATIVES, len(rows))))
