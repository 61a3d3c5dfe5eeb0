"""A calibration from table to result, and every way in which data can be unfit for one."""

import json
import math
import time
from dataclasses import replace

import jax
import jax.numpy as jnp
import jsonschema
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from synthetic import calibrated

import calibration
from calibration.data import runs as records
from calibration.data.input_errors import BadConfiguration, BadData
from calibration.data.robot_file import load_robot, read_robot
from calibration.inference import observers
from calibration.inference import optimizers as fit
from calibration.inference.calibration import calibrate
from calibration.inference.fit_notes import Remark
from calibration.inference.noise import noise_from_table, parse_noise
from calibration.inference.observers import SettledRuns
from calibration.inference.priors import default_names, parameter_coordinates
from calibration.inference.result import HeldOutErrors
from calibration.inference.simulation_errors import relative_error, root_mean_square
from mmrjax.fidelities.steady import steady_batch
from mmrjax.model import channels
from mmrjax.model.paper_robots import nominal
from sweeps.report.calibration_report import calibration_document
from sweeps.report.terminal_renderer import print_document
from tests.commands import read_json, schema_of
from tests.commands import rows as rows_of

SCHEMA = schema_of("calibrate")


@pytest.fixture(scope="module")
def measured():
    return records.read_runs("measured")


@pytest.fixture(scope="module", params=["few starts", pytest.param("all of it", marks=pytest.mark.slow)])
def found(request, measured):
    """Of the packaged table: as quick as it goes, and as the command does it."""
    return calibrated() if request.param == "few starts" else calibrate(measured, nominal())


@pytest.fixture(scope="module")
def document(found):
    return found.to_json()


def changed(runs, **columns):
    return replace(runs, columns={**runs.columns, **columns})


STATED = "current=2%,motor_speed=1%,speed=1%"


def quick(runs, robot=None, **keywords):
    """Only what is wrong with the data matters: few starts, no profiles, no blocks."""
    return calibrate(runs, robot or nominal(), **{"starts": 2, "profiles": False, "blocks": (), **keywords})


def noise_of(runs, stated=STATED):
    return noise_from_table(runs, observers.observer_kind(runs).sizes(runs), stated)


def repeated(measured, current):
    """The table with its fourth row once more, at another current."""
    twice = measured.where(np.r_[0:20, 3])
    return changed(twice, total_current_A=np.append(measured["total_current_A"], current))


def test_packaged_data_figures_are_what_they_were(found, document):
    """rms of (35) on the 20 rows, friction only, datasheet electrics, masses as printed: docs/lab/figures.md."""
    for name, rms in {"total_current": 9.1, "motor_speed": 5.6, "speed": 3.7}.items():
        r = found.readings[name]
        assert root_mean_square(relative_error(r.after, r.measured)) == pytest.approx(rms, abs=0.1)
        of_size = np.sqrt(np.nanmean((r.after - r.measured) ** 2) / np.nanmean(r.measured**2))
        assert document["errors"]["after"]["fitted"][name]["rms_percent"] == pytest.approx(100 * of_size)
    assert found.converged and len(document["parameters"]) == 11
    assert not found.held_out or document["held_out_by"]["slope"]["unreachable_rows"] == [5, 10, 15, 20]


def test_estimated_noise_is_that_of_the_misfit(found):
    leverage = dict(zip(channels.USUAL, found.identifiability.leverage.sum(0), strict=True))
    for name, readings in found.readings.items():
        assert np.sum(readings.sigma**2) == pytest.approx(len(found) - leverage[name], rel=0.01)
    left = 3 * len(found) - sum(leverage.values())
    assert found.chi_square.degrees_of_freedom == pytest.approx(left)
    assert found.chi_square.value == pytest.approx(left, rel=0.01) and not found.chi_square.tests_adequacy


def test_saved_result_has_a_robot_that_reaches_every_row(found, measured, tmp_path):
    found.save(tmp_path / "fitted")
    files = ["posterior.nc", "result.json", "robot.toml", "rows.csv"]
    assert sorted(p.name for p in (tmp_path / "fitted").iterdir()) == files
    jsonschema.validate(read_json(tmp_path / "fitted/result.json"), SCHEMA)
    again = read_robot(tmp_path / "fitted/robot.toml")
    answer = steady_batch(again, measured.conditions(again))
    assert_array_equal(answer.status, 0)
    assert_allclose(answer.speed, found.readings["speed"].after, rtol=1e-9)
    table = rows_of(tmp_path / "fitted/rows.csv")
    assert len(table) == 20 and table[0]["status"] == "converged"
    assert_allclose(float(table[3]["after_speed_mm_s"]), 1e3 * found.readings["speed"].after[3], rtol=1e-8)


