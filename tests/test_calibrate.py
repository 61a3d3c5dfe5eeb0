"""A calibration from table to result, and every way in which data can be unfit for one."""

import csv
import dataclasses
import json
import math

import numpy as np
import pytest

from calibration.data import robot_file
from calibration.inference import noise
from calibration.data import runs as records
from calibration.data.errors import BadConfiguration, BadData
from calibration.inference import result as outcome
from calibration.inference.calibrate import calibrate
from mmrjax import nominal
from mmrjax.fidelities.steady import steady_batch


@pytest.fixture(scope="module")
def measured():
    return records.read("measured")


@pytest.fixture(scope="module")
def found(measured):
    return calibrate(measured, nominal.nominal())


@pytest.fixture(scope="module")
def document(found):
    return outcome.document(found)


def changed(runs, **columns):
    return dataclasses.replace(runs, columns={**runs.columns, **columns})


def quick(runs, **keywords):
    """Only what is wrong with the data matters: few starts, no profiles, no blocks."""
    return calibrate(runs, nominal.nominal(), starts=2, profiles=False, blocks=(), **keywords)


def test_packaged_data_calibrate_and_the_report_says_what_it_must(found, document):
    assert found.converged and document["optimizer"]["agreement"] == "all 64 starts end at the same optimum"
    assert found.starts.infeasible > 0  # nominal adhesion among them
    assert set(document["parameters"]) == {*found.identifiability.names} and len(document["parameters"]) == 11
    for entry in document["parameters"].values():
        low, high = entry["interval"]
        assert low <= entry["value"] <= high and entry["sd"] > 0 and entry["unit"]
        assert {"prior", "held_by_prior", "shift_in_prior_sd"} <= set(entry)
    for when in ("before", "after"):
        for what in ("fitted", "held_out"):
            for channel in records.CHANNELS:
                assert {"rms_percent", "max_percent", "rms_sigma"} <= set(document["errors"][when][what][channel])
    assert set(document["held_out_by"]) == {"slope", "voltage", "payload", "configuration", "voltage_configuration"}
    text = " ".join(document["notes"])
    assert "estimated from the misfit" in text and "only their product acts" in text
    assert not document["chi2"]["tests_adequacy"]


def test_packaged_data_figures_are_what_they_were(document):
    """rms of (35) on the 20 rows, friction only, datasheet electrics, masses as printed: docs/benchmarks.md."""
    after = document["errors"]["after"]["fitted"]
    assert after["total_current"]["rms_percent"] == pytest.approx(9.1, abs=0.1)
    assert after["motor_speed"]["rms_percent"] == pytest.approx(5.6, abs=0.1)
    assert after["speed"]["rms_percent"] == pytest.approx(3.7, abs=0.1)
    assert document["held_out_by"]["slope"]["unreachable_rows"] == [5, 10, 15, 20]


def test_estimated_noise_is_that_of_the_misfit(found):
    error = (found.after - found.runs.measured()) / found.sd
    freedom = len(found.runs) - found.identifiability.leverage.sum(0)
    np.testing.assert_allclose((error**2).sum(0), freedom, rtol=0.01)


def test_calibrated_robot_reaches_every_row_and_is_a_robot_file(found, measured, tmp_path):
    robot_file.write(found.robot, tmp_path / "robot.toml")
    again = robot_file.read(tmp_path / "robot.toml")
    answer = steady_batch(again, measured.command())
    np.testing.assert_array_equal(answer.status, 0)
    np.testing.assert_allclose(answer.reading.speed, found.after[:, 2], rtol=1e-9)


def test_rows_table_has_every_row(found):
    table = outcome.rows_table(found)
    assert all(len(column) == 20 for column in table.values())
    np.testing.assert_allclose(table["after_speed_mm_s"], found.after[:, 2] * 1e3)


