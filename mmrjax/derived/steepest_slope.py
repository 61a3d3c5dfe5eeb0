"""Steepest slope that a robot climbs without sliding or stalling."""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
import optimistix as optx
from jaxtyping import Array, Float

from mmrjax.compile.compiling import compiled
from mmrjax.fidelities.steady import operating_point, operating_state
from mmrjax.model.conditions import Conditions
from mmrjax.model.params import Scalar
from mmrjax.model.quantities import CONDITIONS
from mmrjax.model.robot import Robot
from mmrjax.model.signals import CONVERGED, Signals
from mmrjax.numerics.elementary import value_and_slope

#: The steepest slope considered [deg], returned for robots that hold it.
STEEPEST = CONDITIONS["slope_deg"].range[1]
#: Halvings of the bracket; one Newton step removes the remaining 3e-6 degrees.
HALVINGS = 24


def slope_margin(robot: Robot, conditions: Conditions, slope_deg: Scalar) -> Float[Array, ""]:
    """The smaller of the margins of adhesion and of speed on a slope [-], see `travel_margin`."""
    conditions = replace(conditions, slope_deg=jnp.asarray(slope_deg))
    return travel_margin(robot, operating_state(robot, conditions)[0])


def travel_margin(robot: Robot, signals: Signals) -> Float[Array, ""]:
    """The smaller of two margins [-]: of adhesion, 1 - demand / limit, and of speed, V / (V_s / 10) - 1.

    Positive if `steady` would converge. Both are continuous beyond their limit.
    """
    speed_rest = robot.chassis(signals.configuration).speed_still
    speed_least = jnp.minimum(signals.speed_theoretical, signals.speed)
    return jnp.minimum(1.0 - signals.demand / signals.adhesion_limit, speed_least / speed_rest - 1.0)


@compiled
def compute(robot: Robot, conditions: Conditions) -> dict[str, Array]:
    """Steepest slope for the voltage and payload of one run. The slope of the run has no influence.

    The root of `slope_margin` between level ground and `STEEPEST`, by bisection. Derivatives are implicit, dα =
    -(∂margin/∂α)⁻¹ ∂margin/∂θ dθ, forward and reverse.

    Returns:
        `steepest_slope` [deg], NaN if the robot does not travel on level ground, `STEEPEST`, with zero derivatives,
        if it climbs that. `status` is that of level ground.
    """
    level_point = operating_point(robot, replace(conditions, slope_deg=jnp.zeros_like(conditions.slope_deg)))[0]
    constant_robot, constant_conditions = jax.lax.stop_gradient((robot, conditions))

    solution: optx.Solution = optx.root_find(
        lambda derivative, _: slope_margin(constant_robot, constant_conditions, derivative),
        optx.Bisection(rtol=0.0, atol=0.0, flip=True),  # type: ignore[call-arg]  # its norm is no field
        jnp.full_like(conditions.slope_deg, STEEPEST / 2),
        options={"lower": 0.0, "upper": STEEPEST},
        max_steps=HALVINGS,
        throw=False,
    )
    root = jax.lax.stop_gradient(solution.value)
    derivative = jax.lax.stop_gradient(
        value_and_slope(lambda a: slope_margin(constant_robot, constant_conditions, a), root)[1]
    )
    steepest = root - slope_margin(robot, conditions, root) / derivative
    holds_all = slope_margin(constant_robot, constant_conditions, jnp.full_like(root, STEEPEST)) > 0
    steepest = jnp.where(holds_all, STEEPEST, jnp.clip(steepest, 0.0, STEEPEST))
    return {
        "steepest_slope": jnp.where(level_point.status == CONVERGED, steepest, jnp.nan),
        "status": level_point.status,
    }
