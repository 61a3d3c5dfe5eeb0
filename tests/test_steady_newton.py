"""Newton's method with implicit derivatives: problems with exact roots and gradients, and programs without callbacks."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose

from mmrjax.fidelities.steady import steady
from mmrjax.model.conditions import Conditions
from mmrjax.numerics.newton import root, root_alone

TOLERANCE = 1e-13


START = (jnp.asarray(1.0), jnp.asarray(0.5), jnp.asarray(0.0))


def circle(y, _, radius):
    """Where a circle of `radius` meets the bisector and a third unknown follows."""
    return y[0] ** 2 + y[1] ** 2 - radius**2, y[0] - y[1], y[2] - radius * y[0]


def meeting_of(radius, linear):
    return jnp.stack(root(circle, START, None, radius, TOLERANCE, circle if linear else None)[0])


meeting = partial(meeting_of, linear=False)


def exact(radius):
    return np.array([radius / 2**0.5, radius / 2**0.5, radius**2 / 2**0.5])


@pytest.mark.slow
@pytest.mark.parametrize("linear", [False, True])
def test_root_and_derivatives_are_exact(linear):
    """A circle is not linear: one pass is then not all, whatever was said."""
    meeting, radius = partial(meeting_of, linear=linear), 2.3
    assert_allclose(meeting(radius), exact(radius), rtol=1e-13)
    slope = np.array([2**-0.5, 2**-0.5, 2**0.5 * radius])
    assert_allclose(jax.jacfwd(meeting)(radius), slope, rtol=1e-12)
    assert_allclose(jax.jacrev(meeting)(radius), slope, rtol=1e-12)
    bend = np.array([0.0, 0.0, 2**0.5])
    for twice in (jax.jacfwd(jax.jacrev(meeting)), jax.jacrev(jax.jacfwd(meeting)), jax.jacfwd(jax.jacfwd(meeting))):
        assert_allclose(twice(radius), bend, rtol=1e-11, atol=1e-12)


def test_root_of_a_batch_is_that_of_its_members():
    radii = jnp.asarray([0.3, 1.0, 7.0])
    assert_allclose(jax.vmap(meeting)(radii), [exact(float(r)) for r in radii], rtol=1e-12)
    assert_allclose(jax.vmap(jax.jacrev(meeting))(radii)[:, 2], 2**0.5 * radii, rtol=1e-12)


def test_root_has_no_derivative_by_its_start():
    sensitivity = jax.jacfwd(lambda s: root(circle, s, None, jnp.asarray(2.3), TOLERANCE, None)[0])(START)
    assert not np.any(sensitivity)


def test_root_reports_members_without_one_and_harms_no_other():
    radii = jnp.asarray([1.0, jnp.nan, 2.0])
    _, solved = jax.vmap(lambda r: root(circle, START, None, r, TOLERANCE, None))(radii)
    assert solved.tolist() == [True, False, True]
    alone, ended = jax.vmap(lambda r: root_alone(circle, START, None, r, TOLERANCE))(radii)
    assert_allclose(jnp.stack(alone, 1)[ended], [exact(1.0), exact(2.0)], rtol=1e-13)
    nowhere = root(lambda y, _, a: (y[0] ** 2 + a,), START[:1], None, jnp.asarray(1.0), TOLERANCE, None)
    assert not nowhere[1]


def test_root_derivative_is_zero_where_the_linearisation_is_singular():
    def flat(y, _, a):  # every y[1] is a root
        return y[0] - a, 0.0 * y[1]

    def at(a):
        return jnp.stack(root(flat, START[1:], None, a, TOLERANCE, None)[0])

    assert jax.jacfwd(at)(1.0).tolist() == jax.jacrev(at)(1.0).tolist() == [0.0, 0.0]


def test_root_takes_data_shared_by_a_batch_or_of_its_members():
    def line(y, slope, height):
        return (slope * y[0] - height,)

    def crossing(slope, height):
        return root(line, START[:1], slope, height, TOLERANCE, line)[0][0]

    slope, heights = jnp.asarray(2.0), jnp.asarray([1.0, -3.0])
    assert_allclose(jax.vmap(crossing, (None, 0))(slope, heights), heights / 2, rtol=1e-15)
    by_slope, by_height = jax.vmap(jax.grad(crossing, (0, 1)), (None, 0))(slope, heights)
    assert_allclose(by_slope, -heights / 4, rtol=1e-15)
    assert_allclose(by_height, [0.5, 0.5], rtol=1e-15)


# --- programs that the compilation cache keeps --------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("derivative", [jax.jacfwd, jax.jacrev, jax.hessian])
def test_steady_programs_hold_no_host_callback(rebuild, theta, derivative):
    runs = Conditions(voltage=[15.0, 24.0, 33.0], slope_deg=5.0)
    few = theta[:2]

    def readings(x, run):
        answer = steady(rebuild(theta.at[:2].set(x)), run)
        return jnp.stack([answer.total_current, answer.motor_speed, answer.speed])

    program = jax.jit(jax.vmap(derivative(readings), in_axes=(None, 0))).lower(few, runs)
    assert "callback" not in program.as_text()
