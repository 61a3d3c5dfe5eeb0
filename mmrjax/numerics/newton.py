"""Newton's method for a few unknowns over a large batch, with derivatives by the implicit function theorem.

For 65 536 points of `steady` on two cores the loop takes 27 ms of processor time. The same method called through
optimistix takes 29 ms (medians of four turns of ten calls, alternating in one run, 2026-11-28). optimistix's `Newton`
takes 3.1 times as long, because it factorises by batched calls of LAPACK. The derivative is written here. A program
with optimistix's derivative (`ImplicitAdjoint`) contains a host callback, through lineax. JAX's cache never stores
such a program.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.custom_derivatives import SymbolicZero
from jaxtyping import Array, Bool, Float

from mmrjax.numerics import batch_flow
from mmrjax.numerics.batch_flow import compute_if_needed
from mmrjax.numerics.elementary import value_and_slope
from mmrjax.numerics.linear_equations import Entry, Matrix, Vector, factorise, regularise, substitute

#: f(y, shared, member_data): as many scalars as unknowns, so that in a batch each is an array.
Residual = Callable[[Vector, Any, Any], Vector]


#: Linearisations after which a search has failed.
MAX_STEPS = 60
#: Turns of full steps after which a search is bounded.
PATIENCE = 8
#: Members that turn together where each ends on its own: enough to fill vectors.
TOGETHER = 64


def _linearised(residual: Residual, y: Vector, args: tuple[Any, Any], one_by_one: bool) -> tuple[Matrix, Vector]:
    """∂f/∂y by its rows, and f.

    `one_by_one`: one unknown after another, so that rows that do not depend on it cost nothing. Otherwise all
    together, in a program of a third of the size.
    """
    if not one_by_one:

        def together(y: Array) -> tuple[Vector, Vector]:
            values = residual(tuple(y), *args)
            return values, values

        slopes, value = jax.jacfwd(together, has_aux=True)(jnp.stack(y))
        return [tuple(row) for row in slopes], value
    columns: list[list[Entry]] = []
    value = y
    for k in range(len(y)):
        nonzero_rows: set[int] = set()

        def residual_along(x: Array, k: int = k, nonzero: set[int] = nonzero_rows) -> Vector:
            values = residual((*y[:k], x, *y[k + 1 :]), *args)
            return tuple(_watch_derivative(v, i, nonzero) for i, v in enumerate(values))

        value, column = value_and_slope(residual_along, y[k])
        columns.append([x if i in nonzero_rows else None for i, x in enumerate(column)])
    return list(zip(*columns, strict=True)), value


def _watch_derivative(value: Array, index: int, nonzero: set[int]) -> Array:
    """`value`. While it is differentiated, `index` is added to `nonzero` if it has a derivative."""

    @jax.custom_jvp
    def watched(x: Array) -> Array:
        return x

    def rule(primals: tuple, tangents: tuple) -> tuple[Array, Any]:
        if not isinstance(tangents[0], SymbolicZero):
            nonzero.add(index)
        return primals[0], tangents[0]

    watched.defjvp(rule, symbolic_zeros=True)
    return watched(value)


def _is_small(value: Vector, tolerance: float) -> Bool[Array, ""]:
    return functools.reduce(jnp.logical_and, [jnp.abs(x) < tolerance for x in value], jnp.asarray(True))


def _solve_step(factors: list, value: Vector) -> Vector:
    return tuple(jnp.zeros(()) if x is None else x for x in substitute(factors, value))


def _subtract_step(y: Vector, step: Vector) -> Vector:
    """y - step, with unknowns unchanged that would not be finite."""
    return tuple(jnp.where(jnp.isfinite(b), a - b, a) for a, b in zip(y, step, strict=True))


class NewtonState(eqx.Module):
    """State of a search.

    Full steps between branches of f can alternate without end. After `PATIENCE` turns, the last unknown therefore
    stays between the places where its equation was last below and above 0, with the other equations solved.

    Attributes:
        y: the unknowns.
        solved: True once f is 0 at them.
        turns: number of linearisations.
        low, high: ends of the interval of the last unknown.
    """

    y: Vector
    solved: Bool[Array, ""]
    turns: Array
    low: Array
    high: Array

    def after(self, jacobian: Matrix, value: Vector, tolerance: float) -> NewtonState:
        """The search after one turn, from ∂f/∂y and f at its unknowns.

        It is solved after a step whose square is below `tolerance`.
        """
        factors = factorise(jacobian)
        step = _solve_step(factors, value)
        last = self.y[-1]
        last_residual = value[-1]
        # Such a small step leaves an error of the order of its square.
        solved = _is_small(step, tolerance**0.7)
        is_late = self.turns >= PATIENCE
        is_value_small = _is_small(value[:-1], tolerance**0.5)
        low = jnp.where(is_value_small & (last_residual < 0), last, self.low)
        high = jnp.where(is_value_small & (last_residual > 0), last, self.high)
        next_last = last - step[-1]
        overshoots = (
            is_late & is_value_small & ~solved & jnp.isfinite(high - low) & ((next_last <= low) | (next_last >= high))
        )
        share = jnp.where(overshoots, (last - 0.5 * (low + high)) / jnp.where(overshoots, step[-1], 1.0), 1.0)
        step_of_others = (*_solve_step([row[:-1] for row in factors[:-1]], value[:-1]), jnp.zeros_like(last))
        retries = is_late & ~is_value_small & ~solved
        bounded_step = tuple(
            jnp.where(retries, b, jnp.where(overshoots, share * a, a))
            for a, b in zip(step, step_of_others, strict=True)
        )
        return NewtonState(_subtract_step(self.y, bounded_step), solved, self.turns + 1, low, high)


def _begin(start: Vector) -> NewtonState:
    minus_infinity = jnp.full_like(start[-1], -jnp.inf)
    return NewtonState(start, jnp.asarray(False), jnp.asarray(0), minus_infinity, -minus_infinity)


def _has_ended(state: NewtonState) -> Array:
    return state.solved | (state.turns >= MAX_STEPS)


@eqx.filter_custom_jvp
def root(
    residual: Residual,
    start: Vector,
    shared: Any,
    member_data: Any,
    tolerance: float,
    linear: Residual | None,
) -> tuple[Vector, Bool[Array, ""]]:
    """Solves f(y) = 0, until every member of a batch has converged.

    Args:
        residual: f, scaled to the order of one. Pure, without differentiated data of its own. Equation k
            determines unknown k (see `factorise`).
        start: first guess. No derivative passes through it.
        shared, member_data: arguments p of f other than y, common to a batch or of each member. Derivatives with
            respect to both are implicit, dy = -(∂f/∂y)⁻¹ ∂f/∂p dp, forward and reverse, zero if ∂f/∂y is singular.
            The program holds no host callback.
        tolerance: absolute tolerance of f.
        linear: f in its usual branches, where it is linear in y, None if it has none. Its root is computed first, so
            that XLA fuses it over a batch with the code before and after. The search runs only for members whose |f|
            is then above the tolerance.

    Returns:
        y, and whether it converged within `MAX_STEPS` turns, False for a residual that is not finite.
    """
    member_data = jax.tree.map(jnp.asarray, member_data)

    def search(start: Vector, shared: Any, member_data: Any) -> tuple[Vector, Array]:
        def turn(state: NewtonState) -> NewtonState:
            return state.after(*_linearised(residual, state.y, (shared, member_data), True), tolerance)

        end = jax.lax.while_loop(lambda state: ~_has_ended(state), turn, _begin(start))
        return end.y, end.solved

    if linear is None:
        return search(start, shared, member_data)
    jacobian, value = _linearised(linear, start, (shared, member_data), True)
    y = _subtract_step(start, _solve_step(factorise(jacobian), value))
    solved = _is_small(residual(y, shared, member_data), tolerance)
    return compute_if_needed(~solved, search, (y, shared, member_data), (y, solved))


def root_alone(
    residual: Residual, start: Vector, shared: Any, member_data: Any, tolerance: float
) -> tuple[Vector, Array]:
    """`root` without derivatives, by a program of a third of the size.

    In a batch each member ends on its own. One without a root takes every turn, but does not delay the others.
    """
    solution: tuple[Vector, Array] = batch_flow.loop_until(
        lambda inputs: _begin(inputs[0]),
        lambda inputs, state: state.after(*_linearised(residual, state.y, inputs[1:], False), tolerance),
        _has_ended,
        (start, shared, member_data),
        lambda state: (state.y, state.solved),
        TOGETHER,
    )
    return solution


@root.def_jvp
def _implicit(primals: tuple, tangents: tuple) -> tuple[tuple[Vector, Array], tuple[Any, None]]:
    residual, start, shared, member_data, tolerance, linear = primals
    y, solved = root(residual, start, shared, member_data, tolerance, linear)
    residual_change = eqx.filter_jvp(lambda *inputs: residual(y, *inputs), (shared, member_data), tangents[2:4])[1]
    if residual_change is None or all(m is None for m in residual_change):
        return (y, solved), (tuple(jnp.zeros_like(x) for x in y), None)
    factors, is_regular = regularise(factorise(_linearised(residual, y, (shared, member_data), True)[0]))
    negative_change = substitute(factors, residual_change)
    change = tuple(
        jnp.zeros_like(a) if b is None else jnp.where(is_regular, -b, 0.0)
        for a, b in zip(y, negative_change, strict=True)
    )
    return (y, solved), (change, None)


def implicit_slopes(
    output_slope: Float[Array, "rows outputs x_and_y"], residual_slope: Float[Array, "rows n x_and_y"]
) -> Array:
    """Derivatives of the outputs of rows with respect to x. The unknowns y of each row follow from f(x, y) = 0.

    Args:
        output_slope: ∂/∂x of the outputs, then ∂/∂y.
        residual_slope: the same for f, one equation for each of the n unknowns, in the order of `root`.

    Returns:
        Shape (rows, outputs, x): ∂/∂x - ∂/∂y (∂f/∂y)⁻¹ ∂f/∂x, without the second term if ∂f/∂y is singular.
    """
    n = residual_slope.shape[1]
    input_count = residual_slope.shape[2] - n
    factors, regular = regularise(
        factorise([[residual_slope[:, i, input_count + j, None] for j in range(n)] for i in range(n)])
    )
    derivative = output_slope[:, :, :input_count]
    for k, column in enumerate(substitute(factors, [residual_slope[:, i, :input_count] for i in range(n)])):
        assert column is not None
        derivative = (
            derivative - output_slope[:, :, input_count + k, None] * jnp.where(regular, column, 0.0)[:, None, :]
        )
    return derivative
