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


def execute(config: configuration.Compare, beside: configuration.ComparedRuns) -> int:
    """Simulates the runs of a table, compares them with its readings, and writes a run folder. Returns the exit
    code.
    """
    file = load_robot(config)
    measured_runs = runs = read_runs(
        beside.data, file.robot, columns=config.columns, measured=True, series=True, of_turns=True
    )
    if runs.turns:
        file = dataclasses.replace(file, robot=file.robot.showing_turns(runs.layout.measured_columns), remarks=())
    second = _second_robot(config, file)
    posterior = None
    if runs.sampled:
        options = {"--own-mass": beside.own_mass, "--posterior": config.posterior, "--duration": config.duration_s}
        for option in (name for name, is_given in options.items() if is_given):
            raise BadConfiguration(f"{option}: {Path(runs.source).name} contains time histories; remove this option")
        ready = preparation.prepare_input(runs, file.robot)
        robot, remarks = ready.robot, (*ready.checked, *ready.begins, *ready.weighed)
        other = None if second is None else preparation.prepare_input(runs, second.robot).robot
    else:
        robot = inferred_facts.with_inferred_instruments(file.robot, runs)
        if beside.own_mass:
            runs = runs.without_columns(["total_mass_kg"])
        remarks = tuple(check_ranges(runs, robot))
        other = None if second is None else inferred_facts.with_inferred_instruments(second.robot, runs)
        posterior = None if config.posterior is None else posterior_beside_robot(file)

    def simulated(robot: Robot, folder: RunFolder | None) -> Columns:
        if runs.sampled:  # each is simulated from its start, as in fits
            return run.simulate_histories(robot, runs, None if config.model == fidelities.NAMES[0] else config.model)
        return run.evaluate_runs(robot, runs, config, folder)

    with open_folder("compare", config, robot, beside, runs) as folder:
        table = simulated(robot, folder)
        comparison, summary = compare_readings(measured_runs, table, robot)
        comparison |= {column: runs[column] for column in ("time_s", "run_id") if runs.sampled and runs.has(column)}
        if other is not None:
            readings = simulated(other, None)
            comparison |= {f"against_{c.column}": readings[c.column] for c in runs.channels}
        after_steps = None
        if runs.sampled:
            pairs = [(comparison[f"simulated_{c.column}"], comparison[c.column], c.factor) for c in runs.channels]
            errors = np.stack([(simulation - measured) * factor for simulation, measured, factor in pairs], 1)
            remarks = (*error_after_steps(runs, errors), *remarks)
            after_steps = np.logical_or(*rows_after_steps(runs))
        notes = (*missing_readings_notes(comparison, runs.channels), *sentences(remarks))
        of_draws: list[str] = []
        if posterior is not None and config.posterior is not None:
            table |= run.simulate_draws(robot, posterior, runs, config, config.posterior, folder)
            of_draws = run.interval_ranges(table, robot.channels, config.posterior)
            ends = (run.SD, run.LOWER, run.UPPER)
            comparison |= {
                f"simulated_{key}": table[key] for c in robot.channels for e in ends if (key := c.column + e)
            }
        folder.write_table("comparison.csv", comparison)
        name, against = capabilities.displayed_name(file), ""
        if second is not None:  # with its folder if both files have the same name
            against = capabilities.displayed_name(second)
            against = str(config.against) if against == name else against
        compared = Comparison(
            comparison, summary, runs.channels, Path(runs.source).name, HISTORIES if runs.sampled else config.model,
            name, recorded_fit(file, runs), (*notes, *of_draws), against, runs.sampled, after_steps,
        )  # fmt: skip
        document = print_report(
            comparison_report.comparison_document(compared), dataclasses.replace(file, robot=robot)
        )
        answer = comparison_report.comparison_answer(compared)
        further = {"statement": answer, "errors": summary, "notes": [*file.remarks, *notes]}
        return run.write_run_folder(folder, compared.model, table, document, further)


def _second_robot(config: configuration.Compare, file: RobotFile) -> RobotFile | None:
    """The robot of `--against`, or None.

    Raises:
        BadConfiguration: for the same reasons as `load_robot`, or its channels differ from those of the first robot.
    """
    if config.against is None:
        return None
    second = load_robot(config.model_copy(update={"robot": config.against, "set": {}}))
    if second.robot.channels != file.robot.channels:
        raise BadConfiguration(f"--against {config.against}: its channels differ from those of {file.name}")
    return second


def missing_readings_notes(table: Columns, channels: Sequence[Channel]) -> list[str]:
    """Sentences on channels with missing readings."""
    missing_counts = {c.column: int(np.isnan(table[c.column]).sum()) for c in channels}
    rows = len(table["status"])
    return [
        f"{column}: {'all' if count == rows else f'{count} of {rows}'} readings are missing and are ignored"
        for column, count in missing_counts.items()
        if count
    ]
