"""Settled rows whose tachometer did not read, and rows beyond a limit of supply or driver, are no readings."""

import numpy as np
import pytest

from calibration.data import robot_file
from tests.commands import read_table

RIG = """base = "none"
channels = ["total_current", "motor_speed"]
[motor]
resistance = "0.1 ± 30 %"
torque_constant = "0.004 ± 5 %"
friction_coulomb = "0.001 ± 100 %"
[gearbox]
ratio = 1.0
efficiency_load = 1.0
[propeller]
load = "shaft"
inertia = 1e-5
loss_coulomb = 0.0
"""
DUTY = np.linspace(0.1, 1.0, 10)


@pytest.fixture
def stand(tmp_path):
    """Reads a table of a propeller: with torque c ω² and 12 V, D U = R I + k ω and k I = c ω² + friction."""

    def read(speed=None, current=None, supply=None):
        own, drawn = propeller(DUTY * 12.0)
        rows = zip(
            np.full(10, 12.0) if supply is None else supply, DUTY, own if speed is None else speed,
            drawn * DUTY if current is None else current, strict=True,
        )  # fmt: skip
        (tmp_path / "rig.toml").write_text(RIG)
        lines = ["supply_voltage_V,duty,motor_speed_rpm,total_current_A", *(",".join(map(str, row)) for row in rows)]
        return read_table(tmp_path, "\n".join(lines) + "\n", robot_file.read_robot(tmp_path / "rig.toml"), "runs.csv")

    return read


def propeller(volts):
    """Speed [rpm] and motor current [A]."""
    from scipy.optimize import brentq

    drawn = lambda w: (1.5e-8 * w**2 + 0.001) / 0.004  # noqa: E731
    speeds = np.array([brentq(lambda w, u=u: u - 0.004 * w - 0.1 * drawn(w), 0.0, 1e5) for u in volts])
    return speeds * 60 / (2 * np.pi), drawn(speeds)


def missing(runs):
    return {c.name: (np.flatnonzero(np.isnan(runs[c.column])) + 1).tolist() for c in runs.channels}


def test_speed_of_zero_at_the_current_of_a_turning_motor_is_missing(stand):
    speed, _ = propeller(DUTY * 12.0)
    runs = stand(speed=np.where(DUTY < 0.35, 0.0, speed))
    assert missing(runs) == {"total_current": [], "motor_speed": [1, 2, 3]}
    assert any("0 in rows 1, 2, 3" in note and "missing" in note for note in runs.notes)


def test_motor_that_stands_keeps_its_speed_of_zero(stand):
    """At the current of standstill, and in the dead band of a driver, without current."""
    speed, current = propeller(DUTY * 12.0)
    speed[:2], current[0], current[1] = 0.0, 0.0, 0.2 * 12.0 / 0.1
    assert missing(stand(speed=speed, current=current * DUTY)) == {"total_current": [], "motor_speed": []}


def test_rows_beyond_the_current_of_the_supply_are_set_aside(stand):
    """The supply holds 20 A: its voltage falls from row 9 on."""
    supply = np.where(DUTY > 0.85, 12.0 * 0.82 / DUTY, 12.0)
    speed, current = propeller(DUTY * supply)
    drawn = current * DUTY
    drawn[8:] = 1.01 * drawn[8]
    runs = stand(speed=speed, current=drawn, supply=supply)
    assert missing(runs) == {"total_current": [9, 10], "motor_speed": [9, 10]}
    assert any("rows 9, 10" in note and "limit" in note for note in runs.notes)


def test_rows_beyond_full_voltage_are_set_aside_but_for_the_first(stand):
    speed, current = propeller(np.minimum(DUTY, 0.7) * 12.0)
    assert missing(stand(speed=speed, current=current * np.minimum(DUTY, 0.7)))["motor_speed"] == [8, 9, 10]


def test_readings_of_a_sound_stand_are_kept(stand):
    runs = stand()
    assert missing(runs) == {"total_current": [], "motor_speed": []} and not any("limit" in n for n in runs.notes)
