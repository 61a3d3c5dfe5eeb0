"""Posture and static limits: closed forms, a world of polygons, derivatives, and what a posture changes."""

import dataclasses
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose
from worlds import posture as world

import mmrjax as mm
from mmrjax.climbing import resting_posture, static_limits
from mmrjax.fidelities import steady
from mmrjax.model import balances, params

#: At which a lever's lower run is in line with the belt [deg].
FLUSH = -math.degrees(math.asin((world.TRACK - world.ROLLER) / world.LEVER))
#: By hand: radius over the grousers, half of the wheelbase, centre of mass above the axles without and with 8 kg [m].
RADIUS, HALF, UP, UP_LOADED = 0.0437, 0.15, 5e-3, (13.1 * 5e-3 + 8 * 73e-3) / 21.1

highest_step, limits, rest = (
    jax.jit(f) for f in (static_limits.find_highest_step, static_limits.posture_limits, resting_posture.rest_on_slope)
)


def run(front=None, rear=None, **of):
    return mm.Conditions(0, levers_front_deg=front, levers_rear_deg=rear, **of)


def held(robot, front, rear, up=UP):
    """An outline whose centre of mass is as high as stated, over the middle of the wheelbase."""
    side = resting_posture.side_outline(robot, run(front, rear))
    return dataclasses.replace(side, centre_forward=jnp.zeros(()), centre_up=jnp.asarray(up))


def closed_step(tail, reach, up):
    """Highest step over pitch [m], the tail turning on a circle, the centre of mass `reach` ahead of it."""
    pitch = np.radians(np.linspace(0, 89, 20_000))
    return np.max(tail * (1 - np.cos(pitch)) + (reach - (up + RADIUS) * np.tan(pitch)) * np.sin(pitch))


@pytest.mark.parametrize(
    "rear, up, tail, reach, millimetres",
    [
        (180.0, UP, RADIUS, HALF, 86),
        (180.0, UP_LOADED, RADIUS, HALF, 67),
        (FLUSH, UP, 0.0135, 0.353, 239),
        (FLUSH, UP_LOADED, 0.0135, 0.353, 208),
    ],
)
def test_highest_step_is_that_of_its_closed_form(robot, rear, up, tail, reach, millimetres):
    found = highest_step(held(robot, 180.0, rear, up))
    assert found.height == pytest.approx(closed_step(tail, reach, up), abs=3e-4)
    assert 1e3 * found.height == pytest.approx(millimetres, abs=1)


@pytest.mark.quick(1)
@pytest.mark.parametrize("angle, millimetres", [(45.0, 202), (60.0, 235), (90.0, 262)])
def test_raised_tips(robot, angle, millimetres):
    found = limits(robot, run(angle, angle))
    assert 1e3 * found.tip_front == pytest.approx(millimetres, abs=1)
    assert found.tip_front == found.tip_rear


@pytest.mark.parametrize("angle, gap, contact", [(180.0, 150, 300), (FLUSH, 352.5, 705)])
def test_gaps_and_contacts(robot, angle, gap, contact):
    found = limits(robot, run(angle, angle))
    assert 1e3 * found.gap == pytest.approx(gap, abs=0.5)
    assert 1e3 * found.contact == pytest.approx(contact, abs=1)


@pytest.mark.parametrize(
    "angle, up, back, aside",
    [
        (180.0, UP, 72.0, 68.2),
        (180.0, UP_LOADED, 63.6, 58.5),
        (FLUSH, UP, 82.1, 68.2),
        (FLUSH, UP_LOADED, 78.1, 58.5),
    ],
)
def test_slopes_on_which_it_tips(robot, angle, up, back, aside):
    rests = rest(held(robot, angle, angle, up), 0.0, 0.0)
    assert math.degrees(float(rests.tips_back)) == pytest.approx(back, abs=0.1)
    assert rests.tips_back == pytest.approx(float(rests.tips_forward), abs=1e-12)
    width = float(robot.configurations["6T2A"].turning.width)
    assert math.degrees(math.atan(width / 2 / float(rests.centre_height))) == pytest.approx(aside, abs=0.1)
    slope = math.radians(back)
    assert rest(held(robot, angle, angle, up), slope - 0.005, 0.0).margin > 0
    assert rest(held(robot, angle, angle, up), slope + 0.005, 0.0).margin < 0


