"""The motor driver: its current limit, its diode, its controller, and what it takes from the supply."""

import dataclasses

import pytest

from mmrjax import balances, params
from mmrjax.conditions import Conditions
from mmrjax.driver import STEEPNESS, Driver
from mmrjax.effects import BY_NAME
from mmrjax.signals import State

LIMITED = Driver(current_limit=5.0)


@pytest.mark.parametrize(
    ("duty", "current", "limited"),
    [
        (0.6, 4.9, 0.6),
        (0.6, -4.9, 0.6),
        (0.6, 5.005, 0.6 - STEEPNESS * 1e-3),
        (-0.6, -5.005, -0.6 + STEEPNESS * 1e-3),  # it takes from what drives the current, either way
        (0.6, -5.005, 1.0),
        (0.6, 6.0, -1.0),
    ],
)
def test_the_current_limit_takes_duty_from_what_drives_the_current(duty, current, limited):
    assert float(LIMITED.duty_limited(duty, current)) == pytest.approx(limited, abs=1e-9)
    assert bool(LIMITED.limits(current)) is (abs(current) > 5.0)


def test_a_diode_blocks_current_against_the_duty_alone():
    diode = Driver(returns_current=False)
    assert [bool(diode.blocks(d, i, 0.0)) for d, i in ((1.0, 2.0), (1.0, -2.0), (-1.0, -2.0), (-1.0, 2.0))] == [
        False, True, False, True,
    ]  # fmt: skip
    assert not bool(Driver().blocks(1.0, -2.0, 0.0)) and bool(Driver().blocks(1.0, 2.0, 1.0))


def test_controller_is_proportional_and_integral_with_the_back_emf_fed_forward():
    driver = Driver(gain=4.0, time_reset=0.05)
    assert float(driver.demand(10.0, 0.2, 300.0, 0.0259)) == pytest.approx(0.0259 * (300.0 + 4.0 * (10.0 + 4.0)))


def test_supply_gives_the_duty_of_its_voltage_and_of_the_current(robot):
    """Drops on the way to the driver are before it: its share is of what they leave."""
    sagging = params.replace(BY_NAME["supply_sag"](), {"amplitude": 0.5})
    robot = dataclasses.replace(robot, effects=(sagging,))
    run = Conditions(voltage=24.0, duty=0.25)
    signals = balances.begin(robot, run, State(3.0, 500.0, 0.4, 0.0))
    assert float(signals.total_current) == pytest.approx(2 * 3.0 * 0.25)
    assert float(balances.supply(robot, run, signals).voltage) == pytest.approx(0.25 * (24.0 - 0.5 * 1.5))
