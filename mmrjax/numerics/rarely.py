"""What seldom has to be computed: a branch that a batch skips too where no member of it needs it."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool

T = TypeVar("T")


def rarely(needed: Bool[Array, ""], function: Callable[..., T], arguments: tuple, otherwise: T) -> T:
    """`function(*arguments)` where `needed`, else `otherwise`.

    As `jax.lax.cond`, which `jax.vmap` turns into computing both branches for every member of a batch. Here it is a
    loop of at most one turn: a batch turns it if one member needs it.

    Args:
        function: pure; arguments: trees of arrays; otherwise: of the shapes and types of what `function` gives.
    """

    def turn(state: tuple[Array, T]) -> tuple[Array, T]:
        # Tied to the loop's own state, or the compiler would compute what does not change before the loop.
        _, here = jax.lax.optimization_barrier((state[0], arguments))
        like = jax.tree.map(lambda x, y: jnp.asarray(x, y.dtype), function(*here), otherwise)
        return jnp.zeros_like(state[0]), like

    return jax.lax.while_loop(lambda state: state[0], turn, (needed, otherwise))[1]
