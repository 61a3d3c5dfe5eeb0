"""Rodas4: its order, its stiff decay, its error estimate."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

from mmrjax.models.rosenbrock import Rodas4


def pendulum(t, y, args):
    return jnp.stack([y[1], -jnp.sin(y[0]) - 0.1 * y[1] * jnp.abs(y[1]) ** 2])


def lotka(t, y, args):
    return jnp.stack([y[0] * (1.1 - 0.4 * y[1]), y[1] * (0.1 * y[0] - 0.4)])


@jax.jit
def _end(dt, which):
    def rates(t, y, args):
        return jnp.where(which > 0, lotka(t, y, args), pendulum(t, y, args))

    solution = diffrax.diffeqsolve(
        diffrax.ODETerm(rates),
        Rodas4(),
        0.0,
        3.2,
        dt0=dt,
        y0=jnp.asarray([1.0, 0.5]),
        max_steps=6000,
        stepsize_controller=diffrax.ConstantStepSize(),
        adjoint=diffrax.ForwardMode(),
    )
    return solution.ys[-1]


@pytest.mark.parametrize("problem", [pendulum, lotka])
def test_rodas4_converges_with_order_four(problem):
    exact = solve_ivp(
        lambda t, y: np.asarray(problem(t, y, None)), (0, 3.2), [1.0, 0.5], "DOP853", rtol=1e-13, atol=1e-14
    ).y[:, -1]
    steps = 3.2 / np.array([64, 128, 256, 512])  # fine enough to be asymptotic
    errors = [np.abs(np.asarray(_end(h, float(problem is lotka))) - exact).max() for h in steps]
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
    np.testing.assert_allclose(value, 1.0, atol=20 / stiffness)


def test_rodas4_settles_at_every_step_size():
    # |R(z)| <= 1 on the whole negative axis
    values = [abs(1 - float(_one(h, 1.0)[0])) for h in np.geomspace(1e-3, 1e6, 60)]
    assert max(values) <= 1.0


def test_rodas4_error_estimate_is_of_local_order_four():
    steps = np.array([0.2, 0.1, 0.05, 0.025])
    estimates = [abs(float(_one(h, 1.0)[1])) for h in steps]
    orders = np.log2(np.divide(estimates[:-1], estimates[1:]))
    assert (np.abs(orders - 4) < 0.4).all(), orders
