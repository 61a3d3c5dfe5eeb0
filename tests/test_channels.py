"""Channels belong to a rig: its robot, the tables of its runs and every result carry theirs, and nothing else does."""

import itertools
import pickle
from concurrent.futures import ThreadPoolExecutor
from dataclasses import fields, replace
from types import SimpleNamespace

import jax
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

import calibration
import mmrjax as mm
from calibration.data.input_errors import BadData
from calibration.data.runs import Runs
from calibration.discovery.prediction import ReadingsOfRows
from calibration.discovery.result import DiscoveryResult
from calibration.inference import observers
from calibration.inference.estimates import condition_columns, readings_by_channel
from calibration.inference.noise import default_noise, infer_noise, noise_from_table
from calibration.inference.result import CalibrationResult
from mmrjax.model import channels, quantities
from tests.commands import csv_text, text_file

RIG = """base = "none"
sides = 1
configurations = ["brake"]
imposed = "voltage"
channels = {channels}
[motor]
resistance = "1.1 ± 10 %"
torque_constant = 0.03
friction_coulomb = 0.001
[gearbox]
ratio = 29
efficiency_load = "0.72 ± 6 %"
[brake]
load = "shaft"
inertia = 0.004
loss_coulomb = "0.3 ± 40 %"
loss_viscous = "0.002 ± 40 %"
"""
#: A rig that measures torque, and one that measures something else in each place of its arrays.
TORQUE, VOLTS = ("total_current", "motor_speed", "output_torque"), ("motor_speed", "output_speed", "motor_voltage")
VOLTAGES = np.repeat([4.0, 8.0, 12.0, 16.0, 20.0, 24.0], 2)
#: Newton metres that the instrument shows first; as millimetres a second it would be 61.29 e-3 of one.
FIRST = 0.06129


def rig(folder, shown):
    return calibration.read_robot(text_file(folder / "rig.toml", RIG.format(channels=list(shown)).replace("'", '"')))


def written(path, columns):
    return text_file(path, csv_text(columns))


def made_up(robot, unit=None):
    """Readings of every channel with their sds, told apart by their size. Of torque in another unit where asked."""
    found = {"supply_voltage_V": VOLTAGES}
    for k, c in enumerate(robot.channels):
        scale, column = 1.0, c.column
        if c.name == "output_torque" and unit is not None:
            scale, column = 1 / c.sizes[unit], f"output_torque_{unit}"
        found[column] = scale * (FIRST + k + np.arange(12.0))
        found[column.replace(c.name, f"{c.name}_sd")] = np.full(12, scale * 0.01 * (k + 1))
    return found


@pytest.fixture
def bench(tmp_path):
    return rig(tmp_path, TORQUE)


def calibrated(runs, robot):
    """A calibration's result of these runs, without the fit: what is written of readings is read from it."""
    observe, measured, sd = observers.observer_kind(runs).of(runs, robot), runs.measured(), runs.deviations()
    known = {
        "robot": robot, "channels": runs.channels, "held_out": {}, "conditions": condition_columns(type(observe), runs),
        "readings": readings_by_channel(runs.channels, measured, sd, measured, measured),
        "status": np.full(len(runs), "converged"),
    }  # fmt: skip
    return CalibrationResult(**{**dict.fromkeys(f.name for f in fields(CalibrationResult)), **known})


def discovered(runs):
    """The same of a discovery."""
    measured = runs.measured()
    shown = ReadingsOfRows(measured, runs.deviations(), measured, measured, measured, {}, {})
    known = {
        "runs": runs, "numbers": np.arange(1, len(runs) + 1), "outliers": (), "unusable": (),
        "readings_of_rows": shown, "detail": SimpleNamespace(columns=dict),
    }  # fmt: skip
    return DiscoveryResult(**{**dict.fromkeys(f.name for f in fields(DiscoveryResult)), **known})


# --- a robot, a table, a result


def test_a_robot_has_the_channels_of_its_rig(bench, robot):
    assert channels.channel_names(bench.channels) == TORQUE
    assert channels.channel_names(robot.channels) == channels.USUAL  # whatever was read before
    assert channels.channel_index("output_torque", bench.channels) == 2
    with pytest.raises(KeyError, match="no channel speed; there are total_current, motor_speed, output_torque"):
        channels.channel_index("speed", bench.channels)
    with pytest.raises(KeyError, match="no channel torque; there are total_current, "):
        channels.channels_named(("speed", "torque"))
    assert channels.channel_names(channels.channels_named(reversed(TORQUE))) == TORQUE  # in the order of the table
    assert pickle.loads(pickle.dumps(bench.channels)) == bench.channels and len({bench.channels, bench.channels}) == 1


@pytest.mark.parametrize("unit", [None, "mNm"])
def test_a_reading_keeps_its_column_and_size_from_file_to_result(tmp_path, bench, unit):
    runs = calibration.read_runs(written(tmp_path / "t.csv", made_up(bench, unit)), robot=bench)
    assert channels.channel_names(runs.channels) == TORQUE and runs.unknown == ()
    assert_allclose(runs.measured()[:, 2], FIRST + 2 + np.arange(12.0), rtol=1e-12)
    assert_allclose(runs.deviations()[:, 2], 0.03, rtol=1e-12)
    assert_allclose(runs.measured()[:, 1], (FIRST + 1 + np.arange(12.0)) * quantities.RPM, rtol=1e-12)
    for table in (calibrated(runs, bench).rows(), discovered(runs).rows_table()):
        assert "speed_mm_s" not in table
        for k, c in enumerate(bench.channels):
            for column in (c.column, f"before_{c.column}", f"after_{c.column}"):
                assert_allclose(table[column], FIRST + k + np.arange(12.0), rtol=1e-12)
            assert_allclose(table[c.sd_column], 0.01 * (k + 1), rtol=1e-12)


