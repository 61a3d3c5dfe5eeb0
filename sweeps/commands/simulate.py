"""The command `simulate`: simulates a few given runs, over time if the fidelity allows it."""

from __future__ import annotations

import dataclasses
import functools
import importlib

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from calibration.data import Columns, Json
from calibration.data import runs as records
from calibration.data.input_errors import BadConfiguration
from mmrjax import fidelities
from mmrjax.compile.compiling import SELDOM, compiled
from mmrjax.derived.start_figures import curve_peak, stages_of_histories
from mmrjax.fidelities import outputs
from mmrjax.fidelities.base import History, RunBatch, result_of_signals
from mmrjax.model import channels, contact, quantities
from mmrjax.model.gearmotor import Motor
from mmrjax.model.params import Scalar
from mmrjax.model.robot import Robot
from mmrjax.model.signals import BATTERY_EMPTY, STATUSES
from sweeps import capabilities
from sweeps import config as configuration
from sweeps.inputs import given_runs, load_robot, posterior_beside_robot
from sweeps.pages import words
from sweeps.points import run, scale
from sweeps.points.job import robot_for_turns
from sweeps.report import runs_report, turn_words
from sweeps.report.runs_report import PEAK
from sweeps.store import RunFolder, open_folder, print_report

_MAX_HISTORIES = 1000  # most runs with stored histories
_REMARKS_SHOWN = 6  # most runs on the terminal
#: Channels that histories of a shaft always have.
OF_SHAFT = ("motor_speed", "output_angle")
#: The same for a vehicle.
OF_VEHICLE = ("speed",)
#: Columns of each side's motor currents, if the sides are driven independently.
_OF_SIDES = tuple(channels.find_channel(f"motor_current_{side}").column for side in channels.SIDES)
#: The number of runs is padded to a multiple of this, so that tables of similar size share compiled programs.
PADDING_MULTIPLE = 16
#: Column with the time for which a run's current may flow until the windings reach their limit.
PERMISSIBLE = "permissible_time_s"


def execute(config: configuration.Simulate, invocation: configuration.GivenRuns) -> int:
    """Simulates runs from a file, or one run from options, and writes a run folder. Returns the exit code.

    Raises:
        BadConfiguration: there are more runs than histories can be stored for.
    """
    if config.profile is not None or config.turns:
        module = "turn" if config.profile is None else "missions"
        code: int = importlib.import_module(f"sweeps.commands.{module}").execute(config, invocation)
        return code
    file = load_robot(config)
    robot = file.robot
    runs = given_runs(robot, invocation, config)
    if fidelities.fidelity_facts(config.model).histories and len(runs) > _MAX_HISTORIES:
        raise BadConfiguration(
            f"--runs: got {len(runs)} runs; --model {config.model} saves at most {_MAX_HISTORIES} histories"
        )
    posterior = None if config.posterior is None else posterior_beside_robot(file)
    with open_folder("simulate", config, robot, invocation, runs) as folder:
        instrumented_robot = robot_for_turns(robot, runs.axes)
        table, histories = _simulate_table(folder, instrumented_robot, runs, config)
        table[PERMISSIBLE] = permissible_durations(robot, table)
        postures = turn_words.posture_of_runs(robot, runs, run.conditions_of_runs(robot, runs, config))
        notes = run_remarks(robot, table) + capabilities.unknown_numbers_sentence(robot)
        entries: Json = {"notes": [*file.remarks, *notes]}
        remarks = list(notes)
        if posterior is not None and config.posterior is not None:
            table |= run.simulate_draws(robot, posterior, runs, config, config.posterior, folder)
            remarks += run.interval_remarks(table, config.posterior)
        if postures is not None:
            folder.write_table("posture.csv", postures.table)
            entries["notes"] += turn_words.tipping_remarks(postures)
        if histories is not None and robot.has_ground:
            assert histories.history is not None  # the fidelity was asked for it
            stages = stages_of_histories(robot, histories.history, runs.configurations(robot))
            empty_history: Json = {"stages": [], "acceleration_time_s": None, "slip_over_acceleration": None}
            is_under_way = [
                STATUSES[int(stages_of_run)] in words.UNDER_WAY
                for stages_of_run in np.asarray(histories.result.status)
            ]
            entries["starts"] = [
                {
                    "run_id": str(name),
                    **(stages_of_run.to_json() if stages_of_run is not None and started else empty_history),
                }
                for name, stages_of_run, started in zip(run.run_names(runs), stages, is_under_way, strict=True)
            ]
        if PEAK in table:
            entries[PEAK] = float(np.nanmax(table[PEAK], initial=0.0))
        page_file = dataclasses.replace(file, robot=instrumented_robot)
        document = runs_report.runs_document(page_file, config.model, table, histories, postures, remarks)
        return run.write_run_folder(folder, config.model, table, print_report(document, page_file), entries)


