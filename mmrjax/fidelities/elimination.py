"""Gaussian elimination of a few scalar unknowns, written out so that XLA fuses it over a batch."""

from __future__ import annotations

from collections.abc import Sequence

import jax.numpy as jnp
from jaxtyping import Array

#: Numbers of their own, not one array: under `jax.vmap` each is an array of the batch, and nothing is stacked or cut.
Vector = tuple[Array, ...]
#: A number, or None: a zero that holds for every member of every batch, which costs nothing.
Entry = Array | None
#: By rows.
Matrix = Sequence[Sequence[Entry]]


def _times(a: Entry, b: Entry) -> Entry:
    return None if a is None or b is None else a * b


def _minus(a: Entry, b: Entry) -> Entry:
    if a is None or b is None:
        return a if b is None else -b
    return a - b


def factorise(matrix: Matrix) -> list[list[Entry]]:
    """LU factors of a small matrix by Gaussian elimination, unrolled; each pivot as its reciprocal.

    Nothing is exchanged: the first unknown has to have a pivot in the first equation, and so on, as where each
    equation is written beside the unknown that it determines. A batched call to LAPACK costs about a microsecond
    a member however small the matrix; written out as scalars, the arithmetic of a whole batch becomes a fused loop.
    """
    n = len(matrix)
    rows = [list(row) for row in matrix]
    for k in range(n):
        pivot = rows[k][k]
        rows[k][k] = 1 / (jnp.zeros(()) if pivot is None else pivot)
        for i in range(k + 1, n):
            rows[i][k] = _times(rows[i][k], rows[k][k])
            for j in range(k + 1, n):
                rows[i][j] = _minus(rows[i][j], _times(rows[i][k], rows[k][j]))
    return rows


def substitute(factors: Matrix, vector: Sequence[Entry]) -> list[Entry]:
    """Solve for one right-hand side with the factors of `factorise`."""
    n, x = len(factors), list(vector)
    for i in range(n):
        for j in range(i):
            x[i] = _minus(x[i], _times(factors[i][j], x[j]))
    for i in reversed(range(n)):
        for j in range(i + 1, n):
            x[i] = _minus(x[i], _times(factors[i][j], x[j]))
        x[i] = _times(x[i], factors[i][i])
    return x


def inverse(matrix: Matrix) -> list[list[Entry]]:
    """The inverse by its rows; zeros where it is not finite (a singular matrix), so that one member of a batch harms
    no other.

    Whoever uses it has to look at its residual.
    """
    factors, n = factorise(matrix), len(matrix)
    columns = [substitute(factors, [jnp.ones(()) if i == j else None for i in range(n)]) for j in range(n)]
    finite = jnp.isfinite(sum(jnp.abs(x) for column in columns for x in column if x is not None))
    return [[None if (x := columns[j][i]) is None else jnp.where(finite, x, 0.0) for j in range(n)] for i in range(n)]
