"""The belt on its path and the contacts of one side: geometry, tensions, virtual work, contact pairs."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose

from mmrjax.model import balances, params
from mmrjax.model.conditions import Conditions
from mmrjax.model.signals import State
from mmrjax.undercarriage import side_contacts
from mmrjax.undercarriage.running_gear import (
    GROUSERS,
    POLYGON,
    TEETH_BELT,
    BeltPath,
    belt_runs,
    belt_travel,
    tension_along,
    tips_on_path,
)


@pytest.fixture(scope="module")
def path(robot):
    return BeltPath(robot.configurations["6T2A"].radius, robot.running_gear)


def test_belt_is_840_mm_with_grousers_every_35(path):
    assert path.length == pytest.approx(0.840)
    assert path.pitch == pytest.approx(0.035)
    assert TEETH_BELT / GROUSERS == 7


@pytest.mark.slow
@pytest.mark.parametrize("recess", [0.0, 3e-4])
def test_tip_rates_are_derivatives_of_its_place(path, recess):
    gear = params.replace(path.gear, {"guide_recess": jnp.asarray(recess)})
    path = BeltPath(path.radius, gear)
    places = jnp.linspace(1e-3, 0.8391, 517)  # off the joints of the path
    slope = jax.vmap(jax.jacfwd(lambda p: jnp.stack([tips_on_path(path, p).forward, tips_on_path(path, p).up])))(
        places
    )
    at = tips_on_path(path, places)
    assert_allclose(slope[:, 0], at.rate_forward, atol=1e-9)
    assert_allclose(slope[:, 1], at.rate_up, atol=1e-9)


@pytest.mark.slow
def test_tip_is_continuous_round_the_whole_path(path):
    places = jnp.linspace(0.0, path.length, 8401)
    at = tips_on_path(path, places)
    for value in (at.forward, at.up):
        assert jnp.max(jnp.abs(jnp.diff(value))) < 1.2e-4 * 1.15  # 0.1 mm of belt moves a tip this far
        assert value[0] == pytest.approx(float(value[-1]), abs=1e-9)
    lower = (places > 0.02) & (places < 0.28)
    # sliding speed, support and compliance too, where the ground can be: no force may jump
    for value in (at.rate_forward, at.rate_up, at.guided, at.compliance):
        assert jnp.max(jnp.abs(jnp.diff(value))[:3500]) < 0.02
    assert_allclose(at.up[lower], -(path.radius + path.gear.grouser_height))


def test_point_of_the_belt_follows_the_pulleys_by_its_weight(path):
    place, weight = path.place(jnp.asarray(0.4), jnp.asarray(0.4))
    moved, _ = path.place(jnp.asarray(0.4), jnp.asarray(0.4 + 1e-6))
    shift = (moved - place) / (path.radius * 1e-6)
    assert_allclose(shift, weight, atol=1e-6)
    assert ((weight >= 0) & (weight <= 1)).all()


def test_mesh_is_the_swing_of_a_polygon(path):
    angle = jnp.linspace(0.0, 0.5, 400)
    _, lever = jax.vmap(lambda a: belt_travel(path.radius, a))(angle)
    slope = jax.vmap(jax.grad(lambda a: belt_travel(path.radius, a)[0]))(angle)
    assert_allclose(lever, slope, rtol=1e-12)
    apothem = float(path.radius) * np.cos(np.pi / 48)
    assert (lever.max() - lever.min()) == pytest.approx(float(path.radius) - apothem, rel=1e-3)
    assert pytest.approx(0.00107, rel=1e-2) == POLYGON


def test_runs_pull_as_their_energy_falls(path):
    gear = path.gear

    def energy(angles):
        stretch = belt_travel(path.radius, angles[0])[0] - belt_travel(path.radius, angles[1])[0]
        p, k = gear.pretension, gear.span_stiffness
        return ((p + k * stretch) ** 2 + (p - k * stretch) ** 2) / (2 * k)

    angles = jnp.asarray([0.3012, 0.3])
    torque = -jax.grad(energy)(angles)
    at = belt_runs(path, angles, jnp.zeros(2))
    assert_allclose(torque, jnp.stack([at.torque_front, at.torque_rear]), rtol=1e-9)


def test_slack_run_pulls_nothing(path):
    at = belt_runs(path, jnp.asarray([0.5, 0.0]), jnp.zeros(2))
    assert at.lower == 0.0 and at.upper > 100.0


def test_centrifugal_tension_is_mass_per_length_times_speed_squared(path):
    at = belt_runs(path, jnp.zeros(2), jnp.full(2, 25.0))
    assert at.centrifugal == pytest.approx(0.040 / 0.840 * (25.0 * float(path.radius)) ** 2)


def test_tension_jumps_by_the_force_on_the_belt(path):
    at = belt_runs(path, jnp.asarray([0.301, 0.3]), jnp.zeros(2))
    place, force = jnp.asarray([0.1, 0.2]), jnp.asarray([7.0, 11.0])
    along = tension_along(path, at, place, force, jnp.asarray([0.05, 0.15, 0.25, 0.6]))
    assert_allclose(jnp.diff(along)[:2], [7.0, 11.0], rtol=1e-9)
    lengths = jnp.asarray([0.1, 0.1, 0.1])
    assert (jnp.sum(along[:3] * lengths) / 0.3) == pytest.approx(float(at.lower))  # the mean is the run's
    assert along[3] == pytest.approx(float(at.upper))


def _posture(path, wheeled, robot):
    axle = float(robot.configurations["4W2T"].radius) if wheeled else float(path.radius + path.gear.grouser_height)
    return jnp.asarray([0.0, axle - 3e-4, 2e-3, 0.3012, 0.3]), jnp.asarray([0.9, -0.01, 0.02, 25.0, 24.9])


@pytest.mark.slow
@pytest.mark.parametrize("wheeled", [0.0, 1.0])
def test_generalized_forces_do_the_work_of_the_contacts(path, robot, wheeled):
    """Power of the generalized forces = power at the contact points - friction on the guide + belt, rate by rate."""
    q, v = _posture(path, wheeled, robot)
    run = Conditions(configuration=wheeled)
    chassis = robot.chassis(run.configuration)
    at = side_contacts.compute_contacts(path, chassis, q, v)
    signals = balances.begin_signals(robot, run, State(jnp.asarray(3.0), 48 * v[3], v[0], jnp.asarray(0.0)))
    signals = dataclasses.replace(signals, resistance=jnp.asarray(5.0), speed_slip_terms=jnp.asarray(0.0))
    done = side_contacts.contact_forces(path, chassis, signals, at, q[1])
    assert at.normal > 10.0 and jnp.abs(done.traction) > 0.1

    def point(q):  # of each contact in the world
        now = side_contacts.compute_contacts(path, chassis, q, v)
        return q[0] + now.lever_x, q[1] + now.lever_z

    slope_x, slope_z = jax.jacfwd(point)(q)
    if wheeled:  # a wheel's contact point stays below its axle; the material point there turns with the wheel
        slope_x = slope_x.at[GROUSERS:, 2].set(at.lever_z[GROUSERS:])
        slope_x = slope_x.at[GROUSERS, 3].set(-chassis.radius).at[GROUSERS + 1, 4].set(-chassis.radius)
    work = done.force @ slope_x + at.force @ slope_z
    work = work.at[0].add(-signals.resistance).at[2].add(signals.resistance * q[1])
    work = work.at[3].add(-path.radius * jnp.sum(done.guide * (1 - at.weight)) + at.belt.torque_front)
    work = work.at[4].add(-path.radius * jnp.sum(done.guide * at.weight) + at.belt.torque_rear)
    ours = jnp.insert(done.generalized, 3, -done.load)
    # The belt's own stretch (0.05 mm a run) shifts a grouser's share between the pulleys by parts in 1e4.
    assert_allclose(ours, work, rtol=2e-3, atol=2e-3)


def test_contact_pairs_are_720_on_tracks_and_4_on_wheels(path, robot):
    for wheeled, pairs in ((0.0, 720), (1.0, 4)):
        q, v = _posture(path, wheeled, robot)
        q = q.at[1].add(-1.0).at[2].set(0.0)  # under the ground, so that every contact that can bear does
        run = Conditions(configuration=wheeled)
        chassis = robot.chassis(run.configuration)
        at = side_contacts.compute_contacts(path, chassis, q, 0 * v)
        ground = int(jnp.sum(at.force > 0))
        guides = 2 * TEETH_BELT if wheeled == 0.0 else 0  # spread along both guides
        assert robot.sides * (ground + guides) == pairs


def test_guides_and_pulleys_carry_the_normal_load(path, robot):
    q, v = _posture(path, 0.0, robot)
    at = side_contacts.compute_contacts(path, robot.configurations["6T2A"], q, v)
    signals = balances.begin_signals(robot, Conditions(), State(*(jnp.asarray(0.0) for _ in range(4))))
    loads = side_contacts.inner_loads(
        path, at, side_contacts.contact_forces(path, robot.configurations["6T2A"], signals, at, q[1])
    )
    assert (jnp.sum(loads.support) + loads.guide) == pytest.approx(float(at.normal))
