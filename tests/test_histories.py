"""`drive` on a fixed grid: it follows `drive`, its derivatives are those of what it computes, it says when it can't."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose

from mmrjax.effects import BY_NAME
from mmrjax.fidelities.drive import drive
from mmrjax.fidelities.histories import LONGEST, START, history_signals, linearise_run, time_grid
from mmrjax.model import params
from mmrjax.model.conditions import Conditions
from mmrjax.model.paper_robots import nominal

RUNS = Conditions(
    voltage=np.array([15.0, 33.0, 24.0]),
    slope_deg=[0.0, 10.0, 5.0],
    payload=np.array([0.0, 8.0, 3.0]),
    configuration=np.array([0.0, 0.0, 1.0]),
)
TIMES = np.concatenate([np.linspace(2e-4, 4e-3, 8), np.arange(0.02, 0.8001, 0.02)])
GRID = time_grid(TIMES)
AT = np.searchsorted(GRID, TIMES)
STATE = ("current", "speed_motor", "speed")
#: Every effect with a memory, and one in each of `inertia` and `inductance`.
EFFECTS = ("rotating_inertia", "thermal_drift", "armature_inductance", "cogging", "stick_slip", "pulley_eccentricity",
           "grouser_polygon")  # fmt: skip


def seen(robot, runs=RUNS):
    """Current [A], motor speed [rad/s] and speed [m/s] at TIMES, shape (runs, times, 3)."""
    s = jax.vmap(lambda c: history_signals(robot, c, jnp.asarray(GRID)))(runs)
    return jnp.stack([getattr(s, k) for k in STATE], -1)[:, AT]


seen_compiled = jax.jit(seen)  # of nominal robots one program


def test_grid_holds_the_instants_and_is_fine_where_a_start_is_young():
    step = np.diff(GRID)
    assert GRID[0] == 0.0 and GRID[-1] == TIMES[-1] and np.isin(TIMES, GRID).all()
    assert (step > 0).all() and step[0] <= 1.5 * START[0] and step.max() <= LONGEST * (1 + 1e-9)
    assert len(GRID) < 600  # LONGEST throughout would be 320, the first step's 80 000
    assert np.diff(time_grid(np.array([0.0, 600.0]))).max() > LONGEST  # a long run: no more steps than it can have


def test_histories_follow_drive(robot):
    times = jnp.asarray(np.concatenate([[0.0], TIMES]))
    s = jax.jit(jax.vmap(lambda c: drive(robot, c, times, tolerance=1e-9, max_steps=20000).signals))(RUNS)
    expected = np.stack([np.asarray(getattr(s, k)) for k in STATE], -1)[:, 1:]
    got = np.asarray(seen_compiled(robot))
    # measured: 5 mA of 50 A, 0.11 rad/s of 1200, 13 µm/s of 1.3 m/s
    assert (np.abs(got - expected) < np.array([8e-3, 0.2, 3e-5])).all()
    assert expected[..., 0].max() > 10 and expected[..., 2].max() > 0.5


@pytest.mark.slow
@pytest.mark.parametrize("changes", [
    {}, {"effects.cogging.amplitude": 3e-4, "effects.pulley_eccentricity.amplitude": 0.02},
], ids=["bare", "waves"])  # fmt: skip
def test_derivatives_are_those_of_what_is_computed(changes):
    """By parameters and by the amplitude of every effect with a memory, against central differences."""
    robot = dataclasses.replace(nominal(), effects=tuple(BY_NAME[n]() for n in EFFECTS))
    robot = params.without_weak_types(params.replace(robot, {k: jnp.asarray(v) for k, v in changes.items()}))
    names = [
        "motor.resistance", "motor.inertia", "motor.inductance", "6T2A.ground.friction.static", "4W2T.radius",
        *(f"effects.{n}.amplitude" for n in EFFECTS),
    ]  # fmt: skip
    known = {p.name: p for p in params.walk_parameters(robot)}
    theta = jnp.asarray([float(known[n].value) for n in names])
    step = np.array([1e-4 * (abs(float(known[n].value)) or known[n].spec.prior_sd(0.0)) for n in names])

    def of(theta):
        return seen(params.replace(robot, dict(zip(names, theta, strict=True))))

    slopes = np.moveaxis(np.asarray(jax.jit(jax.jacfwd(of))(theta)), -1, 0)
    sides = jax.jit(lambda thetas: jax.lax.map(of, thetas))
    up, down = (np.asarray(sides(theta + s * jnp.diag(step))) for s in (1, -1))
    for name, slope, high, low, by in zip(names, slopes, up, down, step, strict=True):
        expected = (high - low) / (2 * by)
        scale, error = (np.abs(x).max((0, 1)) for x in (expected, slope - expected))
        assert (scale > 0).any(), name
        assert (error <= 2e-3 * scale + 1e-9 * np.abs(high).max((0, 1)) / by).all(), name


def test_run_that_cannot_be_followed_is_not_finite(robot):
    robot = params.replace(robot, {"motor.resistance": jnp.asarray(jnp.nan)})
    assert not np.isfinite(seen_compiled(robot)).any()


@pytest.mark.slow
def test_known_states_change_neither_values_nor_derivatives():
    robot, run, times = nominal(), jax.tree.map(lambda x: x[0], RUNS), jnp.asarray(GRID[:60])
    friction = float(robot.motor.friction_coulomb)

    def current(x, known=None):
        at = params.replace(robot, {"motor.friction_coulomb": x})
        found = history_signals(at, run, times, known).current
        return found, found

    known = jax.jit(lambda: linearise_run(robot, run, times))()
    by_friction = jax.jit(jax.jacfwd(current, has_aux=True))
    (slope, value), (slope_known, value_known) = by_friction(friction), by_friction(friction, known)
    assert np.abs(value).max() > 1 and np.abs(slope).max() > 0.1
    assert_allclose(value_known, value, rtol=1e-12)
    assert_allclose(slope_known, slope, rtol=1e-9, atol=1e-12)
    # And they are what is followed: those of another run are shown as they are.
    _, other = by_friction(friction, jax.tree.map(lambda x: 2 * x, known))
    assert_allclose(other[1:], 2 * value[1:], rtol=1e-12)