def _simulate_table(
    folder: RunFolder, robot: Robot, runs: records.Runs, config: configuration.Simulate
) -> tuple[Columns, RunBatch | None]:
    """Table of the runs. If the fidelity simulates over time, histories are written and returned too."""
    fidelity = fidelities.get_fidelity(config.model)
    if fidelity.histories is None:
        return run.evaluate_runs(robot, runs, config, folder), None
    conditions = run.conditions_of_runs(robot, runs, config)
    run.check_fidelity_options(robot, conditions, config)
    with scale.share_progress(len(runs), quiet=not fidelity.facts.slow) as report_share:
        batch = jax.device_get(fidelity.histories(robot, conditions, config.options, report_share))
    assert batch.history is not None  # the fidelity was asked for it
    folder.write_table(
        "history.csv", capabilities.drop_inapplicable_columns(robot, history_table(robot, batch.history, runs))
    )
    loads = batch.history.reactions
    if loads is not None:
        # loads inside one side's running gear over time [N], one row per sample
        table = {
            "run_id": np.repeat(run.run_names(runs), batch.history.time.shape[-1]),
            "time_s": np.ravel(batch.history.time),
            "guide_N": np.ravel(loads.guided.sum(-1)),
            "front_N": np.ravel(loads.support[..., 0]),
            "rear_N": np.ravel(loads.support[..., 1]),
            "centrifugal_tension_N": np.ravel(loads.centrifugal),
        }
        for name, values in {"grouser": loads.grouser, "tension": loads.tension}.items():
            table |= {f"{name}_{k + 1:02d}_N": values[..., k].ravel() for k in range(values.shape[-1])}
        folder.write_table("reactions.csv", table)
    return {**run.condition_table(robot, runs), **end_columns_of_histories(robot, batch)}, batch


def end_columns_of_histories(robot: Robot, batch: RunBatch) -> Columns:
    """Columns with the end of each run over time.

    If the battery became empty, they describe the last instant before. `time_end_s` is then the time at which the
    charge ran out at the last current.
    """
    history = batch.history
    status = np.asarray(batch.result.status)
    assert history is not None  # the fidelity was asked for it
    columns = run.ending_columns(robot, batch)
    signals = history.signals
    time = np.asarray(history.time)
    is_finite = np.isfinite(np.asarray(signals.total_current))
    last_sample = np.where(is_finite.any(-1), is_finite.shape[-1] - 1 - np.argmax(is_finite[..., ::-1], -1), 0)
    rows = np.arange(len(last_sample))
    total_current = jnp.abs(robot.sides * signals.current)
    motor_count = jnp.asarray(float(robot.sides))
    peaks = _peaks_of_runs(jnp.asarray(time), total_current, motor_count * float(robot.driver.current_limit))
    columns[PEAK] = np.maximum(peaks, 0.0)
    columns["displacement_m"] = np.array(history.distance)[rows, last_sample]
    columns["time_end_s"] = time[rows, last_sample]
    ran_empty = (status == BATTERY_EMPTY) & ~is_finite[rows, -1]
    if ran_empty.any():
        has_last_sample = ran_empty & is_finite.any(-1)
        signals = jax.tree.map(lambda x: np.asarray(x)[rows, last_sample], signals)
        result = jax.device_get(result_of_signals(robot, signals, jnp.asarray(status)))
        for name, values in outputs.output_columns(result, robot.channels).items():
            columns[name] = np.where(has_last_sample, values, columns[name])
        time_after = time[rows, np.minimum(last_sample + 1, is_finite.shape[-1] - 1)] - columns["time_end_s"]
        battery_current = np.asarray(robot.battery.current(signals.total_current))
        time_left = (float(robot.battery.capacity) - signals.discharge) / np.where(
            battery_current > 0, battery_current, np.nan
        )
        time_left = np.where(has_last_sample, np.clip(np.nan_to_num(time_left), 0.0, time_after), 0.0)
        columns["time_end_s"] += time_left
        columns["displacement_m"] = np.nan_to_num(
            columns["displacement_m"] + time_left * np.nan_to_num(signals.speed)
        )
    return columns


def permissible_durations(robot: Robot, table: Columns) -> np.ndarray:
    """Permissible duration of each run's current from ambient temperature [s]. inf: continuous, NaN: no current."""
    current = motor_currents(robot, table)
    has_current = np.isfinite(current)
    filled = np.zeros(len(current) + -len(current) % PADDING_MULTIPLE)
    filled[: len(current)] = np.where(has_current, current, 0.0)
    time = _permissible_time(robot.motor, jnp.asarray(filled))
    return np.where(has_current, np.asarray(time)[: len(current)], np.nan)


