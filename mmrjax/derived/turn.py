"""What follows from how a robot turns: radius, instantaneous centre, effective width, what each side takes."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from mmrjax import channels
from mmrjax.channels import MM
from mmrjax.conditions import OF_SIDES, Conditions
from mmrjax.fidelities.steady import steady_batch
from mmrjax.robot import Robot
from mmrjax.signals import Result

#: Yaw rate below which a robot travels straight [rad/s]; its turn would take two centuries.
NONE = 1e-9
#: Columns, with what they are.
COLUMNS: dict[str, str] = {
    "turning_radius_mm": "radius of the circle of the centre of mass, positive to the left; inf: straight",
    "centre_x_mm": "instantaneous centre of rotation ahead of the centre of mass",
    "centre_y_mm": "instantaneous centre of rotation to the left of the centre of mass",
    "effective_width_mm": "effective track width (V_teor,right - V_teor,left) / yaw rate",
    "power_left_W": "electrical power of the left motor", "power_right_W": "electrical power of the right motor",
    "winding_left_C": "winding of the left motor after long running",
    "winding_right_C": "winding of the right motor after long running",
}  # fmt: skip


def by_itself(robot: Robot, imposed: float) -> Result:
    """How a robot whose sides differ turns on level ground where both are driven alike, a settled turn of each of its
    configurations in order.

    Args:
        imposed: voltage [V], or motor speed [rad/s] where that is what its rig imposes.
    """
    both = OF_SIDES[-2:] if robot.rig.imposed == "motor_speed" else OF_SIDES[:2]
    alike = dict.fromkeys(both, imposed if robot.rig.imposed == "motor_speed" else 1.0)
    asked = Conditions([*robot.configurations], voltage=abs(imposed), **alike).resolved(robot)
    return jax.device_get(steady_batch(robot, asked))


def columns(robot: Robot, reading: Mapping[str, Any], radius: np.ndarray) -> dict[str, np.ndarray]:
    """The columns of settled turns, of what their channels read [SI]; arrays of one shape.

    Args:
        radius: of the driving wheels [m].
    """
    turn = np.asarray(reading["yaw_rate"])
    # What is left of zero by rounding is no radius.
    rate = np.where(np.abs(turn) > NONE, turn, np.nan)
    shafts = {side: np.asarray(reading[f"motor_speed_{side}"]) for side in channels.SIDES}
    rolled = {side: radius * n / float(robot.gearbox.ratio) for side, n in shafts.items()}
    units = float(robot.sides) / 2
    ahead, left = (-np.asarray(reading["lateral_speed"]) / rate, np.asarray(reading["speed"]) / rate)
    found = {
        "turning_radius_mm": np.where(np.isnan(rate), np.inf, np.copysign(np.hypot(ahead, left), left) / MM),
        "centre_x_mm": ahead / MM,
        "centre_y_mm": left / MM,
        "effective_width_mm": (rolled["right"] - rolled["left"]) / rate / MM,
    }
    for side in channels.SIDES:
        current = np.asarray(reading[f"motor_current_{side}"])
        found[f"power_{side}_W"] = units * np.asarray(reading[f"motor_voltage_{side}"]) * current
    for side in channels.SIDES:
        current = np.asarray(reading[f"motor_current_{side}"])
        found[f"winding_{side}_C"] = np.asarray(robot.motor.temperature_settled(jnp.asarray(current)))
    return {name: np.where(np.isnan(turn), np.nan, x) for name, x in found.items()}
