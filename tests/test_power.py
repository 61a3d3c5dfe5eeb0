"""Supply and battery, eqs. (8)-(13)."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from worlds import paper

from mmrjax.model.power import Battery, curve_remark, voltage_source

RNG = np.random.default_rng(8)


def test_battery_voltage_matches_reference():
    for _ in range(100):
        A, B, U0, R, I_p = RNG.uniform((0, -1e-3, 3, 0, 0), (1e-7, 0, 5, 0.2, 4))
        current, discharge = RNG.uniform((-5, 0), (30, 8000))
        capacity, of_curve = RNG.uniform(2000, 30_000, 2)
        battery = Battery(
            curvature=A, slope=B, voltage_full=U0, resistance=R, current_other=I_p,
            capacity=capacity, capacity_curve=float(of_curve),
        )  # fmt: skip
        expected = paper.battery_voltage(current, discharge, A, B, U0, R, I_p, capacity, of_curve)
        assert_allclose(battery.voltage(current, discharge), expected, rtol=1e-9)


def test_battery_parabola_turns_beyond_capacity():
    battery = Battery()
    lowest = -battery.slope / (2 * battery.curvature)
    assert_allclose(lowest / 3.6, 3571.43, rtol=1e-5)
    assert lowest > battery.capacity and curve_remark(battery) is None
    assert [bool(battery.rises(lowest * share)) for share in (0.999, 1.001)] == [False, True]


def test_battery_of_the_papers_capacity_has_table1_to_the_last_digit():
    battery, charge = Battery(), np.linspace(0.0, 7920.0, 12)
    table1 = battery.curvature * charge**2 + battery.slope * charge + battery.voltage_full
    assert_array_equal(battery.voltage_no_load(charge), table1)


@pytest.mark.parametrize("capacity", [1000.0, 30_670.0, 1e6])
def test_battery_of_any_capacity_falls_as_the_papers_over_its_own(capacity):
    """30 670 C (8519 mAh) once rose to 4.76 V a cell on the way to empty."""
    share = np.linspace(0.0, 1.0, 101)
    own, other = Battery(), Battery(capacity=capacity)
    assert_allclose(other.voltage_no_load(share * capacity), own.voltage_no_load(share * 7920.0), rtol=1e-12)
    assert (np.diff(other.voltage_no_load(share * capacity)) < 0).all()
    assert not bool(other.rises(capacity)) and curve_remark(other) is None


def test_battery_whose_own_parabola_turns_up_is_remarked():
    battery = Battery(curvature=1.25e-8, slope=-1.5e-4, capacity=20_000.0, capacity_curve=10_000.0)
    assert [bool(battery.rises(charge)) for charge in (11_999.0, 12_001.0)] == [False, True]
    assert curve_remark(battery) == (
        "with this curvature and slope a cell's voltage rises after 60 % of its capacity is taken "
        "(capacity_curve: 10000 C)"
    )


@pytest.mark.parametrize("discharge, empty", [(0.0, False), (7919.9, False), (7920.0, True), (1e5, True)])
def test_battery_is_empty_from_its_capacity(discharge, empty):
    assert bool(Battery().empty(discharge)) is empty


@pytest.mark.parametrize("mode, on_battery", [(1, 1.0), (2, 0.0)])
def test_voltage_source_selects_as_reference(mode, on_battery):
    battery = Battery()
    own = float(battery.voltage(2.0, 100.0))
    assert voltage_source(battery, 24.0, on_battery, 2.0, 100.0) == paper.source_voltage(mode, 24.0, own)


def test_voltage_source_external_has_no_battery_gradient():
    gradient = jax.grad(lambda b: voltage_source(b, jnp.asarray(24.0), 0.0, 2.0, 100.0))(Battery())
    assert all(g == 0.0 for g in jax.tree.leaves(gradient))


def test_battery_energy_is_the_integral_of_its_voltage_over_the_charge():
    for battery in (Battery(), Battery(capacity=12_000.0)):
        charge = np.linspace(0.0, 6000.0, 3001)
        volts = 8 * np.asarray(battery.voltage_no_load(charge))
        assert_allclose(battery.energy(6000.0), np.sum((volts[1:] + volts[:-1]) / 2) * 2.0, rtol=1e-7)
