"""The command `check`: a robot held against requirements, a sheet of pass or fail with margins."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
from rich.table import Table

from calibration.data import requirements, robot_file
from calibration.data.requirements import Requirements
from calibration.sizing import sheet
from calibration.sizing.sheet import Change, Outcome
from mmrjax.robot import Robot
from mmrjax.tables import COULOMB_PER_MAH
from sweeps import config as configuration
from sweeps import words
from sweeps.console import say
from sweeps.inputs import load_robot
from sweeps.store import DONE, SOME_NOT_CONVERGED, RunFolder, open_folder

#: Changes that the console shows of each missed requirement.
SHOWN = 3


@dataclasses.dataclass(frozen=True)
class CheckResult:
    """What the command found.

    Attributes:
        asked: the requirements; robot: that was held against them; outcomes: one each, in order.
    """

    asked: Requirements
    robot: Robot
    outcomes: tuple[Outcome, ...]

    @property
    def missed(self) -> list[Outcome]:
        """What does not hold."""
        return [o for o in self.outcomes if not o.met]

    def statement(self) -> str:
        """The sheet in a sentence."""
        if not self.missed:
            return f"All {len(self.outcomes)} requirements are met."
        each = "; ".join(f"{label(o)} {shortfall(o)}" for o in self.missed)
        return f"{len(self.missed)} of {len(self.outcomes)} requirements are missed: {each}."

    def to_json(self) -> dict[str, Any]:
        """`result.json`."""
        return {
            "schema": "mmrjax.check/1",
            "statement": self.statement(),
            "source": self.asked.source,
            **sheet.counts(self.outcomes),
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


def number(value: float) -> str:
    """A value of the sheet: three digits."""
    return f"{value:.0f}" if abs(value) >= 100 else f"{value:.3g}"


def wanted(outcome: Outcome) -> str:
    """What is required."""
    r = outcome.requirement
    return f"{'≥' if r.least else '≤'} {number(limit(outcome))} {r.quantity.unit}"


def reached(outcome: Outcome) -> str:
    """The value with its unit, or why there is none."""
    return (
        words.why(outcome.status)
        if outcome.value is None
        else f"{number(outcome.value)} {outcome.requirement.quantity.unit}"
    )


def shortfall(outcome: Outcome) -> str:
    """By how much it is missed."""
    r = outcome.requirement
    if outcome.value is None or outcome.margin is None:
        return f"({reached(outcome)})"
    way = "below" if r.least else "above"
    return f"{reached(outcome)}, {number(-outcome.margin)} {way} {number(limit(outcome))}"


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


def check(config: configuration.Check, out: Path | None, force: bool) -> int:
    """Hold a robot against requirements and leave a run folder; returns the exit code: 3 where one is missed."""
    asked = requirements.load(Path(config.requirements))
    robot = load_robot(config)
    sheet.refuse(robot, asked)
    with open_folder("check", config, robot, out, force) as folder:
        found = CheckResult(asked, robot, sheet.check(robot, asked, changes=config.changes))
        _write(folder, config, found)
        print_check(found, changes=config.changes)
        if config.report:
            from sweeps import report_check

            report_check.write(folder.partial, found, robot_name=config.robot)
        path = folder.finish({"seed": None, **sheet.counts(found.outcomes)})
        say(str(path))
        return SOME_NOT_CONVERGED if found.missed else DONE


def _write(folder: RunFolder, config: configuration.Check, found: CheckResult) -> None:
    folder.write_text("config.resolved.toml", configuration.as_toml(config))
    folder.write_text("requirements.toml", found.asked.text)
    robot_file.write(found.robot, folder.partial / "robot.toml", note=f"the robot of this check, from {config.robot}")
    folder.write_table("requirements.csv", table(found))
    folder.write_json("result.json", found.to_json())


def table(found: CheckResult) -> dict[str, np.ndarray]:
    """The sheet as a table, a row a requirement."""
    nan = float("nan")
    return {
        "name": np.array([o.requirement.name for o in found.outcomes]),
        "sense": np.array([o.requirement.sense for o in found.outcomes]),
        "required": np.array([limit(o) for o in found.outcomes]),
        "value": np.array([nan if o.value is None else o.value for o in found.outcomes]),
        "margin": np.array([nan if o.margin is None else o.margin for o in found.outcomes]),
        "unit": np.array([o.requirement.quantity.unit for o in found.outcomes]),
        "met": np.array([o.met for o in found.outcomes]),
        "status": np.array([o.status for o in found.outcomes]),
        "at": np.array([corner(o) for o in found.outcomes]),
    }


def print_check(found: CheckResult, changes: bool = True) -> None:
    """The sheet, and what would meet what is missed; for a person."""
    shown = Table(title=f"requirements of {found.asked.source}", box=None, pad_edge=False)
    shown.title_justify = "left"
    for name, side in (("", "left"), ("requirement", "left"), ("required", "right"), ("value", "right")):
        shown.add_column(name, justify=side)  # type: ignore[arg-type]
    shown.add_column("margin", justify="right")
    shown.add_column("at its worst corner")
    for o in found.outcomes:
        margin = "" if o.margin is None else f"{'+' if o.margin >= 0 else '−'}{number(abs(o.margin))}"
        shown.add_row("met" if o.met else "MISSED", label(o), wanted(o), reached(o), margin, corner(o))
    say(shown)
    say(found.statement())
    for o in found.missed if changes else ():
        if o.change:
            more = f"; {len(o.change) - SHOWN} more in result.json" if len(o.change) > SHOWN else ""
            say(f"{label(o)} {wanted(o)} would be met by: {'; or '.join(changed(c) for c in o.change[:SHOWN])}{more}")
        else:
            say(f"{label(o)} {wanted(o)}: no change of one parameter within its bounds was found that meets it")
