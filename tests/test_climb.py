"""Half a robot with levers over terrain: its dynamics against C MuJoCo, energy, tilted gravity, verdicts."""

import functools
from dataclasses import replace
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from numpy.random import default_rng
from numpy.testing import assert_allclose

from mmrjax.climbing import climb_simulation as climb
from mmrjax.climbing import resting_posture, terrain
from mmrjax.climbing.climb_simulation import (
    LOSSES,
    SOURCES,
    LeverSequence,
    build_climb_system,
    climb_batch,
    constant_angles,
)
from mmrjax.climbing.footing import contacts_with_terrain
from mmrjax.climbing.static_limits import find_highest_step, flush_lever_angle
from mmrjax.fidelities.steady import steady
from mmrjax.model import params
from mmrjax.model.conditions import Conditions
from mmrjax.model.paper_robots import nominal
from mmrjax.model.signals import GRAVITY

ROBOT = nominal()
SIZE = 4  # points of every terrain of the first second, so that one program serves them
MEMBERS, POINTS = 12, 6  # of every batch of whole climbs, for the same reason


def batch(runs, robot=ROBOT, **options):
    """Runs of (terrain, front, rear in degrees, volts, further conditions). Pairs of angles are at 0.1 and 0.6 s."""
    grounds = jax.tree.map(lambda *x: jnp.stack(x), *[r[0] for r in runs])
    angles = [[jnp.asarray(np.radians(np.broadcast_to(a, 2))) for a in r[1:3]] for r in runs]
    sequences = [LeverSequence(jnp.array([0.1, 0.6]), *pair, over_time=True) for pair in angles]
    sequences = jax.tree.map(lambda *x: jnp.stack(x), *sequences)
    more = [r[4] if len(r) > 4 else {} for r in runs]
    of = {
        k: np.array([m.get(k, d) for m in more]) for k, d in (("adhesion", 1.0), ("payload", 0.0), ("slope_deg", 0.0))
    }
    which = np.array([m.get("configuration", 0) for m in more])
    conditions = Conditions(which, voltage=np.array([float(r[3]) for r in runs]), **of).resolved(robot)
    return climb_batch(robot, conditions, grounds, sequences, **options)


#: Energies at the beginning of a run.
NO_ENERGY = dict.fromkeys((*SOURCES, *LOSSES), jnp.zeros(()))


def system(ground=None, levers=None, configuration=0, voltage=6.0, **conditions):
    """What a climb is simulated by, on flat ground and with levers that stand unless stated."""
    of = Conditions(configuration, voltage=voltage, **conditions).resolved(ROBOT)
    ground = terrain.flat_ground() if ground is None else ground
    return build_climb_system(ROBOT, of, ground, constant_angles(0.5, 0.3) if levers is None else levers)


def passed_by(run):
    """What a step passes on, of zeros."""
    motion, energy, _ = climb.begin_climb(run)
    shapes = jax.eval_shape(lambda: climb.advance_climb(run, motion, 0.0, energy)[2])
    return jax.tree.map(lambda x: jnp.zeros(x.shape), shapes)


@functools.cache
def first_second():
    """Onto a step, and against a wall. A member without numbers and one with levers in the ground beside them."""
    runs = [
        (terrain.single_step(0.05, size=SIZE), (45, 20), (-8.4, -60), 24),
        (terrain.single_step(0.25, size=SIZE), (45, 80), (-8.4, -60), 24),
        (terrain.single_step(np.nan, size=SIZE), 45, 180, 24),
        (terrain.single_step(0.05, size=SIZE), -30, 180, 24),
    ]
    return batch(runs, duration=0.64, part=0.64)


def is_balanced(record, k, until=np.inf):
    """Energy that came in is stored or lost at every instant. Returns what came in and of each kind [J]."""
    since = {name: (x - x[:, :1])[k] for name, x in record.energy.items()}
    come = sum(since[name] for name in SOURCES)
    stored = (record.stored - record.stored[:, :1])[k]
    left = come - stored - sum(since[name] for name in LOSSES)
    running = (record.time[k] > 0.4) & (record.time[k] < until)
    assert np.abs(left[running] / come[running]).max() < 1e-3, k
    return come, since


