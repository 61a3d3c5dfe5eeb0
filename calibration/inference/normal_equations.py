"""Least squares of a few parameters by normal equations, as loops that XLA batches and fuses.

With priors every direction is known to one prior sd at least and to some 1e-4 of it at best, so the normal
matrix has a condition of at most 1e8 or so and float64 leaves half its digits. A batched LAPACK call (QR,
triangular solve) inside a vmapped search does not only cost more: with a few hundred members on two cores
two of them in flight have waited for each other for ever (jax 0.10.2, CPU).
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float


def solved(matrix: Float[Array, "n n"], b: Float[Array, "n ..."]) -> Float[Array, "n ..."]:
    """A⁻¹ b of a symmetric positive definite matrix, by the elimination of Gauss and Jordan; b may have columns."""
    n = matrix.shape[0]
    index = jnp.arange(n)

    def turn(k: Array, rest: Array) -> Array:
        row = rest[k] / rest[k, k]
        column = jnp.where(index == k, 0.0, rest[:, k])
        return jnp.where((index == k)[:, None], row, rest - column[:, None] * row)

    done = jax.lax.fori_loop(0, n, turn, jnp.concatenate([matrix, b.reshape(n, -1)], 1))
    return done[:, n:].reshape(b.shape)


def half_solved(matrix: Float[Array, "n n"], b: Float[Array, "n ..."]) -> Float[Array, "n ..."]:
    """L⁻¹ b with the lower factor of Cholesky, L Lᵀ = matrix; NaN where it is not positive definite. b may have
    columns."""
    n = matrix.shape[0]
    index = jnp.arange(n)

    def turn(k: Array, rest: Array) -> Array:
        row = rest[k] / jnp.sqrt(rest[k, k])
        column = jnp.where(index > k, row[:n], 0.0)
        return jnp.where((index == k)[:, None], row, rest - column[:, None] * row)

    done = jax.lax.fori_loop(0, n, turn, jnp.concatenate([matrix, b.reshape(n, -1)], 1))
    return done[:, n:].reshape(b.shape)
