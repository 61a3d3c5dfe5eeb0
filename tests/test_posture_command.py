"""Levers stated of runs: `simulate` leaves their posture, and what cannot be is refused in a sentence."""

import numpy as np
import pytest

from calibration.data import contradictions
from calibration.data import runs as records
from mmrjax.model import params
from sweeps.inputs import one_run
from sweeps.report import turn_words
from tests.commands import ends, refused, rows, text_file


@pytest.fixture(scope="module")
def flush(robot):
    cells = {"levers_front_deg": 180.0, "levers_rear_deg": -8.5, "slope_deg": 15.0}
    runs = one_run(robot, cells)
    return turn_words.posture_of_runs(robot, runs, runs.conditions(robot))


@pytest.mark.slow
def test_a_run_that_would_tip_is_said_to(flush):
    tipping = turn_words.Postures({**flush.table, "margin_mm": np.array([-3.0])}, flush.rest, flush.step, flush.best)
    assert turn_words.tipping_remarks(tipping) == [
        "posture: the run would tip over on that slope. Currents and speeds are those of a robot held upright"
    ]


def test_runs_without_levers_have_no_posture(robot):
    runs = one_run(robot, {})
    assert turn_words.posture_of_runs(robot, runs, runs.conditions(robot)) is None


@pytest.mark.slow
def test_one_pair_alone_leaves_the_other_as_the_robot_states_it(robot):
    raised = params.replace(robot, {"running_gear.lever_rear": np.pi / 2})
    conditions = one_run(raised, {"levers_front_deg": 20.0}).conditions(raised)
    assert conditions.levers_rear_deg is None and conditions.states_levers
    tops = turn_words.posture_of_runs(raised, one_run(raised, {"levers_front_deg": 20.0}), conditions).table
    assert tops["tip_rear_mm"][0] == pytest.approx(262, abs=1)


def test_a_table_states_levers_by_row(robot, tmp_path):
    head = "configuration,supply_voltage_V,payload_kg,slope_deg,total_mass_kg,levers_front_deg,levers_rear_deg\n"
    path = tmp_path / "runs.csv"
    runs = records.read_runs(
        text_file(path, head + "6T2A,33,0,0,13.1,30,-8\n6T2A,24,0,5,13.1,180,180\n"), robot=robot, measured=False
    )
    conditions = runs.conditions(robot)
    assert conditions.levers_front_deg.tolist() == [30, 180] and conditions.levers_rear_deg.tolist() == [-8, 180]
    assert contradictions.misplaced_levers(runs, robot) is None
    with refused(r"runs.csv row 2, levers_front_deg: 4W2T has no levers"):
        records.read_runs(
            text_file(path, head + "6T2A,33,0,0,13.1,30,-8\n4W2T,24,0,5,11.5,180,180\n"), robot=robot, measured=False
        )


@pytest.mark.slow
def test_simulate_leaves_posture_and_page(tmp_path, mmrjax):
    folder = tmp_path / "run"
    ends(
        mmrjax("simulate --levers-front 30 --levers-rear -8 --out", str(folder)),
        "steps up to 236 mm",
        code=0,
    )
    (row,) = rows(folder / "posture.csv")
    assert float(row["highest_step_mm"]) == pytest.approx(236, abs=1)
    page = (folder / "report.html").read_text()
    assert 'id="posture-section"' in page and (folder / "figures/posture.svg").exists()
