"""Tables that tell nothing: a sentence with what to check, and no claim of the loop."""

import dataclasses

import numpy as np
import pytest
from numpy.testing import assert_allclose

from calibration.data import robot_file
from calibration.data import runs as records
from calibration.described import describe
from calibration.discovery import loop_input
from calibration.inference import checks, noise, observers, ranges
from tests.commands import read_table, refused, text_file

RIG = """
base = "none"
imposed = "motor_speed"
channels = ["motor_current", "output_torque", "output_speed"]
[motor]
torque_constant = "0.04 ± 3 %"
friction_coulomb = 0.002
[gearbox]
ratio = 20
efficiency_load = "0.8 ± 5 %"
[brake]
load = "shaft"
inertia = 0.004
loss_coulomb = "0.3 ± 40 %"
"""
SPEED = np.linspace(300.0, 3000.0, 12)
RNG = np.random.default_rng(5)
CURRENT = 0.5 + SPEED / 6000 + 0.01 * RNG.standard_normal(12)
TORQUE = 0.25 + SPEED / 12000 + 0.01 * RNG.standard_normal(12)
OUTPUT = SPEED / 20 + 0.2 * RNG.standard_normal(12)


@pytest.fixture(scope="module")
def robot(tmp_path_factory):
    return robot_file.read_robot(text_file(tmp_path_factory.mktemp("rig") / "rig.toml", RIG))


@pytest.fixture
def foreseen(monkeypatch):
    """The robot foresees what these functions of current and torque say, without a program."""

    def says(readings):
        for room in (ranges, checks):
            monkeypatch.setattr(room, "operating_readings", lambda robot, conditions: readings)

    return says


def table(tmp_path, robot, current=CURRENT, torque=TORQUE, output=OUTPUT, speed=SPEED, **more):
    columns = {"motor_speed_rpm": speed, "motor_current_A": current, "output_torque_Nm": torque,
               "output_speed_rpm": output, **more}  # fmt: skip
    lines = [",".join(columns), *(",".join(f"{x:.6g}" for x in row) for row in zip(*columns.values(), strict=True))]
    return read_table(tmp_path, "\n".join(lines) + "\n", robot, "t.csv")


def shown(runs):
    """Readings as the robot would show them."""
    return np.array(runs.measured())


def test_independent_readings_are_no_copies(tmp_path, robot):
    assert checks.copied_channels(table(tmp_path, robot), robot) == []


@pytest.mark.parametrize(
    "copy, column, said",
    [
        ({"torque": 3 - 2 * CURRENT}, "output_torque_Nm", "3 - 2 times motor_current_A"),
        (
            {"torque": 1 - 0.64 * np.round(CURRENT, 4)},
            "output_torque_Nm",
            "1 - 0.64 times motor_current_A in every row, to the last digit, so it is computed",
        ),
    ],
)
def test_a_channel_that_is_a_line_of_another_is_refused_by_the_loop(tmp_path, robot, foreseen, copy, column, said):
    runs = table(tmp_path, robot, **copy)
    (found,) = checks.copied_channels(runs, robot)
    assert (found.column, found.tied) == (column, False) and said in describe(found)
    foreseen(shown(runs))
    with refused(rf"t\.csv, {column}: equals .* Measure or remove it"):
        loop_input.prepare_loop(runs, robot, replicates=192)


@pytest.mark.parametrize(
    "torque", [0.64 * CURRENT + 2e-4 * RNG.standard_normal(12), np.round(0.64 * CURRENT, 2), 0.64 * CURRENT**2]
)
def test_what_follows_another_within_noise_or_a_display_or_on_a_curve_is_no_copy(tmp_path, robot, torque):
    assert checks.copied_channels(table(tmp_path, robot, torque=torque), robot) == []


@pytest.mark.parametrize("torque", [0.64 * CURRENT, np.round(0.64 * CURRENT, 4)])
def test_a_measured_torque_that_is_a_multiple_of_a_current_is_left_out(tmp_path, robot, torque):
    runs = table(tmp_path, robot, torque=torque)
    assert not runs.has("output_torque_Nm") and runs.has("motor_current_A")
    assert any("output_torque_Nm: equals 0.64" in note and "It is left out" in note for note in runs.notes)


