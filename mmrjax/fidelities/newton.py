"""Newton's method for a few unknowns over a large batch, with derivatives by the implicit function theorem."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool

from mmrjax.fidelities.linear import Matrix, Vector, factorise, inverse, substitute

#: f(y, args): as many numbers as there are unknowns, each a scalar, so that a batch of them is an array each.
Residual = Callable[[Vector, Any], Vector]

#: Linearisations after which a search has failed.
MAX_STEPS = 40


def _linearised(residual: Residual, y: Vector, args: Any) -> tuple[Matrix, Vector]:
    """∂f/∂y, and f; by one unknown after another, so that what does not depend on it costs nothing."""
    columns, value = [], y
    for k in range(len(y)):

        def along(x: Array, k: int = k) -> Vector:
            return residual((*y[:k], x, *y[k + 1 :]), args)

        value, column = jax.jvp(along, (y[k],), (jnp.ones_like(y[k]),))
        columns.append(column)
    return tuple(zip(*columns, strict=True)), value


def _largest(vector: Vector) -> Array:
    largest = jnp.abs(vector[0])
    for x in vector[1:]:
        largest = jnp.maximum(largest, jnp.abs(x))
    return largest


def _minus(y: Vector, step: Vector, where: Array) -> Vector:
    return tuple(jnp.where(where, a - b, a) for a, b in zip(y, step, strict=True))


@eqx.filter_custom_jvp
def root(residual: Residual, start: Vector, args: Any, tolerance: float) -> tuple[Vector, Bool[Array, ""]]:
    """y with f(y, args) = 0, by y ← y - J⁻¹ f(y), ended as soon as max |f| < tolerance.

    It stops on the residual that it has just computed, not when two iterates agree, which takes a linearisation
    more. The balances without effects are linear in the unknowns: one linearisation and one look at the residual
    are then all. That first pass stands outside the loop, where XLA fuses it over a batch with what comes before
    and after; the loop turns while some member of the batch is not there yet.

    Args:
        residual: f, scaled to the order of one; pure, with no data of its own that is differentiated.
        start: first guess; no derivative passes through it.
        args: what f depends on beside y; derivatives by it are implicit, dy = -(∂f/∂y)⁻¹ ∂f/∂args dargs, forward
            and reverse, zero where ∂f/∂y is singular. The program holds no host callback.

    Returns:
        y, and whether the residual got below `tolerance` in `MAX_STEPS`; one that is not finite does not.
    """

    def going(search: tuple[Array, Vector, Array]) -> Bool[Array, ""]:
        count, _, solved = search
        return (count < MAX_STEPS) & ~solved

    def improve(search: tuple[Array, Vector, Array]) -> tuple[Array, Vector, Array]:
        count, y, _ = search
        jacobian, value = _linearised(residual, y, args)
        factors = factorise(jacobian)
        step = substitute(factors, value)
        y = _minus(y, step, jnp.isfinite(_largest(step)))
        value = residual(y, args)
        solved = _largest(value) < tolerance
        # What rounding left over is taken off with the same factors: a shaft that stands still has speed 0.
        y = _minus(y, substitute(factors, value), solved)
        return count + 1, y, solved

    _, y, solved = jax.lax.while_loop(going, improve, improve((jnp.asarray(0), start, jnp.asarray(False))))
    return y, solved


@root.def_jvp
def _implicit(primals: tuple, tangents: tuple) -> tuple[tuple[Vector, Array], tuple[Any, None]]:
    residual, start, args, tolerance = primals
    y, solved = root(residual, start, args, tolerance)
    moved = eqx.filter_jvp(lambda args: residual(y, args), (args,), (tangents[2],))[1]
    if moved is None or all(m is None for m in moved):
        return (y, solved), (tuple(jnp.zeros_like(x) for x in y), None)
    rows = inverse(_linearised(residual, y, args)[0])
    change = tuple(-sum(a * m for a, m in zip(row, moved, strict=True) if m is not None) for row in rows)
    return (y, solved), (change, None)
