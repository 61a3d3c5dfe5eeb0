"""Result of the command `check`: requirements with their values, and words for both."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping

import numpy as np

from calibration.data import Json, writing
from calibration.data.input_errors import three_digits
from calibration.data.requirements_file import Requirements
from calibration.sizing import sheet
from calibration.sizing.sheet import Outcome
from mmrjax.model.robot import Robot
from mmrjax.model.signals import NOT_SETTLED, STATUSES
from sweeps.pages import words
from sweeps.results.posture_results import Drawn

#: Missed requirements that the statement names.
NAMED = 3


@dataclasses.dataclass(frozen=True)
class CheckResult:
    """Requirements and their outcomes for one robot.

    Attributes:
        asked: the requirements; robot: compared with them; outcomes: one for each requirement, in order.
        drawn: the robot in the posture of each geometric requirement, see `posture_results.of_requirements`.
    """

    asked: Requirements
    robot: Robot
    outcomes: tuple[Outcome, ...]
    drawn: Mapping[str, tuple[Drawn, float, float]] = dataclasses.field(default_factory=dict)

    @property
    def missed(self) -> list[Outcome]:
        """Outcomes of the missed requirements."""
        return [o for o in self.outcomes if not o.met]

    def statement(self) -> str:
        """The answer: how many requirements are met, and those missed by most in percent of their limits."""
        number, missed = len(self.outcomes), sorted(self.missed, key=_share)
        if not missed:
            return f"All {number} requirements are met." if number > 1 else "The requirement is met."
        verb = "is" if len(missed) == 1 else "are"
        listed = "; ".join(f"{requirement_label(o)} {shortfall_text(o)}" for o in missed[:NAMED])
        more = f"; and {len(missed) - NAMED} more" if len(missed) > NAMED else ""
        worst = "" if len(missed) <= NAMED else "the worst "
        return f"{len(missed)} of {number} requirements {verb} missed: {worst}{listed}{more}."

    def to_json(self) -> Json:
        """`result.json`."""
        return {
            "schema": "mmrjax.check/1",
            "statement": self.statement(),
            "source": self.asked.source,
            **sheet.count_outcomes(self.outcomes),
            "requirements": writing.json_value(self.outcomes),
        }


def _share(outcome: Outcome) -> float:
    """Margin as a share of the limit [-]; the least for a requirement without a value."""
    return -math.inf if outcome.margin is None else outcome.margin / max(abs(requirement_limit(outcome)), 1e-12)


def requirement_label(outcome: Outcome) -> str:
    """Name of a requirement, with its duty."""
    at = outcome.at
    duty = ""
    if "duty" in at:
        duty = f" {at['duty']}" + (f" {100 * at['share']:g} % of the time" if at["share"] else " still")
    return f"{outcome.requirement.quantity.label}{duty}"


def requirement_limit(outcome: Outcome) -> float:
    """Required value, or the rating of the part."""
    found = outcome.requirement.limit
    assert found is not None
    return found


def required_value_text(outcome: Outcome) -> str:
    """Required value with its sense and unit, as in `≥ 0.9 m/s`."""
    r = outcome.requirement
    return f"{'≥' if r.least else '≤'} {three_digits(requirement_limit(outcome))} {r.quantity.unit}"


def reached_value_text(outcome: Outcome) -> str:
    """Value with its unit, or the reason for having none."""
    quantity = outcome.requirement.quantity
    if outcome.value is not None:
        return f"{three_digits(outcome.value)} {quantity.unit}"
    no_turn = quantity.group == "turn" and outcome.status == STATUSES[NOT_SETTLED]
    return words.NO_TURN if no_turn else words.reason_without_value(outcome.status)


def shortfall_text(outcome: Outcome) -> str:
    """Value and its distance from the limit."""
    r = outcome.requirement
    if outcome.value is None or outcome.margin is None:
        return f"({reached_value_text(outcome)})"
    way = "below" if r.least else "above"
    distance, limit = three_digits(-outcome.margin), three_digits(requirement_limit(outcome))
    return f"{reached_value_text(outcome)}, {distance} {way} {limit}"


_PLACES = {
    "payload_kg": "{} kg", "slope_deg": "{}°", "state_of_charge": "{} % charged", "supply_voltage_V": "{} V",
    "ambient_C": "{} °C",
}  # fmt: skip


def worst_corner_text(outcome: Outcome) -> str:
    """The worst corner in words."""
    parts = []
    for key, form in _PLACES.items():
        if key in outcome.at:
            values = np.atleast_1d(outcome.at[key]) * (100 if key == "state_of_charge" else 1)
            parts.append(form.format(" to ".join(f"{v:g}" for v in values[::-1])))
    return ", ".join(parts)
