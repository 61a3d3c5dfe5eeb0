"""Report of `check`: requirements with their margins, and changes that would meet the missed ones."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence

import numpy as np

from calibration.data import Json
from calibration.data.input_errors import three_digits
from calibration.data.requirements_file import Requirements
from calibration.sizing import sheet
from calibration.sizing.sheet import ParameterChange, RequirementOutcome
from mmrjax.model.paper_tables import COULOMB_PER_MAH
from mmrjax.model.robot import Robot
from mmrjax.model.signals import NOT_SETTLED, STATUSES
from sweeps.pages import words
from sweeps.report import catalogue, run_tables
from sweeps.report.document import Cell, Document, Note, Section, Table

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
        number, missed = len(self.outcomes), sorted(self.missed, key=_margin_share)
        if not missed:
            return f"All {number} requirements are met." if number > 1 else "The requirement is met."
        verb = "is" if len(missed) == 1 else "are"
        shortfalls = "; ".join(f"{requirement_label(o)} {shortfall_text(o)}" for o in missed[:NAMED])
        others_text = f"; and {len(missed) - NAMED} more" if len(missed) > NAMED else ""
        worst = ":" if len(missed) <= NAMED else ". Worst:"
        return f"{len(missed)} of {number} requirements {verb} missed{worst} {shortfalls}{others_text}."

    def to_json(self) -> Json:
        """`result.json`."""
        return {
            "schema": "mmrjax.check/1",
            "statement": self.statement(),
            "source": self.asked.source,
            **sheet.count_outcomes(self.outcomes),
            "requirements": self.outcomes,
        }


def _margin_share(outcome: RequirementOutcome) -> float:
    """Margin as a share of the limit [-]. -inf for a requirement without a value."""
    return -math.inf if outcome.margin is None else outcome.margin / max(abs(requirement_limit(outcome)), 1e-12)


def requirement_label(outcome: RequirementOutcome) -> str:
    """Name of a requirement, including its duty."""
    point = outcome.at
    duty = ""
    if "duty" in point:
        duty = f" {point['duty']}" + (f" {100 * point['share']:g} % of the time" if point["share"] else " still")
    return f"{outcome.requirement.quantity.label}{duty}"


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


def shortfall_text(outcome: RequirementOutcome) -> str:
    """Value and its limit."""
    if outcome.value is None or outcome.margin is None:
        return f"({reached_value_text(outcome)})"
    return f"{reached_value_text(outcome)}, required {required_value_text(outcome)}"


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
        sections.append(Section("Changes that would meet them", _changes(found), "changes"))
    corners = [o.at for o in found.outcomes]
    robot, figures = found.robot, [catalogue.figure("run.chart_of_corners", found.robot, corners)]
    if float(robot.gearbox.efficiency_load) < 1 or run_tables.lost_by_load(robot):
        volts = float(robot.battery.voltage_no_load(0.0))
        figures.append(catalogue.figure("run.drive_plane", robot, volts, words=(volts,)))
    sections.append(Section("Motor and gear", tuple(figures)))
    blocks = Note(lead, "lead"), requirements_sheet(found.outcomes), catalogue.note("check.corners")
    return Document("Requirements", found.statement(), blocks, tuple(sections))


def requirements_sheet(outcomes: Sequence[RequirementOutcome], terminal: bool = True) -> Table:
    """Table of requirements with required and reached values, margins and worst corners."""
    rows = [
        (
            Cell(*(("met", "good") if o.met else ("missed", "bad"))), requirement_label(o),
            required_value_text(o), reached_value_text(o), _margin(o), worst_corner_text(o),
            f"{o.at['configuration']}, {o.at['surface'].replace('_', ' ')}", o.requirement.source,
        )
        for o in outcomes
    ]  # fmt: skip
    return catalogue.table("check.requirements", rows, terminal=terminal)


def _changes(found: CheckResult) -> tuple[Note | Table, ...]:
    rows: list[tuple[object, ...]] = []
    brief: list[int] = []
    for o in found.missed:
        brief += range(len(rows), len(rows) + min(len(o.change), SHOWN))
        rows += [(f"{requirement_label(o)} {required_value_text(o)}", *_change(c)) for c in o.change]
    hopeless = [f"{requirement_label(o)} {required_value_text(o)}" for o in found.missed if not o.change]
    others_text = f", {len(rows) - len(brief)} more in result.json" if len(rows) > len(brief) else ""
    title = f"changes of a single parameter that would meet them{others_text}"
    hopeless_sentence = f"No change of a single parameter within its bounds meets {', '.join(hopeless)}."
    return (
        catalogue.note("check.changes"),
        catalogue.table("check.change", rows, title=title, brief=brief),
        *([Note(hopeless_sentence, terminal=True)] if hopeless else []),
    )  # fmt: skip


def _change(c: ParameterChange) -> tuple[object, ...]:
    breaks = ", ".join(c.breaks) or "nothing more"
    unit = f"C ({c.after / COULOMB_PER_MAH:.0f} mAh)" if c.unit == "C" else c.unit
    return f"`{c.parameter}`", c.before, c.after, unit, 100 * (c.after / c.before - 1), breaks


def _margin(o: RequirementOutcome) -> str | None:
    return None if o.margin is None else f"{'+' if o.margin >= 0 else '−'}{three_digits(abs(o.margin))}"
