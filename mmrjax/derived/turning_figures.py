"""Quantities of a turn: radius, instantaneous centre, effective width, power and temperature of each side."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from mmrjax.compile.compiling import compiled
from mmrjax.fidelities.steady import steady
from mmrjax.model import channels
from mmrjax.model.conditions import Conditions
from mmrjax.model.quantities import MM
from mmrjax.model.robot import Robot

#: Yaw rate below which a robot travels straight [rad/s]; a full turn would take two centuries.
NONE = 1e-9
#: Channels of a motion in the plane.
PLANE = ("speed", "lateral_speed", "yaw_rate")


def turning_radius(ahead: Any, aside: Any, rate: Any) -> Array:
    """Radius of the circle on which the centre of mass moves, positive to the left, inf in straight travel [m].

    Args:
        ahead, aside: speeds of the centre of mass [m/s].
        rate: yaw rate [rad/s]. All arguments have the same shape.
    """
    is_turning = jnp.abs(rate) > NONE
    path_speed = jnp.sqrt(jnp.maximum(jnp.square(ahead) + jnp.square(aside), 1e-24))  # a root of 0 has no derivative
    turn_sign = jnp.where(jnp.asarray(ahead) * rate < 0, -1.0, 1.0)
    return jnp.where(is_turning, turn_sign * path_speed / jnp.where(is_turning, jnp.abs(rate), 1.0), jnp.inf)


@compiled
def compute(robot: Robot, conditions: Conditions) -> dict[str, Array]:
    """Radius of the settled turn of one run.

    Returns:
        `turning_radius` [m], NaN if no turn settles. `status` of the turn. Derivatives are implicit.
    """
    point = steady(robot, conditions)
    radius = turning_radius(*(point.reading[name] for name in PLANE))
    return {"turning_radius": jnp.where(jnp.isnan(point.speed), jnp.nan, radius), "status": point.status}


def turning_columns(robot: Robot, reading: Mapping[str, Any], radius: np.ndarray) -> dict[str, np.ndarray]:
    """Table columns of settled turns, from the readings of their channels [SI], all of the same shape.

    Args:
        radius: radius of the driving wheels [m].
    """
    yaw_rate = np.asarray(reading["yaw_rate"])
    # A value within rounding of zero is no radius.
    yaw_rate_nonzero = np.where(np.abs(yaw_rate) > NONE, yaw_rate, np.nan)
    shaft_speeds = {side: np.asarray(reading[f"motor_speed_{side}"]) for side in channels.SIDES}
    theoretical_speeds = {side: radius * n / float(robot.gearbox.ratio) for side, n in shaft_speeds.items()}
    motors_per_side = float(robot.sides) / 2
    centre_x = -np.asarray(reading["lateral_speed"]) / yaw_rate_nonzero
    centre_y = np.asarray(reading["speed"]) / yaw_rate_nonzero
    columns = {
        "turning_radius_mm": np.asarray(turning_radius(*(np.asarray(reading[name]) for name in PLANE))) / MM,
        "centre_x_mm": centre_x / MM,
        "centre_y_mm": centre_y / MM,
        "effective_width_mm": (theoretical_speeds["right"] - theoretical_speeds["left"]) / yaw_rate_nonzero / MM,
    }
    for side in channels.SIDES:
        current = np.asarray(reading[f"motor_current_{side}"])
        columns[f"power_{side}_W"] = motors_per_side * np.asarray(reading[f"motor_voltage_{side}"]) * current
    for side in channels.SIDES:
        current = np.asarray(reading[f"motor_current_{side}"])
        columns[f"winding_{side}_C"] = np.asarray(robot.motor.temperature_settled(jnp.asarray(current)))
    return {name: np.where(np.isnan(yaw_rate), np.nan, x) for name, x in columns.items()}