def test_stated_noise_comes_before_columns_and_columns_before_estimates(measured):
    with_sd = changed(measured, total_current_sd_A=np.full(20, 0.05), speed_sd_mm_s=np.full(20, 4.0))
    made = noise.of(with_sd, "current=2%")
    assert made.source == ("stated", "estimated", "columns") and made.estimated.tolist() == [False, True, False]
    np.testing.assert_allclose(made.sd[:, 0], 0.02 * measured["total_current_A"])
    np.testing.assert_allclose(made.sd[:, 2], 4e-3)
    assert noise.of(measured, "motor_speed=30rpm").sd[0, 1] == pytest.approx(math.pi)


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("amps=2%", "--noise amps=2%: no such channel; .*allowed: current, motor_speed, speed"),
        ("current=2", "--noise current=2: expected a positive number with % or A, e.g. current=2%"),
        ("speed=-1%", "expected a positive number"),
        ("speed=5rpm", "with % or mm/s"),
    ],
)
def test_noise_refuses(text, says):
    with pytest.raises(BadConfiguration, match=says):
        noise.parse(text)


def test_too_few_rows_are_refused(measured):
    two = measured.where(np.array([0, 5]))
    with pytest.raises(
        BadData, match=r"2 rows of 3 channels cannot fit 6 parameters and estimate 3 noise levels; at least 4"
    ):
        quick(two)
    with pytest.raises(BadData, match=r"1 rows of 3 channels cannot fit 6 parameters; at least 2 rows"):
        quick(measured.where(np.array([0])), noise="current=2%,motor_speed=1%,speed=1%")


@pytest.mark.slow
def test_a_configuration_without_rows_is_refused_where_named_and_left_out_where_not(measured):
    tracked = measured.where(measured["configuration"] == "6T2A")
    with pytest.raises(
        BadConfiguration, match=r"--free wheeled.mass: measured has no 4W2T rows, so nothing measures it"
    ):
        quick(tracked, free=["default", "4W2T.mass"])
    names = quick(tracked).identifiability.names
    assert names and all(n.startswith("tracked.") for n in names)


def test_a_stuck_channel_is_refused(measured):
    with pytest.raises(BadData, match=r"measured, motor_speed_rpm: 5000 in every row although the conditions vary"):
        quick(changed(measured, motor_speed_rpm=np.full(20, 5000.0)))


@pytest.mark.slow
def test_a_constant_condition_is_said(measured):
    flat = measured.where((measured["slope_deg"] == 10) | (measured["slope_deg"] == 5))
    level = changed(flat, slope_deg=np.full(8, 5.0), supply_voltage_V=flat["supply_voltage_V"])
    notes = quick(level.where(np.arange(8) % 2 == 0), noise="current=30%,motor_speed=9%,speed=9%").notes
    assert any(n.startswith("slope_deg is 5 in every row: rolling resistance") for n in notes)


def test_contradictory_replicates_are_refused(measured):
    twice = measured.where(np.r_[0:20, 3])
    current = twice["total_current_A"].copy()
    current[20] = 5.2
    other = changed(twice, total_current_A=current)
    with pytest.raises(
        BadData, match=r"rows 4 and 21, total_current_A: the same conditions gave 3.45 and 5.2, 40% apart"
    ):
        quick(other)
    with pytest.raises(
        BadData, match=r"rows 4 and 21, .*, 14 sd apart; remove the wrong one or state a larger --noise"
    ):
        quick(other, noise="current=2%,motor_speed=1%,speed=1%")


def test_samples_of_one_run_under_two_conditions_are_refused(measured):
    with pytest.raises(BadData, match=r"supply_voltage_V: run \(no run_id\) has several values"):
        quick(changed(measured, time_s=np.arange(20.0), configuration=np.full(20, "6T2A")), model="drive")


def test_histories_need_drive(measured):
    with pytest.raises(
        BadConfiguration, match="--model steady: measured holds time histories; they need --model drive"
    ):
        quick(changed(measured, time_s=np.arange(20.0), configuration=np.full(20, "6T2A"),
                      supply_voltage_V=np.full(20, 15.0), slope_deg=np.zeros(20), total_mass_kg=np.full(20, 13.1),
                      payload_kg=np.zeros(20)))  # fmt: skip


