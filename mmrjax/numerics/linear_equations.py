"""Linear equations of a few unknowns, written so that XLA batches and fuses them.

They are here instead of lineax for two reasons, measured in one run (two cores, jax 0.10.2, 2026-11-28):

* A batched call of LAPACK costs about a microsecond per member for any size of matrix. For 65 536 members
  `lineax.LU` takes 25, 8 and 4 times the processor time of `factorise` and `substitute` at n = 2, 3 and 4.
* LAPACK divides its batch among the threads that run the program, and one of these waits for the others. Programs in
  parallel threads can each hold a thread and wait for ever. Four threads that solved batches of 512 to 2048 systems
  by lineax's `LU`, `QR` or `Cholesky` came to a standstill within seconds, in four runs of four. Fits run in parallel
  threads. So the loops for many unknowns stay too, although lineax is faster there. `LU` takes 0.6, 0.8 and 0.5 times
  the time of `solve` at n = 9, 12 and 20, and `Cholesky` 0.4, 0.4 and 0.2 times.

* `factorise`, `substitute`, `solve_factorised`, `regularise`: each number is an array of the batch, without pivoting.
  For equations in the order of the unknowns that they determine: balances, masses with damping.
* `inverse`: the same for a matrix as one array, for several right-hand sides in sequence.
* `solve`, `invert`: loops with row exchanges, for any matrix and many unknowns.
* `solve_lower`: the forward half of a solution by a Cholesky factor, for least squares by normal equations. With
  priors every direction is known to at least one prior sd and at best to about 1e-4 of it. The condition number is
  therefore about 1e8 at most, and float64 leaves half its digits.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

#: Separate numbers, not one array: under `jax.vmap` each is an array of the batch, and nothing is stacked or cut.
Vector = tuple[Array, ...]
#: A number, or None for a zero in every member of every batch, which costs nothing.
Entry = Array | None
#: By rows.
Matrix = Sequence[Sequence[Entry]] | Float[Array, "n n"]
#: Rows of L and U in one matrix, the pivots on its diagonal.
Factors = list[list[Entry]]


def _product(a: Entry, b: Entry) -> Entry:
    return None if a is None or b is None else a * b


def _difference(a: Entry, b: Entry) -> Entry:
    if a is None or b is None:
        return a if b is None else -b
    return a - b


def _quotient(a: Entry, b: Entry) -> Entry:
    # A quotient, not a product with a reciprocal: XLA stores a quotient with several uses for the whole batch, but
    # computes a product and its inputs again for each use.
    return None if a is None else a / (jnp.zeros(()) if b is None else b)


def factorise(matrix: Matrix) -> Factors:
    """LU factors of a small matrix by Gaussian elimination, unrolled.

    There is no pivoting, so equation k has to determine unknown k. Not finite if a pivot vanishes.
    """
    rows = [list(row) for row in matrix]
    n = len(rows)
    for k in range(n):
        for i in range(k + 1, n):
            rows[i][k] = _quotient(rows[i][k], rows[k][k])
            for j in range(k + 1, n):
                rows[i][j] = _difference(rows[i][j], _product(rows[i][k], rows[k][j]))
    return rows


def substitute(factors: Factors, vector: Sequence[Entry] | Float[Array, " n"]) -> list[Entry]:
    """Solution for one right-hand side with the factors of `factorise`."""
    n, x = len(factors), list(vector)
    for i in range(n):
        for j in range(i):
            x[i] = _difference(x[i], _product(factors[i][j], x[j]))
    for i in reversed(range(n)):
        for j in range(i + 1, n):
            x[i] = _difference(x[i], _product(factors[i][j], x[j]))
        x[i] = _quotient(x[i], factors[i][i])
    return x


def solve_factorised(factors: Factors, vector: Float[Array, " n"]) -> Float[Array, " n"]:
    """Solution for one right-hand side as one array, see `substitute`."""
    return jnp.stack([jnp.asarray(x) for x in substitute(factors, vector)])


def regularise(factors: Factors) -> tuple[Factors, Bool[Array, ""]]:
    """Replaces singular or non-finite factors with those of the identity matrix. Also returns True if the original
    factors were kept. A failed member of a batch then does not affect the others, in forward-mode or reverse-mode
    derivatives.
    """
    total = sum((jnp.abs(x) for row in factors for x in row if x is not None), jnp.zeros(()))
    is_regular = jnp.isfinite(total)
    for k, row in enumerate(factors):
        is_regular &= False if (pivot := row[k]) is None else pivot != 0
    return [
        [None if x is None else jnp.where(is_regular, x, 1.0 if i == k else 0.0) for k, x in enumerate(row)]
        for i, row in enumerate(factors)
    ], is_regular


def inverse(matrix: Float[Array, "n n"]) -> tuple[Float[Array, "n n"], Float[Array, ""]]:
    """A⁻¹ and the determinant, by Gauss-Jordan elimination in place, one column at a time, unrolled.

    Without row exchanges, as in `factorise`.
    """
    determinant = jnp.ones((), matrix.dtype)
    for k in range(matrix.shape[0]):
        pivot = matrix[k, k]
        determinant *= pivot
        row, column = matrix[k] / pivot, matrix[:, k].at[k].set(0.0)
        matrix = (matrix - jnp.outer(column, row)).at[k].set(row).at[:, k].set((-column / pivot).at[k].set(1 / pivot))
    return matrix, determinant


def _eliminate(matrix: Array, b: Array, eliminate: Callable[[Array, Array], Array]) -> Array:
    """Right side after a turn (k, rows) for each unknown k on the rows of matrix and right side."""
    n = matrix.shape[0]
    reduced = jax.lax.fori_loop(0, n, eliminate, jnp.concatenate([matrix, b.reshape(n, -1)], 1))
    return reduced[:, n:].reshape(b.shape)


def solve(matrix: Float[Array, "n n"], b: Float[Array, "n ..."]) -> Float[Array, "n ..."]:
    """A⁻¹ b by Gauss-Jordan elimination, with row exchanges for the largest pivot. b may have columns.

    Not finite if A is singular.
    """
    index = jnp.arange(matrix.shape[0])

    def eliminate(k: Array, rows: Array) -> Array:
        pivot = jnp.argmax(jnp.where(index < k, -1.0, jnp.abs(rows[:, k])))
        pivot_row = (index == pivot) @ rows
        row = pivot_row / pivot_row[k]
        exchanged = jnp.where((index == pivot)[:, None], rows[k], rows)
        column = jnp.where(index == k, 0.0, exchanged[:, k])
        return jnp.where((index == k)[:, None], row, exchanged - column[:, None] * row)

    return _eliminate(matrix, b, eliminate)


def invert(matrix: Float[Array, "n n"]) -> Float[Array, "n n"]:
    """A⁻¹, computed as in `solve`."""
    return solve(matrix, jnp.eye(len(matrix), dtype=matrix.dtype))


def solve_lower(matrix: Float[Array, "n n"], b: Float[Array, "n ..."]) -> Float[Array, "n ..."]:
    """L⁻¹ b with the lower Cholesky factor, L Lᵀ = matrix, NaN if it is not positive definite. b may have columns."""
    n = matrix.shape[0]
    index = jnp.arange(n)

    def eliminate(k: Array, rows: Array) -> Array:
        row = rows[k] / jnp.sqrt(rows[k, k])
        column = jnp.where(index > k, row[:n], 0.0)
        return jnp.where((index == k)[:, None], row, rows - column[:, None] * row)

    return _eliminate(matrix, b, eliminate)
