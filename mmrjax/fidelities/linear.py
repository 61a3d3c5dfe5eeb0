"""Linear solver for the few unknowns of a drive, written out so that XLA fuses it over a batch."""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
import lineax as lx
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float

#: Rows of the factors, and for each column the row exchanges that pivoting made.
Factors = tuple[list[list[Array]], list[list[Array]]]


def factorise(matrix: Float[Array, "n n"]) -> Factors:
    """LU factors of a small matrix by Gaussian elimination with partial pivoting, unrolled.

    A batched call to LAPACK costs about a microsecond a member however small the matrix; written out as
    scalars, the arithmetic of a whole batch becomes one fused loop.
    """
    n = matrix.shape[0]
    rows = [[matrix[i, j] for j in range(n)] for i in range(n)]
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
    n = len(rows)
    x = [vector[i] for i in range(n)]
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
    return jnp.stack(x)


class SmallDense(lx.AbstractLinearSolver):
    """`factorise` and `substitute` as a lineax solver, for square operators of a handful of unknowns.

    Where the answer is not finite (a singular matrix) it is zero: lineax would otherwise stop the whole
    batch for one member's sake. Whoever uses it has to look at its residual.
    """

    def init(self, operator: lx.AbstractLinearOperator, options: dict[str, Any]) -> Any:
        return operator.as_matrix(), operator.in_structure()

    def compute(self, state: Any, vector: Any, options: dict[str, Any]) -> Any:
        matrix, structure = state
        flat, _ = ravel_pytree(vector)
        _, unravel = ravel_pytree(jnp.zeros(structure.shape, structure.dtype))
        answer = substitute(factorise(matrix), flat)
        answer = jnp.where(jnp.all(jnp.isfinite(answer)), answer, 0.0)
        return unravel(answer), lx.RESULTS.successful, {}

    def transpose(self, state: Any, options: dict[str, Any]) -> Any:
        matrix, structure = state
        return (matrix.T, structure), {}

    def conj(self, state: Any, options: dict[str, Any]) -> Any:
        return state, {}

    def assume_full_rank(self) -> bool:
        return True
