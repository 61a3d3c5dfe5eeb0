"""What pages say of limits, scales and tables: what is judged, by which measure, and that nothing overruns."""

import dataclasses

import numpy as np
import pytest
from numpy.testing import assert_allclose

import mmrjax as mm
from calibration.data import runs as records
from calibration.data.robot_file import RobotFile
from mmrjax import effects
from mmrjax.model import paper_robots, params
from sweeps.pages import figure_style, power_figures, sweep_figures
from sweeps.report import drive_curves, page_renderer, run_tables
from sweeps.report import runs_report as page
from sweeps.report.document import Document, Section
from tests.commands import with_columns


def run_of(robot, **conditions):
    found = mm.simulate(robot, mm.Conditions("6T2A", 33.0, 5.0, **conditions))
    return {name: np.atleast_1d(values)[0] for name, values in found.to_dict().items()}


def judged(robot, run, peak=95.3):
    return {line["words"]: line for line in page.limits_used(robot, run | {"peak_current_A": peak})}


@pytest.mark.slow
def test_a_winding_is_judged_by_what_it_may_warm_up_by():
    """28 of 125 °C in a room of 25 °C were once 23 % used."""
    assert (
        run_tables.warming_share(28.0, 125.0, 25.0) == pytest.approx(3.0)
        and run_tables.warming_share(125.0, 125.0, 25.0) == 100.0
    )
    robot, run = paper_robots.nominal(), run_of(paper_robots.nominal())
    found = judged(robot, run)["winding, long running"]["percent"]
    assert found == pytest.approx(float(run["winding_settled_C"]) - 25.0)  # of 100 K
    warm = params.replace(robot, {"motor.temperature_ambient": np.asarray(75.0)})
    other = run_of(warm)
    assert judged(warm, other)["winding, long running"]["percent"] == pytest.approx(
        2 * (float(other["winding_settled_C"]) - 75.0)
    )


def test_an_inrush_is_judged_or_it_is_said_that_nobody_stated_its_limit():
    robot, run = paper_robots.nominal(), run_of(paper_robots.nominal())
    line = judged(robot, run)["largest current of the start, all motors"]
    assert (line["value"], line["limit"], line["percent"]) == ("95.3 A", "not stated", None)
    assert line["unstated"] == "driver.current_limit"
    driven = params.replace(robot, {"driver.current_limit": np.asarray(30.0)})
    line = judged(driven, run)["largest current of the start, all motors"]
    assert line["limit"] == "60.0 A" and line["percent"] == pytest.approx(100 * 95.3 / 60)
    rated = dataclasses.replace(robot, battery=dataclasses.replace(robot.battery, current_limit=50.0))
    line = judged(rated, run_of(robot, battery=1.0))["largest current of the start, all motors"]
    assert line["limit"] == "48.5 A"  # beside 1.5 A of the other consumers
    assert judged(rated, run)["largest current of the start, all motors"]["percent"] is None  # fed by a bench supply


@pytest.mark.parametrize(
    "levels, ticks",
    [
        (np.arange(0, 20.5, 0.5), ["0", "5", "10", "15", "20"]),
        (np.round(np.arange(0, 8.05, 0.1), 1), ["0", "2", "4", "6", "8"]),
        (np.array([0.0, 1.5, 3.0, 5.0, 6.5, 8.0]), ["0", "1.5", "3", "5", "6.5", "8"]),
        (np.arange(4.1, 25, 0.41), ["5", "10", "15", "20"]),
    ],
)
def test_ticks_of_a_map_are_round_numbers_at_their_places(levels, ticks):
    """They were once 4.1, 8.2 and 12.3."""
    seen = {}
    sweep_figures._set_ticks(lambda places, names: seen.update(zip(names, places, strict=True)), levels)
    assert list(seen) == ticks
    assert_allclose(np.interp(list(seen.values()), np.arange(levels.size), levels), [float(t) for t in ticks])


def test_every_page_warns_of_curves_that_nobody_has_named(robot, tmp_path):
    """The warning comes before the contents."""
    curved = dataclasses.replace(robot, effects=(effects.UNNAMED["curve_electrical_current"](), effects.ALL[0]()))
    document = Document("a", "b.", (), (Section("c", ()),))
    for shown, warned in ((curved, True), (robot, False)):
        text = page_renderer.write_report_page(tmp_path, document, RobotFile(shown, "x")).read_text("utf-8")
        assert ('id="curve-warning"' in text) == warned
        if warned:
            warning = text.index('id="curve-warning"')
            assert (
                0 < warning < text.index("<code>curve_electrical_current</code>") < text.index('<nav id="contents"')
            )


def test_the_plane_of_drive_and_back_drive_is_that_of_the_gearbox(robot):
    """Driving, the load needs 1/η of its torque, driven back it gives η of it, and `backdriving_loss` less. Readings of
    the same robot lie on its lines."""
    robot = params.replace(robot, {"gearbox.friction_coulomb": 0.0, "gearbox.friction_viscous": 0.0})
    load, losing = (
        np.array([-4.0, 4.0]),
        dataclasses.replace(robot, effects=(effects.BY_NAME["backdriving_loss"](amplitude=0.25),)),
    )
    needs, loses = (drive_curves.motor_torque(r, 24.0, load) for r in (robot, losing))
    share = float(robot.gearbox.efficiency_load)
    assert_allclose(needs / load, [share, 1 / share], rtol=1e-4)
    assert_allclose(loses / load, [0.75 * share, 1 / share], rtol=1e-4)
    assert_allclose(drive_curves.motor_torque(robot, -24.0, load), -needs[::-1], rtol=1e-4)
    runs = records.read_runs("measured")
    simulated = mm.simulate(losing, runs.conditions(losing))
    runs = with_columns(runs, total_current_A=np.asarray(simulated.total_current))
    with figure_style.figure_settings():
        plane = power_figures.draw_drive_plane(*drive_curves.drive_plane(losing, runs)).axes[0]
    lines = {line.get_label(): line.get_xydata() for line in plane.lines}
    dots = lines["measured"][np.isfinite(lines["measured"]).all(1)]
    assert len(dots) > 10 and dots[:, 0].min() > 0
    assert_allclose(dots[:, 1], np.interp(dots[:, 0], *lines["runs forward"].T), rtol=1e-3)
