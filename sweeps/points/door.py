"""A sweep from Python: every combination of a grid, simulated in one call."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from mmrjax.fidelities.results import Results
from mmrjax.fidelities.simulation import simulate
from mmrjax.model.robot import Robot
from sweeps.config import GridPart
from sweeps.points.grid import grid_conditions

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
