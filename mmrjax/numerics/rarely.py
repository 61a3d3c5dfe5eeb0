"""A branch for rarely needed computations. A batch skips it if no member needs it."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool

T = TypeVar("T")


def compute_if_needed(needed: Bool[Array, ""], function: Callable[..., T], arguments: tuple, otherwise: T) -> T:
    """Result of `function(*arguments)` if `needed`, otherwise `otherwise`.

    Similar to `jax.lax.cond`, but `jax.vmap` turns that into computing both branches for every member of a batch.
    This is a loop of at most one turn: a batch runs it if one member needs it.

    Args:
        function: pure function.
        arguments: trees of arrays.
        otherwise: alternative, with the shapes and types of the function's result.
    """

    def turn(state: tuple[Array, T]) -> tuple[Array, T]:
        # Tied to the loop's state; otherwise the compiler would move the computation out of the loop.
        _, ordered_arguments = jax.lax.optimization_barrier((state[0], arguments))
        like = jax.tree.map(lambda x, y: jnp.asarray(x, y.dtype), function(*ordered_arguments), otherwise)
        return jnp.zeros_like(state[0]), like

    return jax.lax.while_loop(lambda state: state[0], turn, (needed, otherwise))[1]
