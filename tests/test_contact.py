"""Friction law of Fig. 7, contact force (27)-(29), step of Fig. 9a."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.random import default_rng
from numpy.testing import assert_allclose
from worlds import paper

from mmrjax.model.contact import Friction, cubic_step, damping_contact, force_contact, smooth_sign

RNG = default_rng(27)
LAW = dict(static=0.4, dynamic=0.3, speed_static=0.02, speed_dynamic=0.2)
quick = settings(max_examples=60, deadline=None, derandomize=True)


@quick
@given(st.floats(-1, 1), st.floats(0.05, 1.5), st.floats(0.3, 1.0), st.floats(1e-3, 0.1), st.floats(1.5, 20))
def test_friction_coefficient_matches_reference(speed, mu_s, ratio, V_s, spread):
    law = Friction(static=mu_s, dynamic=ratio * mu_s, speed_static=V_s, speed_dynamic=spread * V_s)
    expected = paper.friction(speed, mu_s, ratio * mu_s, V_s, spread * V_s)
    assert_allclose(law.coefficient(speed), expected, rtol=1e-9, atol=1e-15)


@quick
@given(st.floats(-0.999, 0.999), st.floats(0.05, 1.5), st.floats(1e-3, 0.1))
def test_friction_speed_creep_matches_reference(share, mu_s, V_s):
    law = Friction(static=mu_s, dynamic=0.8 * mu_s, speed_static=V_s, speed_dynamic=10 * V_s)
    expected = paper.friction_speed(share * mu_s, mu_s, V_s)
    assert_allclose(law.speed_creep(share * mu_s), expected, rtol=1e-9, atol=1e-300)


def test_friction_speed_creep_inverts_coefficient():
    law = Friction(**LAW)
    mu = jnp.linspace(-0.399, 0.399, 201)
    assert_allclose(law.coefficient(law.speed_creep(mu)), mu, rtol=1e-9, atol=1e-15)


def test_friction_coefficient_derivative_is_finite_and_continuous():
    slope = jax.vmap(jax.grad(Friction(**LAW).coefficient))
    assert np.isfinite(slope(jnp.asarray([0.0, 1e-300, 0.02, 0.2, 1.0, 1e8, -1e8]))).all()
    for knot in (0.02, 0.2):
        left, right = slope(jnp.asarray([knot - 1e-9, knot + 1e-9]))
        assert_allclose(left, right, atol=1e-4)


def test_friction_speed_creep_beyond_adhesion_is_flat_and_finite():
    creep = Friction(**LAW).speed_creep
    for mu in (0.4, 0.5, -0.4, -3.0):
        value, gradient = jax.value_and_grad(creep)(mu)
        assert_allclose(value, np.sign(mu) * 0.02)
        assert float(gradient) == 0.0


@quick
@given(st.floats(-2, 3), st.floats(-1, 0), st.floats(0.1, 2), st.floats(-5, 5), st.floats(-5, 5))
def test_step_matches_reference(x, x0, width, y0, y1):
    expected = paper.cubic_step(x, x0, y0, x0 + width, y1)
    assert_allclose(cubic_step(x, x0, y0, x0 + width, y1), expected, rtol=1e-9, atol=1e-9)


def test_direction_is_smooth_sign():
    speeds = np.array([-5.0, -0.002, -0.001, 0.0, 0.0005, 0.002, 7.0])
    expected = [paper.soft_sign(v, 0.002) for v in speeds]
    assert_allclose(smooth_sign(speeds, 0.002), expected, rtol=1e-12)
    assert np.isfinite(jax.vmap(jax.grad(lambda v: smooth_sign(v, 0.002)))(jnp.asarray(speeds))).all()


@pytest.mark.parametrize("exponent", [0.7, 1.0, 1.5, 2.2])
def test_force_contact_matches_reference(exponent):
    for _ in range(100):
        q, rate, r1, r2 = RNG.uniform((0.0, -1, 0.001, 0.001), (0.02, 1, 0.01, 0.01))
        c, b, d = RNG.uniform((1e3, 0, 1e-4), (1e5, 100, 2e-3))
        got = force_contact(q, rate, r1 + r2, c, exponent, b, d)
        expected = paper.contact_force(q, rate, r1, r2, c, exponent, b, d)
        assert_allclose(got, expected, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("exponent", [0.7, 1.0, 1.5])
@pytest.mark.parametrize("gap", [0.009, 0.01, 0.011, 5.0])
def test_force_contact_derivative_is_finite_through_contact(gap, exponent):
    arguments = (gap, 0.1, 0.01, 1e4, exponent, 20.0, 1e-3)
    gradient = jax.grad(force_contact, argnums=tuple(range(7)))(*arguments)
    assert np.isfinite(gradient).all()


def test_friction_rise_is_the_derivative_of_the_coefficient():
    law = Friction(**LAW)
    for speed in (-0.5, -0.15, -0.01, 0.0, 0.007, 0.05, 0.11, 0.19, 0.4):
        difference = (law.coefficient(speed + 1e-7) - law.coefficient(speed - 1e-7)) / 2e-7
        assert_allclose(law.rise(speed), difference, rtol=1e-5, atol=1e-5)


def test_damping_contact_is_how_the_force_falls_with_the_rate_of_the_gap():
    for gap in (0.0085, 0.0095, 0.011):  # deeper than d, within d, without contact
        forces = [force_contact(gap, rate, 0.01, 1e4, 1.0, 20.0, 1e-3) for rate in (-0.01, 0.01)]
        damping = damping_contact(forces[0], gap, 0.01, 20.0, 1e-3)
        assert_allclose(damping, (forces[0] - forces[1]) / 0.02, atol=1e-9)
