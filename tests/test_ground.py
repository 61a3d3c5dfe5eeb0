"""Motion resistance (5), adhesion (6), (7), slip (32), (33)."""

import jax
import numpy as np
import pytest
from numpy.random import default_rng
from numpy.testing import assert_allclose
from worlds import paper

from mmrjax.model import chassis, paper_robots
from mmrjax.model.contact import Friction, Ground, force_gravity, slip_ratio

RNG = default_rng(5)
G = 9.80665


def test_ground_forces_match_reference():
    for _ in range(30):
        f, mu, m, alpha, v, ratio = RNG.uniform((0, 0.1, 2, -0.5, -0.5, 0.3), (0.2, 1, 20, 0.5, 0.5, 2))
        surface = Ground(Friction(static=mu, dynamic=0.8 * mu), rolling_resistance=f)
        normal = chassis.normal_load(2 * m, alpha, G, 2)
        assert_allclose(surface.force_resistance(normal, 1.0), paper.rolling_force(m, alpha, f), rtol=1e-9)
        assert_allclose(surface.force_adhesion(normal, ratio), paper.adhesion_force(m, alpha, ratio * mu), rtol=1e-9)
        expected = paper.friction(v, mu, 0.8 * mu, 0.02, 0.2) * ratio * m * G * np.cos(alpha)
        assert_allclose(surface.traction(v, normal, ratio), expected, rtol=1e-9)
        demand = RNG.uniform(-0.99, 0.99) * ratio * mu * normal
        expected = paper.friction_speed(demand / normal / ratio, mu, 0.02)
        assert_allclose(surface.speed_creep(demand, normal, ratio), expected, rtol=1e-9)
        assert_allclose(force_gravity(m, alpha, G), m * G * np.sin(alpha), rtol=1e-9)


def test_slip_matches_reference():
    for V, w, r in RNG.uniform((0.1, 1, 0.01), (1, 20, 0.1), (50, 3)):
        theoretical = paper.theoretical_speed(w, r)
        assert_allclose(slip_ratio(V, theoretical), paper.slip(V, theoretical), rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("speed, theoretical, slip", [(0.0, 0.0, 0.0), (0.0, 1.0, 1.0), (1.0, 1.0, 0.0)])
def test_slip_limits_are_finite(speed, theoretical, slip):
    value, gradient = jax.value_and_grad(slip_ratio, argnums=(0, 1))(speed, theoretical)
    assert float(value) == slip and np.isfinite(gradient).all()


def test_ground_traction_equals_adhesion_at_its_largest(robot):
    surface = robot.configurations["6T2A"].ground
    speeds = np.linspace(0, 0.5, 2001)
    largest = np.max(surface.traction(speeds, 60.0, 1.0))
    assert_allclose(largest, surface.force_adhesion(60.0, 1.0), rtol=1e-9)


@pytest.mark.parametrize(
    "surface, tracked, wheeled",
    [
        ("lacquered_wood", 0.32, 0.38),
        ("linoleum", 0.42, 0.52),
        ("smooth_concrete_floor", 0.45, 0.60),
        ("asphalt", 0.68, 0.60),
        ("concrete", 0.76, 0.72),
    ],
)
def test_adhesion_ratio_restores_table5(robot, surface, tracked, wheeled):
    for on_tracks, body, phi in (
        (True, robot.configurations["6T2A"], tracked),
        (False, robot.configurations["4W2T"], wheeled),
    ):
        ratio = paper_robots.adhesion_ratio(surface, on_tracks)
        assert_allclose(body.ground.force_adhesion(1.0, ratio), phi, rtol=1e-12)


def test_traction_rise_is_the_derivative_of_traction(robot):
    surface = robot.configurations["6T2A"].ground
    for speed in (-0.05, 0.003, 0.1):
        difference = (surface.traction(speed + 1e-7, 60.0, 1.3) - surface.traction(speed - 1e-7, 60.0, 1.3)) / 2e-7
        assert_allclose(surface.traction_rise(speed, 60.0, 1.3), difference, rtol=1e-5)


def test_a_robot_on_a_wall_creeps_at_v_s_with_derivatives_of_zero(robot):
    surface = robot.configurations["6T2A"].ground
    for normal, demand in ((0.0, 60.0), (0.0, -60.0), (1e-300, 60.0), (-1.0, 60.0)):
        value, slopes = jax.value_and_grad(surface.speed_creep, argnums=(0, 1))(demand, normal, 1.0)
        assert float(value) == np.sign(demand) * surface.friction.speed_static and slopes == (0.0, 0.0)
