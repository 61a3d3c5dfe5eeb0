"""The command `compare`: compare the simulation of one robot, or of two, with measured runs."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from calibration.data import Columns, inferred_facts
from calibration.data.input_errors import BadConfiguration
from calibration.data.robot_file import RobotFile
from calibration.described import sentences
from calibration.inference import preparation
from calibration.inference.conduct import error_after_steps, rows_after_steps
from calibration.inference.ranges import check_ranges
from mmrjax import fidelities
from mmrjax.model.channels import Channel
from mmrjax.model.robot import Robot
from sweeps import capabilities
from sweeps import config as configuration
from sweeps.inputs import load_robot, posterior_beside_robot, read_runs, recorded_fit
from sweeps.points import run
from sweeps.report import comparison_report
from sweeps.report.comparison_report import Comparison, compare_readings
from sweeps.store import RunFolder, open_folder, print_report

#: Fidelity for time histories.
HISTORIES = "drive"


def execute(config: configuration.Compare, invocation: configuration.ComparedRuns) -> int:
    """Simulates the runs of a table, compares them with its readings, and writes a run folder. Returns the exit
    code.
    """
    file = load_robot(config)
    measured_runs = runs = read_runs(
        invocation.data, file.robot, columns=config.columns, measured=True, series=True, of_turns=True
    )
    if runs.turns:
        file = dataclasses.replace(file, robot=file.robot.showing_turns(runs.layout.measured_columns), remarks=())
    second_file = _second_robot(config, file)
    posterior = None
    if runs.sampled:
        options = {
            "--own-mass": invocation.own_mass,
            "--posterior": config.posterior,
            "--duration": config.duration_s,
        }
        for option in (name for name, is_given in options.items() if is_given):
            raise BadConfiguration(f"{option}: {Path(runs.source).name} contains time histories; remove this option")
        prepared = preparation.prepare_input(runs, file.robot)
        robot = prepared.robot
        remarks = (*prepared.table_remarks, *prepared.start_remarks, *prepared.mass_remarks)
        second_robot = None if second_file is None else preparation.prepare_input(runs, second_file.robot).robot
    else:
        robot = inferred_facts.with_inferred_instruments(file.robot, runs)
        if invocation.own_mass:
            runs = runs.without_columns(["total_mass_kg"])
        remarks = tuple(check_ranges(runs, robot))
        second_robot = (
            None if second_file is None else inferred_facts.with_inferred_instruments(second_file.robot, runs)
        )
        posterior = None if config.posterior is None else posterior_beside_robot(file)

    def simulate(robot: Robot, folder: RunFolder | None) -> Columns:
        if runs.sampled:  # each is simulated from its start, as in fits
            return run.simulate_histories(robot, runs, None if config.model == fidelities.NAMES[0] else config.model)
        return run.evaluate_runs(robot, runs, config, folder)

    with open_folder("compare", config, robot, invocation, runs) as folder:
        table = simulate(robot, folder)
        readings, summary = compare_readings(measured_runs, table, robot)
        readings |= {column: runs[column] for column in ("time_s", "run_id") if runs.sampled and runs.has(column)}
        if second_robot is not None:
            second_table = simulate(second_robot, None)
            readings |= {f"against_{c.column}": second_table[c.column] for c in runs.channels}
        after_steps = None
        if runs.sampled:
            pairs = [(readings[f"simulated_{c.column}"], readings[c.column], c.factor) for c in runs.channels]
            errors = np.stack([(simulation - measured) * factor for simulation, measured, factor in pairs], 1)
            remarks = (*error_after_steps(runs, errors), *remarks)
            after_steps = np.logical_or(*rows_after_steps(runs))
        notes = (*missing_readings_notes(readings, runs.channels), *sentences(remarks))
        draw_sentences: list[str] = []
        if posterior is not None and config.posterior is not None:
            table |= run.simulate_draws(robot, posterior, runs, config, config.posterior, folder)
            draw_sentences = run.interval_ranges(table, robot.channels, config.posterior)
            endings = (run.SD, run.LOWER, run.UPPER)
            readings |= {
                f"simulated_{key}": table[key] for c in robot.channels for e in endings if (key := c.column + e)
            }
        folder.write_table("comparison.csv", readings)
        name = capabilities.displayed_name(file)
        second_name = ""
        if second_file is not None:  # with its folder if both files have the same name
            second_name = capabilities.displayed_name(second_file)
            second_name = str(config.against) if second_name == name else second_name
        comparison = Comparison(
            readings, summary, runs.channels, Path(runs.source).name, HISTORIES if runs.sampled else config.model,
            name, recorded_fit(file, runs), (*notes, *draw_sentences), second_name, runs.sampled, after_steps,
        )  # fmt: skip
        page = print_report(comparison_report.comparison_document(comparison), dataclasses.replace(file, robot=robot))
        statement = comparison_report.comparison_answer(comparison)
        entries = {"statement": statement, "errors": summary, "notes": [*file.remarks, *notes]}
        return run.write_run_folder(folder, comparison.model, table, page, entries)


def _second_robot(config: configuration.Compare, file: RobotFile) -> RobotFile | None:
    """The robot of `--against`, or None.

    Raises:
        BadConfiguration: for the same reasons as `load_robot`, or its channels differ from those of the first robot.
    """
    if config.against is None:
        return None
    second_file = load_robot(config.model_copy(update={"robot": config.against, "set": {}}))
    if second_file.robot.channels != file.robot.channels:
        raise BadConfiguration(f"--against {config.against}: its channels differ from those of {file.name}")
    return second_file


def missing_readings_notes(table: Columns, channels: Sequence[Channel]) -> list[str]:
    """Sentences on channels with missing readings."""
    missing_counts = {c.column: int(np.isnan(table[c.column]).sum()) for c in channels}
    rows = len(table["status"])
    return [
        f"{column}: {'all' if count == rows else f'{count} of {rows}'} readings are missing and are ignored"
        for column, count in missing_counts.items()
        if count
    ]