def test_blocks_equal_to_other_blocks_are_reported_and_not_shown(found, capsys):
    """Three identical rows of the table were once printed without a word."""
    reading = {name: r.after for name, r in found.readings.items()}
    other = {name: r.after + 0.02 * r.sd for name, r in found.readings.items()}
    held = [HeldOutErrors(found.errors_after, (), {}, x) for x in (reading, other, reading, reading)]
    kinds = ("voltage_configuration", "slope", "voltage", "payload")
    found = replace(found, held_out=dict(zip(kinds, held, strict=True)))
    assert found.held_out_alike == {"voltage_configuration": ("voltage", "payload"), "slope": ()}
    print_document(calibration_document(found, "nominal"))
    shown = capsys.readouterr().out
    table = [line for line in shown.splitlines() if line.startswith("after, held out")]
    assert [" by slope " in line or " by voltage and configuration " in line for line in table] == [True, True]


def test_stated_noise_comes_before_columns_and_columns_before_estimates(measured):
    made = noise_of(
        changed(measured, total_current_sd_A=np.full(20, 0.05), speed_sd_mm_s=np.full(20, 4.0)), "current=2%"
    )
    assert made.source == ("stated", "estimated", "columns") and made.estimated.tolist() == [False, True, False]
    current = measured["total_current_A"]
    assert_allclose(made.sd[:, 0], 0.02 * np.maximum(current, np.sqrt(np.mean(current**2)) / 5))
    assert_allclose(made.sd[:, 2], 4e-3)
    assert noise_of(measured, "motor_speed=30rpm").sd[0, 1] == pytest.approx(math.pi)


def test_noise_is_in_any_unit_of_its_channel():
    shown = tuple(channels.find_channel(name) for name in ("total_current", "yaw_rate"))
    found = parse_noise("current=40mA,yaw_rate=0.6deg/s", shown)
    assert found == {0: (pytest.approx(0.04), False), 1: (pytest.approx(np.radians(0.6)), False)}


@pytest.mark.parametrize("rows, noise, says", [
    ([0, 5], None, "2 rows of 3 channels cannot fit 6 parameters and estimate 3 noise levels; at least 4"),
    ([0], STATED, "1 row of 3 channels cannot fit 6 parameters; at least 2 rows"),
])  # fmt: skip
def test_too_few_rows_are_refused(measured, rows, noise, says):
    with pytest.raises(BadData, match=says):
        quick(measured.where(np.array(rows)), noise=noise)


@pytest.mark.slow
def test_a_configuration_without_rows_is_refused_where_named_and_left_out_where_not(measured):
    tracked = measured.where(measured["configuration"] == "6T2A")
    with pytest.raises(
        BadConfiguration, match=r"--free 4W2T.mass: measured has no 4W2T rows, so nothing measures it"
    ):
        quick(tracked, free=["default", "4W2T.mass"])
    names = quick(tracked).parameters
    assert names and all(n.startswith("6T2A.") for n in names)


@pytest.mark.parametrize("stated, apart", [(None, "40%"), (STATED, "14 sd")])
def test_repeats_that_differ_are_reported_without_an_error(measured, stated, apart):
    other = repeated(measured, 5.2)
    (note,) = SettledRuns.check(other, noise_of(other, stated))
    assert note == Remark(
        "repeats", source=other.source, rows=(4, 21), column="total_current_A", values=(3.45, 5.2), apart=apart,
        unused=(), more=0, near="",
    )  # fmt: skip


def test_repeats_are_not_measured_by_noise_that_is_their_own_scatter(measured):
    """A current 12 % apart, of which noise estimated along series makes 3 sd: six of a usual ammeter's are 17 %."""
    for factor, said in ((1.12, []), (1.3, ["26%"])):
        other = repeated(measured, factor * measured["total_current_A"][3])
        known = noise_of(other, "current=6%,motor_speed=1%,speed=1%")
        assert SettledRuns.check(other, known) == []
        known = replace(known, source=("series", *known.source[1:]))
        assert [note.apart for note in SettledRuns.check(other, known)] == said


def test_a_column_that_varies_where_no_condition_does_is_named(measured):
    alike = changed(measured.where(np.zeros(6, int)), motor_speed_rpm=np.linspace(4000.0, 5000.0, 6))
    dyno = replace(alike, extras={"torque_mNm": np.arange(6.0), "who": np.array(list("abcdef"))})
    with pytest.raises(BadData, match=r". torque_mNm varies from row to row and is not used. .*; no condition"):
        SettledRuns.check(dyno, noise_of(dyno))


def test_thousands_of_rows_are_compared_at_once(measured):
    long = measured.where(np.tile(np.arange(20), 250))
    long = changed(long, payload_kg=long["payload_kg"] + 1e-3 * np.arange(5000))  # no two alike but by the last
    long.columns["payload_kg"][-1] = long["payload_kg"][19]
    known, began = noise_of(long), time.monotonic()
    assert SettledRuns.check(long, known) == []
    long.columns["speed_mm_s"][-1] *= 2
    assert [note.rows for note in SettledRuns.check(long, known)] == [(20, 5000)]
    assert time.monotonic() - began < 5.0  # of all pairs: minutes


