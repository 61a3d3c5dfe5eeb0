"""Linear equations of a few unknowns, and that programs which run side by side call no LAPACK for them."""

import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from test_log_kinds import servo, written

from calibration.data import runs as records
from calibration.inference import noise, observers, priors
from calibration.inference.optimizers import linearised_signed
from mmrjax.linear_equations import inverted, solved

#: Primitives that the CPU does by LAPACK.
LAPACK = r"\b(lu|cholesky|triangular_solve|qr|householder_product|eigh?|svd|schur|tridiagonal_solve)\["


def test_equations_are_solved_as_by_numpy_whatever_the_pivots():
    rng = np.random.default_rng(0)
    matrices = rng.standard_normal((40, 5, 5))
    matrices[:10, 0, 0] = 0.0  # nothing to begin with
    matrices[10:20] = np.eye(5)[rng.permutation(5)] * 1e-9
    matrices[20:30] *= 10.0 ** rng.uniform(-8, 8, (10, 5, 1))
    b = rng.standard_normal((40, 5, 2))
    found, inverse = jax.vmap(solved)(matrices, b), jax.vmap(inverted)(matrices)
    np.testing.assert_allclose(found, np.linalg.solve(matrices, b), rtol=1e-9)
    np.testing.assert_allclose(inverse, np.linalg.inv(matrices), rtol=1e-9, atol=1e-12)
    assert np.asarray(solved(matrices[0], b[0, :, 0])) == pytest.approx(found[0, :, 0])
    assert not np.isfinite(solved(jnp.ones((3, 3)), jnp.arange(3.0))).any()


def test_a_step_of_a_search_on_a_log_calls_no_lapack(tmp_path):
    """Batched calls of it, of programs side by side, have waited for each other for ever."""
    log = {name: column[:12] for name, column in servo(np.random.default_rng(1), levels=(0.9,), hold=0.2).items()}
    robot = written(tmp_path, "servo", log)
    runs = records.read(tmp_path / "log.csv", robot=robot)
    known = noise.from_table(runs, observers.kind(runs).sizes(runs))
    coordinates = priors.coordinates(robot, ("motor.torque_constant", "wheel.loss_coulomb"))
    problem = observers.pose(runs, robot, coordinates, known.sd)
    step = jax.make_jaxpr(lambda z: linearised_signed(problem, z, problem.data))(jnp.zeros(2))
    assert re.search(LAPACK, str(jax.make_jaxpr(jnp.linalg.inv)(jnp.eye(2)))), "it can fail"
    assert not re.findall(LAPACK, str(step))
