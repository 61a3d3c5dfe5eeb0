"""DC motor, eqs. (14)-(18)."""

from dataclasses import replace

import jax
import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.integrate import solve_ivp
from worlds import paper

from mmrjax.model.gearmotor import Motor

RNG = np.random.default_rng(14)


@pytest.mark.parametrize("sign", [-1.0, 0.0, 1.0])
def test_motor_laws_match_reference(sign):
    for _ in range(50):
        R, L, C, M0, K = RNG.uniform((0.1, 1e-5, 5e-3, 0, 0), (2, 1e-3, 0.1, 0.01, 1e-5))
        current, size = RNG.uniform((-10, 0), (10, 1300))
        w = sign * size
        motor = Motor(resistance=R, inductance=L, torque_constant=C, friction_coulomb=M0, friction_viscous=K)
        loss = paper.motor_loss(w, M0, K, sign)
        assert_allclose(motor.torque_loss(w, sign), loss, rtol=1e-9)
        assert_allclose(motor.voltage_back(w), paper.motor_back(w, C), rtol=1e-9)
        torque = motor.torque_electromagnetic(current) - motor.torque_loss(w, sign)
        expected = paper.motor_torque(current, w, C, M0, K, sign)
        assert_allclose(torque, expected, rtol=1e-9, atol=1e-12)
        rate = (24.0 - motor.voltage_back(w) - motor.voltage_winding(current)) / motor.inductance
        expected = paper.motor_current_rate(24.0, current, w, R, L, C)
        assert_allclose(rate, expected, rtol=1e-9, atol=1e-6)


def test_motor_temperature_settles_at_ambient_plus_heat():
    motor = Motor(
        resistance=2.0, resistance_thermal_winding=1.0, resistance_thermal_housing=4.0, temperature_ambient=20.0
    )
    assert motor.temperature_cold(3.0) == 20.0 + 5.0 * 2.0 * 9.0
    settled = float(motor.temperature_settled(3.0))
    power = 3.0 * float(motor.voltage_winding(3.0, settled))  # copper at that temperature
    assert settled == pytest.approx(20.0 + 5.0 * power, rel=1e-12) and settled > 110.0
    assert [float(rate) for rate in motor.heating(power, settled, 20.0 + 4.0 * power)] == pytest.approx(
        [0, 0], abs=1e-9
    )


def test_no_temperature_settles_where_every_kelvin_brings_more_than_a_kelvin():
    """α R_th R I² = 1 at 8.1 A for the packaged motor: its stall has no settled temperature."""
    motor = Motor()
    edge = float((motor.temperature_coefficient * motor.resistance_thermal * motor.resistance) ** -0.5)
    assert np.isfinite(motor.temperature_settled(0.99 * edge)) and np.isinf(motor.temperature_settled(1.01 * edge))
    assert motor.current_continuous == pytest.approx(3.91, abs=0.005)
    assert motor.temperature_settled(3.91) == pytest.approx(motor.temperature_limit, rel=5e-3)


@pytest.mark.parametrize("current", [0.0, 3.0, 6.0, 20.0])
def test_temperatures_in_closed_form_match_scipy(current):
    motor, time = Motor(), 80.0

    def rates(t, y):
        power = 0.611 * (1 + 0.00393 * (y[0] - 25)) * current**2
        flow = (y[0] - y[1]) / 1.7
        return [(power - flow) * 1.7 / 16.3, (flow - (y[1] - 25) / 6.0) * 6.0 / 593.0]

    end = solve_ivp(rates, [0, time], [40.0, 30.0], method="DOP853", rtol=1e-12, atol=1e-12).y[:, -1]
    assert_allclose(motor.temperatures_after(current, time, 40.0, 30.0), end, rtol=1e-9)


@pytest.mark.slow
def test_permissible_time_is_when_the_limit_is_reached():
    motor = Motor()
    permissible = jax.jit(
        lambda current, ambient=25.0: replace(motor, temperature_ambient=ambient).time_permissible(current)
    )
    for current in (4.5, 8.0, 30.0):
        time = float(permissible(current))
        assert motor.temperatures_after(current, time, 25.0, 25.0)[0] == pytest.approx(125.0, rel=1e-9)
    assert permissible(3.9) == np.inf  # below the continuous current
    assert permissible(8.0, 130.0) == 0.0
    assert permissible(8.0, 80.0) < permissible(8.0) == motor.time_permissible(8.0)


@pytest.mark.slow
def test_permissible_time_has_the_derivative_of_differences():
    permissible = jax.jit(lambda current: Motor().time_permissible(current))
    slope = jax.jit(jax.grad(permissible))
    for current in (4.5, 8.0, 30.0):
        step = 1e-4 * current
        apart = float(permissible(current + step)) - float(permissible(current - step))
        assert slope(current) == pytest.approx(apart / (2 * step), rel=1e-5)
