"""The report of `check`: requirements with their margins, and changes that would meet the missed ones."""

from __future__ import annotations

from collections.abc import Sequence

from calibration.data.input_errors import three_digits
from calibration.sizing.sheet import Change, Outcome
from mmrjax.model.paper_tables import COULOMB_PER_MAH
from sweeps.report.document import Block, Cell, Document, Figure, Note, Section, Table, columns, deferred_figure
from sweeps.results.check_results import (
    CheckResult,
    reached_value_text,
    required_value_text,
    requirement_label,
    worst_corner_text,
)

#: Changes that the terminal shows of each missed requirement.
SHOWN = 3


_CORNERS = (
    "Each quantity at the worst corner of its envelope of payload, slope, charge (or supply voltage) and ambient "
    "temperature: the ends of each range and values between them. Fidelity: steady. Windings are at ambient "
    "temperature; **winding after long running** is their final temperature, with the resistance that it causes."
)
_MARGINS = (
    "Margin of each requirement at the worst corner of its envelope, in percent of the required value: **right** of "
    "the line it is met, **left** it is missed."
)
_POSTURES = (
    "The robot in the posture of each geometric requirement. Highest step: centre of mass (dot) above its edge. Gap: "
    "levers flush with the belt. Size: folded."
)
_CHANGES = (
    "Each line changes one parameter, with everything else (masses too) as it is, and meets the requirement at "
    "every corner: direction from the derivative at the worst corner, value found by search and verified. Changes "
    "that miss no other requirement come first, the smallest first."
)


def check_document(found: CheckResult, robot_name: str, changes: bool = True) -> Document:
    """The report; `changes`: True where changes were searched for."""
    lead = f"Robot: **{robot_name}**. Requirements: **{found.asked.source}**."
    margins = deferred_figure("margins", found.statement(), _MARGINS, "check_figures.draw_margins", found)
    sections = [Section("Requirements", (Note(_CORNERS), requirements_sheet(found.outcomes)), "sheet")]
    if changes and found.missed:
        sections.append(Section("Changes that would meet them", _changes(found), "changes"))
    blocks: tuple[Block, ...] = (Note(lead, "lead"), margins, *_postures(found))
    return Document("Requirements", found.statement(), blocks, tuple(sections))


def requirements_sheet(outcomes: Sequence[Outcome], terminal: bool = True) -> Table:
    """Requirements with required and reached values, margins and worst corners."""
    heads = columns("", "requirement", "required |", "value |", "margin |", "worst corner", "~on", "~source")
    rows = [
        (
            Cell(*(("met", "good") if o.met else ("missed", "bad"))), requirement_label(o),
            required_value_text(o), reached_value_text(o), _margin(o), worst_corner_text(o),
            f"{o.at['configuration']}, {o.at['surface'].replace('_', ' ')}", o.requirement.source,
        )
        for o in outcomes
    ]  # fmt: skip
    return Table("requirements", heads, rows, terminal=terminal)


def _postures(found: CheckResult) -> tuple[Figure, ...]:
    if not found.drawn:
        return ()
    names = ", ".join(
        f"{requirement_label(o)} {reached_value_text(o)}" for o in found.outcomes if o.requirement.name in found.drawn
    )
    title = f"The robot from the side: {names}"
    return (deferred_figure("postures", title, _POSTURES, "posture_figures.asked_about", found.drawn),)


def _changes(found: CheckResult) -> tuple[Note | Table, ...]:
    heads = columns(
        "requirement", "parameter", "now | .4g", "needed | .6g", "unit", "change [%] | +.1f", "would then be missed"
    )
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
        Note(_CHANGES),
        Table("change", heads, rows, title, brief=brief),
        *([Note(none, terminal=True)] if hopeless else []),
    )  # fmt: skip


def _change(c: Change) -> tuple[object, ...]:
    breaks = ", ".join(c.breaks) or "nothing more"
    unit = f"C ({c.after / COULOMB_PER_MAH:.0f} mAh)" if c.unit == "C" else c.unit
    return f"`{c.parameter}`", c.before, c.after, unit, 100 * (c.after / c.before - 1), breaks


def _margin(o: Outcome) -> str | None:
    return None if o.margin is None else f"{'+' if o.margin >= 0 else '−'}{three_digits(abs(o.margin))}"