def test_energy_in_is_stored_and_lost_at_every_instant_and_a_failed_member_harms_no_other():
    found = first_second()
    record, time = found.record, found.record.time[0]
    assert found.names == ["unfinished", "unfinished", "failed", "failed"] and found.ended[3] == 0
    assert all(np.isfinite(np.asarray(x)[:2]).all() for x in jax.tree.leaves(record.motion))
    for k in range(2):
        come, since = is_balanced(record, k)
        assert all(since[name][-1] > 2e-3 * come[-1] for name in LOSSES), since  # or it would not be missed
    assert np.ptp(record.motion.q[0, :, 1]) > 0.01  # it has climbed
    # belts bear on either side of the centre of mass until the levers lift it, though grousers leave the ground before
    assert_allclose(record.carried[0][(time > 0.2) & (time < 0.3)], 1.0, atol=0.03)
    standing = np.asarray(record.margin[0][time < 0.43])
    assert np.nanmin(standing) > 0.1 and np.isfinite(standing).mean() > 0.8


def test_a_margin_is_of_contacts_that_carry_the_robot():
    """Of what grazes the ground in a fall, or touches nothing, there is none."""
    base = jnp.array([[0.2, 0.1], [0.2, -0.1], [0.2, -0.1], [-jnp.inf, -jnp.inf]])
    shown = climb.ClimbRecord.margin.fget(SimpleNamespace(base=base, carried=jnp.array([1.0, 0.9, 0.4, 1.0])))
    assert_allclose(shown, [0.1, -0.1, jnp.nan, jnp.nan])


@pytest.mark.parametrize("duration, step", [(20.0, 1e-4), (2.5, 1e-4), (2.0, 3e-4), (0.3, 7e-4), (0.05, 1e-3)])
def test_parts_of_a_run_follow_on_each_other_and_end_with_it(monkeypatch, duration, step):
    parts = []

    def part(robot, conditions, ground, sequence, state, first, step, steps, samples):
        # as numbers, each would have a program of its own
        assert all(isinstance(x, jax.Array) for x in (step, steps))
        parts.append((float(first), float(steps * step), samples))
        return state, jnp.zeros((1, samples))

    running = None, None, climb.VerdictState(jnp.array([climb._RUNNING]), *[jnp.zeros(1)] * 4)
    monkeypatch.setattr(climb, "_begin_batch", lambda *a: running)
    monkeypatch.setattr(climb, "_advance_compiled", part)
    climb_batch(ROBOT, None, None, None, duration=duration, step=step)
    first, sample, samples = (np.array(x) for x in zip(*parts, strict=True))
    ends = first + sample * samples
    assert first[0] == 0 and first[1:] == pytest.approx(ends[:-1]) and np.all(sample * samples <= 1 + 2 * sample)
    assert duration - 1e-9 <= ends[-1] <= duration + len(parts) * sample[0]


def test_samples_have_all_their_steps_each_at_its_time(monkeypatch):
    run = system()
    motion, energy, progress = climb.begin_climb(run)
    passed = passed_by(run)

    def turned(run, motion, time, energy):
        motion = replace(motion, q=motion.q.at[climb.SHAFT].add(1.0))
        return motion, energy, replace(passed, time=time, motion=motion)

    monkeypatch.setattr(climb, "advance_climb", turned)
    (motion, *_), record = climb.advance_samples(run, (motion, energy, progress), 0.5, jnp.asarray(3), 2)
    assert motion.q[climb.SHAFT] == 6 and record.motion.q[:, climb.SHAFT].tolist() == [3, 6]
    assert np.asarray(record.time) == pytest.approx(0.5 + climb.STEP * np.array([2, 5]))


def test_tracks_of_levers_lose_what_table_3_says_at_their_own_speed():
    """(350 - 70) / 2 mN·m and (16 - 3) / 2 mN·m·s each. All three as one where the levers stand."""
    speeds = jnp.array([10.0, -4.0])
    tracked, wheeled = system(), system(configuration=1)
    loss = np.asarray(climb._lever_loss(tracked, speeds))
    assert loss == pytest.approx([0.140 + 0.0065 * 10, -0.140 - 0.0065 * 4])
    assert 2 * loss[0] + tracked.chassis.track.torque_loss(10.0, 1.0) == pytest.approx(0.350 + 0.016 * 10)
    assert np.asarray(climb._lever_loss(wheeled, speeds)) == pytest.approx(0.0)
    assert wheeled.chassis.track.torque_loss(10.0, 1.0) == pytest.approx(0.070 + 0.003 * 10)