def test_a_load_that_is_a_multiple_of_a_current_is_left_out(tmp_path, robot):
    """The load is what leaves the gearbox at the current. Friction, a display and a meter's noise leave no multiple."""
    current = np.round(CURRENT, 5)
    runs = table(tmp_path, robot, current, load_torque_Nm=np.round(0.64 * current, 4))
    (note,) = (note for note in runs.notes if "load_torque_Nm: equals 0.64" in note)
    assert "this current is no reading either" in note and not runs.has("motor_current_A")
    output = 20 * 0.8 * (0.04 * current - 0.002) - 0.3
    assert_allclose(runs["load_torque_Nm"], output, rtol=1e-3)
    noisy = 0.64 * current + 2e-4 * RNG.standard_normal(12)
    few = np.round(current, 1)
    for drawn, torque in (
        (current, 0.64 * current - 0.03), (current, np.round(0.64 * current, 2)), (current, noisy), (few, 0.64 * few),
    ):  # fmt: skip
        kept = table(tmp_path, robot, drawn, load_torque_Nm=torque)
        assert kept.has("motor_current_A") and not [note for note in kept.notes if "computed" in note]


def test_a_computed_load_is_refused_where_the_current_is_imposed(tmp_path, robot):
    rig = dataclasses.replace(robot.rig, imposed="motor_current", channels=("output_speed", "motor_voltage"))
    driven = dataclasses.replace(robot, rig=rig)
    with refused(r"load_torque_Nm: equals 0\.64 times motor_current_A.* keep rows without"):
        table(tmp_path, driven, load_torque_Nm=0.64 * CURRENT)


def test_readings_that_a_rigid_gear_ties_are_said_and_not_refused(robot):
    """The imposed speed is no channel. With the motor's as one, the output's may be of the same instrument."""
    rig = dataclasses.replace(robot.rig, channels=("motor_speed", "output_speed"), imposed="voltage")
    driven = dataclasses.replace(robot, rig=rig)
    columns = {"supply_voltage_V": SPEED / 200, "motor_speed_rpm": SPEED, "output_speed_rpm": SPEED / 20}
    (found,) = checks.copied_channels(records.read_runs(columns, driven), driven)
    assert found.tied and found.slope == pytest.approx(0.05) and "would count twice" in describe(found)


@pytest.mark.parametrize("spread, varies", [(0.5, False), (3.0, True)])
def test_runs_of_one_condition_are_refused_by_the_loop(tmp_path, robot, foreseen, spread, varies):
    """Conditions that differ by less than shows in any channel are one."""
    speed = 1000 + np.linspace(0, 1, 12)
    runs = table(tmp_path, robot, 0.6 + 0.01 * RNG.standard_normal(12), 0.3 + 0.01 * RNG.standard_normal(12),
                 50 + 0.1 * RNG.standard_normal(12), speed, wind_V=speed)  # fmt: skip
    kind = observers.observer_kind(runs)
    known = noise.infer_noise(runs, kind.sizes(runs), "motor_current=0.01A,output_torque=0.01Nm,output_speed=1rpm")
    middle = np.mean(shown(runs), 0)
    foreseen(middle + spread * np.median(known.sd, 0) * np.linspace(-0.5, 0.5, 12)[:, None])
    found = checks.nothing_varies(runs, robot, known)
    assert (found is None) == varies
    if not varies:
        assert (found.rows, found.column, found.unused) == (12, "motor_speed_rpm", ("wind_V",))
        with refused(r"t\.csv: these 12 runs differ only by noise\. wind_V varies from row to row"):
            loop_input.prepare_loop(
                runs, robot, noise="motor_current=0.01A,output_torque=0.01Nm,output_speed=1rpm", replicates=192
            )


@pytest.mark.parametrize("factor, unit", [(1000.0, "mNm"), (10.0, "")])
def test_a_torque_in_another_unit_is_refused_where_its_friction_is_not_known(tmp_path, robot, foreseen, factor, unit):
    """Friction that nobody knows may be ten times another. A thousand times is a matter of units."""
    runs = table(tmp_path, robot)
    foreseen(shown(runs))
    off = table(tmp_path, robot, torque=factor * TORQUE)
    if unit:
        with refused(r"output_torque_Nm: about 1000 times too large .* are they in mNm"):
            ranges.check_ranges(off, robot)
    else:
        assert ranges.check_ranges(off, robot) == []
