"""Derivatives of every number of `drive` by every parameter, and that no parameter is dead."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mmrjax.model.conditions import Conditions

pytestmark = pytest.mark.slow  # compiles for a minute

RUNS = {
    "tracked_24V": dict(voltage=24.0, slope_deg=np.degrees(0.03), payload=2.0),
    "wheeled_33V_spinning": dict(voltage=33.0, slope_deg=15.0, configuration=1),
    "tracked_battery": dict(battery=1.0, discharge=3600.0),
    "wheeled_15V": dict(voltage=15.0, configuration=1, payload=8.0),
    "tracked_slides": dict(voltage=24.0, slope_deg=20.0),
}
TIMES = np.array([0.0, 1e-4, 1e-3, 0.02, 0.15, 0.6, 1.5])


@pytest.fixture(scope="session")
def run_derivatives(drive_numbers, scales):
    """Values with forward derivatives, and central differences of the fourth order."""
    size, times = jnp.asarray(scales), jnp.asarray(TIMES)

    def scaled(x, vector, run):
        return drive_numbers(vector + x * size, run, times)

    @jax.jit
    def forward(vector, run):
        def column(e):
            return jax.jvp(lambda x: scaled(x, vector, run), (jnp.zeros_like(e),), (e,))

        return jax.vmap(column, out_axes=-1)(jnp.eye(vector.size))

    @jax.jit
    def central(vector, run):
        steps = jnp.concatenate([k * h * jnp.eye(vector.size) for k in (-2, -1, 1, 2)])
        shifted = jax.vmap(scaled, in_axes=(0, None, None), out_axes=-1)(steps, vector, run)

        def stencil(values):
            far_down, down, up, far_up = jnp.split(values, 4, axis=-1)
            return (8 * (up - down) - (far_up - far_down)) / (12 * h)

        return jax.tree.map(stencil, shifted)

    h = 1e-3
    return forward, central


@pytest.fixture(scope="session")
def jacobians(theta, run_derivatives):
    """Values and forward derivatives of every run: the signals, then the result. Last axis the parameters."""
    forward, _ = run_derivatives
    return {name: jax.tree.map(np.asarray, forward(theta, Conditions(**run))) for name, run in RUNS.items()}


@pytest.mark.nightly
@pytest.mark.parametrize("name", sorted(RUNS))
def test_drive_derivatives_are_central_differences(name, theta, jacobians, run_derivatives):
    """To 1e-5 of a signal's largest value or derivative in the run."""
    central = run_derivatives[1](theta, Conditions(**RUNS[name]))
    for values, forward, differences in zip(*jacobians[name], central, strict=True):
        assert np.isfinite(values).all() and np.isfinite(forward).all()
        instants = tuple(range(1, forward.ndim))
        scale = np.maximum(np.abs(values), np.abs(differences)).max(instants, keepdims=True) + 1e-6
        error = np.abs(forward - differences) / scale
        assert error.max() < 1e-5, np.unravel_index(error.argmax(), error.shape)


# --- no parameter that can be freed is dead ---------------------------------------------------------

#: Parameters that leave the steady state alone, and why.
NOT_IN_STEADY = {
    "motor.inductance": "no voltage across it at constant current",
    "motor.inertia": "no torque at constant speed",
    "6T2A.inertia": "no torque at constant speed",
    "4W2T.inertia": "no torque at constant speed",
    "6T2A.ground.friction.dynamic": "below V_s only static friction acts",
    "4W2T.ground.friction.dynamic": "below V_s only static friction acts",
    "6T2A.ground.friction.speed_dynamic": "below V_s only static friction acts",
    "4W2T.ground.friction.speed_dynamic": "below V_s only static friction acts",
    "4W2T.track.guide_friction": "times a guide share of 0: the wheels carry the weight",
    "effects.rotating_inertia.amplitude": "no torque at constant speed",
    "effects.pulley_eccentricity.amplitude": "zero on the average of a turn",
}
#: Beginnings of the names of parameters that neither fidelity reads, and what does.
READ_ELSEWHERE = {
    "running_gear.": "the track model, modes and ripple",
    "driver.": "missions that demand a speed",
    "motor.time_constant_": "missions and the permissible time of a load",
    "rig.delay": "histories of what was measured",
    "6T2A.turning.": "turns",
    "4W2T.turning.": "turns",
}
#: Alive only away from the nominal value of another parameter.
ALIVE_WITH = {"4W2T.track.guide_friction": ("4W2T.track.guide_share", 0.2)}


def test_every_free_parameter_changes_drive(free, theta, jacobians):
    names = [p.name for p in free]
    alive = np.zeros(len(names), bool)
    for values, forward in jacobians.values():
        for v, d in zip(values, forward, strict=True):
            seen = np.abs(d) > 1e-8 * (np.abs(v) + 1e-3)
            alive |= seen.any(tuple(range(d.ndim - 1)))
    dead = {n for n, a in zip(names, alive, strict=True) if not a}
    assert dead == set(ALIVE_WITH) | _elsewhere(names)


def _elsewhere(names):
    return {n for n in names if n.startswith(tuple(READ_ELSEWHERE))}


def test_every_free_parameter_changes_steady(free, theta, steady_numbers, scales):
    names = [p.name for p in free]
    conditions = [dict(voltage=24.0, slope_deg=3.0, configuration=k) for k in (0, 1)]
    conditions += [dict(battery=1.0, discharge=3600.0)]
    jacobian = jax.jit(jax.jacfwd(steady_numbers))
    found = [np.abs(np.asarray(jacobian(theta, Conditions(**c))) * scales).max(0) > 1e-8 for c in conditions]
    dead = {n for n, alive in zip(names, np.any(found, 0), strict=True) if not alive}
    assert dead == set(NOT_IN_STEADY) | _elsewhere(names)
    for name, (other, value) in ALIVE_WITH.items():
        vector = theta.at[names.index(other)].set(value)
        assert np.abs(np.asarray(jacobian(vector, Conditions(**conditions[1])))[:, names.index(name)]).max() > 1e-8
