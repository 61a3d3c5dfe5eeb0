"""The report of `check`: requirements with their margins, and changes that would meet the missed ones."""

from __future__ import annotations

from collections.abc import Sequence

from calibration.data.input_errors import three_digits
from calibration.sizing.sheet import Change, Outcome
from mmrjax.model.paper_tables import COULOMB_PER_MAH
from sweeps.report import catalogue
from sweeps.report.document import Block, Cell, Document, Figure, Note, Section, Table
from sweeps.results.check_results import (
    CheckResult,
    reached_value_text,
    required_value_text,
    requirement_label,
    worst_corner_text,
)

#: Changes that the terminal shows of each missed requirement.
SHOWN = 3


def check_document(found: CheckResult, robot_name: str, changes: bool = True) -> Document:
    """The report; `changes`: True where changes were searched for."""
    lead = f"Robot: **{robot_name}**. Requirements: **{found.asked.source}**."
    margins = catalogue.figure("check.margins", found, finding=found.statement())
    sections = [
        Section("Requirements", (catalogue.note("check.corners"), requirements_sheet(found.outcomes)), "sheet")
    ]
    if changes and found.missed:
        sections.append(Section("Changes that would meet them", _changes(found), "changes"))
    blocks: tuple[Block, ...] = (Note(lead, "lead"), margins, *_postures(found))
    return Document("Requirements", found.statement(), blocks, tuple(sections))


def requirements_sheet(outcomes: Sequence[Outcome], terminal: bool = True) -> Table:
    """Requirements with required and reached values, margins and worst corners."""
    rows = [
        (
            Cell(*(("met", "good") if o.met else ("missed", "bad"))), requirement_label(o),
            required_value_text(o), reached_value_text(o), _margin(o), worst_corner_text(o),
            f"{o.at['configuration']}, {o.at['surface'].replace('_', ' ')}", o.requirement.source,
        )
        for o in outcomes
    ]  # fmt: skip
    return catalogue.table("check.requirements", rows, terminal=terminal)


def _postures(found: CheckResult) -> tuple[Figure, ...]:
    if not found.drawn:
        return ()
    names = ", ".join(
        f"{requirement_label(o)} {reached_value_text(o)}" for o in found.outcomes if o.requirement.name in found.drawn
    )
    title = f"The robot from the side: {names}"
    return (catalogue.figure("check.postures", found.drawn, finding=title),)


def _changes(found: CheckResult) -> tuple[Note | Table, ...]:
    rows: list[tuple[object, ...]] = []
    brief: list[int] = []
    for o in found.missed:
        brief += range(len(rows), len(rows) + min(len(o.change), SHOWN))
        rows += [(f"{requirement_label(o)} {required_value_text(o)}", *_change(c)) for c in o.change]
    hopeless = [f"{requirement_label(o)} {required_value_text(o)}" for o in found.missed if not o.change]
    more = f", {len(rows) - len(brief)} more in result.json" if len(rows) > len(brief) else ""
    title = f"changes of one parameter that would meet them{more}"
    none = f"No change of one parameter within its bounds meets {', '.join(hopeless)}."
    return (
        catalogue.note("check.changes"),
        catalogue.table("check.change", rows, title=title, brief=brief),
        *([Note(none, terminal=True)] if hopeless else []),
    )  # fmt: skip


def _change(c: Change) -> tuple[object, ...]:
    breaks = ", ".join(c.breaks) or "nothing more"
    unit = f"C ({c.after / COULOMB_PER_MAH:.0f} mAh)" if c.unit == "C" else c.unit
    return f"`{c.parameter}`", c.before, c.after, unit, 100 * (c.after / c.before - 1), breaks


def _margin(o: Outcome) -> str | None:
    return None if o.margin is None else f"{'+' if o.margin >= 0 else '−'}{three_digits(abs(o.margin))}"