def test_motors_of_levers_load_the_battery():
    """I_b = I_s + I_p (10), with I_s of all four motors: the voltage falls by 8 x 49 mΩ an ampere."""
    run = system(voltage=24.0, battery=True)
    motion = climb.stand_before_obstacle(run)
    after = jax.jit(lambda m: climb.advance_climb(run, m, 1.0, NO_ENERGY)[::2])
    volts = [8 * 4.17 - 8 * 0.049 * (1.5 + drawn) for drawn in (0.0, 10.0)]
    (end, passed), (end_pulls, passed_pulls) = (
        after(motion),
        after(replace(motion, lever_supply_current=jnp.asarray(10.0))),
    )
    assert [float(p.voltage) for p in (passed, passed_pulls)] == pytest.approx(volts)
    assert float(end_pulls.discharge - end.discharge) == pytest.approx(10 * float(run.step))
    # asked to swing they take their current by the duty of their bridge
    end, passed = after(replace(motion, q=motion.q.at[4].add(-0.5)))
    share = float(passed.lever_voltage[0]) / volts[0]
    assert 0.01 < share < 1 and float(end.lever_supply_current) == pytest.approx(
        share * float(passed.lever_current[0])
    )


@pytest.mark.slow
def test_a_positive_voltage_raises_either_lever():
    """Angles are positive up. Of the rear pair ψ falls then."""
    volts = jnp.full(2, 6.0)
    run = system(levers=LeverSequence(jnp.arange(2.0), volts, volts, over_time=True, begins=jnp.full(2, 0.5)))
    swung = climb._drive_action(run, climb.stand_before_obstacle(run), 0.5, 24.0, jnp.zeros(2), run.step * jnp.eye(2))
    assert swung.rate[0] > 0 > swung.rate[1]
    assert np.asarray(swung.voltage) == pytest.approx([6.0, -6.0])


def whole_climbs(runs, **options):
    """A batch of whole climbs, its last run repeated up to the members that all of these have."""
    return batch([*runs, *runs[-1:] * (MEMBERS - len(runs))], **options)


HOLDS = {"adhesion": 4.0}
WHOLE = [
    (terrain.single_step(0.05, size=POINTS), 45, -8.4, 12),
    (terrain.single_step(0.08, size=POINTS), 60, 180, 8, HOLDS),
    (terrain.single_step(0.12, size=POINTS), 60, 180, 8, HOLDS),
    (terrain.single_step(0.25, size=POINTS), 45, 180, 12),
    (terrain.single_step(0.25, size=POINTS), 60, 180, 0.5, {"payload": 8.0}),
    (terrain.gap(0.6), 0, 0, 12),
    (terrain.gap(0.2), 0, 0, 12),
]
VERDICTS = ["over", "over", "tips", "slides", "stalls", "tips", "over"]  # into the wide gap head first


@pytest.mark.nightly
@pytest.mark.parametrize("step", [1e-4, 5e-5])
def test_verdicts_of_whole_climbs_and_their_energy_and_half_the_step(step):
    found = whole_climbs(WHOLE, duration=14.0, step=step)
    assert found.names[: len(VERDICTS)] == VERDICTS
    for k in range(len(VERDICTS)):
        is_balanced(found.record, k, found.ended[k])


@pytest.mark.slow
def test_how_a_run_ends_is_read_off_its_motion():
    run = system(terrain.single_step(0.08))
    motion, _, progress = climb.begin_climb(run)
    passed = passed_by(run)

    def verdict(time=1.0, body=0.0, **places):
        q = motion.q
        for name, value in places.items():
            q = q.at[["x", "z", "pitch", "turned"].index(name)].set(value)
        now = replace(passed, time=jnp.asarray(time), body=jnp.asarray(body))
        found, after = climb._update_verdict(run, motion, now, replace(motion, q=q), progress)
        assert np.isfinite(found.q).all()
        return None if after.verdict < 0 else climb.NAMES[int(after.verdict)]

    assert verdict() is None
    assert verdict(x=0.3) == "over" and verdict(x=0.1) is None
    assert verdict(pitch=2.0) == "tips" and verdict(pitch=-1.6) is None
    assert verdict(x=np.nan) == "failed"
    late = 1.1 * climb.PATIENCE
    assert verdict(late) == "stalls" and verdict(late, turned=1.0) == "slides"
    assert verdict(late, turned=1.0, body=0.5) == "hangs" and verdict(late, turned=1.0, z=-0.1) == "hangs"
    assert verdict(late, x=float(motion.q[0]) + 0.01) is None


