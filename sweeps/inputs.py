"""Inputs of commands: the robot of a configuration, tables of runs, and single runs from options."""

from __future__ import annotations

import dataclasses
from collections.abc import Collection, Mapping
from pathlib import Path

from calibration.data import Json, Names, effect_file, posterior_file, robot_file, stated, table
from calibration.data import runs as records
from calibration.data.columns import IMPOSED, Layout
from calibration.data.contradictions import misplaced_levers
from calibration.data.input_errors import BadConfiguration, allowed_words, stated_word
from calibration.data.posterior_file import Posterior
from calibration.data.robot_file import RobotFile
from mmrjax import fidelities
from mmrjax.errors import list_some
from mmrjax.model.paper_tables import BENCH, SURFACES
from mmrjax.model.robot import Robot
from sweeps import capabilities, store
from sweeps.config import Calibrate, Compare, Export, FidelityPart, GivenRuns, Loop, OneRun, RobotPart, Simulate
from sweeps.console import print_message
from sweeps.options import options_of_fields
from sweeps.report import turn_words

#: Option for each condition of a single run.
OPTIONS = options_of_fields(OneRun)


def load_robot(config: RobotPart) -> RobotFile:
    """Robot of a configuration, with its changes and the user's own effects.

    Former parameter names are accepted with a note on stderr. Another note reports an example running gear.

    Raises:
        BadConfiguration: the robot does not exist, or its file or a change is rejected.
    """
    file = robot_file.find_robot_file(config.robot, effect_file.effect_library(config.effects))
    robot = robot_file.change_robot(file.robot, config.set, where="--set")
    notes = [*file.remarks, *robot_file.battery_remarks(robot, config.set, "--set")]
    if robot.rig.follows_goal and not (
        type(config) is RobotPart or isinstance(config, Calibrate | Compare | Export | Loop)
    ):
        raise BadConfiguration(
            f"--robot {file.name}: its controller follows a goal; use calibrate, compare, loop or rig check with "
            "a log, export, or mmrjax.simulate in Python"
        )
    unlike_notes: Names = ()
    if robot.unlike and robot.has_ground and not getattr(config, "turns", False):
        unlike_notes = (turn_words.unlike_sides_note(file.name, robot),)
    examples = list_some(stated.example_numbers(file.text))
    if examples and isinstance(config, Calibrate | Loop):  # `rig check` lists their lines
        notes.append(
            f"{file.name}: still example numbers of the template: {examples}. The fit widens each ± among them to "
            f"± {100 * stated.EXAMPLE_SHARE:g} %"
        )
    for note in (*notes, *unlike_notes):
        print_message(note)
    resolves_gear = isinstance(config, FidelityPart) and fidelities.fidelity_facts(config.model).resolves
    # the model rejects other robots
    is_accepted = robot.has_ground and robot.rig.imposed == "voltage"
    is_accepted = is_accepted and all(c.inertia > 0 for _, c in robot.configurations.items())
    if resolves_gear and is_accepted and not capabilities.states_running_gear(robot):
        print_message("the robot's file has no running_gear: its wheelbase, belt and masses are examples")
    return dataclasses.replace(file, robot=robot, stated=file.stated | {*config.set}, remarks=unlike_notes)


def posterior_beside_robot(file: RobotFile) -> Posterior:
    """Posterior from the folder of a robot file that `calibrate` or `loop` wrote.

    Raises:
        BadConfiguration: the robot is not from a file.
        BadData: the posterior is missing, unreadable, or of another robot.
    """
    if Path(file.source).suffix != ".toml":
        raise BadConfiguration(
            f"--posterior: {file.source} has no posterior; expected --robot FOLDER/robot.toml of calibrate or loop"
        )
    path = Path(file.source).with_name(posterior_file.FILE)
    posterior = posterior_file.read_posterior(path)
    posterior.check(file.robot, str(path))
    return posterior


def recorded_fit(file: RobotFile, runs: records.Runs) -> str:
    """`these` if the robot's folder records a fit to these rows, `others` for a fit to other rows, "" for none."""
    fitted = store.rows_of_fit(Path(file.source))
    return "" if not fitted else "these" if runs.digest in fitted else "others"


