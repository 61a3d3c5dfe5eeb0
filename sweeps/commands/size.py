"""The command `size`: searches for a robot that meets requirements."""

from __future__ import annotations

import dataclasses
from collections import Counter
from pathlib import Path

from calibration.data import requirements_file, robot_file
from calibration.data.input_errors import BadConfiguration, stated_word
from calibration.described import report_in_words
from calibration.sizing import sheet
from calibration.sizing.design import OBJECTIVES
from calibration.sizing.design_search import size_robot as search_designs
from calibration.sizing.part_options import packaged_sheets
from calibration.sizing.sheet import RequirementOutcome
from sweeps import capabilities
from sweeps import config as configuration
from sweeps.console import print_message, step_reporter
from sweeps.inputs import load_robot
from sweeps.pages import words
from sweeps.report import check_report
from sweeps.report.check_report import SizeResult, describe_design
from sweeps.store import finish_run_folder, open_folder, print_report


def execute(config: configuration.Size, invocation: configuration.VerbosePart) -> int:
    """Searches for a design and writes a run folder. Returns the exit code: 0 whether or not a design meets
    everything, 3 if the solver failed at a worst corner of the best design.
    """
    requirements = requirements_file.load_requirements(Path(config.requirements))
    file = load_robot(config)
    robot = file.robot
    capabilities.check_on_ground(robot, "size")
    objectives = config.pareto or (config.objective,)
    for name in objectives:
        stated_word(name, OBJECTIVES, "--pareto" if config.pareto else "--objective")
    if config.pareto and len(set(config.pareto)) != 2:
        raise BadConfiguration(f"--pareto: got {', '.join(config.pareto)}; expected two different objectives")
    motor_names = [motor.name for motor in packaged_sheets("motors")]
    for name in config.motors:
        stated_word(name, motor_names, "--motors")
    sheet.reject_impossible(robot, requirements)
    with open_folder("size", config, robot, invocation) as folder:
        with step_reporter(print_message, "drawing designs") as report_step:
            sizing = search_designs(
                robot,
                requirements,
                objectives,
                motors=config.motors,
                seed=config.seed,
                tell=report_in_words(report_step),
            )
            written_robot = robot if sizing.best is None else sizing.best.robot
            outcomes: tuple[RequirementOutcome, ...] = ()
            if sizing.best is not None:
                outcomes = sheet.check_requirements(
                    written_robot, requirements, changes=False, tell=report_in_words(report_step)
                )
        result = SizeResult(requirements, robot, sizing, objectives, outcomes)
        folder.write_text("requirements.toml", requirements.text)
        note = f"the robot that was changed, {config.robot}: no design meets the requirements"
        if sizing.best is not None:
            note = f"sized for {requirements.source} from {config.robot}: {describe_design(sizing.best)}"
        robot_file.write_robot(written_robot, folder.results() / "robot.toml", note=note)
        folder.write_json("result.json", result.to_json())
        page = print_report(
            check_report.size_document(result, capabilities.displayed_name(file)),
            dataclasses.replace(file, robot=written_robot),
            brief=not invocation.verbose,
        )
        manifest = {"seed": config.seed, "feasible": sizing.best is not None}
        solved = words.every_run_solved(Counter(outcome.status for outcome in outcomes))
        return finish_run_folder(folder, manifest, page, solved)
