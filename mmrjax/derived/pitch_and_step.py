"""Pitch and highest step of a run with its levers as they stand, and the highest step in any posture of them."""

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
    """How one run's robot stands and which step its geometry allows, whatever drives it.

    Returns:
        `pitch` [rad]; `highest_step`, of this posture, and `best_step`, of any [m]; `status`: always `converged`.
    """
    found = {
        "pitch": resting_posture.posture(robot, conditions).pitch,
        "highest_step": static_limits.step(resting_posture.outline(robot, conditions)).height,
        "best_step": static_limits.best_step(robot, conditions)[0].height,
    }
    return {name: jnp.asarray(x) for name, x in found.items()} | {"status": jnp.asarray(CONVERGED)}
