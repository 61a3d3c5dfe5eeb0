"""Half a robot with levers over terrain: its dynamics against C MuJoCo, energy, tilted gravity, verdicts."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from mmrjax import footing, terrain
from mmrjax.conditions import Conditions
from mmrjax.fidelities import climb
from mmrjax.fidelities.climb import LOSSES, SOURCES, climb_batch, still, system
from mmrjax.robots import nominal
from mmrjax.signals import GRAVITY

ROBOT = nominal()
SIZE = 4  # points of every terrain here, so that one program serves them


def batch(runs, robot=ROBOT, **options):
    """Runs of (terrain, front, rear in degrees, volts, further conditions)."""
    grounds = jax.tree.map(lambda *x: jnp.stack(x), *[r[0] for r in runs])
    sequences = jax.tree.map(lambda *x: jnp.stack(x), *[still(np.radians(r[1]), np.radians(r[2])) for r in runs])
    more = [r[4] if len(r) > 4 else {} for r in runs]
    of = {
        k: np.array([m.get(k, d) for m in more]) for k, d in (("adhesion", 1.0), ("payload", 0.0), ("slope_deg", 0.0))
    }
    which = np.array([m.get("configuration", 0) for m in more])
    conditions = Conditions(which, voltage=np.array([float(r[3]) for r in runs]), **of).resolved(robot)
    return climb_batch(robot, conditions, grounds, sequences, **options)


@functools.cache
def climbs():
    """A few runs that end in several ways, in one batch."""
    runs = [
        (terrain.step(0.05, size=SIZE), 45, -8.4, 12),
        (terrain.step(0.25, size=SIZE), 45, 180, 12),
        (terrain.step(0.25, size=SIZE), 60, 180, 0.5, {"payload": 8.0}),
        (terrain.step(np.nan, size=SIZE), 45, 180, 12),
    ]
    return batch(runs, duration=3.0)


def test_verdicts_and_a_member_of_no_numbers_harms_no_other():
    assert climbs().names == ["over", "slides", "stalls", "failed"]
    states = jax.tree.leaves(climbs().record.motion)
    assert all(np.isfinite(np.asarray(x)[:3]).all() for x in states)


def test_energy_in_is_stored_and_lost_at_every_instant():
    """Each way of energy is seen: left out, it would be missing."""
    record = climbs().record
    come = sum(record.energy[name] for name in SOURCES)
    lost = {name: record.energy[name] for name in LOSSES}
    for k in range(3):
        come_k = (come - come[:, :1])[k]
        stored = (record.stored - record.stored[:, :1])[k]
        left = come_k - stored - sum((x - x[:, :1])[k] for x in lost.values())
        running = record.time[k] > 0.4
        assert np.abs(left[running] / come_k[running]).max() < 1e-3
        for name in ("winding", "gearbox", "track", "sliding", "rolling"):
            if k == 0:
                assert (lost[name][k, -1] - lost[name][k, 0]) > 5e-3 * come_k[-1], name


def test_dynamics_are_those_of_mujoco():
    """Mass matrix and bias of chassis, pulleys and levers as hinged bodies, at random states."""
    conditions = Conditions(0, voltage=6.0, slope_deg=12.0, payload=5.0).resolved(ROBOT)
    run = system(ROBOT, conditions, terrain.flat(), still(0.5, 0.3))
    half, (mass, along, about) = run.half, (float(x) for x in run.lever)
    base = float(ROBOT.running_gear.wheelbase) / 2
    down = -GRAVITY * np.array([np.sin(np.radians(12)), 0, np.cos(np.radians(12))])

    def hinged(name, x, m, at, j, axis):
        return (
            f'<body pos="{x} 0 0"><inertial pos="{at} 0 0" mass="{m}" diaginertia="{j} {j} {j}"/>'
            f'<joint name="{name}" type="hinge" axis="0 {axis} 0"/></body>'
        )

    pulley = float(half.pulley), 0, float(half.inertia_pulley)
    text = f"""<mujoco><compiler inertiafromgeom="false"/><option gravity="{down[0]} 0 {down[2]}"/><worldbody><body>
      <inertial pos="{float(half.forward)} 0 {float(half.up)}" mass="{float(half.chassis)}"
        diaginertia="{" ".join([str(float(half.inertia))] * 3)}"/>
      <joint type="slide" axis="1 0 0"/><joint type="slide" axis="0 0 1"/><joint type="hinge" axis="0 1 0"/>
      {hinged("p1", base, *pulley, 1)}{hinged("p2", -base, *pulley, 1)}
      {hinged("l1", base, mass, along, about, -1)}{hinged("l2", -base, mass, along, about, -1)}
    </body></worldbody></mujoco>"""
    model = mujoco.MjModel.from_xml_string(text)
    data = mujoco.MjData(model)
    # both pulleys turn as one
    ties = np.zeros((7, 6))
    ties[[0, 1, 2, 3, 4, 5, 6], [0, 1, 2, 3, 3, 4, 5]] = 1
    random = np.random.default_rng(5)
    for _ in range(5):
        q, v = random.normal(size=6), 3 * random.normal(size=6)
        data.qpos[:], data.qvel[:] = ties @ q, ties @ v
        mujoco.mj_forward(model, data)
        whole = np.zeros((7, 7))
        mujoco.mj_fullM(model, data, whole)
        matrix, bias, _ = climb.inertia(run, jnp.asarray(q), jnp.asarray(v))
        assert np.asarray(matrix) == pytest.approx(ties.T @ whole @ ties, abs=1e-11)
        assert np.asarray(bias) == pytest.approx(ties.T @ data.qfrc_bias, abs=1e-10)


def test_rates_of_all_gaps_are_the_derivatives_of_the_gaps():
    """Each contact moves as its distance changes, so that elastic contacts keep what they store."""
    run = system(ROBOT, Conditions(0, voltage=6.0).resolved(ROBOT), terrain.step(0.08, nose=0.01), still(0.5, 0.3))
    q = jnp.array([-0.12, 0.075, -0.2, 1.3, 0.6, 3.4])
    v = jnp.array([0.3, -0.2, 0.7, 2.0, 0.4, -0.5])

    def gaps(t):
        return footing.footing(run.shape, run.terrain, q + t * v, v).gap

    rates = np.asarray(footing.footing(run.shape, run.terrain, q, v).gap_rate)
    numeric = np.asarray((gaps(1e-6) - gaps(-1e-6)) / 2e-6)
    near = np.abs(np.asarray(gaps(0.0))) < 0.5
    off = np.abs(rates - numeric)[near]
    # where two features are equally near, and on wheels that don't bear, there is none
    assert np.median(off) < 1e-7 and (off > 1e-5).mean() < 0.03


def test_polyline_of_constant_slope_is_tilted_gravity():
    angle = np.radians(10.0)
    conditions = [Conditions(0, voltage=10.0, slope_deg=slope).resolved(ROBOT) for slope in (0.0, 10.0)]
    grounds = terrain.slope(angle), terrain.flat()
    raised, level = (system(ROBOT, *of, still(np.pi, np.pi)) for of in zip(conditions, grounds, strict=True))
    start = climb.stand(level)
    cos, sin = np.cos(angle), np.sin(angle)
    x, z = (float(a) for a in start.q[:2])

    @jax.jit
    def end(sys_, motion):
        none = dict.fromkeys((*SOURCES, *LOSSES), jnp.zeros(()))
        return jax.lax.fori_loop(0, 500, lambda k, m: climb.advance(sys_, m, 1.0 + k * sys_.step, none)[0], motion)

    tilted = end(level, start)
    q = start.q.at[0].set(x * cos - z * sin).at[1].set(x * sin + z * cos).at[2].set(-angle)
    ended = end(raised, dataclasses.replace(start, q=q))
    along = float(ended.q[0] * cos + ended.q[1] * sin)
    assert along == pytest.approx(float(tilted.q[0]), abs=1e-9)
    assert float(tilted.q[3]) > 0.01  # it has been driven
    assert float(ended.q[2]) + angle == pytest.approx(float(tilted.q[2]), abs=1e-9)
    assert float(ended.q[3]) == pytest.approx(float(tilted.q[3]), abs=1e-9)
    assert float(ended.current) == pytest.approx(float(tilted.current), rel=1e-8)


@pytest.mark.slow
def test_largest_step_of_a_nose_up_robot_is_that_of_statics():
    """Slow, on a ground that holds: the centre of mass has to come over the edge under the belt. The tail stands on
    grousers, the edge lies between two of them."""
    gear = ROBOT.running_gear
    outer, inner = float(ROBOT.radius_pulley + gear.grouser_height), float(ROBOT.radius_pulley)
    front = np.radians(60.0)
    conditions = Conditions(0, voltage=4.0).resolved(ROBOT)
    run = system(ROBOT, conditions, terrain.flat(), still(front, np.pi))
    q = jnp.zeros(6).at[4].set(front).at[5].set(0.0)
    matrix, *_ = climb.inertia(run, q, jnp.zeros(6))
    ahead = float(-matrix[1, 2] / matrix[0, 0]) + float(gear.wheelbase) / 2
    up = float(matrix[0, 2] / matrix[0, 0])
    theta = np.radians(np.linspace(5, 70, 400))
    height = outer - inner * np.cos(theta) + (ahead - (up + inner) * np.tan(theta)) * np.sin(theta)
    limit = height.max()
    # a grouser more or less under the edge, and the way that the robot is at
    runs = [(terrain.step(limit + d, size=SIZE), 60, 180, 4, {"adhesion": 4.0}) for d in (-0.006, 0.008)]
    assert batch(runs, duration=14.0, step=2e-4).names == ["over", "tips"]
