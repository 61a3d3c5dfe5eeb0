"""Terrain by signed distance, and the path of a tapered belt, against a plain NumPy brute force."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mmrjax.climbing import levers, terrain
from mmrjax.model.paper_robots import nominal
from mmrjax.undercarriage import running_gear

NAMED = {
    "flat": (terrain.flat_ground(8), [(-100, 0), (100, 0)]),
    "step": (terrain.single_step(0.12, size=8), [(-100, 0), (0, 0), (0, 0.12), (100, 0.12)]),
    "stairs": (
        terrain.stairs(0.17, 0.29, 2, size=8),
        [(-100, 0), (0, 0), (0, 0.17), (0.29, 0.17), (0.29, 0.34), (100.29, 0.34)],
    ),
    "gap": (terrain.gap(0.15), [(-100, 0), (0, 0), (0, -5), (0.15, -5), (0.15, 0), (100.15, 0)]),
    "polyline": (
        terrain.polyline([0, 0.1, 0.1, 0.3, 0.5], [0, 0.05, 0.1, 0.02, 0.2]),
        [(-100, 0), (0, 0), (0.1, 0.05), (0.1, 0.1), (0.3, 0.02), (0.5, 0.2), (100.5, 0.2)],
    ),
}


def brute(points, at):
    """Signed distance by going through the edges one by one."""
    found = []
    for p in at:
        least = np.inf
        for a, b in itertools.pairwise(points):
            a, b = np.array(a, float), np.array(b, float)
            s = min(max(np.dot(p - a, b - a) / np.dot(b - a, b - a), 0.0), 1.0)
            least = min(least, np.hypot(*(p - a - s * (b - a))))
        x, z = np.array(points, float).T
        # at a wall the upper side counts, as at its right
        height = max(np.interp(p[0] + 1e-12, x, z), -1e9)
        found.append(least if p[1] >= height else -least)
    return np.array(found)


@pytest.mark.quick(2)
@pytest.mark.parametrize("name", NAMED)
def test_signed_distance_is_that_of_brute_force_and_normal_its_gradient(name):
    ground, points = NAMED[name]
    at = np.random.default_rng(3).uniform([-0.4, -0.3], [0.8, 0.5], (400, 2))
    gap, normal = (np.asarray(x) for x in ground.distance(jnp.asarray(at)))
    assert gap == pytest.approx(brute(points, at), abs=1e-12)
    e = 1e-7
    slope = [(ground.distance(jnp.asarray(at + d))[0] - ground.distance(jnp.asarray(at - d))[0]) / (2 * e)
             for d in ([e, 0], [0, e])]  # fmt: skip
    kinks = np.abs(np.hypot(*slope) - 1) > 1e-4  # on the bisector of two edges
    assert kinks.mean() < 0.02
    assert normal[~kinks] == pytest.approx(np.stack(slope, 1)[~kinks], abs=1e-5)


@pytest.mark.slow
def test_rounded_nose_is_a_circle_that_touches_riser_and_tread():
    ground = terrain.single_step(0.1, nose=0.02)
    on = np.array(
        [[-0.0, 0.05], [0.05, 0.1], *[[0.02 - 0.02 * np.cos(a), 0.08 + 0.02 * np.sin(a)] for a in (0.4, 1.2)]]
    )
    assert ground.distance(jnp.asarray(on))[0] == pytest.approx(0, abs=1e-12)
    corner = ground.corners[ground.corners[:, 1] > -1]
    assert corner == pytest.approx(np.array([[0.02, 0.08]]))


def test_only_convex_corners_are_corners():
    found = np.asarray(NAMED["polyline"][0].corners)
    assert found[found[:, 1] > -1] == pytest.approx(np.array([[0.1, 0.1], [0.5, 0.2]]))
    found = np.asarray(NAMED["gap"][0].corners)
    assert found[found[:, 1] > -1] == pytest.approx(np.array([[0, 0], [0.15, 0]]))


@pytest.mark.slow
def test_distance_of_points_on_an_edge_has_a_finite_derivative():
    ground = terrain.single_step(0.1)
    slope = jax.jacfwd(lambda p: ground.distance(p[None])[0][0])(jnp.array([-0.3, 0.0]))
    assert np.isfinite(slope).all()


@pytest.mark.parametrize(
    "x, z, message",
    [
        ([0, 1, 0.5], [0, 0, 0], "x falls from 1 to 0.5 m at point 3"),
        ([0], [0], "two points or more"),
        ([0, np.nan], [0, 0], "not a number"),
    ],
)
def test_polylines_that_are_none_are_refused(x, z, message):
    with pytest.raises(ValueError, match=message):
        terrain.polyline(x, z)


def lever():
    gear = nominal().running_gear
    roller = gear.levers.roller - gear.grouser_height
    return levers.BeltLoop(
        nominal().radius_pulley, roller, gear.lever_length, gear.grouser_height, gear.grouser_length, 16
    )


def test_levers_track_closes_and_its_pitch_is_that_of_the_main_track():
    assert lever().length == pytest.approx(0.560, abs=5e-4)
    assert lever().pitch == pytest.approx(0.035, abs=5e-5)


@pytest.mark.slow
def test_belt_of_equal_pulleys_is_the_main_track_of_the_track_model(robot):
    gear = robot.running_gear
    main = levers.BeltLoop(
        robot.radius_pulley, robot.radius_pulley, gear.wheelbase, gear.grouser_height, gear.grouser_length, 24
    )
    path = running_gear.BeltPath(robot.radius_pulley, gear)
    place = np.concatenate([np.linspace(0, 0.23, 60), np.linspace(0.61, 0.83, 60)])  # all but the upper run's ends
    mine, rate = levers.grouser_tips(main, jnp.asarray(place))
    theirs = running_gear.tips_on_path(path, jnp.mod(jnp.asarray(place) + gear.wheelbase / 2, path.length))
    assert np.asarray(mine[:, 0]) - float(gear.wheelbase) / 2 == pytest.approx(np.asarray(theirs.forward), abs=1e-12)
    assert mine[:, 1] == pytest.approx(np.asarray(theirs.up), abs=1e-12)
    assert rate == pytest.approx(
        np.stack([theirs.rate_forward, theirs.rate_up], 1), abs=1e-10
    )  # fmt: skip


@pytest.mark.slow
def test_points_project_on_the_belt_where_they_came_from_and_tips_move_as_they_say():
    belt_ = lever()
    place = jnp.linspace(0, float(belt_.length), 500)[:-1]
    height, back = belt_.project(belt_.point(place) + 0.004 * belt_.normal(belt_.turning_angle(place)))
    assert height == pytest.approx(0.004, abs=1e-12)
    off = np.abs(back - place)
    assert np.minimum(off, float(belt_.length) - off) == pytest.approx(0, abs=1e-10)
    moved = (
        levers.grouser_tips(belt_, place[5:-5] + 1e-7)[0] - levers.grouser_tips(belt_, place[5:-5] - 1e-7)[0]
    ) / 2e-7
    assert levers.grouser_tips(belt_, place[5:-5])[1] == pytest.approx(np.asarray(moved), abs=1e-5)