CASES = [(180, 180, 0), (-30, 180, 0), (180, -50, 8), (-45, -20, 3), (-90, -90, 0), (20, -75, 5), (-100, -60, 0)]


@pytest.mark.parametrize("front, rear, payload", CASES)
def test_rest_is_that_of_a_world_of_polygons(robot, front, rear, payload):
    rests = resting_posture.posture(robot, run(front, rear, payload=payload))
    pitch, centre, height = world.rest(math.radians(front), math.radians(rear), payload)
    assert rests.pitch == pytest.approx(pitch, abs=1e-4)
    assert rests.centre_height == pytest.approx(centre, abs=2e-5)
    assert rests.height == pytest.approx(height, abs=2e-5)
    assert 0 < rests.load_front < 1 and rests.margin > 0


@pytest.mark.parametrize("front, rear, payload", [*CASES[:3], (-54, -39, 0), (180, -125, 0), (20, 45, 2)])
def test_highest_step_is_that_of_a_world_of_polygons(robot, front, rear, payload):
    found = limits(robot, run(front, rear, payload=payload)).step
    assert found == pytest.approx(world.step(math.radians(front), math.radians(rear), payload), abs=4e-4)


def test_loads_balance_the_moment_of_gravity(robot):
    """Of the two ends about the centre of mass, on a slope too."""
    rests = resting_posture.posture(robot, run(-40.0, 180.0, slope_deg=15.0))
    ends = rests.load_front * rests.front + (1 - rests.load_front) * rests.rear
    assert ends == pytest.approx(float(rests.centre_ahead - rests.centre_height * math.tan(math.radians(15))))
    assert rests.line == 0


@pytest.mark.slow
def test_on_wheels_a_robot_rests_on_them(robot):
    rests = resting_posture.posture(robot, mm.Conditions("4W2T").resolved(robot))
    assert (float(rests.pitch), float(rests.height), float(rests.line)) == (0.0, 0.05, 0.0)
    found = limits(robot, mm.Conditions("4W2T").resolved(robot))
    assert found.length == pytest.approx(0.4) and found.height == pytest.approx(0.1)
    assert found.gap == 0


@pytest.mark.slow
def test_derivatives_of_posture_and_step_are_those_of_differences(robot):
    names = ("running_gear.lever_length", "running_gear.levers.roller", "running_gear.lever_mass", "6T2A.radius")
    known = {p.name: p.value for p in params.walk_parameters(robot)}

    def outputs(x):
        made = params.replace(robot, {name: known[name] * x[k + 2] for k, name in enumerate(names)})
        here = run(-50.0 * x[0], -30.0 * x[1], payload=4.0)
        rests = resting_posture.posture(made, here)
        step = static_limits.find_highest_step(resting_posture.side_outline(made, here))
        return jnp.stack([rests.pitch, rests.height, rests.load_front, rests.inertia, step.height])

    start = jnp.ones(6)
    exact = np.asarray(jax.jit(jax.jacfwd(outputs))(start))
    compiled = jax.jit(outputs)
    for k in range(len(start)):
        apart = (compiled(start.at[k].add(1e-5)) - compiled(start.at[k].add(-1e-5))) / 2e-5
        assert_allclose(exact[:, k], apart, rtol=1e-4, atol=1e-6)
    assert (np.abs(exact).max(0) > 1e-4).all()


@pytest.mark.quick("angles0")
@pytest.mark.parametrize("angles", [(-120.0, -40.0), (180.0, 50.0)])
def test_derivative_where_two_parts_decide_the_step(robot, angles):
    """Front levers that reach the step beside the belt over its edge, and a smooth highest point."""

    @jax.jit
    def height(angles):
        return static_limits.find_highest_step(resting_posture.side_outline(robot, run(angles[0], angles[1]))).height

    exact, at = jax.jit(jax.grad(height))(jnp.array(angles)), np.array(angles)
    for k, step in enumerate(0.02 * np.eye(2)):
        apart = (float(height(at + step)) - float(height(at - step))) / 0.04
        assert exact[k] == pytest.approx(apart, rel=2e-3), k


