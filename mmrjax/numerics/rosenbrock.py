"""The stages of Rodas4, a stiff method for small autonomous ODEs that solves only linear systems.

Source: Hairer and Wanner, Solving Ordinary Differential Equations II (1996), Section IV.7, RODAS.
"""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from mmrjax.model.conditions import Conditions
from mmrjax.model.params import Scalar
from mmrjax.model.robot import Robot
from mmrjax.numerics.linear_equations import inverse

#: Unknowns in their units, or their rates.
Unknowns = Float[Array, " unknowns"]

_GAMMA = 0.25
_A = (
    (1.544000000000000,),
    (0.9466785280815826, 0.2557011698983284),
    (3.314825187068521, 2.896124015972201, 0.9986419139977817),
    (1.221224509226641, 6.019134481288629, 12.53708332932087, -0.6878860361058950),
)
_C = (
    (-5.668800000000000,),
    (-2.430093356833875, -0.2063599157091915),
    (-0.1073529058151375, -9.594562251023355, -20.47028614809616),
    (7.496443313967647, -10.24680431464352, -33.99990352819905, 11.70890893206160),
    (8.083246795921522, -7.981132988064893, -31.52159432874371, 16.31930543123136, -6.058818238834054),
)

#: Share of a step's change that counts as its error if it crosses a kink [-].
KINK = 1e-2


def error_norm(error: Unknowns, count: int, weight: float | np.ndarray = 1.0) -> Scalar:
    """Root mean square of an error of the robot's `count` unknowns. Memories add to it and never dilute it."""
    return jnp.sqrt(jnp.sum(weight * error**2) / count)


def error_norm_of_sides(error: Unknowns, of_robot: slice, count: int) -> Scalar:
    """Same as `error_norm` for unknowns of both sides and those of the `of_robot` robot.

    A pair counts as one unknown, so that with equal sides the steps are those of the `count` unknowns of straight
    travel.
    """
    weight = np.full(error.shape[0], 0.5)
    weight[of_robot] = 1.0
    return error_norm(error, count, weight)


def error_across_kink(error: Unknowns, y0: Unknowns, y1: Unknowns, kink: Array) -> Unknowns:
    """Error of a step, with `KINK` of the unknowns' change if it crosses a kink of the rates.

    The method linearises at the start of a step, so that its estimate does not see a kink within it. With this share
    the step becomes short.
    """
    return error + jnp.where(kink, KINK * jnp.abs(y1 - y0), 0.0) * jnp.where(error < 0, -1.0, 1.0)


def step_longest(robot: Robot, conditions: Conditions) -> Array | None:
    """The longest step that resolves every effect with a memory [s], None if no effect limits it."""
    limits = [jnp.asarray(effect.step_longest(robot, conditions)) for effect in robot.remembering]
    return jax.lax.stop_gradient(jnp.min(jnp.stack(limits))) if limits else None


def rosenbrock_stages(
    rates: Callable[[Array], tuple[Array, Array]],
    y0: Float[Array, " n"],
    q0: Float[Array, " m"],
    h: Array,
    looped: bool = False,
) -> tuple[Array, Array, Array | list[Array], Array | list[Array]]:
    """One step of length `h`, with integrals that do not act back on the unknowns.

    The equations of the integrals q' = g(y) need no linear system: their part of the matrix is triangular.

    Args:
        rates: f(y) and g(y).
        looped: True to include `rates` once for all stages but the first, in a program that compiles faster.

    Returns:
        y and q at the end of the step, and the stages of both. The last stage estimates the error.
    """

    def both(y: Array) -> tuple[tuple[Array, Array], tuple[Array, Array]]:
        values = rates(y)
        return values, values

    (jacobian, jacobian_q), (f, g) = jax.jacfwd(both, has_aux=True)(y0)
    # A vanishing pivot spoils the step, and the error control rejects it; a shorter step makes the diagonal dominate.
    inverted = inverse(jnp.eye(y0.shape[0], dtype=y0.dtype) / (h * _GAMMA) - jacobian)[0]
    u, v, y, q = [inverted @ f], [], y0, q0
    v.append(h * _GAMMA * (g + jacobian_q @ u[0]))
    if looped:
        return _loop_over_stages(rates, inverted, jacobian_q, y0, q0, h, u[0], v[0])
    for stage in range(1, 6):
        y = y + u[-1] if stage == 5 else y0 + sum(a * x for a, x in zip(_A[stage - 1], u, strict=True))
        q = q + v[-1] if stage == 5 else q0 + sum(a * x for a, x in zip(_A[stage - 1], v, strict=True))
        f, g = rates(y)
        u.append(inverted @ (f + sum(c * x for c, x in zip(_C[stage - 1], u, strict=True)) / h))
        v.append(
            h * _GAMMA * (g + sum(c * x for c, x in zip(_C[stage - 1], v, strict=True)) / h + jacobian_q @ u[-1])
        )
    return y + u[-1], q + v[-1], u, v


def _loop_over_stages(
    rates: Callable[[Array], tuple[Array, Array]],
    inverted: Array,
    jacobian_q: Array,
    y0: Array,
    q0: Array,
    h: Array,
    first: Array,
    first_q: Array,
) -> tuple[Array, Array, Array, Array]:
    """The stages after the first, see `rosenbrock_stages`, in one loop."""
    unknown_weights = np.zeros((5, 6))  # of the second to the sixth stage; the sixth begins at the end of the fifth
    for row, weights in enumerate((*_A, (*_A[-1], 1.0))):
        unknown_weights[row, : len(weights)] = weights
    rate_weights = np.zeros((5, 6))
    for row, weights in enumerate(_C):
        rate_weights[row, : len(weights)] = weights

    def solve_next_stage(k: Array, stages: tuple[Array, Array]) -> tuple[Array, Array]:
        u, v = stages
        a, c = jnp.asarray(unknown_weights)[k], jnp.asarray(rate_weights)[k]
        f, g = rates(y0 + a @ u)
        stage = inverted @ (f + (c @ u) / h)
        return u.at[k + 1].set(stage), v.at[k + 1].set(h * _GAMMA * (g + (c @ v) / h + jacobian_q @ stage))

    stage_arrays = [jnp.zeros((6, *x.shape), x.dtype).at[0].set(x) for x in (first, first_q)]
    u, v = jax.lax.fori_loop(0, 5, solve_next_stage, (stage_arrays[0], stage_arrays[1]))
    last = jnp.asarray(unknown_weights)[4].at[5].set(1.0)
    return y0 + last @ u, q0 + last @ v, u, v
