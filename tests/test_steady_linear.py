"""The written-out linear solver against numpy.linalg."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mmrjax.fidelities import elimination
from mmrjax.fidelities.linear import factorise, substitute

RNG = np.random.default_rng(1)
EXCHANGE = np.array([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]])  # no pivot on the diagonal at all
TINY = np.array([[1e-20, 1.0], [1.0, 1.0]])  # without pivoting the answer is 0 instead of 1
ZERO_LATER = np.array([[1.0, 2, 3], [2, 4, 1], [1, 1, 1]])  # the second pivot vanishes

solve = jax.jit(lambda a, b: substitute(factorise(a), b))


@pytest.mark.parametrize("n", [1, 2, 3, 4, 5])
def test_substitute_matches_numpy(n):
    matrices, vectors = RNG.normal(size=(200, n, n)), RNG.normal(size=(200, n))
    got = jax.vmap(solve)(matrices, vectors)
    expected = np.linalg.solve(matrices, vectors[..., None])[..., 0]
    size = np.linalg.cond(matrices)[:, None] * np.abs(expected).max(-1, keepdims=True)
    assert (np.abs(got - expected) <= 1e-14 * size).all()


@pytest.mark.parametrize("matrix", [EXCHANGE, TINY, ZERO_LATER])
def test_substitute_pivots(matrix):
    vector = np.arange(1.0, len(matrix) + 1)
    np.testing.assert_allclose(solve(matrix, vector), np.linalg.solve(matrix, vector), rtol=1e-13)


def test_substitute_serves_many_right_hand_sides():
    matrix = RNG.permutation(np.eye(4)) * 3 + 1e-3 * RNG.normal(size=(4, 4))
    factors = factorise(jnp.asarray(matrix))
    columns = [substitute(factors, column) for column in np.eye(4)]
    np.testing.assert_allclose(np.stack(columns, 1), np.linalg.inv(matrix), rtol=1e-12, atol=1e-14)


def test_substitute_derivative_is_that_of_the_inverse():
    matrix, vector = RNG.normal(size=(3, 3)), RNG.normal(size=3)
    jacobian = jax.jacfwd(solve)(matrix, vector)
    x, inverse = np.linalg.solve(matrix, vector), np.linalg.inv(matrix)
    np.testing.assert_allclose(jacobian, -np.einsum("ij,k->ijk", inverse, x), rtol=1e-9, atol=1e-12)


def test_singular_matrix_spoils_no_neighbour():
    batch = np.stack([np.eye(3), np.ones((3, 3)), 2 * np.eye(3)])
    answers = np.asarray(jax.vmap(solve)(batch, np.ones((3, 3))))
    np.testing.assert_array_equal(answers[0], 1.0)
    np.testing.assert_array_equal(answers[2], 0.5)


# --- elimination of scalars, without exchanges -----------------------------------------------------------------------

DIAGONAL = 3 * np.eye(3)  # added to a matrix: pivots where elimination without exchanges looks for them


def rows(matrix):
    return [[matrix[i, j] for j in range(matrix.shape[1])] for i in range(matrix.shape[0])]


@jax.jit
def solved(matrix, vector):
    """What an implicit derivative makes of a matrix and a right-hand side."""
    factors, own = elimination.regular(elimination.factorise(rows(matrix)))
    return jnp.where(own, jnp.stack(elimination.substitute(factors, list(vector))), 0.0)


@jax.jit
def eliminate(matrix, vector):
    return jnp.stack(elimination.substitute(elimination.factorise(rows(matrix)), list(vector)))


@pytest.mark.parametrize("n", [1, 2, 3, 4])
def test_elimination_matches_numpy(n):
    matrices, vectors = 3 * np.eye(n) + RNG.uniform(-1, 1, (200, n, n)), RNG.normal(size=(200, n))
    expected = np.linalg.solve(matrices, vectors[..., None])[..., 0]
    np.testing.assert_allclose(jax.vmap(eliminate)(matrices, vectors), expected, rtol=1e-10, atol=1e-13)


def test_elimination_leaves_out_zeros_that_are_stated():
    """The pattern of the balances: slip by speed and motor speed, voltage by current and motor speed."""
    matrix = np.array([[-1.0, 0.0, 0.8], [0.0, -0.6, -2.6], [0.0, -0.12, -0.3]])
    sparse = [[None if x == 0 else jnp.asarray(x) for x in row] for row in matrix]
    vector = [jnp.asarray(x) for x in (0.3, -1.2, 0.7)]
    found = elimination.substitute(elimination.factorise(sparse), vector)
    np.testing.assert_allclose(found, np.linalg.solve(matrix, np.asarray(vector)), rtol=1e-14)
    alone = elimination.substitute(elimination.factorise(sparse), [vector[0], None, None])
    assert alone[1] is None and alone[2] is None  # the slip moves neither current nor motor speed
    np.testing.assert_allclose(alone[0], -0.3, rtol=1e-14)


def test_elimination_without_a_pivot_in_its_place_gives_no_number():
    """Newton's method does not move there."""
    assert not np.isfinite(eliminate(EXCHANGE, np.ones(3))).any()


def test_regular_leaves_a_regular_matrix_alone():
    matrix, vector = DIAGONAL + RNG.uniform(-1, 1, (3, 3)), RNG.normal(size=3)
    # Two programs of the same equations, whose products and sums a compiler may fuse or not: an ulp.
    np.testing.assert_array_max_ulp(solved(matrix, vector), eliminate(matrix, vector), maxulp=1)


def test_regular_gives_zero_for_a_singular_matrix_and_spoils_no_neighbour():
    batch = np.stack([np.eye(3), np.zeros((3, 3)), np.full((3, 3), np.nan), EXCHANGE, 2 * np.eye(3)])
    answers = jax.vmap(solved, (0, None))(batch, np.ones(3))
    np.testing.assert_array_equal(answers[:, 0], [1.0, 0.0, 0.0, 0.0, 0.5])
    for direction in (jax.jacfwd, jax.jacrev):
        by_vector = jax.vmap(direction(solved, argnums=1), (0, None))(batch, np.ones(3))
        np.testing.assert_array_equal(by_vector, [np.eye(3), *np.zeros((3, 3, 3)), np.eye(3) / 2])


def test_regular_reverse_derivative_matches_numpy():
    matrix, vector = DIAGONAL + RNG.uniform(-1, 1, (3, 3)), RNG.normal(size=3)
    got = jax.grad(lambda a: solved(a, vector)[0])(jnp.asarray(matrix))
    x, inverted = np.linalg.solve(matrix, vector), np.linalg.inv(matrix)
    np.testing.assert_allclose(got, -np.outer(inverted[0], x), rtol=1e-9)
