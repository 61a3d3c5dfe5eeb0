"""What once gave plausible wrong answers: reverse, rollback, standing, charging, the battery's end, rated limits."""

import json

import jax
import numpy as np
import pytest

import mmrjax as api
from calibration.data import robot_file
from mmrjax.derived.start_figures import stages_of_start
from mmrjax.model import paper_robots, signals
from sweeps.pages import figure_style, history_figures, words
from sweeps.report import runs_report
from tests.commands import ends, read_json, read_rig
from tests.commands import rows as table


def test_the_words_name_the_same_statuses_as_the_codes():
    assert tuple(signals.STATUSES[k] for k in signals.DONE) == words.SETTLED
    assert tuple(words.STATUSES) == signals.STATUSES and tuple(words.FLAGS) == signals.FLAGS
    assert words.every_run_solved({"converged": 2, "slides": 4, "failed": 0}) and not words.every_run_solved(
        {"converged": 9, "failed": 1}
    )


DOWNHILL = "simulate --battery --configuration 4W2T --slope -20 --payload 8 --surface concrete --set battery.current_other=0 --no-report"


@pytest.mark.slow
@pytest.mark.parametrize(
    "model",
    [
        pytest.param((), id="steady"),
        pytest.param(("--model", "drive", "--duration", "20"), id="drive"),
    ],
)
def test_charging_above_the_charge_voltage_is_flagged_with_the_voltage_of_a_cell(mmrjax, tmp_path, model):
    _, out, _ = ends(mmrjax(DOWNHILL, *model, "--no-report", "--out", "a"), code=0)
    (row,) = table(tmp_path / "a/runs.csv")
    assert "overvoltage" in row["flags"].split(";") and float(row["total_current_A"]) < -0.5
    assert float(row["voltage_cell_V"]) == pytest.approx(float(row["voltage_V"]) / 8, rel=1e-6)
    assert float(row["voltage_cell_V"]) > 4.2 and row["supply_voltage_V"] == ""
    (note,) = read_json(tmp_path / "a/result.json")["notes"]
    assert note in " ".join(out.split()) and "A flow into the battery, a cell at 4." in note
    _, out, _ = ends(
        mmrjax(DOWNHILL, *model, "--set", "battery.voltage_charge=4.9", "--no-report", "--out", "b"), code=0
    )
    assert "overvoltage" not in out


def test_a_cell_has_no_voltage_on_the_external_supply(robot):
    found = api.simulate(robot, api.Conditions(0, 24.0, 0.0, battery=[0.0, 1.0]))
    assert (found.voltage_cell > 0).tolist() == [False, True]
    assert np.isnan(found.to_dict()["supply_voltage_V"]).tolist() == [False, True]


def test_a_winding_that_no_temperature_settles_says_so(mmrjax, tmp_path, robot):
    blocked = ("--configuration", "4W2T", "--slope", 20, "--payload", 200, "--surface", "concrete")
    ends(mmrjax("simulate", *blocked, "--out", "a"), "none settles", code=0)
    text = (tmp_path / "a/result.json").read_text()
    assert "Infinity" not in text and "NaN" not in text
    (row,) = table(tmp_path / "a/runs.csv")
    said = f"winding, long running: none settles at {float(row['total_current_A']) / 2:.2f} A per motor"
    notes = json.loads(text)["notes"]
    assert notes[1].startswith(said)
    time = float(row["permissible_time_s"])
    permissible = jax.jit(lambda current: robot.motor.time_permissible(current))
    assert time == pytest.approx(float(permissible(float(row["total_current_A"]) / 2)), rel=1e-4)
    assert notes[0].startswith(f"winding_hot: 125 °C are reached after {time:.3g} s at this current")
    assert row["winding_settled_C"] == "" and "winding_hot" in row["flags"]
    page = (tmp_path / "a/report.html").read_text()
    assert "none settles" in page and ">inf" not in page and "nan %" not in page


@pytest.mark.slow
def test_a_sweep_on_the_battery_has_no_axis_of_voltages(mmrjax, tmp_path):
    ends(mmrjax("sweep --battery --slopes 0,5 --payloads 0,8 --out a"), code=0)
    rows = table(tmp_path / "a/runs.csv")
    assert len(rows) == 2 * 2 * 2 and {row["supply_voltage_V"] for row in rows} == {""}
    assert len({row["total_current_A"] for row in rows}) == len(rows)
    page = (tmp_path / "a/report.html").read_text()
    assert "nan V" not in page and "6T2A, battery" in (tmp_path / "a/figures/sweep_speed.svg").read_text()
    resolved = tmp_path / "a/config.resolved.toml"
    assert "voltages_V" not in resolved.read_text()
    assert mmrjax("sweep --config", resolved, "--out", "b")[0] == 0  # what it left can be run again
    assert table(tmp_path / "b/runs.csv") == rows
    (tmp_path / "runs.csv").write_text("configuration,payload_kg,slope_deg\n6T2A,8,5\n")
    assert mmrjax("simulate --battery --runs runs.csv --out c")[0] == 0
    (row,) = table(tmp_path / "c/runs.csv")
    assert row["total_current_A"] in {r["total_current_A"] for r in rows}


