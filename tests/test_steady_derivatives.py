"""Derivatives of every number of `steady` by every parameter: implicit against central differences."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose

from mmrjax.model.conditions import Conditions

#: Conditions at which the numbers are smooth: driving, on battery, overhauling, stalled.
POINTS = {
    "tracked_33V_5deg_8kg": dict(voltage=33.0, slope_deg=5.0, payload=8.0),
    "wheeled_15V_level": dict(voltage=15.0, configuration=1),
    "tracked_battery": dict(battery=1.0, discharge=3600.0, slope_deg=np.degrees(0.05), payload=3.0),
    "wheeled_battery_10deg": dict(battery=1.0, discharge=100.0, slope_deg=10.0, configuration=1),
    "wheeled_overhauling": dict(voltage=24.0, slope_deg=np.degrees(-0.2), configuration=1),
    "tracked_near_adhesion": dict(voltage=24.0, slope_deg=14.0, payload=1.5),
    "tracked_stalled": dict(voltage=0.5, slope_deg=np.degrees(0.1)),
    "wheeled_stalled_battery": dict(battery=1.0, slope_deg=np.degrees(0.2), configuration=1, payload=900.0),
    "other_surface": dict(voltage=24.0, slope_deg=20.0, adhesion=2.1),
}


@pytest.fixture(scope="session")
def derivatives(steady_numbers, scales):
    """Forward, reverse and central differences of one command, scaled by the parameters' sizes."""
    size = jnp.asarray(scales)

    def scaled(x, vector, run):
        return steady_numbers(vector + x * size, run)

    @jax.jit
    def evaluate(vector, run):
        zero = jnp.zeros_like(vector)
        forward = jax.jacfwd(scaled)(zero, vector, run)
        reverse = jax.jacrev(scaled)(zero, vector, run)
        steps = 1e-4 * jnp.kron(jnp.array([1.0, -1.0, 2.0, -2.0])[:, None], jnp.eye(vector.size))
        found = jax.vmap(scaled, in_axes=(0, None, None))(jnp.concatenate([zero[None], steps]), vector, run)
        ahead, behind, twice_ahead, twice_behind = found[1:].reshape(4, vector.size, -1)
        first, second = (ahead - behind) / 2e-4, (twice_ahead - twice_behind) / 4e-4
        return found[0], forward, reverse, ((4 * first - second) / 3).T

    return evaluate


@pytest.mark.slow
@pytest.mark.parametrize("point", sorted(POINTS))
def test_steady_derivatives_are_central_differences(point, theta, derivatives):
    values, forward, reverse, central = (np.asarray(x) for x in derivatives(theta, Conditions(**POINTS[point])))
    # No temperature settles a winding at the stall current of a full battery: neither it nor its channel has an end.
    endless = np.isinf(values)
    assert endless.sum() == 2 * (point == "wheeled_stalled_battery") and (forward[endless] == 0).all()
    values, forward, reverse, central = (x[~endless] for x in (values, forward, reverse, central))
    assert np.isfinite(values).all() and np.isfinite(forward).all()
    # relative to the derivative; where a parameter hardly moves an output, 1e-9 of the output or SI unit
    allowed = 1e-5 * np.maximum(np.abs(central), 1e-4 * (np.abs(values)[:, None] + 1.0))
    assert (np.abs(forward - central) <= allowed).all()
    assert (np.abs(reverse - central) <= allowed).all()


@pytest.mark.slow
@pytest.mark.parametrize(
    "conditions",
    [dict(slope_deg=20.0), dict(voltage=np.nan), dict(battery=1.0, discharge=9e3), dict(voltage=0.0)],
    ids=["slides", "nan_voltage", "battery_empty", "zero_voltage"],
)
def test_steady_derivatives_without_an_answer_are_finite(conditions, theta, derivatives):
    _, forward, reverse, _ = derivatives(theta, Conditions(**{"voltage": 24.0, **conditions}))
    assert np.isfinite(forward).all() and np.isfinite(reverse).all()
    assert_allclose(forward, reverse, rtol=1e-9, atol=1e-9)


@pytest.mark.slow
def test_steady_derivatives_at_zero_slip_are_finite(theta, derivatives):
    """A slope at which nothing has to be held: demand, sliding and slip are all zero."""
    run = Conditions(voltage=24.0, slope_deg=np.degrees(-np.arctan(0.06)))
    values, forward, reverse, _ = derivatives(theta, run)
    assert np.isfinite(values).all() and np.isfinite(forward).all() and np.isfinite(reverse).all()


@pytest.mark.slow
def test_steady_second_derivatives_are_central_differences(rebuild, theta, free, scales):
    """Of the speed by three parameters, through the implicit derivative twice."""
    from mmrjax.fidelities.steady import steady

    names = [p.name for p in free]
    chosen = [names.index(n) for n in ("motor.resistance", "6T2A.mass", "6T2A.ground.friction.static")]
    run = Conditions(voltage=24.0, slope_deg=np.degrees(0.08))
    size = jnp.asarray(scales)[jnp.asarray(chosen)]

    def speed(x):
        return steady(rebuild(theta.at[jnp.asarray(chosen)].add(x * size)), run).speed

    hessian = jax.jit(jax.hessian(speed))(jnp.zeros(3))
    slope = jax.jit(jax.grad(speed))
    central = np.stack([(slope(1e-4 * e) - slope(-1e-4 * e)) / 2e-4 for e in np.eye(3)])
    assert_allclose(hessian, central, rtol=1e-5, atol=1e-8)
