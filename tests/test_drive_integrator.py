"""Rodas4: its order, its stiff decay, its error estimate."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.random import default_rng
from numpy.testing import assert_allclose
from scipy.integrate import solve_ivp

from mmrjax.numerics.rodas import Rodas4


def pendulum(t, y, args):
    return jnp.stack([y[1], -jnp.sin(y[0]) - 0.1 * y[1] * jnp.abs(y[1]) ** 2])


def decay(t, y, args):
    return jnp.stack([y[1] - y[0] ** 3, -3.0 * y[1] * (1.0 + y[0])])


STARTS = default_rng(4).uniform(0.3, 2.0, (12, 2))  # several, lest one error cross zero


@jax.jit
def _ends(dt, which):
    def rates(t, y, args):
        return jnp.where(which > 0, decay(t, y, args), pendulum(t, y, args))

    def end(y0):
        solution = diffrax.diffeqsolve(
            diffrax.ODETerm(rates),
            Rodas4(),
            0.0,
            3.2,
            dt0=dt,
            y0=y0,
            max_steps=6000,
            stepsize_controller=diffrax.ConstantStepSize(),
            adjoint=diffrax.ForwardMode(),
        )
        return solution.ys[-1]

    return jax.vmap(end)(jnp.asarray(STARTS))


@pytest.mark.parametrize("problem", [pendulum, decay])
def test_rodas4_converges_with_order_four(problem):
    def exact(start):
        rates = jax.jit(lambda y: problem(0.0, y, None))
        return solve_ivp(lambda t, y: np.asarray(rates(y)), (0, 3.2), start, "DOP853", rtol=1e-12, atol=1e-13).y[
            :, -1
        ]

    ends = np.stack([exact(start) for start in STARTS])
    steps = 3.2 / np.array([64, 128, 256, 512])
    errors = [np.sqrt(np.mean((np.asarray(_ends(h, float(problem is decay))) - ends) ** 2)) for h in steps]
    orders = np.log2(np.divide(errors[:-1], errors[1:]))
    assert (np.abs(orders - 4) < 0.3).all(), orders


@jax.jit
def _one(h, rate):
    """One step of y' = -rate (y - 1) from 0, and its error estimate."""
    term = diffrax.ODETerm(lambda t, y, args: -rate * (y - 1.0))
    y1, error, *_ = Rodas4().step(term, 0.0, h, jnp.asarray([0.0]), None, None, False)
    return y1[0], error[0]


@pytest.mark.parametrize("stiffness", [1e3, 1e6, 1e9])
def test_rodas4_forgets_stiff_transients_in_one_step(stiffness):
    # L-stable: R(∞) = 0, so one step far longer than the transient lands on the settled value.
    value, _ = _one(1.0, stiffness)
    assert_allclose(value, 1.0, atol=20 / stiffness)


def test_rodas4_error_estimate_is_of_local_order_four():
    steps = np.array([0.2, 0.1, 0.05, 0.025])
    estimates = [abs(float(_one(h, 1.0)[1])) for h in steps]
    orders = np.log2(np.divide(estimates[:-1], estimates[1:]))
    assert (np.abs(orders - 4) < 0.4).all(), orders


def _between(h, rates, start, shares):
    """Dense output of one step at shares of its length."""
    term, t0 = diffrax.ODETerm(lambda t, y, args: rates(t, y, args)), 0.0
    _, _, dense, *_ = Rodas4().step(term, t0, h, jnp.asarray(start), None, None, False)
    polynomial = Rodas4.interpolation_cls(t0=t0, t1=h, **dense)
    return np.stack([np.asarray(polynomial.evaluate(share * h)) for share in shares])


def test_rodas4_dense_output_is_of_order_three():
    # The error within one step falls as h^4.
    shares, steps = np.linspace(0, 1, 11), np.array([0.2, 0.1, 0.05, 0.025])
    rates = jax.jit(lambda y: pendulum(0.0, y, None))
    errors = []
    for h in steps:
        exact = solve_ivp(
            lambda t, y: np.asarray(rates(y)), (0, h), [1.0, 0.5], "DOP853", shares * h, rtol=1e-13, atol=1e-15
        )
        errors.append(np.abs(_between(h, pendulum, [1.0, 0.5], shares) - exact.y.T).max())
    orders = np.log2(np.divide(errors[:-1], errors[1:]))
    assert (np.abs(orders - 4) < 0.3).all(), orders


def test_rodas4_dense_output_does_not_swing_on_a_stiff_component():
    # y follows 1 + x within 1e-6 while x grows; y starts 1e-8 off: a Hermite cubic would swing by 0.1.
    def rates(t, y, args):
        return jnp.stack([1e-3 + 0 * y[0], -1e6 * (y[1] - 1.0 - y[0])])

    values = _between(100.0, rates, [0.0, 1.0 + 1e-8], np.linspace(0, 1, 21))
    assert_allclose(values[:, 1], 1.0 + values[:, 0], atol=1e-6)