def test_unknown_fidelity_lists_the_choices(measured):
    with pytest.raises(BadConfiguration, match=r"--model trak: no such fidelity; .*allowed: steady, drive"):
        quick(measured, model="trak")


def test_a_parameter_that_nothing_measures_is_said_with_what_would(measured):
    made = quick(measured, free=["default", "motor.inductance", "6T2A.mass"])
    said = " ".join(made.notes)
    assert "motor.inductance: nothing in these data measures it" in said and "start-up current" in said
    assert "6T2A.mass: nothing in these data measures it" in said and "a scale" in said
    entry = outcome.parameters(made)["motor.inductance"]
    assert entry["held_by_prior"] and not entry["measured_by_data"]
    assert entry["variance_ratio"] == pytest.approx(1.0)


def test_infeasible_starts_are_refused_with_the_rows(measured):
    says = r"no start is feasible: measured rows 5, 10 were measured in steady travel, but the model slides there"
    with pytest.raises(
        BadConfiguration, match=says + r".*tracked.ground.friction.static = 0.32 .*free it, or raise it"
    ):
        quick(measured, fix=["6T2A.ground.friction.static"])


@pytest.mark.slow
def test_drive_reads_settled_rows_rolling_and_agrees_with_steady(measured):
    """Among them one on which the calibrated robot could not start: docs/benchmarks.md."""
    rows = measured.where(np.array([1, 3, 4]))
    free = ["6T2A.ground.friction.static", "6T2A.track.guide_share"]
    made = quick(rows, model="drive", free=free, noise="current=10%,motor_speed=6%,speed=4%")
    assert made.converged and made.starts.agree == 2 and (made.status_after == 0).all()
    assert made.adhesion_used[2] > 0.9
    for entry in outcome.parameters(made).values():
        assert abs(entry["with_steady"]["apart_in_sd"]) < 0.01
    assert any(note.startswith("rows 3: read from a rolling start; from standstill") for note in made.notes)


def rows_of(path):
    with path.open(newline="") as stream:
        return list(csv.DictReader(stream))


def test_the_command_leaves_a_folder_that_other_commands_take(tmp_path, monkeypatch, capsys):
    import sys

    from sweeps import cli

    monkeypatch.chdir(tmp_path)

    def mmrjax(*arguments):
        monkeypatch.setattr(sys, "argv", ["mmrjax", *arguments])
        with pytest.raises(SystemExit) as end:
            cli.main()
        out = capsys.readouterr()
        return end.value.code, out.out, out.err

    code, out, err = mmrjax("calibrate", "measured", "--starts", "4", "--no-profiles", "--out", "c")
    assert code == 0 and err == "" and out.rstrip().splitlines()[-1] == "c"
    result = json.loads((tmp_path / "c" / "result.json").read_text())
    assert result["schema"] == "mmrjax.calibrate/1" and result["optimizer"]["status"] == "converged"
    assert len(rows_of(tmp_path / "c" / "rows.csv")) == 20
    page = (tmp_path / "c" / "report.html").read_text()
    assert "http://" not in page.replace("http://www.w3.org", "") and "6T2A.track.guide_share" in page
    code, out, _ = mmrjax("compare", "measured", "--robot", "c/robot.toml", "--no-report", "--out", "d")
    assert code == 0
    errors = json.loads((tmp_path / "d" / "result.json").read_text())["errors"]["all"]
    for channel in records.CHANNELS:
        fitted = result["errors"]["after"]["fitted"][channel]["rms_percent"]
        assert errors[channel]["rms_percent"] == pytest.approx(fitted, rel=1e-6)
    code, _, err = mmrjax("calibrate", "measured", "--free", "tracked.mu")
    assert code == 2 and "--free tracked.mu: no such parameter" in err
    code, _, err = mmrjax("calibrate", "nowhere.csv")
    assert code == 4 and "no such file" in err
