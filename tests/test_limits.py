"""What an instant exceeds, and how a run over time ends by its last instant."""

from dataclasses import replace

import jax.numpy as jnp
import pytest

from mmrjax.fidelities.base import exceeded_limits, travel_status
from mmrjax.fidelities.rest import is_at_rest, travel_direction
from mmrjax.model.conditions import Conditions
from mmrjax.model.power import Battery
from mmrjax.model.signals import CONVERGED, REVERSES, ROLLS_BACK, STATUSES, Signals, is_done

FINE = dict(
    battery=1.0, voltage_source=30.0, total_current=2.0, current=1.0, speed_motor=600.0, torque_gear=2.0,
    speed=0.4, speed_sliding=0.01,
)  # fmt: skip


@pytest.fixture(scope="module")
def rated(robot):
    battery = Battery(current_limit=8.0, current_charge=2.0)
    driver = replace(robot.driver, current_limit=4.0)
    return replace(robot, battery=battery, driver=driver)


@pytest.mark.parametrize(
    "changed, flags",
    [
        ({}, set()),
        ({"voltage_source": 8 * 2.99}, {"cut_off"}),
        ({"voltage_source": 8 * 2.99, "battery": 0.0}, set()),
        ({"voltage_source": 8 * 4.21, "total_current": -1.6}, {"overvoltage"}),
        ({"voltage_source": 8 * 4.21}, set()),  # no current flows into it
        ({"total_current": -3.6}, {"overvoltage"}),  # more than it may be charged with
        ({"total_current": 6.6}, {"battery_overcurrent"}),  # beside 1.5 A of the other consumers
        ({"total_current": 6.4}, set()),
        ({"current": -4.1}, {"current_limited"}),
        ({"speed_motor": -1000.0}, {"gearbox_overspeed"}),
        ({"speed_motor": 1300.0}, {"gearbox_overspeed", "motor_overspeed"}),
        ({"torque_gear": -6.3}, {"gearbox_overload"}),
        ({"speed_sliding": -0.03}, {"slips"}),
        ({"discharge": 12_800.0}, set()),  # the parabola turns at 12 857 C
        ({"discharge": 12_900.0}, {"voltage_rising"}),
        ({"discharge": 12_900.0, "battery": 0.0}, set()),
        ({"total_current": -0.1, "battery": 0.0}, {"current_returned"}),
        ({"total_current": 0.1, "battery": 0.0}, set()),
        ({"voltage_source": -24.0, "total_current": -0.1, "battery": 0.0}, set()),  # driven backward, it draws
        ({"voltage_source": -24.0, "total_current": 0.1, "battery": 0.0}, {"current_returned"}),
    ],
)
def test_limits_that_an_instant_exceeds(rated, changed, flags):
    over = exceeded_limits(rated, Signals(**{name: jnp.asarray(x) for name, x in {**FINE, **changed}.items()}))
    assert {name for name, x in over.items() if bool(x)} == flags


def test_travel_is_named_by_what_drives_it():
    cases = [(0.4, 24.0), (0.0, 0.0), (-0.4, -24.0), (-0.4, 24.0), (0.4, -24.0)]
    names = [STATUSES[int(travel_status(jnp.asarray(v), jnp.asarray(u)))] for v, u in cases]
    assert names == ["converged", "converged", "reverses", "rolls_back", "rolls_back"]
    codes = jnp.arange(len(STATUSES))
    assert [int(k) for k in codes if bool(is_done(k))] == [CONVERGED, REVERSES] and ROLLS_BACK not in (0, REVERSES)


def test_a_driven_robot_creeps_where_either_lags_and_one_that_gravity_drives_where_both_do():
    rest, fast, slow = 0.002, 0.01, 0.001
    speeds = [(a, b) for a in (fast, slow) for b in (fast, slow)]
    driven, rolling = ([bool(is_at_rest(1.0, volts, a, b, rest)) for a, b in speeds] for volts in (24.0, -24.0))
    assert driven == [False, True, True, True] and rolling == [False, False, False, True]
    assert not bool(is_at_rest(-1.0, -24.0, -fast, -fast, rest))


@pytest.mark.parametrize(
    "voltage, slope, way", [(24.0, 10.0, 1.0), (-24.0, 0.0, -1.0), (0.4, 20.0, -1.0), (0.4, 5.0, 1.0)]
)
def test_travel_is_the_way_of_the_larger_torque_at_rest(robot, voltage, slope, way):
    """48 C_m U / R = 2.03 U [N·m] on a side, of which gravity asks 6.55 kg · g · sin α · 38.2 mm."""
    assert float(travel_direction(robot, Conditions(voltage=voltage, slope_deg=slope))) == way
