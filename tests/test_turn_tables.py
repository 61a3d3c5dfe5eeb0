"""Tables of turns: what they may state of either side, and every way in which that can be wrong."""

import functools

import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

import mmrjax as mm
from calibration.data import runs as records
from calibration.data.inferred_facts import with_inferred_instruments
from calibration.data.input_errors import BadData
from calibration.inference.ranges import check_ranges
from mmrjax.model import balances
from mmrjax.model.quantities import RPM
from mmrjax.model.signals import State
from sweeps.inputs import read_runs
from tests.commands import read_rig, read_table, refused, text_file

#: A robot on four wheels whose sides' speeds are imposed; the numbers are nobody's.
KINEMATIC = """
base = "none"
sides = 2
imposed = "motor_speed"
channels = ["motor_current_left", "motor_current_right", "yaw_rate"]
[motor]
torque_constant = "0.044 ± 5 %"
friction_coulomb = "0.05 ± 50 %"
[gearbox]
ratio = 78.0
efficiency_load = "0.7 ± 20 %"
[rover]
load = "vehicle"
movers = "wheels"
mass = 50.0
radius = 0.165
[rover.ground]
rolling_resistance = "0.03 ± 50 %"
[rover.ground.friction]
static = "0.6 ± 50 %"
speed_static = "0.04 ± 100 %"
[rover.turning]
width = "0.555 ± 5 %"
lateral = "0.7 ± 50 %"
inertia = 3.0
[running_gear]
wheelbase = 0.512
"""
#: The same, its voltage imposed and its motors' speeds read.
DRIVEN = (
    KINEMATIC.replace('imposed = "motor_speed"\n', "")
    .replace('channels = ["motor_current', 'channels = ["motor_speed_left", "motor_speed_right", "motor_current')
    .replace("[motor]", "[motor]\nresistance = 0.5")
)
SPEEDS = "motor_speed_left_rpm,motor_speed_right_rpm"
READ = "motor_current_left_A,motor_current_right_A,yaw_rate_rad_s"


@pytest.fixture
def rig(tmp_path):
    """Reads a robot's file, then a table of its runs."""

    return functools.partial(read_rig, tmp_path)


@pytest.fixture
def table(tmp_path):
    def written(header, *rows, robot):
        return read_table(
            tmp_path, "\n".join([header, *(",".join(map(str, row)) for row in rows)]) + "\n", robot, "turns.csv"
        )

    return written


#: Speeds of left and right, currents and yaw rate that can be true of one robot.
SOUND = (
    (1000, 2000, -3.0, 9.0, 0.3), (2000, 1000, 9.0, -3.0, -0.3), (1500, 1500, 2.0, 2.0, 0.0),
    (-1500, 1500, -8.0, 8.0, 0.9), (1500, -1500, 8.0, -8.0, -0.9), (0, 1500, -2.0, 8.0, 0.4),
)  # fmt: skip


def test_speeds_of_both_sides_are_conditions(rig, table):
    robot = rig(KINEMATIC)
    runs = table(f"{SPEEDS},{READ}", *SOUND, robot=robot)
    assert runs.turns and runs.axes[:1] == ("motor_speed_rpm",) and set(SPEEDS.split(",")) < set(runs.axes)
    conditions = runs.conditions(robot)
    assert_allclose(conditions.motor_speed_left, RPM * np.array([row[0] for row in SOUND]))
    assert_allclose(conditions.motor_speed_right, RPM * np.array([row[1] for row in SOUND]))
    assert conditions.turns and conditions.duty_left is None


def test_a_table_of_turns_with_channels_of_turns_alone_is_answered_by_the_line_to_write(tmp_path, rig):
    path = tmp_path / "turns.csv"
    with pytest.raises(BadData, match=r"yaw_rate_rad_s: set channels = ") as said:
        records.read_runs(
            text_file(
                path,
                "configuration,supply_voltage_V,total_mass_kg,payload_kg,slope_deg,duty_left,duty_right,yaw_rate_rad_s\n"
                + "6T2A,33,13.1,0,0,1,0.4,-1.1\n" * 3,
            ),
            robot=rig('base = "nominal"'),
        )
    line = said.value.args[0].rpartition("set ")[2].partition(" in ")[0]
    robot = rig(f'base = "nominal"\n{line}')
    assert [c.name for c in records.read_runs(path, robot=robot).channels] == ["yaw_rate"]