def test_noise_is_of_the_channels_of_a_table(tmp_path, bench):
    columns = {c: x for c, x in made_up(bench).items() if "_sd_" not in c}
    runs = calibration.read_runs(written(tmp_path / "t.csv", columns), robot=bench)
    sizes = observers.observer_kind(runs).sizes(runs)
    known = infer_noise(runs, sizes, "output_torque=0.05Nm")
    assert known.source == ("series", "series", "stated") and (known.sd[:, 2] == 0.05).all()
    assert default_noise(runs.channels) == "current=2%,motor_speed=0.5%,output_torque=1%"
    assert known.scaled({"output_torque": 2.0}).sd[0].tolist() == [*known.sd[0, :2], 0.1]
    with pytest.raises(calibration.data.input_errors.BadConfiguration, match="--noise speed=1%: no such channel"):
        noise_from_table(runs, sizes, "speed=1%")


def test_a_table_without_a_robot_has_every_channel_of_which_it_has_a_column(tmp_path, robot):
    usual = {
        "configuration": ["6T2A"] * 12,
        "total_mass_kg": [13.1] * 12,
        "payload_kg": [0] * 12,
        "slope_deg": [0] * 12,
    }
    columns = {**usual, "supply_voltage_V": VOLTAGES, "total_current_A": 1 + np.arange(12.0)}
    columns |= {"output_torque_mNm": 1e3 * (FIRST + np.arange(12.0)), "output_torque_sd_mNm": np.full(12, 10.0)}
    path = written(tmp_path / "t.csv", columns)
    runs = calibration.read_runs(path)
    assert channels.channel_names(runs.channels) == (*channels.USUAL, "output_torque") and runs.unknown == ()
    assert_allclose(runs.measured()[:, 3], FIRST + np.arange(12.0), rtol=1e-12)
    assert np.isnan(runs.measured()[:, 1:3]).all()
    # Of a robot without that channel, read so or used so, its columns are said to be left out.
    for left in (calibration.read_runs(path, robot=robot), runs.of(robot)):
        assert left.channels == channels.usual_channels() and not left.has("output_torque_Nm")
        assert len(left.unknown) == 2 and all(name.startswith("output_torque") for name in left.unknown)
        assert set(left.unknown) == set(left.extras)


def test_a_table_takes_the_channels_of_the_robot_that_it_is_used_with(tmp_path, bench):
    other = rig(tmp_path, ("total_current", "motor_speed"))
    path = written(tmp_path / "t.csv", made_up(bench))
    narrow = calibration.read_runs(path, robot=other)
    assert narrow.unknown == ("output_torque_Nm", "output_torque_sd_Nm")
    wide = calibration.read_runs(path, robot=bench)
    assert wide.of(bench) is wide and wide.of(other).channels == narrow.channels
    assert wide.of(other).unknown == narrow.unknown and wide.of(other).columns.keys() == narrow.columns.keys()
    assert_array_equal(wide.of(other).measured(), narrow.measured())
    with pytest.raises(
        BadData, match=r"t\.csv, output_torque_Nm: the table was read without this channel; .* with robot="
    ):
        narrow.of(bench)


def test_what_is_imposed_is_kept_though_it_is_no_channel(bench):
    imposed = replace(bench.rig, imposed="motor_speed", channels=("total_current",))
    robot = replace(bench, rig=imposed)
    columns = {"motor_speed_rpm": 100.0 * np.arange(1, 13), "total_current_A": np.arange(1.0, 13)}
    runs = Runs("made", {"configuration": np.full(12, "brake"), **columns})
    assert runs.of(robot).has("motor_speed_rpm") and runs.of(robot).channels == robot.channels


# --- one process, two rigs


def test_simulated_runs_have_the_columns_of_their_robot(bench):
    found = mm.simulate(bench, mm.Conditions(voltage=np.array([12.0, 24.0])))
    table = found.to_dict()
    assert table["output_torque_Nm"] == pytest.approx(np.asarray(found.reading["output_torque"]), rel=1e-12)
    assert "speed_mm_s" not in table and "output torque" in found.table() and "motor speed" in found.table()
    assert hash(found.channels) == hash(bench.channels)
    assert jax.jit(lambda x: x)(found).channels == bench.channels  # static


def read_by(robot, path):
    """All that a table says of its readings, as one robot's."""
    runs = calibration.read_runs(path, robot=robot)
    known = noise_from_table(runs, observers.observer_kind(runs).sizes(runs), None)
    rows = calibrated(runs, robot).rows()
    return (
        channels.channel_names(runs.channels),
        runs.measured(),
        known.sd,
        known.source,
        list(rows),
        list(rows.values()),
    )


def same(one, other):
    return all(np.array_equal(a, b) for a, b in zip(jax.tree.leaves(one), jax.tree.leaves(other), strict=True))


def test_two_rigs_in_turn_and_side_by_side_are_read_as_alone(tmp_path):
    cases = []
    for name, shown in (("a", TORQUE), ("b", VOLTS)):
        (tmp_path / name).mkdir()
        robot = rig(tmp_path / name, shown)
        path = written(tmp_path / name / "t.csv", made_up(robot))
        cases.append((robot, path, read_by(robot, path)))
    assert not same(cases[0][2][1], cases[1][2][1])
    in_turn = list(itertools.islice(itertools.cycle(cases), 6))
    assert all(same(read_by(robot, path), alone) for robot, path, alone in in_turn)
    with ThreadPoolExecutor(4) as pool:
        many = list(itertools.islice(itertools.cycle(cases), 40))
        found = list(pool.map(lambda case: read_by(*case[:2]), many))
    assert all(same(one, alone) for one, (_, _, alone) in zip(found, many, strict=True))


# --- with their fits
