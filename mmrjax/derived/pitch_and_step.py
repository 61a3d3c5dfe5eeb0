"""Pitch and highest step of a run at its lever angles, and the highest step at any lever angles."""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array

from mmrjax.climbing import resting_posture, static_limits
from mmrjax.compile.compiling import compiled
from mmrjax.model.conditions import Conditions
from mmrjax.model.robot import Robot
from mmrjax.model.signals import CONVERGED


@compiled
def compute(robot: Robot, conditions: Conditions) -> dict[str, Array]:
    """Pitch and highest steps of the robot of one run, from geometry alone.

    Returns:
        `pitch` [rad], `highest_step`, in this posture, and `best_step`, in any [m], `status`: always `converged`.
    """
    columns = {
        "pitch": resting_posture.posture(robot, conditions).pitch,
        "highest_step": static_limits.find_highest_step(resting_posture.side_outline(robot, conditions)).height,
        "best_step": static_limits.best_step(robot, conditions)[0].height,
    }
    return {name: jnp.asarray(x) for name, x in columns.items()} | {"status": jnp.asarray(CONVERGED)}
