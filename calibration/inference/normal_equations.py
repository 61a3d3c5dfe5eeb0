"""Least squares of a few parameters by normal equations and Cholesky, as loops that XLA batches and fuses.

With priors every direction is known to one prior sd at least and to some 1e-4 of it at best, so the normal
matrix has a condition of at most 1e8 or so and float64 leaves half its digits. A batched LAPACK call (QR,
triangular solve) inside a vmapped search does not only cost more: with a few hundred members on two cores
two of them in flight have waited for each other for ever (jax 0.10.2, CPU).
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float


def cholesky(matrix: Float[Array, "n n"]) -> Float[Array, "n n"]:
    """Lower factor L of a symmetric positive definite matrix, L Lᵀ = matrix; NaN where it is not."""
    n = matrix.shape[0]
    below = jnp.arange(n)

    def column(k: Array, carry: tuple[Array, Array]) -> tuple[Array, Array]:
        rest, lower = carry
        c = jnp.where(below >= k, rest[:, k], 0.0) / jnp.sqrt(rest[k, k])
        return rest - c[:, None] * c[None, :], lower.at[:, k].set(c)

    return jax.lax.fori_loop(0, n, column, (matrix, jnp.zeros_like(matrix)))[1]


def forward(lower: Float[Array, "n n"], b: Float[Array, "n ..."]) -> Float[Array, "n ..."]:
    """Solve L x = b; b may have columns."""

    def row(k: Array, x: Array) -> Array:
        # x is zero from row k on, so the product takes only the rows already solved.
        return x.at[k].set((b[k] - lower[k] @ x) / lower[k, k])

    return jax.lax.fori_loop(0, lower.shape[0], row, jnp.zeros_like(b))


def backward(lower: Float[Array, "n n"], b: Float[Array, "n ..."]) -> Float[Array, "n ..."]:
    """Solve Lᵀ x = b."""
    flipped = lower[::-1, ::-1].T
    return forward(flipped, b[::-1])[::-1]
