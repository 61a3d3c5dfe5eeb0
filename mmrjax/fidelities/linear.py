"""Linear solver for the few unknowns of a drive, written out so that XLA fuses it over a batch."""

from __future__ import annotations

from collections.abc import Sequence

import jax.numpy as jnp
from jaxtyping import Array

#: Numbers of their own, not one array: under `jax.vmap` each is an array of the batch, and nothing is stacked or cut.
Vector = tuple[Array, ...]
Matrix = tuple[Vector, ...]
#: Rows of the factors, and for each column the row exchanges that pivoting made.
Factors = tuple[list[list[Array]], list[list[Array]]]


def factorise(matrix: Sequence[Sequence[Array]]) -> Factors:
    """LU factors of a small matrix, given by its rows, by Gaussian elimination with partial pivoting, unrolled.

    A batched call to LAPACK costs about a microsecond a member however small the matrix; written out as
    scalars, the arithmetic of a whole batch becomes one fused loop.
    """
    n = len(matrix)
    rows = [list(row) for row in matrix]
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


def substitute(factors: Factors, vector: Sequence[Array]) -> Vector:
    """Solve for one right-hand side with the factors of `factorise`."""
    rows, exchanges = factors
    n = len(rows)
    x = list(vector)
    for k in range(n):
        for i, larger in zip(range(k + 1, n), exchanges[k], strict=True):
            x[k], x[i] = jnp.where(larger, x[i], x[k]), jnp.where(larger, x[k], x[i])
    for i in range(n):
        for j in range(i):
            x[i] = x[i] - rows[i][j] * x[j]
    for i in reversed(range(n)):
        for j in range(i + 1, n):
            x[i] = x[i] - rows[i][j] * x[j]
        x[i] = x[i] / rows[i][i]
    return tuple(x)


def inverse(matrix: Sequence[Sequence[Array]]) -> Matrix:
    """The inverse by its rows; zeros where it is not finite (a singular matrix), so that one member of a batch harms
    no other.

    Whoever uses it has to look at its residual.
    """
    factors, n = factorise(matrix), len(matrix)
    one, zero = jnp.ones_like(matrix[0][0]), jnp.zeros_like(matrix[0][0])
    columns = [substitute(factors, [one if i == j else zero for i in range(n)]) for j in range(n)]
    finite = jnp.isfinite(sum(jnp.abs(x) for column in columns for x in column))
    return tuple(tuple(jnp.where(finite, columns[j][i], 0.0) for j in range(n)) for i in range(n))
