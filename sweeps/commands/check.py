"""The command `check`: a robot held against requirements, a sheet of pass or fail with margins."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

import numpy as np
from rich.table import Table

from calibration.data import requirements_file, robot_file
from calibration.data.input_errors import BadConfiguration, rounded
from calibration.sizing import sheet
from mmrjax.derived.requirements import CHARGE, OF_HEAT
from mmrjax.model.channels import HEAT
from mmrjax.model.robot import Robot
from sweeps import capabilities
from sweeps import config as configuration
from sweeps.console import say
from sweeps.inputs import load_robot
from sweeps.pages import words
from sweeps.points import imposed
from sweeps.results import posture_results
from sweeps.results.check_results import CheckResult, changed, corner, label, limit, reached, wanted
from sweeps.skeleton import leave, page
from sweeps.store import RunFolder, open_folder

#: Changes that the console shows of each missed requirement.
SHOWN = 3


def check(config: configuration.Check, out: Path | None, force: bool) -> int:
    """Hold a robot against requirements and leave a run folder; returns the exit code.

    0 done, with what is missed said; 3 where the solver failed at a worst corner.
    """
    asked = requirements_file.load(Path(config.requirements))
    file = load_robot(config)
    robot = file.robot
    imposed.check_on_ground(robot, "check")
    sheet.refuse_impossible(robot, asked)
    _check_charge(robot, asked)
    _check_heat(robot, asked)
    with open_folder("check", config, robot, out, force) as folder:
        outcomes = sheet.check_requirements(robot, asked, changes=config.changes)
        found = CheckResult(asked, robot, outcomes, posture_results.of_requirements(robot, outcomes))
        _write(folder, config, found)
        print_check(found, changes=config.changes)
        manifest = {"seed": None, **sheet.count_outcomes(found.outcomes)}
        return leave(
            folder,
            config,
            manifest,
            solved=words.solved(Counter(o.status for o in found.outcomes)),
            page=page("check", found, file),
        )


def _check_charge(robot: Robot, asked: requirements_file.Requirements) -> None:
    """Refuse requirements on a battery that the robot's file does not state."""
    for r in asked.each:
        depends = CHARGE in r.quantity.axes or r.quantity.group == "endurance"
        if depends and r.envelope.battery and not capabilities.battery(robot):
            raise BadConfiguration(
                f"{asked.source}, {r.name}: the robot's file states no battery; add [battery] to it, or state "
                "supply_voltage_V in [envelope]"
            )


def _check_heat(robot: Robot, asked: requirements_file.Requirements) -> None:
    """Refuse requirements on a winding after long running of which the robot's file does not state how warm it
    becomes."""
    lacking = robot.unknown(HEAT)
    for r in asked.each:
        if lacking and r.name in OF_HEAT:
            raise BadConfiguration(
                f"{asked.source}, {r.name}: rests on how warm the windings become, and the robot's file does not "
                f"state {', '.join(lacking)}; state them, or leave the requirement out"
            )


def _write(folder: RunFolder, config: configuration.Check, found: CheckResult) -> None:
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
        margin = "" if o.margin is None else f"{'+' if o.margin >= 0 else '−'}{rounded(abs(o.margin))}"
        shown.add_row("met" if o.met else "MISSED", label(o), wanted(o), reached(o), margin, corner(o))
    say(shown)
    say(found.statement())
    for o in found.missed if changes else ():
        if o.change:
            more = f"; {len(o.change) - SHOWN} more in result.json" if len(o.change) > SHOWN else ""
            say(f"{label(o)} {wanted(o)} would be met by: {'; or '.join(changed(c) for c in o.change[:SHOWN])}{more}")
        else:
            say(f"{label(o)} {wanted(o)}: no change of one parameter within its bounds was found that meets it")
