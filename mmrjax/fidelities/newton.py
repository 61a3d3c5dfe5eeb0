"""Newton's method for a few unknowns over a large batch, with derivatives by the implicit function theorem."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from mmrjax.fidelities.linear import factorise, inverse, substitute

Residual = Callable[[Array, Any], Array]

#: Linearisations after which a search has failed.
MAX_STEPS = 40


def _linearised(residual: Residual, y: Float[Array, " n"], args: Any) -> tuple[Array, Array]:
    """∂f/∂y, and f."""

    def twice(y: Float[Array, " n"]) -> tuple[Array, Array]:
        value = residual(y, args)
        return value, value

    return jax.jacfwd(twice, has_aux=True)(y)


@eqx.filter_custom_jvp
def root(
    residual: Residual, start: Float[Array, " n"], args: Any, tolerance: float
) -> tuple[Float[Array, " n"], Bool[Array, ""]]:
    """y with f(y, args) = 0, by y ← y - J⁻¹ f(y), ended as soon as max |f| < tolerance.

    It stops on the residual that it has just computed, not when two iterates agree, which takes a linearisation
    more. The balances without effects are linear in the unknowns: one linearisation and one look at the residual
    are then all, which is what a sweep of millions of points spends its time on.

    Args:
        residual: f, scaled to the order of one; pure, with no data of its own that is differentiated.
        start: first guess; no derivative passes through it.
        args: what f depends on beside y; derivatives by it are implicit, dy = -(∂f/∂y)⁻¹ ∂f/∂args dargs, forward
            and reverse, zero where ∂f/∂y is singular. The program holds no host callback.

    Returns:
        y, and whether the residual got below `tolerance` in `MAX_STEPS`; one that is not finite does not.
    """

    def going(search: tuple[Array, Array, Array]) -> Bool[Array, ""]:
        count, _, solved = search
        return (count < MAX_STEPS) & ~solved

    def improve(search: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        count, y, _ = search
        jacobian, value = _linearised(residual, y, args)
        factors = factorise(jacobian)
        step = substitute(factors, value)
        y = y - jnp.where(jnp.all(jnp.isfinite(step)), step, 0.0)
        value = residual(y, args)
        solved = jnp.max(jnp.abs(value)) < tolerance
        # What rounding left over is taken off with the same factors: a shaft that stands still has speed 0.
        y = jnp.where(solved, y - substitute(factors, value), y)
        return count + 1, y, solved

    _, y, solved = jax.lax.while_loop(going, improve, (jnp.asarray(0), start, jnp.asarray(False)))
    return y, solved


@root.def_jvp
def _implicit(primals: tuple, tangents: tuple) -> tuple[tuple[Array, Array], tuple[Array, None]]:
    residual, start, args, tolerance = primals
    y, solved = root(residual, start, args, tolerance)
    moved = eqx.filter_jvp(lambda args: residual(y, args), (args,), (tangents[2],))[1]
    if moved is None:
        return (y, solved), (jnp.zeros_like(y), None)
    return (y, solved), (-inverse(_linearised(residual, y, args)[0]) @ moved, None)