def test_a_table_of_turns_is_read_once_with_the_channels_of_turns_that_it_has(tmp_path, monkeypatch, robot):
    path, reads = tmp_path / "turns.csv", []
    read = records.read_runs
    monkeypatch.setattr(records, "read_runs", lambda *told, **how: reads.append(told) or read(*told, **how))
    header = "configuration,voltage_left_V,voltage_right_V,total_mass_kg,payload_kg,slope_deg"
    runs = read_runs(
        text_file(path, f"{header},yaw_rate_rad_s,motor_current_left_A\n" + "6T2A,24,12,13.1,0,0,-1.1,2\n" * 2),
        robot,
        measured=True,
        of_turns=True,
    )
    assert len(reads) == 1 and not runs.unknown
    assert [c.name for c in runs.channels] == [
        "total_current", "motor_speed", "speed", "motor_current_left", "yaw_rate"
    ]  # fmt: skip
    assert read_runs(
        text_file(
            tmp_path / "straight.csv",
            f"{header.replace('voltage_left_V,voltage_right_V', 'supply_voltage_V')},yaw_rate_rad_s,speed_mm_s"
            "\n6T2A,24,13.1,0,0,0,700\n",
        ),
        robot,
        measured=True,
        of_turns=True,
    ).unknown == ("yaw_rate_rad_s",)


#: Of SOUND, at 0.012 V/rpm.
VOLTS = [(0.012 * row[0], 0.012 * row[1], *row) for row in SOUND]


def test_voltages_of_both_sides_are_shares_of_the_larger_or_of_the_supply(rig, table):
    robot = rig(DRIVEN)
    runs = table(f"voltage_left_V,voltage_right_V,{SPEEDS},{READ}", *VOLTS, robot=robot)
    volts = np.array(VOLTS)[:, :2]
    supply = np.abs(volts).max(1)
    assert_allclose(runs["supply_voltage_V"], supply)
    duties = np.stack([runs["duty_left"], runs["duty_right"]], 1)
    assert_allclose(duties, volts / supply[:, None])
    assert np.abs(duties).max() == 1.0 and runs.turns and not runs.has("voltage_left_V")
    assert any("voltage_left_V and voltage_right_V are read as duty_left" in n for n in runs.notes)
    rows = [(-24, *row) for row in VOLTS]
    stated = table(f"supply_voltage_V,voltage_left_V,voltage_right_V,{SPEEDS},{READ}", *rows, robot=robot)
    assert_allclose(stated["duty_left"], volts[:, 0] / -24)
    assert (stated["supply_voltage_V"] == -24).all()
    renamed = rig(DRIVEN.replace("[motor]", '[columns]\nvoltage_left_V = "Ul"\nvoltage_right_V = "Ur"\n[motor]', 1))
    theirs = table(f"Ul,Ur,{SPEEDS},{READ}", *VOLTS, robot=renamed)
    assert_array_equal(theirs["duty_right"], runs["duty_right"])


def test_a_supply_of_either_sign_drives_the_sides(rig, table):
    """Shares of a negative voltage drive backward where they are positive."""
    robot, header = rig(DRIVEN), f"supply_voltage_V,duty_left,duty_right,{SPEEDS},{READ}"
    rows = [(-24, -a / 2000, -b / 2000, a, b, abs(i), abs(k), w) for a, b, i, k, w in SOUND * 2]
    unsigned = table(header, *rows, robot=robot)
    assert_allclose(unsigned.of_sides[0], [0.012 * a for a, *_ in SOUND * 2])
    assert [i.channel for i in unsigned.layout.instruments] == ["motor_current_left", "motor_current_right"]
    with refused(r"got -1500 and 1500 although the left and right sides are driven at 18 and -18 V"):
        table(header, *[(24, *row[1:]) for row in rows], robot=robot)


