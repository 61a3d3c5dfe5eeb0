"""The command `simulate` for one run with different commands for the two sides: turn, motor currents and path."""

from __future__ import annotations

import dataclasses

import jax
import numpy as np

from calibration.data import Columns, Json, contradictions
from calibration.data.columns import SIDES, SUPPLY
from calibration.data.input_errors import BadConfiguration
from mmrjax import fidelities
from mmrjax.derived import turning_figures
from mmrjax.fidelities import outputs
from mmrjax.fidelities.base import History, RunBatch
from mmrjax.model import channels, quantities
from mmrjax.model.channels import Channel
from mmrjax.model.conditions import Conditions
from mmrjax.model.robot import Robot
from sweeps import capabilities
from sweeps import config as configuration
from sweeps.console import report_stage
from sweeps.inputs import load_robot, one_run
from sweeps.points import run, scale
from sweeps.report import runs_report, turn_words
from sweeps.store import open_folder, print_report

#: Duties of the inner side for which settled turns are shown, as shares of the outer side's duty.
DUTY_SHARES = np.linspace(1.0, -1.0, 97)
#: Channels of a turn, in addition to the robot's channels.
TURN_CHANNELS = tuple(c.name for c in channels.OF_TURNS)


def execute(config: configuration.Simulate, invocation: configuration.GivenRuns) -> int:
    """Simulates one run from options with different commands for the two sides, and writes a run folder. Returns the
    exit code.

    Raises:
        BadConfiguration: runs are from a file, the robot cannot turn, or the turn has no steady state.
    """
    if invocation.runs is not None:
        raise BadConfiguration(
            "--runs: cannot be combined with --left, --right or --heading; put duty_left and duty_right into the file"
        )
    file = load_robot(config)
    stated_columns = invocation.stated
    robot = file.robot
    name = stated_columns.get("configuration") or robot.configurations.names[0]
    capabilities.check_can_turn(robot, (name,), "--left, --right, --heading")
    if robot.rig.imposed != "voltage":
        raise BadConfiguration("--left, --right: the robot's file imposes no voltage")
    runs = one_run(robot, {**stated_columns, **turn_columns(config, stated_columns)}, config.battery)
    is_settled = config.model == fidelities.NAMES[0]
    with open_folder("simulate", config, robot, invocation, runs) as folder:
        conditions = run.conditions_of_runs(robot, runs, config)
        run.check_fidelity_options(robot, conditions, config)
        turn_channels = channels.channels_named((*robot.rig.channels, *TURN_CHANNELS))
        shown_channels = tuple(c for c in turn_channels if c.settled or not is_settled)
        if is_settled:
            with report_stage(1, 2, "settled turns over the duties of the inner side"):
                batch, turn_conditions = _turns_to_compare(robot, conditions)
            turns = {
                **{name: np.asarray(getattr(turn_conditions, name)) for name in SIDES},
                **_turn_table(robot, shown_channels, turn_conditions, batch),
            }
            folder.write_table("turns.csv", capabilities.drop_inapplicable_columns(robot, turns))
            first_run = jax.tree.map(lambda x: x[:1], batch)
            history = None
        else:
            fidelity = fidelities.get_fidelity(config.model)
            assert fidelity.histories is not None  # of `drive` and `track`
            is_slow = fidelity.facts.slow
            with (
                report_stage(1, 2, "the turn over time", is_slow),
                scale.share_progress(quiet=not is_slow) as report_share,
            ):
                first_run = jax.device_get(fidelity.histories(robot, conditions, config.options, report_share))
            turns = None
            history = first_run.history
            assert history is not None
            folder.write_table("history.csv", history_table(history, shown_channels))
        fidelity_columns = {name: np.asarray(values) for name, values in first_run.columns.items()}
        table = {
            **run.condition_table(robot, runs),
            **_turn_table(robot, shown_channels, conditions, first_run),
            **fidelity_columns,
        }
        numbers = {q.column: float(table[q.column][0]) for q in quantities.TABLE["turn"]}
        turn = {name: x if np.isfinite(x) else None for name, x in numbers.items()}
        with report_stage(2, 2, "posture"):
            postures = turn_words.posture_of_runs(robot, runs, conditions)
        notes = []
        if postures is not None:
            folder.write_table("posture.csv", postures.table)
            notes.append(turn_words.posture_sentences(postures))
        end = None
        if history is not None:
            yaw_deg = np.degrees(np.asarray(history.reading["yaw"])[0])
            end = {
                "time_s": float(history.time[0, -1]),
                "displacement_m": float(history.distance[0, -1]),
                "turned_deg": float(yaw_deg[-1] - yaw_deg[0]),
            }
        document = runs_report.turn_document(file, config.model, table, end, history, turns, notes)
        return run.write_run_folder(folder, config.model, table, print_report(document, file), {"turn": turn})


def turn_columns(config: configuration.TurnPart, stated_columns: Json) -> Json:
    """Columns of the run: both duties, and the supply voltage, by default the larger side voltage."""
    columns: Json = {} if config.heading_deg is None else {"heading_deg": config.heading_deg}
    if config.duty_left is not None:
        return columns | {"duty_left": config.duty_left, "duty_right": config.duty_right}
    if config.left_V is None or config.right_V is None:  # only a heading is stated
        return columns | {name: 1.0 for name in SIDES}
    larger = max(abs(config.left_V), abs(config.right_V))
    supply = stated_columns.get(SUPPLY)
    if supply is not None and supply < larger:
        raise BadConfiguration(f"--voltage: got {supply:g}; expected at least {larger:g} V, as --left and --right")
    volts = np.array([config.left_V, config.right_V])
    voltage, duties = contradictions.supply_and_shares(volts, None if supply is None else np.asarray(supply))
    return columns | {SUPPLY: float(voltage), **dict(zip(SIDES, map(float, duties), strict=True))}


def _turns_to_compare(robot: Robot, conditions: Conditions) -> tuple[RunBatch, Conditions]:
    """Settled turns in one batch: the requested one, and turns at other duties of the slower side."""
    duties = [float(np.asarray(getattr(conditions, name))[0]) for name in SIDES]
    slower_side = int(np.argmin(np.abs(duties)))
    outer_duty = max(duties, key=abs)
    rows = jax.tree.map(lambda x: jax.numpy.repeat(jax.numpy.asarray(x), len(DUTY_SHARES) + 1), conditions)
    varied = {
        name: jax.numpy.asarray(
            [duties[k], *(outer_duty * DUTY_SHARES if k == slower_side else [outer_duty] * len(DUTY_SHARES))]
        )
        for k, name in enumerate(SIDES)
    }
    rows = dataclasses.replace(rows, **varied)
    return jax.device_get(fidelities.get_fidelity(fidelities.NAMES[0]).run(robot, rows, {})), rows


def _turn_table(
    robot: Robot, shown_channels: tuple[Channel, ...], conditions: Conditions, batch: RunBatch
) -> Columns:
    radii = np.array([float(c.radius) for c in robot.configurations.members])
    reading = batch.result.reading
    return {
        **outputs.output_columns(batch.result, shown_channels),
        **turning_figures.turning_columns(robot, reading, radii[np.asarray(conditions.configuration)]),
    }


def history_table(history: History, shown_channels: tuple[Channel, ...]) -> Columns:
    """Table of a turn over time, with a row for each sample."""
    reading_columns = {c.column: np.ravel(history.reading[c.name]) / c.factor for c in shown_channels if c.over_time}
    return {"time_s": np.ravel(history.time), **reading_columns, "displacement_m": np.ravel(history.distance)}