def test_dynamics_are_those_of_mujoco():
    """Mass matrix and bias of chassis, pulleys and levers as hinged bodies, at random states."""
    run = system(slope_deg=12.0, payload=5.0)
    model = mujoco.MjModel.from_xml_string(_bodies(run, 12.0))
    data = mujoco.MjData(model)
    random = default_rng(5)
    for _ in range(5):
        q, v = random.normal(size=6), 3 * random.normal(size=6)
        data.qpos[:], data.qvel[:] = TIES @ q, TIES @ v
        mujoco.mj_forward(model, data)
        whole = np.zeros((7, 7))
        mujoco.mj_fullM(model, data, whole)
        matrix, bias, _ = climb.mass_matrix_and_bias(run, jnp.asarray(q), jnp.asarray(v))
        assert_allclose(matrix, TIES.T @ whole @ TIES, rtol=0, atol=1e-11)
        assert_allclose(bias, TIES.T @ data.qfrc_bias, rtol=0, atol=1e-10)


def beside_mujoco(slope):
    """Coordinates of 10 000 steps of driving off and swinging the levers, ours and MuJoCo's under the forces that each of
    ours had, impulses over its time."""
    angles = (jnp.radians(jnp.array(pair)) for pair in ((45.0, 20.0), (-8.4, 30.0)))
    levers = LeverSequence(jnp.array([0.1, 0.8]), *angles, over_time=True)
    run = system(levers=levers, voltage=12.0, slope_deg=slope, payload=5.0)

    @jax.jit
    def driven(run, motion):
        def one(motion, k):
            after = climb.advance_climb(run, motion, k * run.step, NO_ENERGY)[0]
            matrix, bias, _ = climb.mass_matrix_and_bias(run, motion.q, motion.v)
            return after, (matrix @ (after.v - motion.v) / run.step + bias, after.q)

        return jax.lax.scan(one, motion, jnp.arange(10_000))

    start = climb.stand_before_obstacle(run, 0.1)
    _, (force, ours) = jax.device_get(driven(run, start))
    model = mujoco.MjModel.from_xml_string(_bodies(run, slope))
    model.opt.timestep = float(run.step)
    data = mujoco.MjData(model)
    data.qpos[:] = TIES @ np.asarray(start.q)
    shared = TIES / TIES.sum(axis=0)  # both pulleys have half of the shaft's
    theirs = np.empty_like(ours)
    for k, applied in enumerate(force):
        data.qfrc_applied[:] = shared @ applied
        mujoco.mj_step(model, data)
        theirs[k] = data.qpos[[0, 1, 2, 3, 5, 6]]
    return ours, theirs


@pytest.mark.quick(1)
@pytest.mark.parametrize("slope", [0.0, 10.0])
def test_ten_thousand_steps_are_those_of_mujoco_under_the_same_forces(slope):
    ours, theirs = beside_mujoco(slope)
    assert np.abs(ours - theirs).max() < 1e-6
    assert ours[-1, 0] - ours[0, 0] > 0.05 and np.ptp(ours[:, 4]) > 0.3 and np.ptp(ours[:, 5]) > 0.3


#: Both pulleys turn as one.
TIES = np.zeros((7, 6))
TIES[[0, 1, 2, 3, 4, 5, 6], [0, 1, 2, 3, 3, 4, 5]] = 1


def _bodies(run, slope):
    """Chassis, pulleys and levers as hinged bodies under gravity tilted by a slope [deg]."""
    half, (mass, along, about) = run.half, (float(x) for x in run.lever)
    base = float(ROBOT.running_gear.wheelbase) / 2
    down = -GRAVITY * np.array([np.sin(np.radians(slope)), 0, np.cos(np.radians(slope))])

    def hinged(name, x, m, at, j, axis):
        return (
            f'<body pos="{x} 0 0"><inertial pos="{at} 0 0" mass="{m}" diaginertia="{j} {j} {j}"/>'
            f'<joint name="{name}" type="hinge" axis="0 {axis} 0"/></body>'
        )

    pulley = float(half.pulley), 0, float(half.inertia_pulley)
    return f"""<mujoco><compiler inertiafromgeom="false"/><option gravity="{down[0]} 0 {down[2]}"/><worldbody><body>
      <inertial pos="{float(half.forward)} 0 {float(half.up)}" mass="{float(half.chassis)}"
        diaginertia="{" ".join([str(float(half.inertia))] * 3)}"/>
      <joint type="slide" axis="1 0 0"/><joint type="slide" axis="0 0 1"/><joint type="hinge" axis="0 1 0"/>
      {hinged("p1", base, *pulley, 1)}{hinged("p2", -base, *pulley, 1)}
      {hinged("l1", base, mass, along, about, -1)}{hinged("l2", -base, mass, along, about, -1)}
    </body></worldbody></mujoco>"""


