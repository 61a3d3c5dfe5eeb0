"""Grids of operating points as tables of runs."""

from __future__ import annotations

import itertools

import numpy as np

from calibration.data.runs import Runs
from mmrjax.robot import Robot
from sweeps.config import GridPart
from sweeps.inputs import check_configurations


def grid(config: GridPart, robot: Robot, battery: bool = False) -> Runs:
    """Every combination of the axes as a table of conditions, slope varying fastest.

    Args:
        battery: whether the runs are on the battery, where the axis of voltages drops out.

    Raises:
        BadConfiguration: a configuration that the robot does not have.
    """
    names = configurations(config, robot)
    points = list(itertools.product(names, config.volts(battery), config.payloads_kg, config.slopes_deg))
    configuration, voltage, payload, slope = (np.array(column) for column in zip(*points, strict=True))
    return Runs(
        source="the grid",
        columns={
            "configuration": configuration,
            "supply_voltage_V": voltage,
            "payload_kg": payload,
            "slope_deg": slope,
            "surface": np.full(len(points), config.surface),
        },
    )


def configurations(config: GridPart, robot: Robot) -> tuple[str, ...]:
    """The configurations of a grid: those stated, each of which the robot has, or all of the robot's.

    Raises:
        BadConfiguration: one that the robot does not have.
    """
    if config.configurations is None:
        return robot.configurations.names
    check_configurations(robot, config.configurations, "configurations")
    return config.configurations
