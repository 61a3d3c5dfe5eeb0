"""Calibrations, the loop, its campaigns and `rig check` prepare a table and a robot alike."""

import numpy as np
import pytest
from test_rig_histories import ARM, DRIVE, USUAL

from calibration.data import robot_file
from calibration.data import runs as records
from calibration.data.runs import Runs
from calibration.discovery import discover, loop_input
from calibration.inference.calibration import calibrate
from calibration.inference.foresight import predict_identifiability
from tests.commands import csv_text, read_table, refused, text_file

ALL = {
    "calibrate": lambda runs, robot: calibrate(runs, robot),
    "discover": lambda runs, robot: discover.discover(runs, robot),
    "a campaign": lambda runs, robot: loop_input.prepare_loop(runs, robot),
    "rig check": lambda runs, robot: predict_identifiability(runs, robot),
}


@pytest.mark.parametrize("who", ALL)
def test_a_table_whose_masses_have_another_unit_is_refused_by_all(who, robot):
    """`calibrate` took the table's mass for the robot's own before it compared the two, and fitted a robot of 79 kg.
    `rig check` compared nothing."""
    runs = records.read_runs("measured")
    runs = Runs("runs.csv", {**runs.columns, "total_mass_kg": 6 * runs["total_mass_kg"]})
    with refused(r"runs.csv, total_mass_kg: about 6\.2 times too large for this robot"):
        ALL[who](runs, robot)


@pytest.mark.slow
def test_a_campaign_sees_the_instruments_that_the_table_shows(tmp_path):
    """Signs and steps that a rig's file leaves to its table: campaigns left them open."""
    path = tmp_path / "rig.toml"
    text = DRIVE.format(channels='"total_current"', **USUAL)
    text += '[instruments.total_current]\nsigned = "free"\nquantum = "free"\n'
    robot = robot_file.load_robot(text_file(path, text + ARM))
    assert robot.rig.instruments[0].free
    volts = np.concatenate([np.linspace(-12, -4, 12), np.linspace(4, 12, 12)])
    current = np.round(0.3 + 0.01 * np.abs(volts), 2)
    columns = {"supply_voltage_V": volts, "total_current_A": current}
    given = loop_input.prepare_loop(
        read_table(
            tmp_path,
            csv_text(columns),
            robot,
            "table.csv",
        ),
        robot,
    )
    seen = given.robot.rig.instruments[0]
    assert seen.signed is False and seen.quantum == pytest.approx(0.01)
    assert given.noise.sd.min() >= 0.01 / 12**0.5  # with the error of the step
