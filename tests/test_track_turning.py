"""The track model of both sides: energy, symmetry, straight travel, its masses and its friction."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from numpy.testing import assert_allclose

from mmrjax.fidelities.steady import steady_batch
from mmrjax.fidelities.track import track_batch
from mmrjax.model import balances, params
from mmrjax.model.conditions import Conditions
from mmrjax.model.masses import masses_of_parts
from mmrjax.model.signals import CONVERGED, GRAVITY, State
from mmrjax.turning.two_sides import SIDES, ContactLaw
from mmrjax.undercarriage import both_sides, half_robot, mjcf
from mmrjax.undercarriage.half_robot import build_system

STEP, STEPS = 1e-4, 3000
#: Two turns that mirror one another, one on the spot across a slope, one of wheels under load, and sides alike.
RUNS = Conditions(
    configuration=[0, 0, 0, 1, 0],
    voltage=[24.0, 24.0, 15.0, 24.0, 15.0],
    slope_deg=[0.0, 0.0, 8.0, 3.0, 5.0],
    payload=[0.0, 0.0, 0.0, 5.0, 3.0],
    duty_left=[1.0, 0.4, -1.0, 1.0, 1.0],
    duty_right=[0.4, 1.0, 1.0, 0.2, 1.0],
    heading_deg=[0.0, 0.0, 60.0, -30.0, 0.0],
)
MIRRORED, ALIKE = (0, 1), 4


def _power(run, motion):
    """A step, and where its power goes [W], of the whole robot. What is stored after it [J]."""
    robot, b = run.robot, both_sides
    sides, plane = b._contacts_of_sides(run, motion), b.plane_motion(run, motion)
    signals, pulled = b._resolve_signals(run, plane, sides)
    _, levers, rises = b.damping_matrix(run, motion, signals, sides, pulled)
    after, travel, _ = b.advance(run, motion)
    gained = after.v - motion.v
    mean, at = motion.v + gained / 2, sides.contacts
    ahead, aside, normal = b.contact_forces_after_step(at, pulled, levers, rises, gained)
    moves = [jnp.einsum("sci,si->sc", x, mean[b.OF_SIDE]) for x in levers]  # along, across, off
    front, rear = mean[b.PULLEYS].T
    belt = run.path.radius * (front[:, None] * (1 - at.weight) + rear[:, None] * at.weight)
    losses = b._loss_derivatives(run, plane, sides)
    motor, rate = robot.gearbox.ratio * front, robot.gearbox.ratio * gained[b.PULLEYS[:, 0]] / STEP
    mesh = signals.torque_motor - signals.torque_idle - robot.motor.inertia * rate
    charge = after.current + motion.current
    y = SIDES * run.chassis.turning.width
    speed = (jnp.cos(motion.q[3]) * mean[0] + jnp.sin(motion.q[3]) * mean[1]) - y * mean[3]
    faster = (jnp.cos(motion.q[3]) * gained[0] + jnp.sin(motion.q[3]) * gained[1]) - y * gained[3]
    loss = signals.torque_track_loss - run.path.radius * jnp.sum(pulled.guide, axis=-1)
    powers = {
        "in": signals.voltage * charge / 2,
        "winding": (signals.voltage_drop + robot.motor.resistance * (after.current - motion.current) / 2)
        * charge
        / 2,
        "motor": signals.torque_motor_loss * motor,
        "gearbox": (signals.torque_idle + (1 - signals.efficiency_load) * mesh) * motor,
        "track": (loss + losses[1] * gained[b.PULLEYS[:, 0]]) * front,
        "guide": jnp.sum(pulled.guide * belt, axis=-1),
        "sliding": -jnp.sum(ahead * moves[0] + aside * moves[1], axis=-1),
        "contact": -jnp.sum(normal * moves[2], axis=-1),
        "belt": -(at.belt.torque_front * front + at.belt.torque_rear * rear),
        "rolling": signals.resistance * (speed - sides.height * mean[b.PITCH]) + losses[0] * faster * speed,
    }
    return after, {name: jnp.sum(jnp.asarray(x)) for name, x in powers.items()}, travel


def _stored(run, motion):
    robot, b, q, v = run.robot, both_sides, motion.q, motion.v
    none = jnp.zeros(b.COORDINATES)
    mass, _ = b.mass_matrix_and_bias(run, motion, none[:2])
    forward, up = run.half.centre
    rotors = robot.motor.inertia * (robot.gearbox.ratio * v[b.PULLEYS[:, 0]]) ** 2
    level = forward * jnp.cos(q[b.PITCH]) + up * jnp.sin(q[b.PITCH])
    place = q[0] + jnp.cos(q[3]) * level - jnp.sin(q[3]) * -up * q[b.ROLL]
    high = q[2] - forward * jnp.sin(q[b.PITCH]) + up * jnp.cos(q[b.PITCH]) * jnp.cos(q[b.ROLL])
    lift = mass[0, 0] * GRAVITY * (jnp.sin(run.conditions.slope) * place + jnp.cos(run.conditions.slope) * high)
    return (v @ mass @ v + jnp.sum(rotors + robot.motor.inductance * motion.current**2)) / 2 + lift


@pytest.fixture(scope="module")
def runs(robot):
    """Motions, energy that went each way, and what is stored, from standstill on."""

    @jax.jit
    @jax.vmap
    def every(conditions):
        run = build_system(robot, conditions, STEP)

        def step(motion, _):
            after, powers, travel = _power(run, motion)
            return after, (after, powers, _stored(run, after), travel)

        start = both_sides.stand(run)
        _, (motions, powers, stored, travel) = jax.lax.scan(step, start, None, length=STEPS)
        energy = jax.tree.map(lambda p: STEP * jnp.cumsum(p), powers)
        return motions, energy, stored - _stored(run, start), travel

    return jax.device_get(every(RUNS))


def since(energy, stored, first=200):
    """Energies since that step, when the currents' inrush is over, of every instant from as many steps later on.

    In it a step's torque is that of the current at its beginning: what is left of the balance then is of the order of
    the step.
    """
    energy = {name: (x - x[:, first, None])[:, 2 * first :] for name, x in energy.items()}
    return energy, (stored - stored[:, first, None])[:, 2 * first :]


@pytest.mark.slow
def test_energy_in_is_lost_or_stored_at_every_instant(runs):
    """To 1e-3 of what the supplies have given."""
    energy, stored = since(*runs[1:3])
    spent = stored + sum(value for name, value in energy.items() if name != "in")
    assert (energy["in"] > 0.3).all()
    assert_allclose(spent / energy["in"], 1.0, atol=1e-3)
    slid = np.diff(runs[1]["sliding"], axis=1)
    assert slid.min() >= 0 and slid.max() > 1e-3  # friction never adds


@pytest.mark.slow
def test_sides_swapped_mirror(runs):
    motions = runs[0]
    one, other = (jax.tree.map(lambda x, k=k: x[k], motions) for k in MIRRORED)
    sign = np.array([1, -1, 1, -1, 1, -1, 1, 1, 1, 1.0])
    place = [0, 1, 2, 3, 4, 5, 8, 9, 6, 7]
    for name in ("q", "v"):
        a, b = getattr(one, name), (sign * getattr(other, name))[:, place]
        assert_allclose(a, b, atol=1e-9 * np.abs(a).max(axis=0).max())
    assert_allclose(one.current, other.current[:, ::-1], rtol=1e-9, atol=1e-9)
    assert abs(one.q[-1, 3]) > 0.01


@pytest.mark.slow
def test_sides_alike_are_the_half_robot(robot, runs):
    """To 1e-6 of every coordinate's and rate's size, and of the current. Nothing to the side."""
    straight = jax.tree.map(lambda x: x[ALIKE], RUNS).straight()
    run = build_system(robot, straight, STEP)

    def step(motion, _):
        after = half_robot.advance(run, motion)[0]
        return after, after

    half = jax.jit(lambda m: jax.lax.scan(step, m, None, length=STEPS)[1])(half_robot.stand(run))
    mine = jax.tree.map(lambda x: x[ALIKE], runs[0])
    for name in ("q", "v"):
        theirs, ours = np.asarray(getattr(half, name)), getattr(mine, name)
        for column, theirs_column in zip(([0], [2], [4], [6, 8], [7, 9]), theirs.T, strict=True):
            size = np.abs(theirs_column).max()
            assert_allclose(ours[:, column], theirs_column[:, None].repeat(len(column), 1), atol=1e-6 * size)
        assert np.abs(ours[:, [1, 3, 5]]).max() < 1e-9
    assert_allclose(mine.current, np.asarray(half.current)[:, None].repeat(2, 1), rtol=1e-6)


def test_forces_do_the_work_of_contacts_and_friction_takes_it(robot):
    """Generalized forces on any velocities, against the sum over contacts. Lateral friction is λ of that along."""
    conditions = Conditions(0, voltage=24.0, duty_left=1.0, duty_right=0.3, adhesion_lateral=0.6).resolved(robot)
    b, v = both_sides, 1e-3 * np.array([3.0, 2.0, 0.4, 20.0, 0.7, 1.5, 90.0, 95.0, 60.0, 70.0])
    q = np.zeros(10)
    q[[b.HEIGHT, b.YAW]] = float(robot.radius_pulley + robot.running_gear.grouser_height) - 5e-4, 0.4

    @jax.jit
    def all_of(motion):
        run = build_system(robot, conditions, STEP)
        found = b.instant(run, motion)
        return (
            run.path,
            run.chassis,
            b._contacts_of_sides(run, motion),
            *found,
            b.generalized_forces(run, motion, *found),
        )

    motion = half_robot.HalfRobotState(jnp.asarray(q), jnp.asarray(v), jnp.zeros(2), jnp.zeros(()))
    path, chassis, sides, signals, at, pulled, forces = jax.device_get(all_of(motion))
    front, rear = v[b.PULLEYS].T
    belt = path.radius * (front[:, None] * (1 - at.weight) + rear[:, None] * at.weight)
    y = SIDES * chassis.turning.width
    speed = np.cos(q[b.YAW]) * v[0] + np.sin(q[b.YAW]) * v[1] - y * v[b.YAW]
    work = np.sum(
        pulled.force * at.speed_x + pulled.aside * sides.lateral_speed + at.force * at.gap_rate - pulled.guide * belt
    )
    work += np.sum(
        at.belt.torque_front * front + at.belt.torque_rear * rear + (signals.torque_net + pulled.load) * front
    )
    work -= np.sum(signals.resistance * (speed - sides.height * v[b.PITCH]))
    assert forces @ v == pytest.approx(float(work), rel=1e-9)
    bears = at.force > 0
    ratios = [(pulled.aside / sides.lateral_speed)[bears], (pulled.force / at.speed_x)[bears]]
    assert_allclose(ratios[0] / ratios[1], 0.6 * chassis.turning.lateral, rtol=1e-9)
    assert bears.any(axis=1).all() and max(r.max() for r in ratios) < 0


@pytest.mark.parametrize("configuration", [0, 1])
def test_bodies_are_the_robot_that_mujoco_compiles(robot, configuration):
    """Mass, and the moment of inertia in yaw about the centre, of all, and of half a robot twice the planar ones."""
    run = Conditions(configuration, payload=3.0, heading_deg=0.0)
    zero = jnp.asarray(0.0)
    total = balances.begin_signals(robot, run, State(zero, zero, zero, zero)).mass
    changed = params.replace(robot, {"running_gear.centre_offset": 0.02})
    model = mujoco.MjModel.from_xml_string(mjcf.mjcf_text(changed, run, float(total), STEP))
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    mass = np.zeros((model.nv, model.nv))
    mujoco.mj_fullM(model, data, mass)
    half = masses_of_parts(changed, run, total)
    turning = robot.chassis(configuration).turning
    ahead = float(half.centre[0])
    assert mass[0, 0] == pytest.approx(float(total))
    assert mass[3, 3] - mass[0, 0] * ahead**2 == pytest.approx(float(turning.inertia))
    pitching = 2 * float(half.inertia_about_middle(robot.running_gear.wheelbase) + 2 * half.inertia_pulley)
    assert mass[4, 4] == pytest.approx(pitching)
    assert 0.02 < mass[5, 5] < mass[3, 3]
    ours, _ = mjcf.model_template(True)
    ours = mjcf.member_model(ours, mjcf.robot_bodies(changed, half, run), run.slope, STEP)
    for field in ("body_mass", "body_subtreemass", "body_inertia", "body_ipos", "body_pos", "jnt_axis"):
        assert_allclose(getattr(ours, field), getattr(model, field), rtol=1e-12, atol=1e-15, err_msg=field)


@pytest.mark.parametrize("rule", [1.0, 2.0])
def test_friction_rises_as_differences_say_and_never_falls_along_its_sliding(robot, rule):
    law = ContactLaw(robot.configurations["6T2A"].ground.friction, 1.3 ** (2 * rule - 2), 1.0, 16)
    slow, fast = jnp.asarray([[0.004, -0.003]]), jnp.asarray([[0.05, 0.03]])

    def forces(u):
        return law.per_speed(u[..., 0] ** 2, u[..., 1] ** 2)[..., None] * u

    for speeds in (slow, fast):
        (a, b), (c, d) = law.rises(speeds[:, 0], speeds[:, 1])
        found = np.array([[a[0], b[0]], [c[0], d[0]]])
        differences = np.stack(
            [np.asarray(forces(speeds + h) - forces(speeds - h))[0] / 2e-7 for h in 1e-7 * jnp.eye(2)], axis=1
        )
        if speeds is slow:
            assert_allclose(found, differences, rtol=1e-6)
        else:  # where friction falls: as differences say across the sliding, and none along it
            u = np.asarray(speeds[0])
            assert u @ differences @ u < 0
            assert_allclose(found @ u, 0.0, atol=1e-12)


@pytest.mark.slow
def test_wheels_turn_as_the_steady_fidelity_says_and_tracks_faster(robot):
    """On the spot. The track does not bear along all of its wheelbase (docs/explanation/turning.md)."""
    turns = Conditions(["6T2A", "4W2T"], voltage=[15.0, 24.0], duty_left=-1.0, duty_right=1.0).resolved(robot)
    found = track_batch(robot, turns, duration=0.6, rolling=True)
    settled = steady_batch(robot, turns)
    assert list(found.result.status) == [CONVERGED, CONVERGED]
    for name in ("yaw_rate", "motor_current_right", "motor_speed_right"):
        mine, other = (float(x.reading[name][1]) for x in (found.result, settled))
        assert mine == pytest.approx(other, rel=1e-3), name
    faster = found.result.reading["yaw_rate"][0] / settled.reading["yaw_rate"][0]
    assert 1.07 < faster < 1.13
