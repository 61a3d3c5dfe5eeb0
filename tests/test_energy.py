"""Energy of one instant: what the source gives goes somewhere or is stored."""

import pytest
from numpy.testing import assert_allclose

from mmrjax.model.balances import moving_signals
from mmrjax.model.conditions import Conditions
from mmrjax.model.energy import SINKS, sink_powers, source_power, stored_energy
from mmrjax.model.signals import State

#: (configuration, voltage, slope [deg], payload [kg], on the battery, current [A], motor speed [rad/s], speed [m/s]).
INSTANTS = {
    "climbing": (0, 24.0, 10.0, 3.0, 0.0, 2.5, 800.0, 0.60),
    "on the battery": (1, 0.0, 5.0, 1.0, 1.0, 1.5, 700.0, 0.95),
    "driven backward": (0, -15.0, -5.0, 0.0, 0.0, -1.2, -500.0, -0.37),
    "braking downhill": (1, 6.0, -15.0, 8.0, 0.0, -3.0, 400.0, 0.52),
}


@pytest.mark.parametrize("case", INSTANTS)
def test_source_is_what_goes_and_what_is_stored(robot, case):
    which, volts, slope, payload, battery, current, motor, speed = INSTANTS[case]
    run = Conditions(which, volts, slope, payload, battery)
    signals = moving_signals(robot, run, State(current, motor, speed, 900.0))
    sinks = sink_powers(robot, run, signals)
    assert set(sinks) == set(SINKS)
    ratio, i = robot.gearbox.ratio, signals.voltage_left / signals.inductance
    # how fast what is stored grows, by its derivatives along the motion
    parts = (
        float(signals.mass * speed * signals.acceleration),
        2 * float(robot.motor.inertia * motor * ratio * signals.acceleration_wheel),
        2 * float(robot.chassis(which).inertia * signals.speed_wheel * signals.acceleration_wheel),
        2 * float(signals.inductance * current * i),
    )
    source = float(source_power(robot, run, signals))
    scale = abs(source) + sum(abs(float(x)) for x in sinks.values()) + sum(map(abs, parts))
    assert source == pytest.approx(sum(map(float, sinks.values())) + sum(parts), abs=1e-9 * scale)
    for name in ("winding", "motor", "gearbox", "track", "rolling", "sliding", "battery", "other"):
        assert float(sinks[name]) >= -1e-12, name


def test_stored_energy_is_of_mass_wheels_rotors_and_inductance(robot):
    run = Conditions(0, 24.0)
    signals = moving_signals(robot, run, State(2.0, 600.0, 0.45, 0.0))
    wanted = 0.5 * 13.1 * 0.45**2 + 33.5e-7 * 600.0**2 + 0.119e-3 * 2.0**2
    wanted += float(robot.chassis(0).inertia) * (600.0 / 48) ** 2
    assert_allclose(stored_energy(robot, signals), wanted, rtol=1e-9)