def check_configurations(robot: Robot, names: Names, where: str) -> None:
    """Rejects a configuration that the robot does not have.

    Raises:
        BadConfiguration: the robot does not have it. The message has `where` and the robot's configurations.
    """
    for name in names:
        stated_word(name, robot.configurations, where, f"got {name}; the robot has no such configuration")


def read_runs(
    source: str,
    robot: Robot,
    *,
    measured: bool,
    columns: str | Mapping[str, str] | None = None,
    series: bool = False,
    battery: bool = False,
    of_turns: bool = False,
) -> records.Runs:
    """Reads a table and lists its unused columns on stderr.

    Args:
        source: a file of any format, or a packaged table.
        robot: robot with the configurations of the table.
        measured: True if readings are required.
        series: True if time histories are accepted.
        columns: preset, preset file, or names by those of this program, see `runs.read_runs`.
        battery: True if the runs are on the battery, see `runs.read_runs`.
        of_turns: True to add each channel of the sides and of the yaw for which a table of turns has a column.

    Raises:
        BadData: as in `runs.read_runs`, or time histories are not accepted, or the robot lacks a configuration.
    """
    runs = records.read_runs(source, robot, columns=columns, measured=measured, battery=battery, of_turns=of_turns)
    if not series:
        from calibration.inference import observers

        observers.observer_kind(runs).check_settled(runs)
    runs.configurations(robot)
    for note in runs.notes:
        print_message(note)
    if runs.unknown:
        print_message(f"{runs.source}: not used: {', '.join(runs.unknown)}")
    return runs


def given_runs(
    robot: Robot, invocation: GivenRuns, config: Simulate, profile_columns: Collection[str] = ()
) -> records.Runs:
    """Runs from a file, or one run from options. `profile_columns`: columns that a profile states."""
    if invocation.runs is None:
        return one_run(robot, invocation.stated, config.battery, profile_columns)
    return read_runs(str(invocation.runs), robot, columns=config.columns, measured=False, battery=config.battery)


def one_run(robot: Robot, cells: Json, battery: bool = False, profile_columns: Collection[str] = ()) -> records.Runs:
    """One run from options by column name, of the robot's first configuration unless stated.

    Args:
        profile_columns: columns that a profile states.

    Raises:
        BadConfiguration: a value is out of range, the configuration is unknown, or a voltage is combined with the
            battery. Also if a condition does not act on the robot, or the imposed value is missing and the file has
            no limit.
    """
    if battery and cells.get("supply_voltage_V") is not None:
        raise BadConfiguration(
            f"--voltage: got {cells['supply_voltage_V']:g} with --battery, whose charge sets the voltage; "
            "give one of them"
        )
    cell_values = {key: value for key, value in cells.items() if value is not None}
    name = cell_values.get("configuration", robot.configurations.names[0])
    check_configurations(robot, (name,), "--configuration")
    layout = Layout.of(robot)
    column = layout.imposed_column
    for other_column, _ in IMPOSED.values():
        if other_column != column and other_column in cell_values:
            raise BadConfiguration(capabilities.option_refusal(robot, OPTIONS[other_column], OPTIONS[column]))
    inapplicable = [OPTIONS[key] for key in cell_values if key in layout.idle]
    capabilities.check_acting(robot, inapplicable, inapplicable)
    if battery:
        capabilities.check_battery(robot)
    elif column in profile_columns:
        cell_values.setdefault(column, 0.0)
    elif column not in cell_values:
        cell_values[column] = capabilities.imposed_default(robot, OPTIONS[column])
    if robot.has_ground:
        default_surface = {"surface": BENCH} if robot.rig.scales_adhesion else {}
        cell_values = {**default_surface, "payload_kg": 0.0, "slope_deg": 0.0, **cell_values}
        surface = cell_values.get("surface", BENCH)
        has_friction = surface in SURFACES or not robot.rig.scales_adhesion
        if not has_friction and table.configuration_on_surface(name, surface) not in robot.configurations:
            raise BadConfiguration(
                f"--surface: got {surface}, for which no friction is known; {allowed_words(surface, SURFACES)}"
            )
    run = records.single_run({**cell_values, "configuration": name}, layout)
    if misplaced_lever := misplaced_levers(run, robot):
        _, column, reason = misplaced_lever
        raise BadConfiguration(f"{OPTIONS[column]}: {reason}")
    return run
