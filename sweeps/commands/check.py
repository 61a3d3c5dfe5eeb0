"""The command `check`: compare a robot with requirements. Each passes or fails by a margin."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

import numpy as np

from calibration.data import requirements_file
from calibration.data.input_errors import BadConfiguration
from calibration.described import report_in_words
from calibration.sizing import sheet
from mmrjax.derived.requirements import OF_HEAT
from mmrjax.model.quantities import CHARGE, HEAT
from sweeps import capabilities
from sweeps import config as configuration
from sweeps.console import print_message, step_reporter
from sweeps.inputs import load_robot
from sweeps.pages import words
from sweeps.report import check_report
from sweeps.report.check_report import CheckResult, requirement_limit, worst_corner_text
from sweeps.store import finish_run_folder, open_folder, print_report

#: Columns of requirements.csv.
COLUMNS = ("name", "sense", "required", "value", "margin", "unit", "met", "status", "at")


def execute(config: configuration.Check, invocation: configuration.FolderPart) -> int:
    """Compares a robot with requirements and writes a run folder. Returns the exit code.

    The code is 0 whether or not requirements are missed, and 3 if the solver failed at a worst corner.
    """
    requirements = requirements_file.load_requirements(Path(config.requirements))
    file = load_robot(config)
    robot = file.robot
    capabilities.check_on_ground(robot, "check")
    sheet.reject_impossible(robot, requirements)
    for requirement in requirements.each:
        needs_charge = CHARGE in requirement.quantity.axes or requirement.quantity.group == "endurance"
        if needs_charge and requirement.envelope.battery and not capabilities.has_battery(robot):
            raise BadConfiguration(
                f"{requirements.source}, {requirement.name}: the robot's file has no battery; add it, or set "
                "supply_voltage_V in [envelope]"
            )
    lacking = robot.unknown(HEAT)
    for requirement in requirements.each:
        if lacking and requirement.name in OF_HEAT:
            raise BadConfiguration(
                f"{requirements.source}, {requirement.name}: needs the winding temperature, for which the robot's "
                f"file lacks {', '.join(lacking)}; add them"
            )
    with open_folder("check", config, robot, invocation) as folder:
        with step_reporter(print_message, "reading the requirements") as report:
            outcomes = sheet.check_requirements(
                robot, requirements, changes=config.changes, tell=report_in_words(report)
            )
            result = CheckResult(requirements, robot, outcomes)
        folder.write_text("requirements.toml", requirements.text)
        rows = [
            (r.name, r.sense, requirement_limit(o), np.nan if o.value is None else o.value,
             np.nan if o.margin is None else o.margin, r.quantity.unit, o.met, o.status, worst_corner_text(o))
            for o in outcomes for r in (o.requirement,)
        ]  # fmt: skip
        columns = zip(COLUMNS, zip(*rows, strict=True), strict=True)
        folder.write_table("requirements.csv", {name: np.array(values) for name, values in columns})
        folder.write_json("result.json", result.to_json())
        page = print_report(
            check_report.check_document(result, capabilities.displayed_name(file), config.changes), file
        )
        manifest = {"seed": None, **sheet.count_outcomes(result.outcomes)}
        solved = words.every_run_solved(Counter(outcome.status for outcome in result.outcomes))
        return finish_run_folder(folder, manifest, page, solved)
