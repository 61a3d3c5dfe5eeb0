"""Linear equations of a few unknowns, and that programs which run side by side call no LAPACK for them."""

import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.random import default_rng
from numpy.testing import assert_allclose, assert_array_equal
from test_log_kinds import servo, written

from calibration.data import runs as records
from calibration.inference import noise, observers, priors
from calibration.inference.optimizers import linearise_rollout
from mmrjax.numerics.linear_equations import (
    factorise,
    inverse,
    invert,
    regularise,
    solve,
    solve_factorised,
    solve_lower,
    substitute,
)

#: Primitives that the CPU does by LAPACK.
LAPACK = r"\b(lu|cholesky|triangular_solve|qr|householder_product|eigh?|svd|schur|tridiagonal_solve)\["


def test_equations_are_solved_as_by_numpy_whatever_the_pivots():
    rng = default_rng(0)
    matrices = rng.standard_normal((40, 5, 5))
    matrices[:10, 0, 0] = 0.0  # nothing to begin with
    matrices[10:20] = np.eye(5)[rng.permutation(5)] * 1e-9
    matrices[20:30] *= 10.0 ** rng.uniform(-8, 8, (10, 5, 1))
    b = rng.standard_normal((40, 5, 2))
    found, inverse = jax.vmap(solve)(matrices, b), jax.vmap(invert)(matrices)
    assert_allclose(found, np.linalg.solve(matrices, b), rtol=1e-9)
    assert_allclose(inverse, np.linalg.inv(matrices), rtol=1e-9, atol=1e-12)
    assert np.asarray(solve(matrices[0], b[0, :, 0])) == pytest.approx(found[0, :, 0])
    assert not np.isfinite(solve(jnp.ones((3, 3)), jnp.arange(3.0))).any()


def test_half_of_a_solution_is_that_of_a_cholesky_factor():
    rng = default_rng(0)
    a = rng.standard_normal((9, 5))
    lower = np.linalg.cholesky(a.T @ a)
    assert_allclose(solve_lower(a.T @ a, a.T), np.linalg.solve(lower, a.T), rtol=1e-9, atol=1e-12)
    assert np.isnan(solve_lower(-a.T @ a, a.T)).any()


# --- written out, without exchanges ---------------------------------------------------------------------------------

RNG = default_rng(1)
DIAGONAL = 3 * np.eye(3)  # added to a matrix: pivots where elimination without exchanges looks for them
EXCHANGE = np.array([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]])  # no pivot on the diagonal at all


@jax.jit
def implicit(matrix, vector):
    """What an implicit derivative makes of a matrix and a right-hand side."""
    factors, own = regularise(factorise(matrix))
    return jnp.where(own, solve_factorised(factors, vector), 0.0)


@jax.jit
def eliminate(matrix, vector):
    return solve_factorised(factorise(matrix), vector)


@pytest.mark.parametrize("n", [1, 2, 3, 4])
def test_elimination_and_inverse_match_numpy(n):
    matrices, vectors = 3 * np.eye(n) + RNG.uniform(-1, 1, (200, n, n)), RNG.normal(size=(200, n))
    expected = np.linalg.solve(matrices, vectors[..., None])[..., 0]
    assert_allclose(jax.vmap(eliminate)(matrices, vectors), expected, rtol=1e-10, atol=1e-13)
    found, determinant = jax.vmap(inverse)(jnp.asarray(matrices))
    assert_allclose(found, np.linalg.inv(matrices), rtol=1e-10, atol=1e-13)
    assert_allclose(determinant, np.linalg.det(matrices), rtol=1e-10)


def test_elimination_leaves_out_zeros_that_are_stated():
    """The pattern of the balances: slip by speed and motor speed, voltage by current and motor speed."""
    matrix, vector = (
        np.array([[-1.0, 0.0, 0.8], [0.0, -0.6, -2.6], [0.0, -0.12, -0.3]]),
        jnp.asarray([0.3, -1.2, 0.7]),
    )
    factors = factorise([[None if x == 0 else jnp.asarray(x) for x in row] for row in matrix])
    assert_allclose(substitute(factors, [*vector]), np.linalg.solve(matrix, vector), rtol=1e-14)
    slip, *others = substitute(factors, [vector[0], None, None])
    assert others == [None, None]  # the slip moves neither current nor motor speed
    assert_allclose(slip, -0.3, rtol=1e-14)


def test_elimination_without_a_pivot_in_its_place_gives_no_number():
    """Newton's method does not move there."""
    assert not np.isfinite(eliminate(EXCHANGE, np.ones(3))).any()


def test_regular_gives_zero_for_a_singular_matrix_and_spoils_no_neighbour():
    batch = np.stack([np.eye(3), np.zeros((3, 3)), np.full((3, 3), np.nan), EXCHANGE, 2 * np.eye(3)])
    answers = jax.vmap(implicit, (0, None))(batch, np.ones(3))
    assert_array_equal(answers[:, 0], [1.0, 0.0, 0.0, 0.0, 0.5])
    for direction in (jax.jacfwd, jax.jacrev):
        by_vector = jax.vmap(direction(implicit, argnums=1), (0, None))(batch, np.ones(3))
        assert_array_equal(by_vector, [np.eye(3), *np.zeros((3, 3, 3)), np.eye(3) / 2])


def test_regular_reverse_derivative_matches_numpy():
    matrix, vector = DIAGONAL + RNG.uniform(-1, 1, (3, 3)), RNG.normal(size=3)
    got = jax.grad(lambda a: implicit(a, vector)[0])(jnp.asarray(matrix))
    x, back = np.linalg.solve(matrix, vector), np.linalg.inv(matrix)
    assert_allclose(got, -np.outer(back[0], x), rtol=1e-9)


# --- programs ---------------------------------------------------------------------------------------------------------


def test_a_step_of_a_search_on_a_log_calls_no_lapack(tmp_path):
    """Batched calls of it, of programs side by side, have waited for each other for ever."""
    log = {name: column[:12] for name, column in servo(default_rng(1), levels=(0.9,), hold=0.2).items()}
    robot = written(tmp_path, "servo", log)
    runs = records.read_runs(tmp_path / "log.csv", robot=robot)
    known = noise.noise_from_table(runs, observers.observer_kind(runs).sizes(runs))
    coordinates = priors.parameter_coordinates(robot, ("motor.torque_constant", "wheel.loss_coulomb"))
    problem = observers.pose_problem(runs, robot, coordinates, known.sd)
    step = jax.make_jaxpr(lambda z: linearise_rollout(problem, z))(jnp.zeros(2))
    assert re.search(LAPACK, str(jax.make_jaxpr(jnp.linalg.inv)(jnp.eye(2)))), "it can fail"
    assert not re.findall(LAPACK, str(step))