@pytest.mark.slow
def test_a_parameter_that_no_reading_determines_is_reported_with_readings_that_would(measured):
    made = quick(measured, free=["default", "motor.inductance", "6T2A.mass"])
    assert {Remark("unmeasured", name=name) for name in ("motor.inductance", "6T2A.mass")} <= {*made.remarks}
    entry = made.parameters["motor.inductance"]
    assert entry.held_by_prior and not entry.measured_by_data
    assert entry.variance_ratio == pytest.approx(1.0)


@pytest.mark.slow
def test_infeasible_starts_are_refused_with_the_rows(measured):
    says = r"no start is feasible: measured rows 5, 10 were steady, but the model slides there"
    with pytest.raises(BadConfiguration, match=says + r".*6T2A.ground.friction.static = 0.32 .*free it, or raise it"):
        quick(measured, fix=["6T2A.ground.friction.static"])


@pytest.mark.nightly
def test_drive_reads_settled_rows_rolling_and_agrees_with_steady(measured):
    """Among them one on which the calibrated robot could not start: docs/lab/figures.md."""
    rows = measured.where(np.array([1, 3, 4]))
    free = ["6T2A.ground.friction.static", "6T2A.track.guide_share"]
    made = quick(rows, model="drive", free=free, noise="current=10%,motor_speed=6%,speed=4%")
    assert made.converged and made.starts.agree == 2 and (made.status == "converged").all()
    assert made.adhesion_used[2] > 0.9
    assert all(abs(p.with_steady.apart_in_sd) < 0.01 for p in made.parameters.values())
    jsonschema.validate(made.to_json(), SCHEMA)
    assert any(note.startswith("rows 3: computed from a rolling start. From standstill") for note in made.notes)


# --- missing readings -----------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def gaps(measured):
    """The table without motor speed, and without two readings of the current."""
    current = measured["total_current_A"].copy()
    current[[2, 7]] = np.nan
    columns = {k: v for k, v in measured.columns.items() if k != "motor_speed_rpm"}
    return replace(measured, columns={**columns, "total_current_A": current})


@pytest.fixture(scope="module")
def found_with_gaps(gaps):
    return calibrate(gaps, nominal(), starts=4, noise="current=9%", profiles=False, blocks=("slope",))


@pytest.mark.slow
def test_a_prediction_is_made_where_a_reading_is_missing(found_with_gaps):
    table = found_with_gaps.rows()
    assert np.isfinite(table["after_motor_speed_rpm"]).all() and np.isnan(table["motor_speed_rpm"]).all()
    assert np.isfinite(table["after_total_current_A"][2]) and np.isnan(table["error_total_current_sigma"][2])


def test_a_missing_reading_weighs_nothing_whatever_number_stands_in_its_place(gaps, robot):
    coordinates = parameter_coordinates(robot, default_names(["6T2A", "4W2T"], robot))
    posed = observers.pose_problem(gaps, robot, coordinates, noise_of(gaps, "current=9%,speed=4%").sd)
    starts = 0.3 * jnp.ones((5, len(coordinates)))  # as many as `found_with_gaps` compiled
    lost = jnp.isnan(gaps.measured())
    assert lost.sum() == 22
    one, other = (
        fit.search_starts(posed.with_data(measured=posed.data.measured + number * lost), starts)[0]
        for number in (0.0, 1e6)
    )
    for name in ("z", "sd", "cost"):
        assert_array_equal(getattr(one, name), getattr(other, name))


# --- other robots, another channel ----------------------------------------------------------------------

# --- from Python ------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_a_calibration_is_the_same_where_jax_is_single(measured):
    """Its threads are double too."""
    stated = {"noise": "current=9%,motor_speed=6%,speed=4%", "blocks": True}
    double = quick(measured, **stated)
    with jax.enable_x64(False):
        single = quick(measured, load_robot("nominal"), **stated)
        resistance = single.robot.motor.friction_coulomb
    assert isinstance(resistance, np.ndarray) and resistance == double.robot.motor.friction_coulomb
    assert json.dumps(single.to_json()) == json.dumps(double.to_json())


@pytest.mark.parametrize("name", ["calibrate", "discover"])
def test_a_fit_is_refused_inside_a_trace_in_single_precision(name, measured, robot):
    fit = getattr(calibration, name)
    with (
        jax.enable_x64(False),
        pytest.raises(BadConfiguration, match=f"{name}: called inside a JAX transformation"),
    ):
        jax.jit(lambda x: fit(measured, robot) and x)(1.0)