def test_the_packaged_robot_turns_by_voltages_of_its_sides_without_a_supply(tmp_path, robot):
    path = tmp_path / "turns.csv"
    header = "configuration,total_mass_kg,payload_kg,slope_deg,voltage_left_mV,voltage_right_mV"
    runs = records.read_runs(
        text_file(path, f"{header}\n6T2A,13.1,0,0,6000,24000\n6T2A,13.1,0,0,-12000,12000\n"), measured=False
    )
    conditions = runs.conditions(robot)
    assert_allclose(conditions.voltage, [24.0, 12.0])
    assert_allclose(conditions.duty_left, [0.25, -1.0])
    with refused(r"voltage_left_V together with --battery, .* give duty_left and duty_right"):
        records.read_runs(path, measured=False, battery=True)


@pytest.mark.parametrize("row, zero", [((0, 1, 0.4), "supply_voltage_V"), ((24, 0, 0), "duty_left and duty_right")])
def test_a_turn_that_nothing_drives_is_left_out_with_a_note(rig, table, row, zero):
    header = f"supply_voltage_V,duty_left,duty_right,{SPEEDS}"
    found = table(header, (24, 0, 1, 0, 900), (*row, 0, 0), robot=rig(DRIVEN))
    assert len(found) == 1
    assert f"turns.csv: row 2 is left out, since nothing drives the motors ({zero} is 0). " in found.notes[0]


@pytest.mark.parametrize(
    "columns, name, factor",
    [("", "yaw_rate_deg_s", np.degrees(1)), ('[columns]\nyaw_rate_rad_s = {column = "w", factor = -1}\n', "w", -1)],
)
def test_yaw_rate_is_converted_and_turned_as_its_name_or_the_file_says(rig, table, columns, name, factor):
    robot = rig(KINEMATIC.replace("[motor]", f"{columns}[motor]", 1))
    runs = table(f"{SPEEDS},{name}", *[(a, b, factor * w) for a, b, _, _, w in SOUND], robot=robot)
    assert_allclose(runs["yaw_rate_rad_s"], [row[-1] for row in SOUND])


@pytest.mark.slow
def test_yaw_rate_in_degrees_under_another_name_is_refused(rig, table):
    robot = rig(KINEMATIC)
    rows = [(a, b, np.degrees((b - a) * RPM / 78 * 0.165 / 0.9)) for a, b, *_ in SOUND]
    with refused(r"yaw_rate_rad_s: .*deg/s"):
        check_ranges(table(f"{SPEEDS},yaw_rate_rad_s", *rows, robot=robot), robot)


def test_currents_without_sign_are_compared_as_magnitudes(rig, table):
    robot = rig(KINEMATIC)
    runs = table(f"{SPEEDS},{READ}", *[(a, b, abs(i), abs(k), w) for a, b, i, k, w in SOUND * 2], robot=robot)
    assert not robot.rig.instruments
    assert {i.channel: i.signed for i in with_inferred_instruments(robot, runs).rig.instruments} == {
        "motor_current_left": False, "motor_current_right": False,
    }  # fmt: skip
    assert any("magnitudes are compared" in note for note in runs.notes)
    signed = table(f"{SPEEDS},{READ}", *SOUND, robot=robot)
    assert with_inferred_instruments(robot, signed) is robot


def test_gearbox_loses_though_no_inertia_is_stated(rig):
    robot = rig(KINEMATIC)
    run = mm.Conditions("rover", motor_speed=100.0).resolved(robot)
    state = State(*(jnp.asarray(x) for x in (1.6, 100.0, 0.2, 0.0)))
    signals, _ = balances.settled_signals(robot, run, state, 1.0)
    assert signals.efficiency_load == pytest.approx(0.7)
    assert np.isfinite(float(signals.torque_output))
