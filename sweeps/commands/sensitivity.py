"""The command `sensitivity`: influence of each parameter on the outputs."""

from __future__ import annotations

import dataclasses

import numpy as np

from calibration.data import Json
from calibration.data.columns import Layout
from calibration.data.input_errors import BadConfiguration
from calibration.data.runs import Runs
from calibration.described import report_in_words
from calibration.sensitivity import uncertain_inputs
from calibration.sensitivity.analyse import analyse_sensitivity
from calibration.sensitivity.model import chosen_outputs
from calibration.sensitivity.result import METHODS, OperatingPoints
from calibration.sensitivity.study import Study
from mmrjax.model.conditions import OF_TURNS
from mmrjax.model.paper_tables import COULOMB_PER_MAH, PAYLOADS_KG, SLOPES_DEG, VOLTAGES_V
from mmrjax.model.quantities import RPM
from mmrjax.model.robot import Robot
from sweeps import capabilities
from sweeps import config as configuration
from sweeps.config import GridPart
from sweeps.console import print_message
from sweeps.inputs import load_robot, posterior_beside_robot
from sweeps.points import axes as sweep_axes
from sweeps.points import grid as grids
from sweeps.points.grid import grid_conditions, grid_configurations
from sweeps.points.job import robot_for_turns
from sweeps.points.run import check_fidelity_options
from sweeps.report import sensitivity_report
from sweeps.store import finish_run_folder, open_folder, print_report

#: Operating points for methods that draw a sample at each: ends of Table 8, and the middle of its slopes.
CORNERS = {
    "voltages_V": (VOLTAGES_V[0], VOLTAGES_V[-1]),
    "payloads_kg": (PAYLOADS_KG[0], PAYLOADS_KG[-1]),
    "slopes_deg": SLOPES_DEG[::2],
}
TABLE_8 = {"voltages_V": VOLTAGES_V, "payloads_kg": PAYLOADS_KG, "slopes_deg": SLOPES_DEG}
#: Condition that may vary → axis of operating points that it replaces.
AXES = {
    "voltage": "voltages_V",
    "motor_speed": "motor_speeds_rpm",
    "payload": "payloads_kg",
    "slope_deg": "slopes_deg",
}


def execute(config: configuration.Sensitivity, invocation: configuration.FolderPart) -> int:
    """Runs a sensitivity study of a robot and writes a run folder. Returns the exit code: 0 if done, 3 if the solver
    failed at some operating points.
    """
    file = load_robot(config)
    if config.method not in METHODS:
        raise BadConfiguration(f"--method: got {config.method!r}; input should be one of {', '.join(METHODS)}")
    ranges: dict[str, tuple[float, float]] = {}
    for text in config.vary:
        name, _, ends = text.partition("=")
        low, _, high = ends.partition(":")
        if name in ranges:
            raise BadConfiguration(f"--vary {name}: given twice; give it once")
        try:
            ranges[name] = float(low), float(high)
        except ValueError:
            raise BadConfiguration(
                f"--vary: got {text}; expected name=low:high with numbers, such as voltage=22:26"
            ) from None
    turn_conditions = [name for name in ranges if name in OF_TURNS]
    robot = robot_for_turns(file.robot, turn_conditions)
    outputs = chosen_outputs(config.outputs, robot, bool(turn_conditions))
    runs = _operating_points(config, robot, ranges)
    if config.posterior and config.parameters:
        raise BadConfiguration("--posterior: cannot be combined with --parameters; give one of them")
    if config.posterior:
        inputs = uncertain_inputs.inputs_from_posterior(file.robot, posterior_beside_robot(file), ranges)
    else:
        configurations = tuple(dict.fromkeys(map(str, runs["configuration"])))
        names = config.parameters or uncertain_inputs.default_input_names(
            file.robot, configurations, config.battery, config.model, bool(turn_conditions)
        )
        inputs = uncertain_inputs.inputs_from_priors(file.robot, names, ranges)
    conditions = runs.conditions(robot)
    turn_columns: Json = {name: np.full(len(runs), np.mean(ranges[name])) for name in turn_conditions}
    check_fidelity_options(robot, dataclasses.replace(conditions, **turn_columns), config)
    study = Study(
        robot, inputs, OperatingPoints.of(runs), outputs, config.model, config.options,
        report_in_words(print_message), battery=float(config.battery),
        discharge=config.discharge_mAh * COULOMB_PER_MAH, adhesion=np.asarray(conditions.adhesion),
    )  # fmt: skip
    with open_folder("sensitivity", config, file.robot, invocation, runs) as folder:
        result = analyse_sensitivity(study, config.method, config.evaluations, config.seed)
        folder.write_json("result.json", result.to_json())
        for name, table in result.tables().items():
            folder.write_table(name, table)
        document = print_report(sensitivity_report.sensitivity_document(result, file), file)
        manifest = {"seed": result.seed, "statuses": result.statuses}
        return finish_run_folder(folder, manifest, document, result.solved)


def _operating_points(
    config: configuration.Sensitivity, robot: Robot, ranges: dict[str, tuple[float, float]]
) -> Runs:
    """Grid of operating points. For a condition with --vary it contains one value, the middle of the range."""
    layout = Layout.of(robot)
    if layout.imposed == "motor_current":
        raise BadConfiguration("sensitivity: this robot imposes the motor current; use simulate or sweep")
    default_axes: dict[str, tuple[float, ...]] = {}
    if layout.complete:
        default_axes = CORNERS if config.method in ("sobol", "morris") else TABLE_8
        if not set(OF_TURNS).isdisjoint(ranges):  # which settle only on level ground
            default_axes = {**default_axes, "slopes_deg": (0.0,)}
    axes = {key: getattr(config, key) or default_axes.get(key) for key in (*TABLE_8, "motor_speeds_rpm")}
    for name, (low, high) in ranges.items():
        ground, shaft = (
            [f"--vary {name}"] * (name in acting_names)
            for acting_names in (sweep_axes.ON_GROUND, sweep_axes.ON_SHAFT)
        )
        capabilities.check_acting(robot, ground, shaft)
        if name in grids.AXIS and name != layout.imposed:
            raise BadConfiguration(
                f"--vary {name}: the robot's file imposes the {layout.imposed.replace('_', ' ')}; vary it instead"
            )
        if config.battery and name == "voltage":
            raise BadConfiguration("--vary voltage: has no effect on a battery")
        key = AXES.get(name)
        if key is not None and getattr(config, key) is not None:
            raise BadConfiguration(f"--vary {name}: --{key.partition('_')[0]} sets it too; give one of them")
        if key is not None:
            axes[key] = ((low + high) / 2 / (RPM if name == "motor_speed" else 1.0),)
    try:
        grid = GridPart(configurations=config.configurations, surface=config.surface, **axes)
    except ValueError:
        raise BadConfiguration(f"--vary: got {', '.join(config.vary)}; a range exceeds the limits of a run") from None
    notes: list[str] = []
    grid = grids.resolve_grid(grid, robot, config.battery, notes)
    for note in notes:
        print_message(note)
    names = grid_configurations(grid, robot)
    capabilities.check_turning(robot, ranges, names, "--vary")
    return grid_conditions(
        grid.model_copy(update={"configurations": tuple(dict.fromkeys(names))}), robot, config.battery
    )
