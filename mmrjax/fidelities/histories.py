"""Fidelity `drive` on a grid of time that is given, cheap to differentiate in many directions at once.

The same rates as `drive`, by an implicit method of fixed steps: SDIRK2, two stages, order 2, L-stable and
stiffly accurate (Alexander, Diagonally implicit Runge-Kutta methods for stiff O.D.E.'s, SIAM J. Numer. Anal. 14
(1977)). A derivative follows from the implicit function theorem stage by stage: linear equations with the matrix
of Newton's method at the solution, so that a direction more costs one tangent of the rates a stage, instead of a
rollout.
"""

from __future__ import annotations

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from mmrjax.conditions import Conditions
from mmrjax.fidelities.drive import moving, rates, start, state_of
from mmrjax.robot import Robot
from mmrjax.signals import Signals

_GAMMA = 1 - 0.5**0.5
#: Most Newton steps of a stage, which starts where the last one ended, and what its equations may leave in the
#: units of the unknowns (10 A, 1000 rad/s, 1 m/s).
NEWTON, SOLVED = 30, 1e-9
#: The first step, its growth with the time since the start [1/s · s], and the longest step [s].
FIRST, GROWTH, LONGEST = 1e-5, 0.02, 2.5e-3
#: Most steps of a run that LONGEST may ask for; a longer run has longer steps.
STEPS = 8000


def grid(times: Float[np.ndarray, " times"]) -> np.ndarray:
    """Instants from 0 to the last of `times` [s], `times` among them, close together while a start is young."""
    times = np.unique(np.concatenate([[0.0], np.asarray(times, float)]))
    longest = max(LONGEST, times[-1] / STEPS)
    knee = max((longest - FIRST) / GROWTH, 0.0)

    def clock(t: np.ndarray) -> np.ndarray:  # steps taken up to t: ∫ dt / min(longest, FIRST + GROWTH t)
        young = np.log1p(GROWTH * np.minimum(t, knee) / FIRST) / GROWTH
        return young + np.maximum(t - knee, 0.0) / longest

    at, at_knee = clock(times), clock(np.asarray(knee))
    parts = []
    for k in range(len(times) - 1):
        count = max(1, int(np.ceil(at[k + 1] - at[k] - 1e-9)))
        wanted = np.linspace(at[k], at[k + 1], count, endpoint=False)
        young = FIRST / GROWTH * np.expm1(GROWTH * np.minimum(wanted, at_knee))
        parts.append(young + np.maximum(wanted - at_knee, 0.0) * longest)
        parts[-1][0] = times[k]
    return np.concatenate([*parts, times[-1:]])


def _matrix(robot: Robot, conditions: Conditions, y: Array, h: Array) -> tuple[Array, Array]:
    """I - γ h ∂f/∂y, and f."""

    def f(y: Array) -> tuple[Array, Array]:
        value = rates(robot, conditions, y)
        return value, value

    jacobian, value = jax.jacfwd(f, has_aux=True)(y)
    return jnp.eye(y.shape[0], dtype=y.dtype) - _GAMMA * h * jacobian, value


def _stage(robot: Robot, conditions: Conditions, known: Array, guess: Array, h: Array) -> Array:
    """Y = known + γ h f(Y)."""

    def left(y: Array) -> Array:
        return y - known - _GAMMA * h * rates(robot, conditions, y)

    def newton(state: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        count, y, _ = state
        matrix, value = _matrix(robot, conditions, y, h)
        step = jnp.linalg.solve(matrix, y - known - _GAMMA * h * value)
        # Over a kink of the friction law full steps can swing to and fro for ever.
        whole, part = y - step, y - 0.3 * step
        of_whole, of_part = jnp.max(jnp.abs(left(whole))), jnp.max(jnp.abs(left(part)))
        y = jnp.where(of_part < of_whole, part, whole)
        return count + 1, y, jnp.minimum(of_part, of_whole)

    def going(state: tuple[Array, Array, Array]) -> Array:
        return (state[0] < NEWTON) & (state[2] > SOLVED)

    _, y, error = jax.lax.while_loop(going, newton, (jnp.asarray(0), guess, jnp.asarray(jnp.inf, guess.dtype)))
    return jnp.where(error <= SOLVED, y, jnp.nan)


@eqx.filter_custom_jvp
def states(robot: Robot, conditions: Conditions, times: Float[Array, " times"]) -> tuple[Array, Array]:
    """Unknowns of one run from standstill at both stages of every step, shape (steps, unknowns) each."""
    y0 = start(robot, conditions)

    def step(y: Array, h: Array) -> tuple[Array, tuple[Array, Array]]:
        one = _stage(robot, conditions, y, y, h)
        two = _stage(robot, conditions, y + (1 - _GAMMA) / _GAMMA * (one - y), one, h)
        return two, (one, two)

    return jax.lax.scan(step, y0, jnp.diff(times))[1]


@states.def_jvp
def _response(primals: tuple, tangents: tuple) -> tuple[tuple[Array, Array], tuple[Array, Array]]:
    robot, conditions, times = primals
    moved = tangents[0]
    stages = states(robot, conditions, times)

    def source(_: Array, y: Array) -> Array:
        return eqx.filter_jvp(lambda r: rates(r, conditions, y), (robot,), (moved,))[1]

    return stages, respond(robot, conditions, times, stages, source, lambda y, dy: dy)


def respond(
    robot: Robot,
    conditions: Conditions,
    times: Float[Array, " times"],
    stages: tuple[Array, Array],
    source: Callable[[Array, Array], Array],
    seen: Callable[[Array, Array], Array],
) -> tuple[Array, Array]:
    """What small changes of the rates do to a run.

    Args:
        stages: of the run, from `states`.
        source: (time, state) → change of the rates there, shape (unknowns, ...).
        seen: (state, its change) → what is kept of the change, of every stage.

    Returns:
        What is kept of the first and of the second stage of every step; the second is the step's end.
    """

    def step(dy: Array, inputs: tuple) -> tuple[Array, tuple[Array, Array]]:
        t, h, one, two = inputs
        first = jnp.linalg.inv(_matrix(robot, conditions, one, h)[0])
        second = jnp.linalg.inv(_matrix(robot, conditions, two, h)[0])
        d1 = jnp.tensordot(first, dy + _GAMMA * h * source(t + _GAMMA * h, one), 1)
        known = dy + (1 - _GAMMA) / _GAMMA * (d1 - dy)
        d2 = jnp.tensordot(second, known + _GAMMA * h * source(t + h, two), 1)
        return d2, (seen(one, d1), seen(two, d2))

    still = jnp.zeros_like(source(times[0], stages[0][0]))
    return jax.lax.scan(step, still, (times[:-1], jnp.diff(times), *stages))[1]


def histories(robot: Robot, conditions: Conditions, times: Float[Array, " times"]) -> Signals:
    """Signals of one run from standstill at every instant of a grid; fields have shape (times,).

    Args:
        robot: its parameters may be tracers; derivatives by them, and by nothing else, are forward and exact
            for these steps.
        conditions: one run, scalar fields.
        times: from 0 on, as by `grid` [s]; repeated instants are steps of no length.

    A run that could not be followed is not finite from there on.
    """
    y0 = start(robot, conditions)
    _, nodes = states(robot, conditions, times)
    ys = jnp.concatenate([y0[None], nodes])
    return jax.vmap(lambda y: moving(robot, conditions, state_of(robot, y)))(ys)
