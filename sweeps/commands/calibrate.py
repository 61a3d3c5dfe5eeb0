"""The command `calibrate`: fits a robot to a table of runs and writes a run folder."""

from __future__ import annotations

import contextlib
import dataclasses
import re
from importlib import resources

import numpy as np

from calibration.data import contents, robot_file
from calibration.data.input_errors import BadConfiguration, BadData
from calibration.data.runs import Runs
from calibration.inference import priors
from calibration.inference.calibration import calibrate as fit_robot
from calibration.inference.feedforward import UNITS, DriveLog, Feedforward, Tolerances, fit_feedforward
from mmrjax.model.channels import EVERY
from sweeps import config as configuration
from sweeps.console import print_message, step_reporter
from sweeps.inputs import load_robot, read_runs
from sweeps.pages import words
from sweeps.report import calibration_report
from sweeps.store import finish_run_folder, open_folder, print_report


def execute(config: configuration.Calibrate, invocation: configuration.FittedRuns) -> int:
    """Calibrates a robot to a table and writes a run folder. Returns the exit code: 0 if done, 3 if the search or a
    fit without a block did not converge, or the solver failed for a row.
    """
    if config.feedforward is not None:
        return _execute_feedforward(config, invocation)
    robot = load_robot(config).robot
    runs = read_runs(invocation.data, robot, columns=config.columns, measured=True, series=True)
    prior_options = priors.parse_priors(config.prior)
    with (
        open_folder("calibrate", config, robot, invocation, runs) as folder,
        step_reporter(print_message, "fitting") as report_step,
    ):
        result = fit_robot(
            runs, robot, rows=config.rows, free=config.free, fix=config.fix, stated=prior_options,
            noise=config.noise or None, model=config.model, starts=config.starts, population=config.population,
            generations=config.generations, keep=folder.stage, seed=config.seed,
            profiles=config.profiles, blocks=config.hold_out, tell=report_step,
        )  # fmt: skip
        result.save(folder.results(), config.robot, folder.tables)
        report = calibration_report.calibration_document(result, config.robot, voltage_fit(runs))
        page = print_report(report, brief=not invocation.verbose)
        is_solved = result.converged and all(
            block.converged for errors in result.held_out.values() for block in errors.blocks.values()
        )
        manifest = {"seed": result.seed, "statuses": result.counts}
        return finish_run_folder(folder, manifest, page, is_solved and words.every_run_solved(result.counts))


#: Names of signals with the battery voltage.
BATTERY = re.compile(r"batt\w*volt", re.IGNORECASE)
#: Columns of a velocity and its position. The first pair with readings is fitted.
PAIRS = (("output_speed_rpm", "output_angle_deg"), ("speed_mm_s", "position_mm"))
ROTOR = "motor_speed_rpm", ""


def _execute_feedforward(config: configuration.Calibrate, invocation: configuration.FittedRuns) -> int:
    """Fits the constants, prints them and writes a run folder. Returns the exit code, 0."""
    if config.robot != "nominal":
        robot = load_robot(config).robot
    else:
        with resources.as_file(resources.files("calibration.data") / "rigs" / "feedforward.toml") as path:
            robot = robot_file.read_robot(path)
    file = contents.inspect_source(invocation.data)
    columns = config.columns or ("sysid" if file.preset == "sysid" else None)
    runs = read_runs(invocation.data, robot, columns=columns, measured=True, series=True)
    log = drive_log(runs, config.unit, as_logged=(columns or "").startswith("sysid"))
    battery = [
        voltage
        for signal in file.signals
        if BATTERY.search(signal.path)
        for voltage in (signal.least, signal.greatest)
    ]
    log = dataclasses.replace(log, battery=np.array(battery) if battery else None)
    tolerances = Tolerances(
        config.position_error, config.velocity_error, config.effort_V, config.period_s, config.measurement_delay_s
    )
    fit = fit_feedforward(log, config.feedforward or "", tolerances)
    with open_folder("calibrate", config, robot, invocation, runs) as folder:
        folder.write_json("feedforward.json", fit.to_json())
        folder.write_table("windows.csv", fit.windows)
        page = print_report(calibration_report.feedforward_document(fit))
        return finish_run_folder(folder, {"seed": None}, page)


def voltage_fit(runs: Runs) -> Feedforward | None:
    """Constants of a log of voltage and speed. None for other data, or with too little motion."""
    if runs.sampled and runs.layout.imposed == "voltage":
        with contextlib.suppress(BadData):
            return fit_feedforward(drive_log(runs))
    return None


def drive_log(runs: Runs, unit: str | None = None, as_logged: bool = False) -> DriveLog:
    """Readings of a log, with positions in a given unit. None: the unit of the first pair of channels.

    Args:
        as_logged: True for a log of SysId, which has its own units. `unit` is their name.

    Raises:
        BadData: the log has no time, or neither velocity nor position.
        BadConfiguration: an angle has a unit of length, or a length that of an angle.
    """

    factors = {channel.column: channel.factor for channel in EVERY}

    def readings(column: str) -> np.ndarray | None:
        if not runs.has(column) or not np.isfinite(runs[column]).any():
            return None
        return runs[column] * factors[column]

    pair = next((pair for pair in (*PAIRS, ROTOR) if any(readings(column) is not None for column in pair)), None)
    if pair is None:
        raise BadData(
            f"{runs.source}: no velocity and no position; expected output_speed_rpm, output_angle_deg, "
            "speed_mm_s, position_mm or motor_speed_rpm, or --columns sysid"
        )
    velocity, position = map(readings, pair)
    unit = unit or ("m" if pair[0] == "speed_mm_s" else "rotation")
    if (unit == "m") != (pair[0] == "speed_mm_s") and not as_logged:
        raise BadConfiguration(f"--unit: got {unit}, but the log has {pair[0]}; expected a unit of that position")
    unit_size = 2 * np.pi if as_logged else UNITS[unit] or 1.0
    if not runs.sampled:
        raise BadData(f"{runs.source}: no time; expected a column time_s")
    order = np.concatenate(list(runs.rows_by_run().values()))
    duty = runs["duty"] if runs.has("duty") else 1.0
    voltage = np.asarray(runs["supply_voltage_V"] * duty, float)

    def ordered(unordered: np.ndarray | None, unit_size: float) -> np.ndarray | None:
        return None if unordered is None else unordered[order] / unit_size

    return DriveLog(
        runs.run_names[order],
        np.asarray(runs["time_s"], float)[order],
        voltage[order],
        ordered(position, unit_size),
        ordered(velocity, unit_size),
        ordered(readings("motor_current_A"), 1.0),
        unit=unit,
    )
