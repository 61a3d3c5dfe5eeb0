"""What the command `check` found: requirements with what is reached, in words."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any

import numpy as np

from calibration.data.input_errors import rounded
from calibration.data.requirements_file import Requirements
from calibration.sizing import sheet
from calibration.sizing.sheet import Change, Outcome
from mmrjax.model.paper_tables import COULOMB_PER_MAH
from mmrjax.model.robot import Robot
from mmrjax.model.signals import NOT_SETTLED, STATUSES
from sweeps.pages import words
from sweeps.results.posture_results import Drawn


@dataclasses.dataclass(frozen=True)
class CheckResult:
    """What the command found.

    Attributes:
        asked: the requirements; robot: that was held against them; outcomes: one each, in order.
        drawn: the robot as requirements of its geometry ask about it, see `posture.of_requirements`.
    """

    asked: Requirements
    robot: Robot
    outcomes: tuple[Outcome, ...]
    drawn: Mapping[str, tuple[Drawn, float, float]] = dataclasses.field(default_factory=dict)

    @property
    def missed(self) -> list[Outcome]:
        """What does not hold."""
        return [o for o in self.outcomes if not o.met]

    def statement(self) -> str:
        """The sheet in a sentence."""
        number = len(self.outcomes)
        if not self.missed:
            return f"All {number} requirements are met." if number > 1 else "The requirement is met."
        each = "; ".join(f"{label(o)} {shortfall(o)}" for o in self.missed)
        verb = "is" if len(self.missed) == 1 else "are"
        return f"{len(self.missed)} of {number} requirements {verb} missed: {each}."

    def to_json(self) -> dict[str, Any]:
        """`result.json`."""
        return {
            "schema": "mmrjax.check/1",
            "statement": self.statement(),
            "source": self.asked.source,
            **sheet.count_outcomes(self.outcomes),
            "requirements": [o.to_json() for o in self.outcomes],
        }


def label(outcome: Outcome) -> str:
    """A requirement in words."""
    at = outcome.at
    duty = ""
    if "duty" in at:
        duty = f" {at['duty']}" + (f" {100 * at['share']:g} % of the time" if at["share"] else " still")
    return f"{outcome.requirement.quantity.label}{duty}"


def limit(outcome: Outcome) -> float:
    """What is required, a rating in place."""
    found = outcome.requirement.limit
    assert found is not None
    return found


def wanted(outcome: Outcome) -> str:
    """What is required."""
    r = outcome.requirement
    return f"{'≥' if r.least else '≤'} {rounded(limit(outcome))} {r.quantity.unit}"


def reached(outcome: Outcome) -> str:
    """The value with its unit, or why there is none."""
    quantity = outcome.requirement.quantity
    if outcome.value is not None:
        return f"{rounded(outcome.value)} {quantity.unit}"
    no_turn = quantity.group == "turn" and outcome.status == STATUSES[NOT_SETTLED]
    return words.NO_TURN if no_turn else words.why(outcome.status)


def shortfall(outcome: Outcome) -> str:
    """By how much it is missed."""
    r = outcome.requirement
    if outcome.value is None or outcome.margin is None:
        return f"({reached(outcome)})"
    way = "below" if r.least else "above"
    return f"{reached(outcome)}, {rounded(-outcome.margin)} {way} {rounded(limit(outcome))}"


_PLACES = {
    "payload_kg": "{} kg", "slope_deg": "{}°", "state_of_charge": "{} % charged", "supply_voltage_V": "{} V",
    "ambient_C": "{} °C",
}  # fmt: skip


def corner(outcome: Outcome) -> str:
    """The worst corner in words."""
    parts = []
    for key, form in _PLACES.items():
        if key in outcome.at:
            values = np.atleast_1d(outcome.at[key]) * (100 if key == "state_of_charge" else 1)
            parts.append(form.format(" to ".join(f"{v:g}" for v in values[::-1])))
    return ", ".join(parts)


def changed(change: Change) -> str:
    """A change in words."""
    unit = "" if change.unit == "-" else f" {change.unit}"
    unit += f" ({change.after / COULOMB_PER_MAH:.0f} mAh)" if change.unit == "C" else ""
    breaks = f" (but then {', '.join(change.breaks)} would be missed)" if change.breaks else ""
    return f"{change.parameter} {change.before:.4g} → {change.after:.6g}{unit}{breaks}"
