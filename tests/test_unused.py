"""Columns that vary and are no conditions: found, with what each may be. A torque at the output that a brake sets."""

import numpy as np
import pytest
from test_load_torque import RIG as IDEAL

from calibration.data.columns import LOAD, Layout
from calibration.described import sentences
from calibration.discovery import verdict
from calibration.inference import noise
from calibration.inference.checks import unexplained_torque_notes, unused_notes
from calibration.inference.observers import SettledRuns
from tests.commands import csv_text, read_rig, read_table, refused

RIG = IDEAL.replace("loss_coulomb = 0.0", "loss_coulomb = 0.1")
#: Of an ideal motor at 24 V, R 0.5, k 0.05, M0 0.01: torque of a brake [N·m], speed [rpm], current [A].
TORQUE = np.array([0.0, 0.1, 0.2, 0.3, 0.4, 0.5])
CURRENT = (TORQUE + 0.01) / 0.05
SPEED = (24 - 0.5 * CURRENT) / 0.05 * 30 / np.pi


def table(tmp_path, head, **columns):
    """A table of six rows read for the rig with a line `head` in its file."""
    robot = read_rig(tmp_path, RIG.format(head=head))
    every = {"supply_voltage_V": np.full(6, 24.0), "motor_speed_rpm": SPEED, "motor_current_A": CURRENT, **columns}
    return read_table(tmp_path, csv_text(every), robot, "runs.csv")


CHANNELS = 'channels = ["motor_current", "motor_speed"]'


@pytest.mark.parametrize(
    "column, near",
    [
        ("brake_torque_Nm", "load_torque_Nm"),
        ("torque", "load_torque_Nm"),
        ("load_Nm", "load_torque_Nm"),
        ("Drehmoment_mNm", "load_torque_mNm"),  # the only condition in this unit
        ("room_C", ""),
        ("hold_s", ""),  # no table of settled runs lacks a time
        ("room", ""),
    ],
)
def test_a_column_is_likened_to_what_the_table_lacks(column, near):
    known = Layout(has_ground=False, inherits=False)
    assert known.nearest(column, {"supply_voltage_V"}) == near
    assert "load_torque" not in Layout(inherits=False).nearest(column, {"supply_voltage_V"})  # of a vehicle
    assert "load_torque" not in known.nearest(column, {"supply_voltage_V", LOAD})


def test_numbers_that_vary_and_have_no_role_are_said(tmp_path):
    counted = {"row_id": np.arange(6), "epoch": 1e9 + 7.0 * np.arange(6), "rig_no": np.full(6, 3)}
    runs = table(tmp_path, CHANNELS, brake_torque_Nm=TORQUE, **counted)
    (note,) = unused_notes(runs)
    assert note.columns == (("brake_torque_Nm", "load_torque_Nm"),)
    assert sentences((note,)) == (
        "runs.csv: brake_torque_Nm varies from row to row and is not used. If brake_torque_Nm is load_torque_Nm, set "
        '[columns] load_torque_Nm = "brake_torque_Nm" in the robot\'s file',
    )
    assert verdict.unused_inputs(runs) == ("brake_torque_Nm",)
    assert unused_notes(table(tmp_path, CHANNELS, load_torque_Nm=TORQUE)) == ()


def test_a_torque_that_no_load_gives_may_be_a_brakes(tmp_path):
    imposed = 'imposed = "motor_speed"\nchannels = ["motor_current", "output_torque"]'
    runs = table(tmp_path, imposed, output_torque_Nm=TORQUE)
    (note,) = unexplained_torque_notes(runs)
    assert note.share > 0.99 and verdict.unused_inputs(runs) == ("output_torque_Nm as a condition",)
    for friction in (0.3 + 1e-4 * SPEED, np.full(6, 0.3), 0.5 - 1e-9 * SPEED):
        assert unexplained_torque_notes(table(tmp_path, imposed, output_torque_Nm=friction)) == ()
    backward = table(tmp_path, imposed, motor_speed_rpm=-SPEED, motor_current_A=-CURRENT, output_torque_Nm=-TORQUE)
    assert unexplained_torque_notes(backward)


def test_readings_that_a_brake_explains_are_no_contradiction(tmp_path):
    """As a condition it tells rows apart, without it the message says how it becomes one."""

    def checked(runs):
        return SettledRuns.check(runs, noise.infer_noise(runs, SettledRuns.sizes(runs), None))

    runs = table(tmp_path, 'channels = ["motor_current", "motor_speed", "output_torque"]', output_torque_Nm=TORQUE)
    with refused(r'set \[columns\] load_torque_Nm = "output_torque_Nm"'):
        checked(runs)
    runs = table(tmp_path, f'{CHANNELS}\n[columns]\nload_torque_Nm = "output_torque_Nm"', output_torque_Nm=TORQUE)
    assert checked(runs) == [] and runs.axes == ("supply_voltage_V", LOAD)
