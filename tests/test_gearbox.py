"""Reduction gear, eqs. (19)-(23)."""

import jax
import numpy as np
import pytest
from numpy.random import default_rng
from numpy.testing import assert_allclose
from worlds import paper

from mmrjax.model.gearmotor import Gearbox

RNG = default_rng(19)


def test_gearbox_laws_match_reference():
    for _ in range(100):
        i, eta, M0, K, torque, w = RNG.uniform((5, 0.3, 0, 0, 0.002, 0), (100, 1, 1e-3, 1e-6, 0.1, 1300))
        gear = Gearbox(ratio=i, efficiency_load=eta, friction_coulomb=M0, friction_viscous=K)
        idle = paper.gear_idle(w, M0, K, 1.0)
        eta_r = paper.gear_efficiency(torque, idle, eta)
        loss = paper.gear_loss(torque, i, eta_r)
        assert_allclose(loss, paper.gear_loss_split(torque, idle, i, eta), rtol=1e-9)  # (21) = (22)
        assert_allclose(gear.torque_idle(w, 1.0), idle, rtol=1e-9)
        assert_allclose(gear.efficiency(torque, w), eta_r, rtol=1e-9)
        assert_allclose(gear.torque_loss(torque, w), loss, rtol=1e-9)
        assert_allclose(gear.torque_output(torque - idle, 1.0), paper.gear_output(torque, loss, i), rtol=1e-9)


def test_gearbox_efficiency_at_zero_torque_is_finite_with_its_gradient():
    value, gradient = jax.value_and_grad(Gearbox().efficiency)(0.0, 800.0)
    assert np.isfinite(value) and np.isfinite(gradient)


def test_gearbox_load_loss_takes_power_in_both_directions():
    gear = Gearbox()
    for direction in (-1.0, 1.0):
        for transmitted in (-0.05, -0.001, 0.001, 0.05):
            out = float(gear.torque_output(transmitted, direction))
            power_in, power_out = transmitted * direction, out * direction / 48.0
            assert power_in > power_out  # what enters at the motor side exceeds what leaves


@pytest.mark.parametrize("direction", [1.0, -1.0])
def test_gearbox_without_torque_has_the_efficiency_of_a_load_about_to_grow(direction):
    """Whichever sign rounding leaves: nothing but a torque that is transmitted sends power back."""
    gear = Gearbox()
    efficiency = [float(gear.efficiency_flow(torque, direction)) for torque in (0.0, 1e-15, -1e-15)]
    assert_allclose(efficiency, 0.74, rtol=1e-12)
    assert_allclose(float(gear.efficiency_flow(-1e-9 * direction, direction)), 1 / 0.74, rtol=1e-12)
