"""The steepest slope on which a robot still travels uphill: it neither slides nor stalls there."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import optimistix as optx
from jaxtyping import Array, Float

from mmrjax.compile.compiling import compiled
from mmrjax.fidelities.steady import operating, operating_point
from mmrjax.model.conditions import Conditions
from mmrjax.model.params import Scalar
from mmrjax.model.quantities import CONDITIONS
from mmrjax.model.robot import Robot
from mmrjax.model.signals import CONVERGED, Signals

#: The steepest slope that is looked at [deg]; a robot that holds it is said to hold this.
STEEPEST = CONDITIONS["slope_deg"].range[1]
#: Halvings of the bracket; what they leave, 3e-6 of a degree, one step of Newton's method takes off.
HALVINGS = 24


def margin(robot: Robot, conditions: Conditions, slope_deg: Scalar) -> Float[Array, ""]:
    """What is left on a slope of the limit that is nearer [-], see `travel_margin`."""
    conditions = dataclasses.replace(conditions, slope_deg=jnp.asarray(slope_deg))
    return travel_margin(robot, operating(robot, conditions)[0])


def travel_margin(robot: Robot, signals: Signals) -> Float[Array, ""]:
    """What is left of the limit that is nearer [-]: of adhesion, 1 - demand / limit, or of speed, V / (V_s / 10) - 1.

    Positive where `steady` says `converged`; continuous through the edge, whichever it is.
    """
    rest = robot.chassis(signals.configuration).speed_still
    slowest = jnp.minimum(signals.speed_theoretical, signals.speed)
    return jnp.minimum(1.0 - signals.demand / signals.adhesion_limit, slowest / rest - 1.0)


@compiled
def compute(robot: Robot, conditions: Conditions) -> dict[str, Array]:
    """Steepest slope held by one run's voltage and payload; its own slope does not matter.

    The root of `margin` between the flat and `STEEPEST`, by bisection. Derivatives are implicit,
    dα = -(∂margin/∂α)⁻¹ ∂margin/∂θ dθ, forward and reverse.

    Returns:
        `steepest_slope` [deg], NaN where not even the flat is held; `STEEPEST` where that is held, with zero
        derivatives. `status` is that of the flat.
    """
    flat = operating_point(robot, dataclasses.replace(conditions, slope_deg=jnp.zeros_like(conditions.slope_deg)))[0]
    still_robot, still = jax.lax.stop_gradient((robot, conditions))

    found: optx.Solution = optx.root_find(
        lambda slope, _: margin(still_robot, still, slope),
        optx.Bisection(rtol=0.0, atol=0.0, flip=True),
        jnp.full_like(conditions.slope_deg, STEEPEST / 2),
        options={"lower": 0.0, "upper": STEEPEST},
        max_steps=HALVINGS,
        throw=False,
    )
    at = jax.lax.stop_gradient(found.value)
    slope = jax.lax.stop_gradient(jax.jvp(lambda a: margin(still_robot, still, a), (at,), (jnp.ones_like(at),))[1])
    held = at - margin(robot, conditions, at) / slope
    holds_all = margin(still_robot, still, jnp.full_like(at, STEEPEST)) > 0
    held = jnp.where(holds_all, STEEPEST, jnp.clip(held, 0.0, STEEPEST))
    return {"steepest_slope": jnp.where(flat.status == CONVERGED, held, jnp.nan), "status": flat.status}
