"""Data that no model can make much of: each is refused, or its result says so, in `loop` and in `calibrate`."""

import csv

import numpy as np
import pytest
import worlds.histories
from synthetic import table
from test_loop_command import mmrjax
from worlds import settled, tables

from calibration.data.runs import Runs
from calibration.inference.conduct import conduct_notes
from calibration.inference.fit_notes import Remark
from mmrjax.model import paper_robots, params

CLIMBING = params.replace(paper_robots.nominal(), settled.CLIMBING)


def started(p=settled.CLIMBING, duration=0.8, every=0.02):
    """Six starts without effects, as the world follows them, and a little noise."""
    return table(worlds.histories.narrow(seed=0, duration=duration, every=every, constants=p))


@pytest.fixture(scope="module")
def histories():
    return started()


@pytest.fixture(scope="module")
def sliding():
    """The same on a surface that hardly holds anything."""
    slippery = {
        f"{c}.ground.friction.{k}": 0.08 * f for c in ("6T2A", "4W2T") for k, f in (("static", 1.0), ("dynamic", 0.8))
    }
    return started(settled.CLIMBING | slippery)


@pytest.fixture(scope="module")
def short():
    return started(duration=0.0101, every=5e-4)


RUNS = tuple(f"start{k}" for k in range(6))


def written(path, runs):
    with path.open("w", newline="", encoding="utf-8") as file:
        out = csv.writer(file)
        out.writerow(runs.columns)
        out.writerows(zip(*runs.columns.values(), strict=True))


@pytest.mark.slow
def test_histories_that_grip_have_no_notes(histories):
    assert conduct_notes(histories, CLIMBING) == []
    assert conduct_notes(table(tables.narrow(seed=3)), CLIMBING) == []


@pytest.mark.slow
def test_histories_that_never_grip_are_reported(sliding, histories):
    which, none = conduct_notes(sliding, CLIMBING)
    assert (
        which == Remark("never_grips", runs=RUNS, share=which.share)
        and 0 <= which.share < 0.7
        and none == Remark("no_grip")
    )
    half = {c: np.concatenate([sliding[c][sliding["run_id"] == "start0"], histories[c][histories["run_id"] != "start0"]])
            for c in histories.columns}  # fmt: skip
    (said,) = conduct_notes(Runs("runs.csv", half), CLIMBING)
    assert said == Remark("never_grips", runs=("start0",), share=said.share)


def test_runs_of_ten_milliseconds_are_reported(short):
    (said,) = conduct_notes(short, CLIMBING)
    assert said.code == "ends_early" and said.runs == RUNS
    assert said.lasts == pytest.approx(0.01, rel=0.1) and 0 < said.share < 0.7
    bare = Runs("runs.csv", {c: x for c, x in short.columns.items() if not c.startswith("speed")})
    (said,) = conduct_notes(bare, CLIMBING)
    assert said.code == "ends_early" and said.runs == RUNS and np.isnan(said.share)


#: A table or histories, and what is said of it by every command that fits.
REFUSED = {
    "moving": "run start0 is moving at 0 s",
    "every reading equal": "total_current_A: 2.5 in every row although conditions vary; the instrument was stuck",
    "every sample equal": "total_current_A: 2.5 in every row although conditions vary; the instrument was stuck",
    "two configurations": "runs.csv, configuration: run start0 has several values; give each its own run_id",
}


def made(case, histories):
    columns = {c: x.copy() for c, x in histories.columns.items()}
    if case == "moving":
        late = {c: x[columns["time_s"] > 0.39] for c, x in columns.items()}
        return Runs("runs.csv", late | {"time_s": np.round(late["time_s"] - 0.4, 6)})
    if case == "two configurations":
        columns["configuration"][np.flatnonzero(columns["run_id"] == "start0")[20:]] = "4W2T"
        return Runs("runs.csv", columns)
    if case == "every reading equal":
        columns = dict(tables.narrow(seed=3).table)
    for name, value in {"total_current_A": 2.5, "motor_speed_rpm": 5000.0, "speed_mm_s": 400.0}.items():
        columns[name] = np.full(len(columns["configuration"]), value)
    return Runs("runs.csv", columns)


@pytest.mark.parametrize("command", ["calibrate", "loop"])
@pytest.mark.parametrize("case", REFUSED)
def test_refused_with_4_and_one_sentence(case, command, histories, tmp_path):
    written(tmp_path / "runs.csv", made(case, histories))
    answer = mmrjax(tmp_path, command, "runs.csv", "--out", "x")
    assert answer.code == 4 and REFUSED[case] in answer.err
    assert len(answer.err.strip().splitlines()) == 1 and not (tmp_path / "x").exists()