def test_rates_of_all_gaps_are_the_derivatives_of_the_gaps():
    """Each contact moves as its distance changes, so that elastic contacts keep what they store."""
    run = system(terrain.single_step(0.08, nose=0.01))
    q = jnp.array([-0.12, 0.075, -0.2, 1.3, 0.6, 3.4])
    v = jnp.array([0.3, -0.2, 0.7, 2.0, 0.4, -0.5])

    def at(t):
        return contacts_with_terrain(run.shape, run.terrain, q + t * v, v)

    numeric = (at(1e-6).gap - at(-1e-6).gap) / 2e-6
    off = np.abs(at(0.0).gap_rate - numeric)[np.abs(at(0.0).gap) < 0.5]
    # where two features are equally near, and on wheels that don't bear, there is none
    assert np.median(off) < 1e-7 and (off > 1e-5).mean() < 0.03


@pytest.mark.slow
def test_polyline_of_constant_slope_is_tilted_gravity():
    angle = np.radians(10.0)
    along = np.array([np.cos(angle), np.sin(angle)])
    flush = constant_angles(np.pi, np.pi)
    raised = system(terrain._terrain_of_points([-terrain.FAR * along, terrain.FAR * along], 0.0), flush, voltage=10.0)
    level = system(levers=flush, voltage=10.0, slope_deg=10.0)
    start = climb.stand_before_obstacle(level)

    @jax.jit
    def end(run, motion):
        return jax.lax.fori_loop(
            0, 500, lambda k, m: climb.advance_climb(run, m, 1.0 + k * run.step, NO_ENERGY)[0], motion
        )

    tilted = end(level, start)
    turn = np.array([along * [1, -1], along[::-1]])  # to the coordinates of the raised ground
    q = start.q.at[:2].set(turn @ start.q[:2]).at[2].set(-angle)
    ended = end(raised, replace(start, q=q))
    back = [along @ ended.q[:2], ended.q[2] + angle, ended.q[3]]
    assert_allclose(back, np.asarray(tilted.q)[[0, 2, 3]], rtol=0, atol=1e-9)
    assert float(tilted.q[3]) > 0.01  # it has been driven
    assert_allclose(ended.current, tilted.current, rtol=1e-8)


@pytest.mark.slow
def test_level_ground_is_travelled_as_settled_balances_have_it():
    """With the share of its load on the guide that its belt has: the same laws, but for the ripple of its grousers.

    `track`, whose belt yields, has another share and another ripple, and so other means (docs/explanation/climbing.md).
    """
    travel = {"voltage": 15.0, "slope_deg": 5.0}
    run = system(levers=constant_angles(np.pi, np.pi), **travel)

    @jax.jit
    def driven(motion, first):
        def one(motion, k):
            after, _, passed = climb.advance_climb(run, motion, first + k * run.step, NO_ENERGY)
            at = contacts_with_terrain(run.shape, run.terrain, motion.q, motion.v)
            load = jnp.stack([jnp.sum(at.guided * at.force), jnp.sum(at.force)])
            return after, (motion.q[3], passed.current, motion.v[0], load)

        return jax.lax.scan(one, motion, jnp.arange(9000))

    motion, _ = driven(climb.stand_before_obstacle(run), 0.0)
    _, (turned, *found) = jax.device_get(driven(motion, 0.9))
    pitch = float(run.shape.main.pitch / run.shape.main.first)
    whole = np.searchsorted(turned, turned[0] + pitch * np.floor((turned[-1] - turned[0]) / pitch))
    current, speed, (guided, load) = (x[:whole].mean(axis=0) for x in found)
    assert 0.85 < guided / load < 0.95
    robot = params.replace(ROBOT, {"6T2A.track.guide_share": guided / load})
    settled = steady(robot, Conditions(0, **travel).resolved(ROBOT))
    assert current == pytest.approx(float(settled.total_current) / 2, rel=3e-3)
    assert speed == pytest.approx(float(settled.speed), rel=1e-3)


