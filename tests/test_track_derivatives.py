"""Derivatives of the track model's averages, forward and reverse, against central differences.

Eight operating points in both configurations, rolling, averaged over whole grouser periods of the settled
orbit. Every parameter by its relative change. To 1 %, no floor but for what is zero.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose

from mmrjax.fidelities.track import track
from mmrjax.model import params
from mmrjax.model.conditions import Conditions
from mmrjax.model.signals import CONVERGED, GRAVITY
from mmrjax.undercarriage import half_robot

PARAMETERS = (
    "track.guide_friction",
    "ground.friction.static",
    "ground.friction.speed_static",
    "ground.rolling_resistance",
    "track.loss_coulomb",
    "gearbox.efficiency_load",
    "motor.resistance",
    "mass",
)
#: (wheeled, slope [deg], payload [kg], voltage [V])
POINTS = np.array(
    [
        (0, 0, 0, 33),
        (0, 5, 8, 33),
        (0, 10, 0, 15),
        (0, 5, 3, 24),
        (1, 0, 0, 33),
        (1, 10, 8, 33),
        (1, 15, 0, 15),
        (1, 5, 3, 24),
    ],
    float,
)
OUTPUTS = ("total_current", "motor_speed", "speed")


@pytest.fixture(scope="module")
def averages(robot):
    """Outputs and status over (relative changes of the parameters, command), not compiled."""
    values = {p.name: p.value for p in params.walk_parameters(robot)}

    def outputs(theta, run):
        changes = {}
        for k, name in enumerate(PARAMETERS):
            on_robot = name.startswith(("gearbox", "motor"))
            for full in [name] if on_robot else [f"6T2A.{name}", f"4W2T.{name}"]:
                changes[full] = values[full] * (1 + theta[k])
        answer = track(params.replace(robot, changes), run, duration=0.5, rolling=True).result
        return jnp.stack([answer.reading[name] for name in OUTPUTS]), answer.status

    return outputs


@pytest.fixture(scope="module")
def commands():
    wheeled, slope, payload, voltage = POINTS.T
    return Conditions(voltage=voltage, slope_deg=slope, payload=payload, configuration=wheeled)


@pytest.fixture(scope="module")
def at():
    return jnp.zeros(len(PARAMETERS))


@pytest.fixture(scope="module")
def forward(averages, commands, at):
    slope = jax.jit(jax.vmap(jax.jacfwd(averages, has_aux=True), in_axes=(None, 0)))
    jacobian, status = slope(at, commands)
    assert (status == CONVERGED).all()
    return np.asarray(jacobian)


@pytest.mark.slow
def test_forward_derivatives_are_central_differences(averages, commands, at, forward):
    runs = jax.jit(jax.vmap(jax.vmap(averages, in_axes=(None, 0)), in_axes=(0, None)))
    h = 2e-5  # the averages are smooth, but they curve over the phase at which a run ends
    moved = jnp.concatenate([h * jnp.eye(at.size), -h * jnp.eye(at.size), jnp.zeros((1, at.size))])
    values = np.asarray(runs(moved, commands)[0])
    central = (values[: at.size] - values[at.size : -1]).transpose(1, 2, 0) / (2 * h)
    # A relative change of 1 moves the output by less than 1e-4 of itself: zero to both.
    floor = 1e-4 * np.abs(values[-1])[..., None]
    error = np.abs(forward - central) / np.maximum(np.abs(central), floor)
    worst = np.unravel_index(error.argmax(), error.shape)
    assert error.max() < 0.01, f"point {worst[0]}, {OUTPUTS[worst[1]]} by {PARAMETERS[worst[2]]}: {error.max():.3g}"


@pytest.mark.slow
def test_no_parameter_is_dead(forward):
    tracked = np.abs(forward[:4]).max(axis=(0, 1))
    wheeled = np.abs(forward[4:]).max(axis=(0, 1))
    assert (tracked > 1e-4).all()
    assert (np.delete(wheeled, PARAMETERS.index("track.guide_friction")) > 1e-4).all()
    assert wheeled[PARAMETERS.index("track.guide_friction")] == 0.0  # wheels carry no load on the guides


@pytest.mark.slow
def test_reverse_derivatives_are_forward_ones(averages, commands, at, forward):
    slope = jax.jit(jax.vmap(jax.jacrev(averages, has_aux=True), in_axes=(None, 0)))
    reverse = np.asarray(slope(at, commands)[0])
    assert_allclose(reverse, forward, rtol=1e-6, atol=1e-9)


@pytest.mark.slow
def test_robot_at_rest_is_borne_with_exact_derivatives(robot):

    def borne(payload, slope_deg, configuration):
        conditions = Conditions(configuration, voltage=24.0, slope_deg=slope_deg, payload=payload)
        run = half_robot.build_system(robot, conditions, 1e-4)
        q = half_robot.stand(run, 0.1).q
        at = half_robot.side_contacts.compute_contacts(run.path, run.chassis, q, jnp.zeros(5))
        return q[1:3], at.normal / (half_robot.centre_of_mass(run)[2] * GRAVITY * jnp.cos(run.conditions.slope))

    both = jax.jit(jax.vmap(lambda *given: (*borne(*given), jax.jacrev(borne)(*given)[0])))
    cases = jnp.asarray([3.0, 6.0]), jnp.asarray([12.0, -5.0]), jnp.asarray([0.0, 1.0])
    _, share, slope = both(*cases)
    assert_allclose(share, 1.0, rtol=1e-10)
    higher, lower = (both(cases[0] + step, *cases[1:])[0] for step in (0.01, -0.01))
    assert_allclose(slope, (higher - lower) / 0.02, rtol=1e-4)
