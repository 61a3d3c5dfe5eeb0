"""DC motor, eqs. (14)-(18)."""

import numpy as np
import pytest
import reference

from mmrjax.motor import ALPHA, Motor

RNG = np.random.default_rng(14)


@pytest.mark.parametrize("sign", [-1.0, 0.0, 1.0])
def test_motor_laws_match_reference(sign):
    for _ in range(50):
        R, L, C, M0, K = RNG.uniform((0.1, 1e-5, 5e-3, 0, 0), (2, 1e-3, 0.1, 0.01, 1e-5))
        current, size = RNG.uniform((-10, 0), (10, 1300))
        w = sign * size
        motor = Motor(resistance=R, inductance=L, torque_constant=C, friction_coulomb=M0, friction_viscous=K)
        loss = reference.motor_loss(w, M0, K, sign)
        np.testing.assert_allclose(motor.torque_loss(w, sign), loss, rtol=1e-9)
        np.testing.assert_allclose(motor.voltage_back(w), reference.motor_back(w, C), rtol=1e-9)
        torque = motor.torque_electromagnetic(current) - motor.torque_loss(w, sign)
        expected = reference.motor_torque(current, w, C, M0, K, sign)
        np.testing.assert_allclose(torque, expected, rtol=1e-9, atol=1e-12)
        rate = (24.0 - motor.voltage_back(w) - motor.voltage_winding(current)) / motor.inductance
        expected = reference.motor_current_rate(24.0, current, w, R, L, C)
        np.testing.assert_allclose(rate, expected, rtol=1e-9, atol=1e-6)


def test_motor_speed_constant_is_369_rpm_per_volt():
    np.testing.assert_allclose(1 / Motor().torque_constant * 60 / (2 * np.pi), 369, rtol=1e-3)


def test_motor_without_friction_loses_no_torque():
    assert float(Motor(friction_coulomb=0.0, friction_viscous=0.0).torque_loss(900.0, 1.0)) == 0.0


def test_motor_friction_at_no_load_is_near_the_sheet_current():
    # Table 2's fit at 8810 rpm against the sheet's 165 mA: samples of Fig. 11 lie below the sheet.
    current = Motor().torque_loss(8810 * 2 * np.pi / 60, 1.0) / Motor().torque_constant
    assert 0.10 < float(current) < 0.165


def test_motor_temperature_settles_at_ambient_plus_heat():
    motor = Motor(
        resistance=2.0, resistance_thermal_winding=1.0, resistance_thermal_housing=4.0, temperature_ambient=20.0
    )
    assert float(motor.temperature_cold(3.0)) == 20.0 + 5.0 * 2.0 * 9.0
    settled = float(motor.temperature_settled(3.0))
    power = 3.0 * float(motor.voltage_winding(3.0, settled))  # copper at that temperature
    assert settled == pytest.approx(20.0 + 5.0 * power, rel=1e-12) and settled > 110.0
    assert [float(rate) for rate in motor.heating(power, settled, 20.0 + 4.0 * power)] == pytest.approx(
        [0, 0], abs=1e-9
    )


def test_no_temperature_settles_where_every_kelvin_brings_more_than_a_kelvin():
    """α R_th R I² = 1 at 8.1 A for the packaged motor: its stall has no settled temperature."""
    motor = Motor()
    edge = float((ALPHA * motor.resistance_thermal * motor.resistance) ** -0.5)
    assert np.isfinite(motor.temperature_settled(0.99 * edge)) and np.isinf(motor.temperature_settled(1.01 * edge))
    assert float(motor.temperature_settled(3.91)) == pytest.approx(motor.temperature_limit, rel=5e-3)
