"""Settled rows whose tachometer did not read, and rows beyond a limit of supply or driver, are no readings."""

import re

import numpy as np
import pytest
from commands import command

from calibration.data import robot_file
from tests.commands import read_json, read_table

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


def stand_of_a_long_table(folder):
    """Propeller of 76 rows by rising command: the driver gives duty ** 0.77, 8 speeds were not read, 16 rows at 25 A."""
    from scipy.optimize import brentq

    random, pulses = np.random.default_rng(7), np.linspace(1080, 2000, 76).round()
    duty = (pulses - 1000) / 1000

    def row(volts, share):
        drawn = lambda w: (1.1e-7 * w**2 + 0.004) / 0.0072  # noqa: E731
        speed = brentq(lambda w: volts * share - 0.0072 * w - 0.09 * drawn(w), -1.0, 1e5)
        return volts, speed * 60 / (2 * np.pi), share * drawn(speed)

    rows = []
    for share in duty**0.77:
        sags = brentq(lambda v, s=share: v - 14.8 + 0.01 * row(v, s)[2], 5.0, 14.8)
        limited = row(sags, share)[2] > 25.0
        rows.append(row(brentq(lambda v, s=share: row(v, s)[2] - 25.0, 3.0, 14.8) if limited else sags, share))
    volts, speed, current = np.array(rows).T * (1 + random.normal(0, [[5e-4], [3e-3], [6e-3]], (3, 76)))
    thrust, read = 0.11 * (speed / 1000) ** 2, np.where(np.arange(76) < 8, 0.0, speed)
    columns = np.arange(1, 77), pulses, volts, duty, read, current + random.normal(0, 0.02, 76), thrust
    header = "order,pulse_us,supply_voltage_V,duty,motor_speed_rpm,total_current_A,thrust_N"
    np.savetxt(folder / "runs.csv", np.array(columns).T, fmt="%.5g", delimiter=",", header=header, comments="")
    rig = (
        RIG.replace("0.1 ± 30 %", "0.09 ± 20 %").replace("0.004 ± 5 %", "0.0072 ± 5 %").replace("0.001 ±", "0.004 ±")
    )
    (folder / "rig.toml").write_text(rig)


@pytest.mark.slow
def test_a_propeller_has_a_load_with_the_square_of_speed_and_a_law_of_the_driver(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    stand_of_a_long_table(tmp_path)
    assert command(["loop", "runs.csv", "--robot", "rig.toml", "--out", "found"]) == 0
    found = read_json(tmp_path / "found/result.json")
    amplitudes = {e["name"]: e["parameters"]["amplitude"] for e in found["effects"]}
    load, driver = amplitudes["churning"], amplitudes["duty_exponent"]  # ΔM = a ω², voltage as duty ** (1 + a)
    assert abs(load["value"] - 1.1e-7) < 3 * load["sd"] < 2e-8
    assert abs(driver["value"] + 0.23) < 3 * driver["sd"] < 0.06
    unseen = found["errors"]["after"]["held_out"]
    assert unseen["total_current"]["rms_percent"] < 6 and unseen["motor_speed"]["rms_percent"] < 8
    assert "order" not in found["statement"]
    notes = "".join(capsys.readouterr())
    assert "0 in rows 1, 2, 3, 4, 5, 6, 7, 8 although the current is a turning motor's" in notes
    listed, more = re.search(r"rows ([\d, ]+) and (\d+) more: readings no longer change", notes).groups()
    assert len(listed.split(",")) + int(more) == 16
