"""Readings in other units, and readings of another robot, are found before anything is fitted."""

import numpy as np
import pytest
import worlds.histories
from synthetic import table
from test_loop_command import mmrjax
from worlds import tables

from calibration.data import runs as records
from calibration.data.runs import Runs
from calibration.inference import ranges
from calibration.inference.ranges import check_ranges
from mmrjax.model import params
from mmrjax.model.quantities import RPM
from tests.commands import csv_text, read_rig, read_table, refused, text_file

#: Column of a table, factor on its readings, and what is said.
WRONG = {
    "m/s": ("speed_mm_s", 1e-3, r"speed_mm_s: about \d+ times too small for this robot; are they in m/s\?"),
    "km/h": ("speed_mm_s", 3.6e-3, r"speed_mm_s: .* too small for this robot; are they in km/h( or m/s)?\?"),
    "rad/s": ("motor_speed_rpm", RPM, r"motor_speed_rpm: .*[89]\.\d times too small .*are they in rad/s\? expected rpm"),
    "of the wheel": ("motor_speed_rpm", 1 / 48, "motor_speed_rpm: .* too small .*rpm of the driving wheel"),
    "mA": ("total_current_A", 1e3, r"total_current_A: .* times too large .*are they in mA\? expected A"),
    "seven times": ("speed_mm_s", 7.0, r"speed_mm_s: about 6.9 times too large for this robot; check the unit, mm/s"),
    "g": ("total_mass_kg", 1 / 30, r"total_mass_kg: about 3\d times too small for this robot \(11.5 kg, 13.1 kg and"),
}  # fmt: skip


@pytest.fixture(scope="module")
def runs():
    return table(tables.narrow(seed=4))


def test_rounding_errors_are_nothing_that_a_robot_could_show():
    """Yaw rates of a robot that pulls aside at equal duties, and goes straight in simulation, are in no wrong unit."""
    yaw = np.array([0.02, -0.01])
    assert ranges._range_factor(yaw, np.array([[1e-18, 0.0]])) == 1.0
    assert ranges._range_factor(yaw, np.array([[1e-4, 1e-4]])) == pytest.approx(150.0)


@pytest.fixture(scope="module")
def histories():
    return table(worlds.histories.narrow((), 0.0, 3, duration=0.8, every=0.02))


def scaled(runs, column, factor):
    return Runs("runs.csv", {**runs.columns, column: runs[column] * factor})


WINCH = """
base = "none"
imposed = "motor_speed"
channels = ["motor_current"]
[motor]
torque_constant = 0.0551
[gearbox]
ratio = 1.0
efficiency_load = 1.0
[winch]
load = "shaft"
inertia = 1e-4
torque_constant = 0.2
loss_coulomb = 0.03
"""


@pytest.mark.parametrize("sign", [1, -1])
def test_a_current_that_one_sign_explains_beside_a_weight_is_doubted(tmp_path, sign):
    robot = read_rig(tmp_path, WINCH)
    lifts = np.array([30.0, 120.0, 240.0, -30.0, -120.0, -240.0])
    current = sign * np.where(lifts > 0, 4.7, 3.2)
    rows = "".join(f"{n},{i}\n" for n, i in zip(lifts, current, strict=True))
    found = ranges.remarks_on_signs(
        read_table(tmp_path, f"motor_speed_rpm,motor_current_A\n{rows}", robot, "t.csv"),
        robot,
    )
    assert [note.column for note in found] == ["motor_current_A"] * (sign < 0)
    assert all(note.turned < 1.0 < 7.0 < note.off for note in found)


@pytest.mark.slow
def test_right_units_pass_in_silence(runs, histories, robot):
    assert check_ranges(runs, robot) == check_ranges(histories, robot) == []
    assert check_ranges(records.read_runs("measured"), robot) == []
    assert check_ranges(records.read_runs("simulated_by_paper"), robot) == []


@pytest.mark.quick(1 + len(WRONG))
@pytest.mark.parametrize(
    "data, case", [*(("runs", case) for case in WRONG), ("histories", "m/s"), ("histories", "rad/s")]
)
def test_wrong_units_are_refused_with_the_factor_and_the_likely_unit(request, data, case, robot):
    column, factor, says = WRONG[case]
    with refused(f"runs.csv, {says}"):
        check_ranges(scaled(request.getfixturevalue(data), column, factor), robot)


def test_histories_that_never_get_under_way_are_no_matter_of_units(histories, robot):
    assert check_ranges(scaled(histories, "speed_mm_s", 1 / 150), robot) == []
    early = histories.where(histories["time_s"] < 0.011)
    assert check_ranges(early, robot) == []


@pytest.mark.parametrize("factor, is_said", [(3.0, True), (1 / 3.0, True), (1.7, False)])
def test_smaller_factors_are_said_and_not_refused(runs, factor, is_said, robot):
    said = check_ranges(scaled(runs, "speed_mm_s", factor), robot)
    assert bool(said) == is_said and all(s.column == "speed_mm_s" and (s.factor > 1) == (factor > 1) for s in said)


def test_a_factor_that_all_speeds_share_points_to_the_voltage(runs, robot):
    half = scaled(scaled(runs, "speed_mm_s", 1 / 6.5), "motor_speed_rpm", 1 / 6.5)
    with refused(r"; the same factor in speed_mm_s: check supply_voltage_V and the robot's file"):
        check_ranges(half, robot)


def test_friction_that_nobody_has_measured_is_no_matter_of_units(runs, robot):
    # three times the friction, as of a robot file that another robot's friction was left in
    others = params.replace(
        robot,
        {
            f"{c}.track.loss_{k}": 3.0 * v
            for c in ("6T2A", "4W2T")
            for k, v in (("coulomb", 0.35), ("viscous", 0.016))
        },
    )
    assert check_ranges(runs, others) == []


@pytest.mark.parametrize("unit, of", [("radians", np.radians), ("percent", lambda a: 100 * np.tan(np.radians(a)))])
def test_slopes_in_other_units_are_said(runs, unit, of, robot):
    other = Runs("runs.csv", {**runs.columns, "slope_deg": of(runs["slope_deg"])})
    said = check_ranges(other, robot)
    assert any(s.code == "slopes_in" and s.unit == unit for s in said), said


def test_missing_channels_and_readings_pass(runs, robot):
    bare = {k: v for k, v in runs.columns.items() if "current" not in k}
    speed = runs["speed_mm_s"].copy()
    speed[::2] = np.nan
    assert check_ranges(Runs("runs.csv", {**bare, "speed_mm_s": speed}), robot) == []


@pytest.mark.parametrize("command", ["compare", "calibrate", "loop"])
def test_every_command_on_measured_runs_refuses(runs, command, tmp_path):
    text_file(tmp_path / "runs.csv", csv_text(scaled(runs, "speed_mm_s", 1e-3).columns))
    answer = mmrjax(tmp_path, command, "runs.csv", "--out", "x")
    assert answer.code == 4 and "are they in m/s? expected mm/s" in answer.err
    assert len(answer.err.strip().splitlines()) == 1 and not (tmp_path / "x").exists()