@pytest.fixture(scope="module")
def climb():
    robot = paper_robots.nominal()
    return robot, api.simulate(robot, api.Conditions(0, [33.0, -33.0], [10.0, -10.0]), "drive", duration=5.0)


@pytest.mark.slow
def test_a_start_is_drawn_of_the_run_that_was_asked_for(climb):
    robot, found = climb
    heading = runs_report.run_headings(found.to_dict())
    assert heading == ["6T2A, 33 V, 0 kg, 10°", "6T2A, -33 V, 0 kg, -10°"]
    up, back = history_figures.start_runs(robot, found.history, np.asarray(found.status), [0, 0], heading)
    for k, start in enumerate((up, back)):
        assert start.end_values[0] == pytest.approx(abs(float(found.total_current[k])), rel=1e-6)
        assert start.end_values[1] == pytest.approx(1e3 * abs(float(found.speed[k])), rel=1e-6)
        assert start.gets_under_way and start.current.max() > 90
    assert (up.stages.sense, back.stages.sense) == (1.0, -1.0)  # the way back is drawn as the way there
    assert (*up.stages.bounds, up.stages.settled) == pytest.approx((*back.stages.bounds, back.stages.settled))
    flat = api.simulate(robot, api.Conditions(0, 33.0, 0.0), "drive", duration=5.0)
    assert up.end_values[0] > 1.2 * float(flat.total_current)


@pytest.mark.slow
def test_a_run_may_last_a_day(robot):
    found = api.simulate(robot, api.Conditions(0, 33.0), "drive", duration=86_400.0, history=False)
    assert found.statuses == "converged"


RATED = (
    "[gearbox]\ntorque_limit = 4.5\nmesh_theory = true\n[driver]\nreturns_current = false\ndecay = 'fast'\n[battery]\n"
    "voltage_charge = 4.25\nvoltage_cutoff = 3.2\ndelay_cutoff = 2.0\ncurrent_limit = 30\ncurrent_charge = 2\n"
)


def test_rated_limits_and_switches_are_read_and_written(tmp_path, robot):
    nominal = robot
    assert nominal.gearbox.torque_limit == pytest.approx(3.0 * 25 / 12)
    robot = read_rig(tmp_path, RATED, "mine.toml")
    assert (robot.gearbox.torque_limit, robot.gearbox.mesh_theory, robot.driver.returns_current) == (4.5, True, False)
    assert robot.driver.decay == "fast"
    battery = robot.battery
    assert (battery.voltage_charge, battery.voltage_cutoff, battery.delay_cutoff) == (4.25, 3.2, 2.0)
    assert (battery.current_limit, battery.current_charge) == (30.0, 2.0)
    for k, given in enumerate((robot, nominal)):
        robot_file.write_robot(given, tmp_path / f"{k}.toml")
        again = robot_file.read_robot(tmp_path / f"{k}.toml")
        assert (again.gearbox, again.driver, again.battery) == (given.gearbox, given.driver, given.battery)
    assert "current_limit = None" not in (tmp_path / "1.toml").read_text()


def test_rated_limits_stand_in_the_report(robot):
    found = api.simulate(robot, api.Conditions("6T2A", 33.0, 10.0, 8.0, battery=1.0))
    run = {name: np.atleast_1d(values)[0] for name, values in found.to_dict().items()}
    shown = {line["words"]: line for line in runs_report.limits_used(robot, run)}
    torque = shown["gearbox torque at the driving wheel"]
    wheel = float(found.theoretical_speed) / float(robot.configurations["6T2A"].radius)
    assert torque["limit"] == "6.25 N·m"
    assert torque["value"] == f"{float(found.power_gear) / 2 / wheel:.2f} N·m"
    assert shown["voltage of a cell, charged"]["limit"] == "4.20 V"


def test_a_run_without_current_is_drawn():
    """Nothing drives its motors: no scale of nothing."""
    time = np.linspace(0.0, 1.0, 30)
    stages = stages_of_start(time, *3 * [0 * time], 0.02)
    still = history_figures.StartRun("run 1", "6T2A", "stalled", stages, time, *3 * [0 * time])
    figure_style.figure_as_svg(history_figures.draw_starts([still]))
