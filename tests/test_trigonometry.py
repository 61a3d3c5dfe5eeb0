"""The written-out sine, cosine and third of an arc sine against NumPy, with derivatives of both directions."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose

from mmrjax.numerics.elementary import cosine, sine, sine_third

FUNCTIONS = {
    "sine": (sine, np.sin, np.cos),
    "cosine": (cosine, np.cos, lambda x: -np.sin(x)),
}


@pytest.mark.parametrize("name", FUNCTIONS)
def test_trigonometry_matches_numpy(name):
    function, expected, slope = FUNCTIONS[name]
    x = np.concatenate([np.linspace(-20, 20, 100_001), np.pi / 2 * np.arange(-8, 9), [1e4, -1e4]])
    assert_allclose(function(x), expected(x), rtol=0, atol=4e-16)
    for derivative in (jax.jacfwd, jax.jacrev):
        found = jax.vmap(derivative(function))(x[::100])
        assert_allclose(found, slope(x[::100]), rtol=0, atol=4e-16)


def test_sine_keeps_small_angles_to_the_last_bits():
    x = np.geomspace(1e-300, 1.0, 2001)
    assert_allclose(sine(x), np.sin(x), rtol=4e-16)
    assert sine(jnp.asarray(0.0)) == 0.0


def test_sine_third_matches_numpy_and_its_cubic():
    x = np.concatenate([np.linspace(-1, 1, 100_001), [0.5, -0.5, 1e-300]])
    y = np.asarray(sine_third(x))
    assert_allclose(y, np.sin(np.arcsin(x) / 3), rtol=8e-16)
    assert_allclose(3 * y - 4 * y**3, x, rtol=0, atol=4e-16)
    assert np.isnan(sine_third(jnp.asarray(1.0001)))


def test_sine_third_derivative_is_that_of_its_cubic():
    x = np.linspace(-0.99, 0.99, 199)
    y = np.asarray(sine_third(x))
    for derivative in (jax.jacfwd, jax.jacrev):
        assert_allclose(jax.vmap(derivative(sine_third))(x), 1 / (3 - 12 * y**2), rtol=1e-12)
    second = jax.vmap(jax.hessian(sine_third))(x)
    assert_allclose(second, 24 * y / (3 - 12 * y**2) ** 3, rtol=1e-9, atol=1e-12)


def test_trigonometry_of_single_precision_stays_single():
    x = jnp.linspace(-1.0, 1.0, 101, dtype=jnp.float32)
    for function, expected in ((sine, np.sin), (cosine, np.cos), (sine_third, lambda v: np.sin(np.arcsin(v) / 3))):
        assert function(x).dtype == jnp.float32
        assert_allclose(function(x), expected(np.asarray(x, float)), rtol=0, atol=3e-7)