@functools.partial(compiled, options=SELDOM)
def _peaks_of_runs(
    time: Float[Array, "runs samples"], values: Float[Array, "runs samples"], current_limit: Array
) -> Float[Array, " runs"]:
    return jax.vmap(curve_peak, in_axes=(0, 0, None))(time, values, current_limit)


@functools.partial(compiled, options=SELDOM)
def _permissible_time(motor: Motor, currents: Float[Array, " runs"]) -> Scalar:
    return jax.vmap(motor.time_permissible)(currents)


def motor_currents(robot: Robot, table: Columns) -> np.ndarray:
    """Magnitude of the current of one motor [A], the larger one if the sides differ. NaN if no column contains it."""
    if all(column in table for column in _OF_SIDES):
        return np.asarray(np.max([np.abs(table[column]) for column in _OF_SIDES], axis=0))
    for column, motor_count in (("total_current_A", float(robot.sides)), ("motor_current_A", 1.0)):
        if column in table:
            return np.asarray(np.abs(np.asarray(table[column])) / motor_count)
    return np.full(len(table["status"]), np.nan)


def run_remarks(robot: Robot, table: Columns) -> list[str]:
    """Remarks on facts that the numbers do not show, one sentence each, on a few runs at most."""
    remarks: list[str] = []
    has_several_runs = len(table["status"]) > 1
    durations = table[PERMISSIBLE] if PERMISSIBLE in table else permissible_durations(robot, table)
    for k, status in enumerate(table["status"]):
        prefix = f"run {k + 1}: " if has_several_runs else ""
        flags = str(table["flags"][k]).split(";")
        cell_voltage = float(table["voltage_cell_V"][k])
        if "overvoltage" in flags:
            charging = -float(robot.battery.current(table["total_current_A"][k]))
            remarks.append(
                f"{prefix}overvoltage: {charging:.2f} A flow into the battery, a cell at {cell_voltage:.2f} V. The "
                f"highest charging voltage is {robot.battery.voltage_charge:g} V"
            )
        if "cut_off" in flags:
            remarks.append(
                f"{prefix}cut_off: a cell at {cell_voltage:.2f} V, below its cut-off voltage of "
                f"{robot.battery.voltage_cutoff:g} V"
            )
        if "winding_hot" in flags:
            limit = robot.motor.temperature_limit
            ambient = float(robot.motor.temperature_ambient)
            remarks.append(
                f"{prefix}winding_hot: {limit:g} °C are reached after {float(durations[k]):.3g} s at this "
                f"current, from {ambient:g} °C"
            )
        if np.isinf(table["winding_settled_C"][k]):
            current = float(motor_currents(robot, table)[k])
            remarks.append(
                f"{prefix}winding, long running: {words.NONE_SETTLES} at {current:.2f} A per motor. The "
                f"permissible current is {float(robot.current_continuous):.2f} A"
            )
        if status == "battery_empty" and "time_end_s" in table:
            time_end, distance = float(table["time_end_s"][k]), float(table["displacement_m"][k])
            remarks.append(
                f"{prefix}battery_empty: after {time_end:.1f} s and {distance:.2f} m. Values are those just before"
                if time_end > 0
                else f"{prefix}battery_empty: empty before the start"
            )
    return remarks[:_REMARKS_SHOWN] + (
        [f"... and {len(remarks) - _REMARKS_SHOWN} more remarks"] if len(remarks) > _REMARKS_SHOWN else []
    )


def history_table(robot: Robot, history: History, runs: records.Runs) -> Columns:
    """Time histories of a batch as one table with a row for each sample."""
    signals = history.signals
    channel_names = {*robot.rig.channels, *(OF_VEHICLE if robot.has_ground else OF_SHAFT)}
    shown_channels = [c for c in channels.EVERY if c.over_time and c.name in channel_names]
    return {
        "run_id": np.repeat(run.run_names(runs), history.time.shape[-1]),
        "time_s": np.ravel(history.time),
        **{c.column: np.ravel(history.reading[c.name]) / c.factor for c in shown_channels},
        "theoretical_speed_mm_s": np.ravel(signals.speed_theoretical) / quantities.MM,
        "slip": np.ravel(contact.slip_ratio(signals.speed, signals.speed_theoretical)),
        "displacement_m": np.ravel(history.distance),
        "voltage_V": np.ravel(signals.voltage),
        "traction_N": float(robot.sides) * np.ravel(signals.traction),
    }
