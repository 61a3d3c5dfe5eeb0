"""Gaussian elimination of a few scalar unknowns, written out so that XLA fuses it over a batch."""

from __future__ import annotations

from collections.abc import Sequence

import jax.numpy as jnp
from jaxtyping import Array, Bool

#: Numbers of their own, not one array: under `jax.vmap` each is an array of the batch, and nothing is stacked or cut.
Vector = tuple[Array, ...]
#: A number, or None: a zero that holds for every member of every batch, which costs nothing.
Entry = Array | None
#: By rows.
Matrix = Sequence[Sequence[Entry]]


#: Rows of L and U in one matrix, the pivots on its diagonal.
Factors = list[list[Entry]]


def _times(a: Entry, b: Entry) -> Entry:
    return None if a is None or b is None else a * b


def _minus(a: Entry, b: Entry) -> Entry:
    if a is None or b is None:
        return a if b is None else -b
    return a - b


def _over(a: Entry, b: Entry) -> Entry:
    # A quotient, not a product with a reciprocal: where several others need it, XLA stores a quotient for the whole
    # batch, while a product and all that leads to it is computed again for each of them.
    return None if a is None else a / (jnp.zeros(()) if b is None else b)


def factorise(matrix: Matrix) -> Factors:
    """LU factors of a small matrix by Gaussian elimination, unrolled.

    Nothing is exchanged: the first unknown has to have a pivot in the first equation, and so on, as where each
    equation is written beside the unknown that it determines. A batched call to LAPACK costs about a microsecond
    a member however small the matrix; written out as scalars, the arithmetic of a whole batch becomes a fused loop.
    """
    n = len(matrix)
    rows = [list(row) for row in matrix]
    for k in range(n):
        for i in range(k + 1, n):
            rows[i][k] = _over(rows[i][k], rows[k][k])
            for j in range(k + 1, n):
                rows[i][j] = _minus(rows[i][j], _times(rows[i][k], rows[k][j]))
    return rows


def substitute(factors: Factors, vector: Sequence[Entry]) -> list[Entry]:
    """Solve for one right-hand side with the factors of `factorise`."""
    n, x = len(factors), list(vector)
    for i in range(n):
        for j in range(i):
            x[i] = _minus(x[i], _times(factors[i][j], x[j]))
    for i in reversed(range(n)):
        for j in range(i + 1, n):
            x[i] = _minus(x[i], _times(factors[i][j], x[j]))
        x[i] = _over(x[i], factors[i][i])
    return x


def regular(factors: Factors) -> tuple[Factors, Bool[Array, ""]]:
    """The factors, those of the unit matrix in place of what has none (singular, or not finite), and whether they are
    the matrix's own.

    One member of a batch then harms no other, in derivatives of either direction.
    """
    size = sum((jnp.abs(x) for row in factors for x in row if x is not None), jnp.zeros(()))
    own = jnp.isfinite(size)
    for k, row in enumerate(factors):
        own &= False if (pivot := row[k]) is None else pivot != 0
    return [
        [None if x is None else jnp.where(own, x, 1.0 if i == k else 0.0) for k, x in enumerate(row)]
        for i, row in enumerate(factors)
    ], own
