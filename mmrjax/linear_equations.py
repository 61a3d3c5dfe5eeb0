"""Linear equations of a few unknowns, as loops that XLA batches and fuses.

A batched call of LAPACK hands parts of its batch to the threads that the program which calls it runs on, and waits
for them on one of these: programs side by side can each hold a thread and wait for ever (jax 0.10.2, two cores).
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float


def solved(matrix: Float[Array, "n n"], b: Float[Array, "n ..."]) -> Float[Array, "n ..."]:
    """A⁻¹ b by the elimination of Gauss and Jordan, rows exchanged for the largest pivot; b may have columns. Not
    finite where A is singular."""
    n = matrix.shape[0]
    index = jnp.arange(n)

    def turn(k: Array, rest: Array) -> Array:
        pivot = jnp.argmax(jnp.where(index < k, -1.0, jnp.abs(rest[:, k])))
        found = (index == pivot) @ rest
        row = found / found[k]
        exchanged = jnp.where((index == pivot)[:, None], rest[k], rest)
        column = jnp.where(index == k, 0.0, exchanged[:, k])
        return jnp.where((index == k)[:, None], row, exchanged - column[:, None] * row)

    done = jax.lax.fori_loop(0, n, turn, jnp.concatenate([matrix, b.reshape(n, -1)], 1))
    return done[:, n:].reshape(b.shape)


def inverted(matrix: Float[Array, "n n"]) -> Float[Array, "n n"]:
    """A⁻¹, not finite where A is singular."""
    return solved(matrix, jnp.eye(len(matrix), dtype=matrix.dtype))
