"""The command `compare`: compare the simulation of one robot, or of two, with measured runs."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from calibration.data import Columns, Names, inferred_facts
from calibration.data import runs as records
from calibration.data.input_errors import BadConfiguration
from calibration.data.robot_file import RobotFile
from calibration.described import sentences
from calibration.inference import preparation
from calibration.inference.conduct import error_after_steps, rows_after_steps
from calibration.inference.ranges import check_ranges
from mmrjax import fidelities
from mmrjax.model.channels import Channel
from sweeps import capabilities
from sweeps import config as configuration
from sweeps.inputs import load_robot, posterior_beside_robot, read_runs, recorded_fit
from sweeps.points import run
from sweeps.report import comparison_report
from sweeps.report.comparison_report import Comparison, add_second_robot, compare_readings
from sweeps.store import RunFolder, open_folder, print_report

#: Fidelity for time histories, and further axes over which their errors are shown.
HISTORIES, OVER = "drive", {"time_s": "time [s]"}


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
    if runs.sampled:
        return _compare_histories(config, file, second, runs, beside)
    robot = inferred_facts.with_inferred_instruments(file.robot, runs)
    if beside.own_mass:
        runs = dataclasses.replace(runs, columns={k: v for k, v in runs.columns.items() if k != "total_mass_kg"})
    remarks = sentences(check_ranges(runs, robot))
    posterior = None if config.posterior is None else posterior_beside_robot(file)
    with open_folder("compare", config, robot, beside, runs) as folder:
        table = run.evaluate_runs(robot, runs, config, folder)
        comparison, summary = compare_readings(measured_runs, table, robot)
        if second is not None:
            other = inferred_facts.with_inferred_instruments(second.robot, runs)
            comparison = add_second_robot(
                comparison, measured_runs.channels, run.evaluate_runs(other, runs, config, folder=None)
            )
        notes = (*missing_readings_notes(comparison, measured_runs.channels), *remarks)
        of_draws: list[str] = []
        if posterior is not None and config.posterior is not None:
            spread = run.simulate_draws(robot, posterior, runs, config, config.posterior, folder)
            of_draws = run.interval_ranges(table, spread)
            table |= spread.columns
            ends = (run.SD, run.LOWER, run.UPPER)
            comparison |= {
                f"simulated_{key}": table[key] for c in robot.channels for e in ends if (key := c.column + e)
            }
        folder.write_table("comparison.csv", comparison)
        result = Comparison(
            comparison, summary, measured_runs.channels, Path(runs.source).name, config.model,
            capabilities.displayed_name(file),
            recorded_fit(file, runs), notes=(*notes, *of_draws), against=_second_name(config, file, second),
        )  # fmt: skip
        return _write_result(folder, config, dataclasses.replace(file, robot=robot), runs, table, result, notes)


def _compare_histories(
    config: configuration.Compare,
    file: RobotFile,
    second: RobotFile | None,
    runs: records.Runs,
    beside: configuration.ComparedRuns,
) -> int:
    """Compares time histories, each simulated from its start as in fits."""
    options = {"--own-mass": beside.own_mass, "--posterior": config.posterior, "--duration": config.duration_s}
    for option in (name for name, is_given in options.items() if is_given):
        raise BadConfiguration(
            f"{option}: {Path(runs.source).name} contains time histories with their own masses and times; remove "
            "this option"
        )
    model = None if config.model == fidelities.NAMES[0] else config.model
    ready = preparation.prepare_input(runs, file.robot)
    with open_folder("compare", config, ready.robot, beside, runs) as folder:
        table = run.simulate_histories(ready.robot, runs, model)
        comparison, summary = compare_readings(runs, table, ready.robot)
        comparison |= {column: runs[column] for column in (*OVER, "run_id") if runs.has(column)}
        if second is not None:
            other = preparation.prepare_input(runs, second.robot).robot
            comparison = add_second_robot(comparison, runs.channels, run.simulate_histories(other, runs, model))
        folder.write_table("comparison.csv", comparison)
        readings = ((comparison[f"simulated_{c.column}"], comparison[c.column]) for c in runs.channels)
        factors = [c.factor for c in runs.channels]
        errors = np.stack([simulated - measured for simulated, measured in readings], 1) * factors
        notes = (
            *missing_readings_notes(comparison, runs.channels),
            *sentences((*error_after_steps(runs, errors), *ready.checked, *ready.begins, *ready.weighed)),
        )
        after_steps = np.logical_or(*rows_after_steps(runs))
        result = Comparison(
            comparison, summary, runs.channels, Path(runs.source).name, HISTORIES, capabilities.displayed_name(file),
            recorded_fit(file, runs), OVER, notes, _second_name(config, file, second), after_steps,
        )  # fmt: skip
        return _write_result(folder, config, dataclasses.replace(file, robot=ready.robot), runs, table, result, notes)


def _write_result(
    folder: RunFolder,
    config: configuration.Compare,
    file: RobotFile,
    runs: records.Runs,
    table: Columns,
    found: Comparison,
    notes: Names,
) -> int:
    """Prints a comparison and writes its folder, with these notes in `result.json`. Returns the exit code."""
    document = print_report(comparison_report.comparison_document(found), file)
    answer = comparison_report.comparison_answer(found)
    further = {"statement": answer, "errors": found.summary, "notes": [*file.remarks, *notes]}
    result = run.SimulationResult("compare", found.model, file.robot, runs, table, further)
    return run.write_run_folder(folder, config, result, document)


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


def _second_name(config: configuration.Compare, file: RobotFile, second: RobotFile | None) -> str:
    """Name of the second robot, with its folder if both files have the same name. "" without one."""
    if second is None:
        return ""
    name = capabilities.displayed_name(second)
    return str(config.against) if name == capabilities.displayed_name(file) else name


def missing_readings_notes(table: Columns, channels: Sequence[Channel]) -> list[str]:
    """Sentences on channels with missing readings."""
    missing_counts = {c.column: int(np.isnan(table[c.column]).sum()) for c in channels}
    rows = len(table["status"])
    return [
        f"{column}: {'all' if count == rows else f'{count} of {rows}'} readings are missing and are ignored"
        for column, count in missing_counts.items()
        if count
    ]