@pytest.mark.quick("-180.0")
@pytest.mark.parametrize("least", [-180.0, -30.0])
def test_no_posture_stands_on_a_higher_step_than_the_best(robot, least):
    """Of all within the range, near the best and far from it, and near it some stand about as high."""
    of = params.replace(
        robot,
        {
            "running_gear.levers.angle_least": np.radians(least),
            "running_gear.centre_offset": 0.02,
            f"{robot.configurations.names[0]}.mass": 16.0,
        },
    )
    conditions = run(payload=3.0)
    best, front, rear = jax.jit(static_limits.best_step)(of, conditions)
    front, rear = (float(np.degrees(x)) for x in (front, rear))

    def angles(at):
        return np.unique(np.clip([*np.arange(-180.0, 181.0, 30.0), *(at + np.linspace(-3, 3, 7))], least, 180.0))

    pairs = jnp.stack(jnp.meshgrid(angles(front), angles(rear)), -1).reshape(-1, 2)

    def at(pair):
        levers = static_limits.with_lever_angles(conditions, *jnp.radians(pair))
        return static_limits.find_highest_step(resting_posture.side_outline(of, levers)).height

    heights = np.asarray(jax.jit(jax.vmap(at))(pairs))
    assert heights.max() <= best.height + 1e-8
    assert heights.max() == pytest.approx(float(best.height), abs=1e-6)
    assert np.median(heights) < best.height - 0.02
    if least == -30.0:
        assert front == rear == pytest.approx(-30.0)
    else:  # front levers level, rear ones upright but for a few degrees
        pitch = float(np.degrees(best.pitch))
        assert front == pytest.approx(-pitch, abs=1e-3) and 0 < pitch - rear - 90 < 5


@pytest.mark.parametrize("name", ["length", "width", "height", "ahead", "on_tracks"])
def test_folded_levers_stand_as_none_stated(robot, name):
    mass = jnp.asarray(18.1)
    folded, plain = (
        balances.stance(robot, c, robot.configurations["6T2A"], mass)
        for c in (run(180.0, 180.0, payload=5.0), run(payload=5.0))
    )
    assert getattr(folded, name) == pytest.approx(float(getattr(plain, name)), abs=1e-12)


@pytest.mark.slow
def test_straight_travel_does_not_change_with_posture(robot):
    speeds = [steady.operating_state(robot, c)[0].speed for c in (run(), run(180.0, 180.0), run(-30.0, 40.0))]
    assert speeds[0] == speeds[1] == speeds[2]


def test_outstretched_levers_turn_more_slowly(robot):
    """On a contact of 705 mm the lateral friction takes more of the traction."""
    stands = balances.stance(robot, run(FLUSH, FLUSH), robot.configurations["6T2A"], jnp.asarray(13.1))
    assert stands.length == pytest.approx(0.7055, abs=1e-4) and stands.on_tracks == 1
    lifted = balances.stance(robot, run(-60.0, -60.0), robot.configurations["6T2A"], jnp.asarray(13.1))
    assert lifted.on_tracks == 0


@pytest.mark.slow
def test_highest_step_falls_by_what_the_levers_mass_moves(robot):
    """By hand 229 mm: the centre of mass as high as with folded levers, 12.5 mm further back."""
    moved = 2 * 0.495 / 13.1 * 0.083 * (1 + math.cos(math.radians(FLUSH)))
    side = dataclasses.replace(held(robot, 180.0, FLUSH), centre_forward=jnp.asarray(-moved))
    assert 1e3 * float(highest_step(side).height) == pytest.approx(229, abs=1)
    # the robot's own parts: its centre of mass is 3.0 mm above the axles then, not 5
    assert 1e3 * float(limits(robot, run(180.0, FLUSH)).step) == pytest.approx(231.6, abs=0.1)
