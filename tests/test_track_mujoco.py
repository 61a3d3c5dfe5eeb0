"""The MJCF in C MuJoCo, stepped with the same forces, against MJX, and the mass constants of a member."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from numpy.testing import assert_allclose

from mmrjax.model import balances, params
from mmrjax.model.conditions import Conditions
from mmrjax.model.signals import State
from mmrjax.undercarriage import mjcf
from mmrjax.undercarriage.half_robot import advance, build_system, damping_matrix, generalized_forces, instant, stand

RUNS = {
    "tracked": dict(voltage=33.0, slope_deg=5.0, payload=3.0),
    "wheeled": dict(voltage=24.0, slope_deg=3.0, payload=8.0, configuration=1),
}
STEP = 1e-4


def native(robot, run):
    """The same half robot compiled by C MuJoCo from its own MJCF."""
    rest = State(*(jnp.asarray(0.0) for _ in range(4)))
    mass = float(balances.begin_signals(robot, run, rest).mass)
    return mujoco.MjModel.from_xml_string(mjcf.mjcf_text(robot, run, mass, STEP))


@pytest.mark.parametrize("name", sorted(RUNS))
def test_member_has_the_constants_that_mujoco_compiles(robot, name):
    """Against stale derived constants (mujoco issue 1607): MJX's are replaced, MuJoCo's compiled afresh."""
    changes = {"running_gear.lever_front": jnp.asarray(2.5), "running_gear.centre_offset": jnp.asarray(0.01)}
    changed, run = params.replace(robot, changes), Conditions(**RUNS[name])
    ours, theirs = build_system(changed, run, STEP).model, native(changed, run)
    for field in ("body_mass", "body_subtreemass", "body_inertia", "body_ipos", "body_pos", "jnt_axis"):
        assert_allclose(getattr(ours, field), getattr(theirs, field), rtol=1e-12, atol=1e-15, err_msg=field)
    assert_allclose(ours.opt.gravity, theirs.opt.gravity, rtol=1e-12, atol=1e-15)
    assert ours.opt.timestep == theirs.opt.timestep == STEP
    assert [theirs.body(i + 1).name for i in range(3)] == ["chassis", "driving", "driven"]


@pytest.mark.parametrize("name", sorted(RUNS))
def test_masses_make_up_the_robot(robot, name):
    run = Conditions(**RUNS[name])
    half = build_system(robot, run, STEP).half
    chassis = robot.chassis(run.configuration)
    assert (half.chassis + 2 * half.pulley) == pytest.approx(float(chassis.mass + run.payload) / 2)
    assert (2 * half.inertia_pulley) == pytest.approx(float(chassis.inertia))
    assert half.inertia > 0


@pytest.fixture(scope="module")
def step_both(robot):
    @jax.jit
    def forces(run, motion):
        constants = build_system(robot, run, STEP)
        signals, at, pulled = instant(constants, motion)
        after, _, _ = advance(constants, motion)
        return (
            *generalized_forces(constants, signals, pulled),
            damping_matrix(constants, motion, signals, at, pulled),
            after,
        )

    return forces


@pytest.mark.slow
@pytest.mark.parametrize("name", sorted(RUNS))
def test_c_mujoco_agrees_over_a_second(robot, step_both, name):
    """10 000 steps, each engine on its own trajectory. To 1e-6 of every coordinate's and rate's size.

    What C MuJoCo gives to a step are its mass matrix and its acceleration.
    """
    run = Conditions(**RUNS[name])
    model = native(robot, run)
    data = mujoco.MjData(model)

    @jax.jit
    def second(motion):
        return jax.lax.scan(lambda m, _: (step_both(run, m)[-1], None), motion, None, length=10_000)[0]

    start = stand(build_system(robot, run, STEP))
    end = second(start)
    data.qpos[:], motion = start.q, start
    mass = np.zeros((model.nv, model.nv))
    for _ in range(10_000):
        force, armature, damping, after = step_both(run, motion)
        model.dof_armature[:] = armature
        data.qfrc_applied[:] = force
        mujoco.mj_forward(model, data)
        mujoco.mj_fullM(model, data, mass)
        data.qvel[:] += np.linalg.solve(mass + STEP * np.asarray(damping), STEP * mass @ data.qacc)
        mujoco.mj_integratePos(model, data.qpos, data.qvel, STEP)
        # the current is ours in both; its next value depends on this instant alone
        motion = type(after)(jnp.asarray(data.qpos), jnp.asarray(data.qvel), after.current, after.discharge)
    scale_q, scale_v = np.array([1.0, 0.05, 0.01, 25.0, 25.0]), np.array([1.0, 1.0, 1.0, 25.0, 25.0])
    assert abs(end.q[0]) > 0.2  # it went somewhere
    assert np.max(np.abs(data.qpos - end.q) / scale_q) < 1e-6
    assert np.max(np.abs(data.qvel - end.v) / scale_v) < 1e-6


@pytest.mark.parametrize("name", sorted(RUNS))
def test_mjcf_shows_a_robot_that_stands_on_its_ground(robot, name):
    """What MuJoCo's viewer draws at the keyframe: wheels touch the ground, pulleys leave room for the grousers."""
    gear = robot.running_gear
    model = native(robot, Conditions(**RUNS[name]))
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, model.key("stand").id)
    mujoco.mj_forward(model, data)
    movers = np.flatnonzero(model.geom_type == mujoco.mjtGeom.mjGEOM_CYLINDER)
    lowest = data.geom_xpos[movers, 2] - model.geom_size[movers, 0]
    assert_allclose(lowest, {"tracked": gear.grouser_height, "wheeled": 0.0}[name], atol=1e-6)
    sides = data.geom_xpos[movers, 1]
    assert len(movers) == 4 and (sides > 0.1).sum() == (sides < -0.1).sum() == 2
    shown = np.flatnonzero(model.geom_bodyid > 0)
    assert (model.geom_rgba[shown, 3] == 1.0).all() and set(model.geom_bodyid[shown]) == {1, 2, 3}
    assert (data.geom_xpos[shown, 2] > 0).all()
