"""Derivatives of a step of the track model through linearised sums, against those of what is computed."""

from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.random import default_rng
from numpy.testing import assert_allclose

from mmrjax.effects import BY_NAME
from mmrjax.model import params
from mmrjax.model.conditions import Conditions
from mmrjax.undercarriage import mjcf
from mmrjax.undercarriage.half_robot import (
    HalfRobotState,
    _implicit_step,
    advance,
    axle_height,
    build_system,
    generalized_forces,
    instant,
)
from mmrjax.undercarriage.mjcf import mjx

RUNS = {
    "tracked": dict(voltage=24.0, slope_deg=5.0, payload=3.0, battery=1.0),
    "wheeled": dict(voltage=33.0, slope_deg=3.0, payload=8.0, configuration=1),
}
#: Slip that follows speed and load, loads and losses, two memories, mass and inertia.
EFFECTS = ("rolling_radius", "belt_creep", "nonlinear_slip", "voltage_sag", "mass_error", "speed_slip")
STEP = 1e-4


@pytest.fixture(scope="module")
def recessed(robot):
    """A robot in which nothing that contacts depend on is zero."""
    return params.replace(robot, {"running_gear.guide_recess": 1e-4})


@pytest.fixture(scope="module")
def eventful(recessed):
    """The same with effects that enter a step in every way: slip, memories, losses, mass, inertia."""
    remembering = [e for e in BY_NAME.values() if e.memory_size is not None][:2]
    chosen = [BY_NAME[n] for n in EFFECTS if n in BY_NAME] + [
        next(e for e in BY_NAME.values() if e.balance == balance) for balance in ("inertia", "ground", "gearbox")
    ]
    effects = {e.name: e for e in [*chosen, *remembering]}
    robot = replace(recessed, effects=tuple(e() for e in effects.values()))
    sizes = {p.name: 0.3 * p.spec.prior_sd(0.0) for p in params.walk_parameters(robot) if p.spec.amplitude}
    return params.replace(robot, {name: jnp.asarray(size) for name, size in sizes.items()})


def motion_of(robot, run, k):
    """In mid-run, no two parts alike. Which of the contacts slip beyond V_s differs with `k`."""
    draw = default_rng(k)
    setup = build_system(robot, run, STEP)
    low = float(axle_height(setup))
    q = jnp.asarray([0.1, low - 2e-4, 1e-3 * draw.normal(), 0.3 + draw.random(), 0.0])
    q = q.at[4].set(q[3] - 1e-4)
    turning = [0.7, 25.0, 30.0][k % 3]
    speed = turning * float(setup.chassis.radius) * [0.9, 0.99, 0.7][k % 3]
    v = jnp.asarray([speed, 2e-3 * draw.normal(), 0.02 * draw.normal(), turning, turning * 1.002])
    memory = {e.name: jnp.asarray(0.3 + 0.1 * draw.random()) for e in robot.remembering}
    return HalfRobotState(q, v, jnp.asarray(1.5 + draw.random()), jnp.asarray(20.0), memory)


@pytest.fixture(scope="module")
def pushed():
    """Generalized force of an instant, and the impulse that MJX's step with it takes."""

    @eqx.filter_jit
    def both(robot, run, motion):
        setup = build_system(robot, run, STEP)
        signals, _, pulled = instant(setup, motion)
        force, armature = generalized_forces(setup, signals, pulled)
        model = setup.model.replace(dof_armature=armature)
        data = mjx.step(model, setup.data.replace(qpos=motion.q, qvel=motion.v, qfrc_applied=force))
        gained, wheelbase = data.qvel - motion.v, setup.path.gear.wheelbase
        return force, mjcf.step_impulse(
            setup.half, wheelbase, run, motion.q[2], motion.v[2], armature[3], gained, STEP
        )

    return both


@pytest.mark.parametrize("name", sorted(RUNS))
def test_impulse_is_that_of_mjx(recessed, pushed, name):
    run = Conditions(**RUNS[name])
    motion = motion_of(recessed, run, 1)
    motion = replace(motion, q=motion.q.at[2].set(0.3), v=motion.v.at[2].set(2.0))
    force, spent = pushed(recessed, run, motion)
    assert_allclose(spent / STEP, force, rtol=1e-9, atol=1e-9 * float(jnp.abs(force).max()))


def _stepped(robot, run, motion, step, forward):
    return forward(build_system(robot, run, step), motion)


def _as_computed(run, motion):
    step = _implicit_step(run, motion)
    return step.after, step.signals, step.guided


def _changes(tree, seed):
    """A random change of every number, relative to its size."""
    draw = default_rng(seed)
    leaves, structure = jax.tree.flatten(eqx.filter(tree, eqx.is_inexact_array))
    changes = [jnp.asarray((np.abs(x) + 1e-3) * draw.normal(size=x.shape)) for x in leaves]
    return jax.tree.unflatten(structure, changes)


def _equal(ours, theirs):
    for a, b in zip(jax.tree.leaves(ours), jax.tree.leaves(theirs), strict=True):
        if jnp.issubdtype(jnp.asarray(b).dtype, jnp.inexact):
            assert_allclose(a, b, rtol=1e-7, atol=1e-7 * max(float(jnp.abs(b).max()), 1e-12))


@pytest.fixture(scope="module")
def forward():
    """Derivatives of a step along a direction: as differentiated, and of what it computes."""
    return eqx.filter_jit(
        lambda at, moved: tuple(
            eqx.filter_jvp(lambda *a, s=s: _stepped(*a, s), at, moved)[1] for s in (advance, _as_computed)
        )
    )


def _some(after, signals, guided):
    return jnp.sum(after.q) + jnp.sum(after.v) + after.current + signals.traction + 1e-2 * guided


@pytest.fixture(scope="module")
def backward():
    return eqx.filter_jit(eqx.filter_grad(lambda at: _some(*_stepped(*at, advance))))


@pytest.mark.slow
@pytest.mark.parametrize("name", sorted(RUNS))
@pytest.mark.parametrize("k", range(3))
def test_derivatives_of_a_step_are_those_of_what_it_computes(eventful, forward, backward, name, k):
    """Every parameter, condition, coordinate, rate and memory and the step at once, forward and backward."""
    run = jax.tree.map(lambda x: jnp.asarray(x, float), Conditions(**RUNS[name]).resolved(eventful))
    at = (eventful, run, motion_of(eventful, run, k), jnp.asarray(STEP))
    moved = _changes(at, k)
    ours, theirs = forward(at, moved)
    _equal(ours, theirs)
    pairs = zip(jax.tree.leaves(backward(at)), jax.tree.leaves(moved), strict=True)
    assert sum(float(jnp.sum(a * b)) for a, b in pairs) == pytest.approx(float(_some(*ours)), rel=1e-8)


@pytest.mark.nightly
def test_second_derivatives_are_those_of_what_is_computed(recessed):
    run = Conditions(**RUNS["tracked"])
    motion = motion_of(recessed, run, 1)

    def slope(v, step):
        def after(v):
            return step(build_system(recessed, run, STEP), replace(motion, v=v))[0].v

        return jax.jacfwd(jax.jacfwd(after))(v)

    ours, theirs = (jax.jit(lambda v, s=s: slope(v, s))(motion.v) for s in (advance, _as_computed))
    assert_allclose(ours, theirs, rtol=1e-6, atol=1e-7 * float(jnp.abs(theirs).max()))
