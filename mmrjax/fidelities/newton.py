"""Newton's method for a few unknowns over a large batch, with derivatives by the implicit function theorem."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.custom_derivatives import SymbolicZero
from jaxtyping import Array, Bool

from mmrjax.fidelities.elimination import Entry, Matrix, Vector, factorise, regular, substitute

#: f(y, shared, own): as many numbers as there are unknowns, each a scalar, so that a batch of them is an array each.
Residual = Callable[[Vector, Any, Any], Vector]

#: Linearisations after which a search has failed.
MAX_STEPS = 40


def _linearised(residual: Residual, y: Vector, shared: Any, own: Any) -> tuple[Matrix, Vector]:
    """∂f/∂y by its rows, and f; by one unknown after another, so that what does not depend on it costs nothing."""
    columns: list[list[Entry]] = []
    value = y
    for k in range(len(y)):
        moved: set[int] = set()

        def along(x: Array, k: int = k, moved: set[int] = moved) -> Vector:
            values = residual((*y[:k], x, *y[k + 1 :]), shared, own)
            return tuple(_watched(v, i, moved) for i, v in enumerate(values))

        value, column = jax.jvp(along, (y[k],), (jnp.ones_like(y[k]),))
        columns.append([x if i in moved else None for i, x in enumerate(column)])
    return list(zip(*columns, strict=True)), value


def _watched(value: Array, index: int, moved: set[int]) -> Array:
    """`value`; while it is differentiated, `index` is added to `moved` if it has a derivative at all."""

    @jax.custom_jvp
    def watched(x: Array) -> Array:
        return x

    def rule(primals: tuple, tangents: tuple) -> tuple[Array, Any]:
        if not isinstance(tangents[0], SymbolicZero):
            moved.add(index)
        return primals[0], tangents[0]

    watched.defjvp(rule, symbolic_zeros=True)
    return watched(value)


def _improved(residual: Residual, y: Vector, shared: Any, own: Any, tolerance: float) -> tuple[Vector, Array]:
    """One pass of `root`: the next y, and whether its residual is below `tolerance`."""
    jacobian, value = _linearised(residual, y, shared, own)
    step = substitute(factorise(jacobian), value)
    y = tuple(a if b is None else jnp.where(jnp.isfinite(b), a - b, a) for a, b in zip(y, step, strict=True))
    small = [jnp.abs(x) < tolerance for x in residual(y, shared, own)]
    return y, functools.reduce(jnp.logical_and, small)


@eqx.filter_custom_jvp
def root(
    residual: Residual, start: Vector, shared: Any, own: Any, tolerance: float
) -> tuple[Vector, Bool[Array, ""]]:
    """y with f(y) = 0, by y ← y - J⁻¹ f(y), ended as soon as max |f| < tolerance.

    It stops on the residual that it has just computed, not when two iterates agree, which takes a linearisation
    more. The balances without effects are linear in the unknowns: one linearisation and one look at the residual
    are then all. That first pass stands outside the loop, where XLA fuses it over a batch with what comes before
    and after; the loop turns while some member of the batch is not there yet, and seldom at all.

    Args:
        residual: f, scaled to the order of one; pure, with no data of its own that is differentiated. Equation k
            determines unknown k (see `factorise`).
        start: first guess; no derivative passes through it.
        shared, own: what f depends on beside y: data of all members of a batch and of each. Derivatives by both
            are implicit, dy = -(∂f/∂y)⁻¹ (∂f/∂shared dshared + ∂f/∂own down), forward and reverse, zero where ∂f/∂y
            is singular. The program holds no host callback.

    Returns:
        y, and whether the residual got below `tolerance` in `MAX_STEPS`; one that is not finite does not.
    """

    def going(search: tuple[Array, Vector, Array]) -> Bool[Array, ""]:
        count, _, solved = search
        return (count < MAX_STEPS) & ~solved

    def turn(search: tuple[Array, Vector, Array]) -> tuple[Array, Vector, Array]:
        count, y, solved = search
        # Members that are there count for nothing. Were this not said, the compiler would compute and store what
        # the turns have in common before the first of them, also where there is none.
        open_ = jax.tree.map(lambda x: jnp.where(solved, jnp.ones_like(x), x), own)
        return count + 1, *_improved(residual, y, shared, open_, tolerance)

    first = (jnp.asarray(1, jnp.int8), *_improved(residual, start, shared, own, tolerance))
    _, y, solved = jax.lax.while_loop(going, turn, first)
    return y, solved


@root.def_jvp
def _implicit(primals: tuple, tangents: tuple) -> tuple[tuple[Vector, Array], tuple[Any, None]]:
    residual, start, shared, own, tolerance = primals
    y, solved = root(residual, start, shared, own, tolerance)
    moved = eqx.filter_jvp(lambda *given: residual(y, *given), (shared, own), tangents[2:4])[1]
    if moved is None or all(m is None for m in moved):
        return (y, solved), (tuple(jnp.zeros_like(x) for x in y), None)
    factors, own_factors = regular(factorise(_linearised(residual, y, shared, own)[0]))
    step = substitute(factors, moved)
    change = tuple(jnp.zeros_like(a) if b is None else jnp.where(own_factors, -b, 0.0) for a, b in zip(y, step, strict=True))
    return (y, solved), (change, None)
