"""Reports of requirements: how a robot meets them, and the search for one that does."""

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
        asked: the requirements.
        robot: the robot.
        outcomes: one for each requirement, in order.
    """

    asked: Requirements
    robot: Robot
    outcomes: tuple[RequirementOutcome, ...]

    @property
    def missed(self) -> list[RequirementOutcome]:
        return [o for o in self.outcomes if not o.met]

    def statement(self) -> str:
        """The answer: number of requirements that are met, and those missed by the largest share of their limits."""
        number, missed = len(self.outcomes), self.missed
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
        more = len(missed) - len(parts)
        count = f"{len(missed)} of {number} requirements {'is' if len(missed) == 1 else 'are'} missed"
        return f"{count}{'. Worst' * (more > 0)}: {'; '.join(parts)}{f'; and {more} more' if more > 0 else ''}."

    def to_json(self) -> Json:
        """`result.json`."""
        return {
            "schema": "mmrjax.check/1",
            "statement": self.statement(),
            "source": self.asked.source,
            **sheet.count_outcomes(self.outcomes),
            "requirements": self.outcomes,
        }


def requirement_label(outcome: RequirementOutcome) -> str:
    """Name of a requirement, including its duty."""
    point, label = outcome.at, outcome.requirement.quantity.label
    if "duty" not in point:
        return label
    return f"{label} {point['duty']}" + (f" {100 * point['share']:g} % of the time" if point["share"] else " still")


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


_PLACES = {
    "payload_kg": "{} kg", "slope_deg": "{}°", "state_of_charge": "{} % charged", "supply_voltage_V": "{} V",
    "ambient_C": "{} °C",
}  # fmt: skip


def worst_corner_text(outcome: RequirementOutcome) -> str:
    """The worst corner in words."""
    parts = []
    for key, form in _PLACES.items():
        if key in outcome.at:
            values = np.atleast_1d(outcome.at[key]) * (100 if key == "state_of_charge" else 1)
            parts.append(form.format(" to ".join(f"{v:g}" for v in values[::-1])))
    return ", ".join(parts)


#: Number of changes for each missed requirement on the terminal.
SHOWN = 3


def check_document(found: CheckResult, robot_name: str, changes: bool = True) -> Document:
    """The report. `changes`: True if changes were searched for."""
    lead = f"Robot: **{robot_name}**. Requirements: **{found.asked.source}**."
    sections = []
    if changes and found.missed:
        sections.append(Section("Changes that would meet them", _blocks_of_changes(found), "changes"))
    sections.append(Section("Motor and gear", (_chart(found.robot, found.outcomes),)))
    blocks = Note(lead, "lead"), requirements_sheet(found.outcomes), catalogue.note("check.corners")
    return Document("Requirements", found.statement(), blocks, tuple(sections))


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


def _blocks_of_changes(found: CheckResult) -> tuple[Note | Table, ...]:
    """Table of the single changes that would meet a missed requirement."""
    rows, brief, hopeless = list[tuple[object, ...]](), list[int](), list[str]()
    for o in found.missed:
        requirement = f"{requirement_label(o)} {required_value_text(o)}"
        brief += range(len(rows), len(rows) + min(len(o.change), SHOWN))
        for c in o.change:
            unit = f"C ({c.after / COULOMB_PER_MAH:.0f} mAh)" if c.unit == "C" else c.unit
            percent, breaks = 100 * (c.after / c.before - 1), ", ".join(c.breaks) or "nothing more"
            rows.append((requirement, f"`{c.parameter}`", c.before, c.after, unit, percent, breaks))
        hopeless += [requirement] * (not o.change)
    more = f", {len(rows) - len(brief)} more in result.json" if len(rows) > len(brief) else ""
    title = f"changes of a single parameter that would meet them{more}"
    hopeless_sentence = f"No change of a single parameter within its bounds meets {', '.join(hopeless)}."
    return (
        catalogue.note("check.changes"),
        catalogue.table("check.change", rows, title=title, brief=brief),
        *[Note(hopeless_sentence, terminal=True)] * bool(hopeless),
    )


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

            def shortfall(f: SizedDesign) -> float:
                return sum(max(-m, 0.0) for m in f.margins.values())

            nearest = min(s.motors.values(), key=shortfall, default=None)
            why = "" if nearest is None else (
                f" The nearest, {describe_design(nearest)}, misses {', '.join(missed_limits(nearest))}."
            )  # fmt: skip
            return f"{catalogue.text('size.none')}{why}{left_out}"
        missing = [requirement_label(o) for o in self.outcomes if not (o.met or requirement_label(o) in s.unmeetable)]
        binds = f" Binding limits: {', '.join(s.best.binds) or 'none'}."
        binds += f" It misses {', '.join(missing)}." if missing else ""
        return f"{describe_design(s.best)}: {objective_text(s.best, s.objective)}.{binds}{left_out}"

    def to_json(self) -> Json:
        """`result.json`."""
        return {
            "schema": "mmrjax.size/2",
            "statement": self.statement(),
            **writing.entries_of(self, "source=asked.source", "objectives"),
            **writing.entries_of(self.sizing, "unmeetable", "best", "ideal", "alternatives"),
            "motors": list(self.sizing.motors.values()),
            **writing.entries_of(self, "pareto=sizing.front", "requirements=outcomes"),
            "evaluated": self.sizing.evaluated,
        }


def design_verdict(found: SizedDesign, unmeetable: Names) -> str:
    """Verdict on a design. `unmeetable`: requirements that no choice of parts meets, which were ignored."""
    return "misses" if not found.feasible else "meets the others" if unmeetable else "meets"


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
ALTERNATIVES, NEXT = 5, 2


def size_document(found: SizeResult, robot_name: str) -> Document:
    """Report of a search that started from the named robot."""
    s, objective_words = found.sizing, ", ".join(OBJECTIVES[name][1] for name in found.objectives)
    lead = (
        f"Requirements: **{found.asked.source}**. Starting from: **{robot_name}**. Minimised: **{objective_words}**. "
        f"{s.evaluated:,} designs were evaluated."
    )
    best = () if s.best is None else (s.best, *s.alternatives)
    about = catalogue.note("size.designs" if best else "size.none")
    tables = _table("best", found, best), requirements_sheet(found.outcomes, terminal=False)
    motors = _table("by_motor", found, s.motors.values(), "best design of each motor, the first five", terminal=True)
    designs = [f"{describe_design(f)} ({objective_text(f, s.objective)})" for f in s.alternatives]
    next_best = (f"Next best: {'. '.join(designs[:NEXT])}.",) if designs else ()
    front_words: Names = ()
    if s.front:
        (first, second), (low, *_, high) = found.objectives, (s.front[0], *s.front)
        front_words = (
            f"{count_noun(len(s.front), 'design')} on the Pareto front of {first} and {second}, from "
            f"{objective_text(low, first)} to {objective_text(high, second)}.",
        )
    front = [b for x in front_words for b in (Note(x, terminal=True), _table("front", found, s.front))]
    sections = [
        Section("Designs", (about, *tables), "designs"),
        Section("Every motor", (catalogue.note("size.motors"), motors), "motors"),
    ]
    if s.best is not None:
        sections.append(Section("Motor and gear", (_chart(s.best.robot, found.outcomes),)))
    return Document(
        "Sizing", found.statement(), (Note(lead, "lead"), *front), tuple(sections),
        brief=(lead, *next_best, *front_words),
    )  # fmt: skip


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
    return Table(name, COLUMNS, rows, title, terminal=terminal, brief=range(min(ALTERNATIVES, len(rows))))
