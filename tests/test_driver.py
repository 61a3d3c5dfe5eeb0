"""The motor driver: its current limit, its diode, its controller, and what it takes from the supply."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose

from mmrjax.effects import BY_NAME
from mmrjax.fidelities.steady import steady_batch
from mmrjax.model import paper_robots, params
from mmrjax.model.balances import begin_signals, driven_signals, moving_signals, supply
from mmrjax.model.conditions import Conditions
from mmrjax.model.driver import FAST, SLOW, STEEPNESS, Driver
from mmrjax.model.energy import sink_powers, source_power
from mmrjax.model.robot import Configurations
from mmrjax.model.shaft import Shaft
from mmrjax.model.signals import State

LIMITED = Driver(current_limit=5.0)


@pytest.mark.parametrize(
    "duty, current, limited",
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
    assert_allclose(LIMITED.duty_limited(duty, current), limited, rtol=0, atol=1e-9)
    assert bool(LIMITED.limits(current)) is (abs(current) > 5.0)


@pytest.mark.parametrize("volts", [6.0, -6.0])
def test_limit_and_diode_act_alike_on_a_supply_of_either_sign(robot, volts):
    """Beyond the limit the motors get less than the supply has, and a diode blocks what flows against it alone."""
    limited = replace(robot, driver=replace(robot.driver, current_limit=1.0, returns_current=False))
    given = [
        float(moving_signals(limited, Conditions(voltage=volts), State(current, 0.0, 0.0, 0.0)).voltage)
        for current in (np.sign(volts) * 1.001, -np.sign(volts) * 1.001)
    ]
    assert given == pytest.approx([0.5 * volts, 0.0])  # at the back-EMF of motors that stand


def test_a_diode_blocks_current_against_the_duty_alone():
    """At no current, what the driver's voltage would drive."""
    diode = Driver(returns_current=False)
    cases = {
        (1.0, 2.0, 5.0): 1, (1.0, 2.0, -5.0): 1, (1.0, -2.0, 5.0): 0, (1.0, 0.0, 5.0): 1, (1.0, 0.0, -5.0): 0,
        (-1.0, -2.0, -5.0): 1, (-1.0, 2.0, -5.0): 0, (-1.0, 0.0, 5.0): 0, (0.0, -2.0, 5.0): 1, (1.0, -2.0, -5.0): -1,
    }  # fmt: skip
    for (duty, current, excess), conducts in cases.items():
        assert float(diode.conducts(duty, duty, current, excess, 0.0)) == conducts
    assert float(diode.conducts(1.0, -0.1, 6.0, 5.0, 0.0)) == 0  # the limit would reverse the duty
    assert float(Driver().conducts(1.0, 1.0, -2.0, -5.0, 0.0)) == 1
    assert float(Driver().conducts(1.0, 1.0, 2.0, 5.0, 1.0)) == 0


@pytest.mark.parametrize("returns", [True, False])
@pytest.mark.parametrize("duty", [1.0, -0.4, 0.0])
def test_admitted_current_is_what_the_balance_of_a_winding_admits(duty, returns):
    """Along the curve, U = D U_s at the current's own duty, less what a diode holds back, falls evenly by R."""
    driver = Driver(current_limit=2.0, returns_current=returns)
    resistance, source, wanted = 0.5, 12.0, np.linspace(-80.0, 80.0, 4001)
    current, held = driver.admitted(wanted, duty, source / resistance)
    left = driver.duty_limited(duty, current) * source - resistance * (current + held)
    assert_allclose(left, duty * source - resistance * wanted, atol=1e-9)
    assert (np.diff(current) >= 0).all() and (returns or (np.asarray(current) * duty >= 0).all())
    assert returns or np.abs(current).max() < 2.0 * (1 + 1.01 * max(abs(duty), 1e-9) / STEEPNESS)


def test_controller_is_proportional_and_integral_with_the_back_emf_fed_forward():
    driver = Driver(gain=4.0, time_reset=0.05)
    assert float(driver.demand(10.0, 0.2, 300.0, 0.0259)) == pytest.approx(0.0259 * (300.0 + 4.0 * (10.0 + 4.0)))


