"""Grids of operating points as tables of runs, and their simulation from Python."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from typing import Any, TypeVar

import numpy as np

from calibration.data import Names
from calibration.data.columns import LOAD, Layout
from calibration.data.input_errors import BadConfiguration, stated_word
from calibration.data.runs import Runs
from mmrjax.fidelities.results import Results
from mmrjax.fidelities.simulation import simulate
from mmrjax.model.paper_tables import BENCH, PAYLOADS_KG, SLOPES_DEG, SURFACES
from mmrjax.model.robot import Robot
from sweeps import capabilities
from sweeps.config import GridPart
from sweeps.inputs import check_configurations
from sweeps.options import options_of_fields

G = TypeVar("G", bound=GridPart)

#: Option of each axis.
OPTIONS = options_of_fields(GridPart)
#: Axes that act only on vehicles, and only on loads on a shaft.
ON_GROUND, ON_SHAFT = ("payloads_kg", "slopes_deg", "surface"), ("load_torques_Nm",)
#: Axis of each imposed quantity (`rig.IMPOSED`).
AXIS = {"voltage": "voltages_V", "motor_speed": "motor_speeds_rpm", "motor_current": "motor_currents_A"}


def resolve_grid(config: G, robot: Robot, battery: bool, notes: list[str] | None = None) -> G:
    """Grid with values for every axis of the robot.

    Defaults for the packaged robot are the imposed quantities, payloads and slopes of Table 8. For a rig they are
    thirds of its limit (`capabilities.imposed_levels`), no payload and level ground.

    Args:
        battery: True if the runs are on the battery, which removes the axis of voltages.
        notes: list to which a sentence on values that follow from a rig's limit is added.

    Raises:
        BadConfiguration: the robot lacks an axis, an axis is neither stated nor determined by a limit, or a surface
            or configuration is unknown.
    """
    layout = Layout.of(robot)
    imposed_axis = AXIS[layout.imposed]
    for key in AXIS.values():
        if key != imposed_axis and getattr(config, key) is not None:
            raise BadConfiguration(capabilities.option_refusal(robot, OPTIONS[key], OPTIONS[imposed_axis]))
    ground, shaft = (
        [OPTIONS[key] for key in keys if getattr(config, key) is not None] for keys in (ON_GROUND, ON_SHAFT)
    )
    capabilities.check_acting(robot, ground, shaft)
    surface = config.surface
    if surface is not None and robot.rig.scales_adhesion:
        stated_word(surface, SURFACES, OPTIONS["surface"], f"got {surface!r}")
    update: dict[str, object] = {"configurations": grid_configurations(config, robot)}
    if battery:
        capabilities.check_battery(robot)
    elif getattr(config, imposed_axis) is None:
        update[imposed_axis] = capabilities.imposed_levels(robot, OPTIONS[imposed_axis], notes)
    if robot.has_ground:
        inherits = robot.rig.inherits
        update |= {
            "payloads_kg": config.payloads_kg or (PAYLOADS_KG if inherits else (0.0,)),
            "slopes_deg": config.slopes_deg or (SLOPES_DEG if inherits else (0.0,)),
            "surface": config.surface or (BENCH if inherits else None),
        }
    return config.model_copy(update=update)


def grid_axes(config: GridPart, robot: Robot, battery: bool) -> dict[str, tuple[object, ...]]:
    """Values of each axis of a grid, by column. The slope is last.

    Args:
        config: grid from `resolve_grid`.
        battery: True if the runs are on the battery.

    Raises:
        BadConfiguration: a configuration that the robot does not have.
    """
    layout = Layout.of(robot)
    axes: dict[str, tuple[object, ...]] = {
        "configuration": grid_configurations(config, robot),
        layout.imposed_column: (math.nan,) if battery else getattr(config, AXIS[layout.imposed]),
    }
    loads = {LOAD: config.load_torques_Nm, "payload_kg": config.payloads_kg, "slope_deg": config.slopes_deg}
    return axes | {column: values for column, values in loads.items() if values}


def grid_conditions(config: GridPart, robot: Robot, battery: bool = False) -> Runs:
    """Every combination of the axes as a table of conditions. The slope varies fastest.

    Args:
        config: grid, resolved or not.
        battery: True if the runs are on the battery.

    Raises:
        BadConfiguration: for the same reasons as `resolve_grid`.
    """
    config = resolve_grid(config, robot, battery)
    values = grid_axes(config, robot, battery)
    points = list(itertools.product(*values.values()))
    columns = {name: np.array(column) for name, column in zip(values, zip(*points, strict=True), strict=True)}
    if config.surface is not None:
        columns["surface"] = np.full(len(points), config.surface)
    return Runs(source="the grid", columns=columns, layout=Layout.of(robot))


def grid_configurations(config: GridPart, robot: Robot) -> Names:
    """Configurations of a grid: the stated ones, or all configurations of the robot.

    Raises:
        BadConfiguration: a configuration that the robot does not have.
    """
    if config.configurations is None:
        return robot.configurations.names
    check_configurations(robot, config.configurations, "configurations")
    return config.configurations


#: One value of an axis, or several.
Axis = Sequence[float] | np.ndarray | float | None


def sweep(
    robot: Robot,
    *,
    configurations: Sequence[str] | str | None = None,
    voltages: Axis = None,
    motor_speeds_rpm: Axis = None,
    motor_currents_A: Axis = None,
    payloads: Axis = None,
    slopes_deg: Axis = None,
    surface: str | None = None,
    load_torques: Axis = None,
    battery: bool = False,
    discharge: float = 0.0,
    model: str = "steady",
    **options: Any,
) -> Results:
    """Simulates every combination of a grid. The slope varies fastest. The default is Table 8.

    Args:
        configurations: names. None: all.
        voltages: voltages [V]. Rigs with another imposed quantity take motor_speeds_rpm [rpm] or motor_currents_A [A]
            instead.
        payloads: payloads [kg].
        slopes_deg: slopes [deg].
        surface: surface of Table 5.
        load_torques: load torques of a load on a shaft [N·m].
        battery: True if the on-board battery feeds the motors.
        discharge: charge drawn from it so far [C].
        model, options: as in `simulate`.

    Returns:
        Results of shape (runs,).

    Raises:
        BadConfiguration: the robot lacks a configuration or an axis, or the surface is unknown.
        UsageError: for the same reasons as `simulate`.
    """
    names = (configurations,) if isinstance(configurations, str) else configurations
    config = GridPart.model_construct(
        configurations=None if names is None else tuple(names),
        voltages_V=_axis(voltages), motor_speeds_rpm=_axis(motor_speeds_rpm),
        motor_currents_A=_axis(motor_currents_A), payloads_kg=_axis(payloads),
        slopes_deg=_axis(slopes_deg), surface=surface, load_torques_Nm=_axis(load_torques),
    )  # fmt: skip
    runs = grid_conditions(config, robot, battery)
    return simulate(robot, runs.conditions(robot, battery=float(battery), discharge=discharge), model, **options)


def _axis(values: Axis) -> tuple[float, ...] | None:
    return None if values is None else tuple(float(v) for v in np.atleast_1d(np.asarray(values, float)))
