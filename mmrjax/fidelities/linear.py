"""Linear solver for the few unknowns of a drive, written out so that XLA fuses it over a batch."""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
from jaxtyping import Array, Float

from mmrjax.fidelities import elimination

#: Rows of the factors, and for each column the row exchanges that pivoting made.
Factors = tuple[elimination.Factors, list[list[Array]]]


def factorise(matrix: Float[Array, "n n"]) -> Factors:
    """LU factors of a small matrix by Gaussian elimination with partial pivoting, unrolled.

    A batched call to LAPACK costs about a microsecond a member however small the matrix; written out as
    scalars, the arithmetic of a whole batch becomes one fused loop.
    """
    n = matrix.shape[0]
    rows: Any = [[matrix[i, j] for j in range(n)] for i in range(n)]
    exchanges: list[list[Array]] = []
    for k in range(n):
        swaps = []
        for i in range(k + 1, n):  # bubble the largest pivot up to row k
            larger = jnp.abs(rows[i][k]) > jnp.abs(rows[k][k])
            swaps.append(larger)
            for j in range(n):
                a, b = rows[k][j], rows[i][j]
                rows[k][j], rows[i][j] = jnp.where(larger, b, a), jnp.where(larger, a, b)
        exchanges.append(swaps)
        for i in range(k + 1, n):
            rows[i][k] = rows[i][k] / rows[k][k]
            for j in range(k + 1, n):
                rows[i][j] = rows[i][j] - rows[i][k] * rows[k][j]
    return rows, exchanges


def substitute(factors: Factors, vector: Float[Array, " n"]) -> Float[Array, " n"]:
    """Solve for one right-hand side with the factors of `factorise`."""
    rows, exchanges = factors
    x = list(vector)
    for k, swaps in enumerate(exchanges):
        for i, larger in enumerate(swaps, k + 1):
            x[k], x[i] = jnp.where(larger, x[i], x[k]), jnp.where(larger, x[k], x[i])
    found: list[Any] = elimination.substitute(rows, x)
    return jnp.stack(found)