def test_supply_gives_the_duty_of_its_voltage_and_of_the_current(robot):
    """Drops on the way to the driver are before it: its share is of what they leave."""
    sagging = params.replace(BY_NAME["supply_sag"](), {"amplitude": 0.5})
    robot = replace(robot, effects=(sagging,))
    run = Conditions(voltage=24.0, duty=0.25)
    signals = begin_signals(robot, run, State(3.0, 500.0, 0.4, 0.0))
    assert float(signals.total_current) == pytest.approx(2 * 3.0 * 0.25)
    assert float(supply(robot, run, signals).voltage) == pytest.approx(0.25 * (24.0 - 0.5 * 1.5))


def bench(decay, **load):
    """k = 0.1 N·m/A, R = 5 ohm, without losses but the shaft's 0.02 N·m."""
    shaft = Shaft(**{"inertia": 1e-3, "loss_coulomb": 0.02, **load})
    robot = paper_robots.blank_robot(Configurations({"bench": shaft}), sides=1.0)
    motor = {
        "motor.resistance": 5.0,
        "motor.torque_constant": 0.1,
        "gearbox.ratio": 1.0,
        "gearbox.efficiency_load": 1.0,
    }
    return replace(params.replace(robot, motor), driver=Driver(decay=decay))


DUTIES = np.array([0.25, 0.5, 0.9, 1.0, -0.3, -1.0])


def test_between_the_pulses_of_fast_decay_the_motors_coast():
    """Mean torque |d| k (U - k ω)/R: the speed without load does not depend on the duty, and what the supply gives is
    all of the current."""
    way, share = np.sign(DUTIES), np.abs(DUTIES)
    fast, slow = (steady_batch(bench(decay), Conditions(voltage=8.0, duty=DUTIES)) for decay in (FAST, SLOW))
    speed = 8.0 / 0.1 - 0.02 * 5.0 / (0.1**2 * share)
    for name, expected in {
        "motor_speed": way * speed, "motor_current": 0.2 * way, "total_current": 0.2 + 0 * way,
        "power_supply": 8.0 * 0.2 + 0 * way, "efficiency_motor": 0.1 * speed / 8.0,
    }.items():  # fmt: skip
        assert_allclose(getattr(fast, name), expected, rtol=1e-9, err_msg=name)
    assert_allclose(slow.motor_speed, 80.0 * DUTIES - 10.0 * way, rtol=1e-9)
    for name in ("motor_speed", "power_supply", "total_current"):
        a, b = (getattr(found, name)[share == 1] for found in (fast, slow))
        assert_allclose(a, b, rtol=1e-12)


def test_a_driver_in_fast_decay_is_the_effect_of_its_name():
    effect = replace(bench(SLOW), effects=(BY_NAME["coast_decay"](amplitude=1.0),))
    runs = Conditions(voltage=8.0, duty=DUTIES)
    speeds = [steady_batch(robot, runs).motor_speed for robot in (effect, bench(FAST))]
    assert_allclose(*speeds, rtol=1e-9)


@pytest.mark.parametrize("decay", [SLOW, FAST])
@pytest.mark.parametrize("duty", [0.3, -0.6, 0.0])
@pytest.mark.parametrize("current, speed", [(0.4, 30.0), (-0.7, 120.0)])
def test_power_of_the_supply_is_what_goes_into_heat_and_motion(decay, duty, current, speed):
    """Also while a load drives the motors faster than the pulses would, and with no pulses at all."""
    robot, run = bench(decay, torque_constant=-0.5), Conditions(voltage=8.0, duty=duty)
    current = 0.0 if decay == FAST and duty == 0 else current
    signals = moving_signals(robot, run, State(current, speed, speed, 0.0))
    goes = sum(float(x) for x in sink_powers(robot, run, signals).values())
    stored = signals.voltage_left * signals.current  # in the inductance
    stored += (robot.motor.inertia + 1e-3) * signals.acceleration_wheel * signals.speed_wheel
    assert_allclose(source_power(robot, run, signals), goes + float(stored), rtol=0, atol=1e-9)


@pytest.mark.parametrize("opened, current", [(1.0, 0.0), (-1.0, -0.1 * 40.0 / 5.0), (0.0, 0.0)])
def test_fast_decay_coasts_without_pulses_and_brakes_where_it_is_told_to(opened, current):
    run = Conditions(voltage=8.0, duty=0.0, open=opened)
    robot = bench(FAST)
    signals = driven_signals(robot, run, State(current, 40.0, 40.0, 0.0), None)
    assert_allclose(signals.voltage_left, 0.0, rtol=0, atol=1e-12)
