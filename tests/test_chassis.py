"""Masses and inertias, eqs. (1)-(4), (31)."""

import numpy as np
import pytest
from numpy.random import default_rng
from numpy.testing import assert_allclose
from scipy.optimize import brentq
from worlds import paper

from mmrjax.model.balances import begin_signals, moving_signals
from mmrjax.model.chassis import inertia_reduced, normal_load
from mmrjax.model.conditions import Conditions
from mmrjax.model.signals import State
from tests.commands import parameter_values

RNG = default_rng(31)


def test_chassis_inertias_match_reference():
    for _ in range(100):
        J_d, i, eta, J_w = RNG.uniform((0, 5, 0.3, 0), (1e-5, 100, 1, 1e-2))
        rotating = inertia_reduced(J_d, i, eta, J_w)
        assert_allclose(rotating, paper.rotating_inertia(J_d, i, eta, J_w), rtol=1e-9)


def test_normal_load_matches_reference():
    for mass, alpha in RNG.uniform((5, -0.7), (40, 0.7), (50, 2)):
        expected = paper.rolling_force(mass / 2, alpha, 1.0)
        assert_allclose(normal_load(mass, alpha, paper.G, 2), expected, rtol=1e-9)


@pytest.mark.quick(1)
@pytest.mark.parametrize("wheeled", [0.0, 1.0])
def test_mass_factor_is_that_of_acceleration_without_sliding(robot, wheeled):
    """(1) with (2), (4): where wheel and robot accelerate alike, m δ a = M_d i η / r - M_t / r - F_f - G."""
    run = Conditions(voltage=24.0, slope_deg=np.degrees(0.05), configuration=wheeled)
    body, ratio, eta = robot.chassis(wheeled), robot.gearbox.ratio, robot.gearbox.efficiency_load

    def signals(sliding):
        return moving_signals(robot, run, State(1.5, 300.0, 300.0 / ratio * body.radius - sliding, 0.0))

    def lag(sliding):
        s = signals(sliding)
        return float(s.acceleration - body.radius * s.acceleration_wheel)

    s = signals(brentq(lag, 0.0, float(body.ground.friction.speed_static), xtol=1e-16))
    free = (s.torque_motor - s.torque_idle) * ratio * eta / body.radius - s.torque_track_loss / body.radius - s.demand
    turned = paper.equivalent_inertia(s.mass / 2, body.radius, robot.motor.inertia, ratio, eta, body.inertia)
    delta = paper.mass_factor(s.mass / 2, body.radius, turned)
    assert float(delta) > 1.3  # 48 : 1 makes the rotor count
    assert_allclose(s.acceleration, free / (s.mass / 2 * delta), rtol=1e-9)


def test_total_mass_stated_overrides_robot_and_payload(robot):
    state = State(0.0, 0.0, 0.0, 0.0)
    assert_allclose(begin_signals(robot, Conditions(payload=3.0), state).mass, 16.1, rtol=1e-15)
    assert float(begin_signals(robot, Conditions(payload=3.0, total_mass=20.0), state).mass) == 20.0


def test_masses_are_table7(robot):
    values = parameter_values(robot)
    assert (values["6T2A.mass"], values["4W2T.mass"]) == (13.1, 11.5)
    assert values["motor.inertia"] > 5760e-6 / 48**2  # [kg·m²]; the rotor of the sheet has 3.35e-6