@jax.jit
def lowest(run, q):
    """Least gap of all contacts [m]."""
    return jnp.min(contacts_with_terrain(run.shape, run.terrain, q, 0 * q).gap)


def leant(run, pitch):
    """Coordinates at a pitch, nose up, with the tail on the lower ground and the robot against the edge of a step."""
    q = climb.stand_before_obstacle(run).q.at[2].set(-pitch)

    def gap(x, z):
        return float(lowest(run, q.at[0].set(x).at[1].set(z)))

    z = 1.0 - gap(-1.5, 1.0)
    far, near = -1.5, 0.5
    for _ in range(40):
        middle = (far + near) / 2
        free = gap(middle, z + 1e-4) > 0
        far, near = (middle, near) if free else (far, middle)
    return q.at[0].set(far).at[1].set(z - 2e-5)


def nose_up():
    """Largest step of a robot with its front levers raised, whose centre of mass has to come over the edge under the
    belt [m]. The tail stands on grousers, the edge lies between two of them."""
    gear = ROBOT.running_gear
    outer, inner = float(ROBOT.radius_pulley + gear.grouser_height), float(ROBOT.radius_pulley)
    front = np.radians(60.0)
    run = system(levers=constant_angles(front, np.pi), voltage=4.0)
    q = jnp.zeros(6).at[4].set(front).at[5].set(0.0)
    matrix, *_ = climb.mass_matrix_and_bias(run, q, jnp.zeros(6))
    ahead = float(-matrix[1, 2] / matrix[0, 0]) + float(gear.wheelbase) / 2
    up = float(matrix[0, 2] / matrix[0, 0])
    theta = np.radians(np.linspace(5, 70, 400))
    height = outer - inner * np.cos(theta) + (ahead - (up + inner) * np.tan(theta)) * np.sin(theta)
    return height.max()


@pytest.mark.nightly
def test_static_limits_of_steps_and_gaps_are_those_of_the_dynamics():
    """Slow, on a ground that holds. A robot that leans on a step with its rear levers flush gets over where the centre
    of mass comes over the edge: under the tips of grousers at the least, between two of them at the most."""
    flush = float(np.degrees(flush_lever_angle(ROBOT)))
    runs, starts = [], []
    for payload in (0.0, 8.0):
        of = HOLDS | {"payload": payload}
        side = resting_posture.side_outline(
            ROBOT, Conditions(0, payload=payload, levers_front_deg=180.0, levers_rear_deg=flush).resolved(ROBOT)
        )
        low = find_highest_step(side)
        high = find_highest_step(replace(side, belt=ROBOT.radius_pulley))
        assert 1e3 * float(low.height) == pytest.approx({0.0: 232, 8.0: 203}[payload], abs=1)
        for height in (float(low.height) - 0.004, float(high.height) + 0.006):
            ground = terrain.single_step(height, size=POINTS)
            run = system(ground, constant_angles(np.pi, np.radians(flush)), voltage=4.0, **of)
            runs.append((ground, 180, flush, 4, of))
            starts.append(leant(run, float(low.pitch) - np.radians(4.0)))
    # a grouser more or less under the edge of a step that it drives up to nose up, and the way that the robot is at
    grounds = [(terrain.single_step(nose_up() + d, size=POINTS), 60.0, 180.0) for d in (-0.006, 0.008)]
    # what bridges on both sides of the centre of mass does not fall in; a nose that does may still catch the far edge
    for front, widths in ((180.0, (0.144, 0.21)), (flush, (0.346, 0.38))):
        grounds += [(terrain.gap(width), front, front) for width in widths]
    for ground, front, rear in grounds:
        run = system(ground, constant_angles(*np.radians([front, rear])), voltage=4.0)
        runs.append((ground, front, rear, 4, HOLDS))
        starts.append(climb.stand_before_obstacle(run).q)
    starts += starts[-1:] * (MEMBERS - len(starts))
    zero = np.zeros(len(starts))
    start = climb.ClimbMotion(jnp.stack(starts), jnp.zeros((len(starts), 6)), *map(jnp.asarray, (zero, zero, zero)))
    found = whole_climbs(runs, duration=16.0, step=2e-4, start=start)
    over = [name == "over" for name in found.names[: len(runs)]]
    assert over == [True, False] * 5, found.names
    assert found.names[5] == "tips"
