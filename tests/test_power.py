"""Supply and battery, eqs. (8)-(13)."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import reference

from mmrjax.power import Battery, voltage_source

RNG = np.random.default_rng(8)


def test_battery_voltage_matches_reference():
    for _ in range(100):
        A, B, U0, R, I_p = RNG.uniform((0, -1e-3, 3, 0, 0), (1e-7, 0, 5, 0.2, 4))
        current, discharge = RNG.uniform((-5, 0), (30, 8000))
        battery = Battery(curvature=A, slope=B, voltage_full=U0, resistance=R, current_other=I_p)
        expected = reference.battery_voltage(current, discharge, A, B, U0, R, I_p)
        np.testing.assert_allclose(battery.voltage(current, discharge), expected, rtol=1e-9)


def test_battery_voltage_full_without_load_is_eight_cells():
    battery = Battery(current_other=0.0)
    np.testing.assert_allclose(battery.voltage(0.0, 0.0), 33.36, rtol=1e-12)  # Table A4 rounds to 33.4


def test_battery_table1_units_are_per_mah():
    # Table 1 in its own units: 2000 mAh taken from a cell leave 4.17 - 1.0 + 0.28 V.
    np.testing.assert_allclose(Battery().voltage_no_load(2000 * 3.6), 3.45, rtol=1e-12)


def test_battery_parabola_turns_beyond_capacity():
    battery = Battery()
    lowest = -battery.slope / (2 * battery.curvature)
    np.testing.assert_allclose(lowest / 3.6, 3571.43, rtol=1e-5)
    assert lowest > battery.capacity


@pytest.mark.parametrize(("discharge", "empty"), [(0.0, False), (7919.9, False), (7920.0, True), (1e5, True)])
def test_battery_is_empty_from_its_capacity(discharge, empty):
    assert bool(Battery().empty(discharge)) is empty


def test_battery_current_includes_other_consumers():
    assert float(Battery().current(3.0)) == 4.5


@pytest.mark.parametrize(("mode", "on_battery"), [(1, 1.0), (2, 0.0)])
def test_voltage_source_selects_as_reference(mode, on_battery):
    battery = Battery()
    own = float(battery.voltage(2.0, 100.0))
    assert float(voltage_source(battery, 24.0, on_battery, 2.0, 100.0)) == reference.source_voltage(mode, 24.0, own)


def test_voltage_source_external_has_no_battery_gradient():
    gradient = jax.grad(lambda b: voltage_source(b, jnp.asarray(24.0), 0.0, 2.0, 100.0))(Battery())
    assert all(float(g) == 0.0 for g in jax.tree.leaves(gradient))


def test_battery_energy_is_the_integral_of_its_voltage_over_the_charge():
    battery = Battery()
    charge = np.linspace(0.0, 6000.0, 3001)
    volts = 8 * np.asarray(battery.voltage_no_load(charge))
    np.testing.assert_allclose(battery.energy(6000.0), np.sum((volts[1:] + volts[:-1]) / 2) * 2.0, rtol=1e-7)
