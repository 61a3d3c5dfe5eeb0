"""The running gear in reports: Figs. 23-27 of the paper remade, and a run's own, out of the track model."""

import dataclasses
import re

import jax
import numpy as np
import pytest
from numpy.testing import assert_allclose

from calibration.data import runs as records
from calibration.data.robot_file import RobotFile
from mmrjax import fidelities
from mmrjax.model import params
from mmrjax.model.conditions import Conditions
from mmrjax.undercarriage.modes import largest_step
from sweeps.pages import resonance_figures
from sweeps.paper import report
from sweeps.points import run as simulation
from sweeps.report import page_renderer, runs_report

SECONDS = 0.9  # of a run; both configurations are under way after 0.5 s


def page(folder, robot):
    document, _ = report.paper_document(RobotFile(robot, "nominal"), gear=True)
    return page_renderer.write_report_page(folder, document).read_text(encoding="utf-8")


def drawn(text):
    return {name for name in re.findall(r'<figure id="([^"]+)">', text) if name.startswith("track_")}


@pytest.fixture(scope="module")
def written(robot, tmp_path_factory):
    """Folder and text of the paper remade with the track model, and the run that its figures show."""
    seen, runs = [], report.simulate_gear_runs
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(report, "SECONDS", SECONDS)
        patch.setattr(report, "simulate_gear_runs", lambda robot: seen.append(runs(robot)) or seen[0])
        folder = tmp_path_factory.mktemp("report")
        text = page(folder, robot)
    return folder, text, seen[0]


@pytest.fixture(scope="module")
def period(written):
    """Eq. (34) [s] at the driving pulley's mean speed at the end, 6T2A: S_g = 35 mm, r_k = 38.2 mm."""
    run = written[2]
    return 0.035 / (run.signals.speed_wheel[0, run.time[0] > SECONDS - 0.3].mean() * 0.84 / (7 * np.pi))


@pytest.fixture(scope="module")
def gears(robot, written):
    run = written[2]
    return resonance_figures.gear_runs(
        robot, run, run.result.status, run.steady.guide_share, (0, 1), ("6T2A", "4W2T")
    )


@pytest.mark.slow
def test_figure_26_marks_a_touchdown_each_pitch(gears, written, period):
    upper, lower = resonance_figures.draw_touchdowns(gears[0]).axes
    for axes in (upper, lower):
        marks = sorted(line.get_xdata()[0] for line in axes.lines if line.get_linestyle() == ":")
        assert len(marks) >= 3
        assert_allclose(np.diff(marks), 1e3 * period, rtol=0.04)  # to a sample
    loads = [np.asarray(line.get_ydata()) for line in lower.lines if line.get_linestyle() == "-"]
    total = np.nansum(loads, axis=0)
    assert_allclose(total, written[2].reactions.grouser[0, -len(total) :].sum(-1))


@pytest.mark.slow
def test_stiff_robot_is_run_with_a_step_that_it_bears(robot, monkeypatch):
    """A sweep of it has been asked for with such a step. The report's own runs must not be refused."""
    stiff = params.replace(robot, {"running_gear.contact_stiffness": np.asarray(1e12)})
    taken = {}
    monkeypatch.setattr(
        "mmrjax.fidelities.track.track_batch", lambda robot, conditions, **keywords: taken.update(keywords)
    )
    report.simulate_gear_runs(stiff)
    limit = largest_step(stiff, Conditions(["6T2A", "4W2T"], 33.0).resolved(stiff)).min()
    assert taken["step"] <= limit < 1e-4
    assert (taken["sample"] / taken["step"]) == pytest.approx(round(taken["sample"] / taken["step"]))


@pytest.mark.slow
def test_run_of_the_track_model_shows_its_own_running_gear(robot, tmp_path):
    """0.9 s on wheels. Of a run that has not settled long enough no ripple is drawn."""
    runs = records.Runs("the test", {
        "configuration": np.array(["4W2T"]), "supply_voltage_V": np.array([33.0]), "payload_kg": np.zeros(1),
        "slope_deg": np.zeros(1),
    })  # fmt: skip
    kept = fidelities.get_fidelity("track").histories(robot, runs.conditions(robot), {"duration": 0.9, "step": 1e-4})
    batch = jax.device_get(kept)
    short = dataclasses.replace(batch, history=jax.tree.map(lambda x: x[:, :100], batch.history))
    for name, shown, figures in (("whole", batch, {"drive_chart", "history", "power", "ripple", "reactions"}),
                                 ("short", short, {"drive_chart", "history", "power"})):  # fmt: skip
        table = {**simulation.condition_table(robot, runs), **simulation.ending_columns(robot, batch)}
        document = runs_report.runs_document(RobotFile(robot, "nominal"), "track", table, shown)
        path = page_renderer.write_report_page(tmp_path / name, document)
        assert set(re.findall(r'<figure id="([^"]+)">', path.read_text())) == figures


@pytest.mark.slow
def test_ripple_table_has_the_period_of_equation_34(written, period):
    cells = re.search(r'id="ripple-table">.*?<tr><td class="words">6T2A</td>(.*?)</tr>', written[1], re.S).group(1)
    found, expected, current, speed, reaction, guide = map(float, re.findall(r"<td>([^<]+)</td>", cells))
    assert expected == pytest.approx(1e3 * period, abs=0.006)  # as printed
    assert found == pytest.approx(1e3 * period, rel=0.02)
    assert 2 < current < 20 and 0 < speed < 2 and 5 < reaction < 50
    assert guide == pytest.approx(100 * written[2].steady.guide_share[0], abs=0.06)
