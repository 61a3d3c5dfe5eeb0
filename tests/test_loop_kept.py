"""Stages of the loop are kept as they end, the same command goes on, and a budget of time ends it with what there is."""

import concurrent.futures
import os
import signal
import sys
import time
from types import SimpleNamespace

import numpy as np
import pytest
from numpy.random import default_rng
from worlds import rigs

from calibration.data import robot_file
from calibration.data import runs as records
from calibration.data.input_errors import BadConfiguration
from calibration.discovery import OutOfTime
from calibration.discovery.discover import discover
from calibration.discovery.verdict import LoopStages
from mmrjax.compile import programs
from sweeps.commands import loop as command
from sweeps.config import FolderPart, LoopBeside
from sweeps.stage_files import read_stage, write_stage
from sweeps.store import RunFolder, open_folder
from tests.commands import ends


def refuse():
    raise AssertionError("made again")


def test_a_stage_is_made_once_and_read_after_an_interrupt(tmp_path):
    with pytest.raises(KeyboardInterrupt), RunFolder(tmp_path / "x", {"seed": 1}) as folder:
        assert folder.stage("noise 0.5", lambda: (1, np.arange(3)))[0] == 1
        raise KeyboardInterrupt
    with pytest.raises(KeyboardInterrupt), RunFolder(tmp_path / "x", {"seed": 1}) as folder:
        assert folder.stage("noise 0.5", refuse)[1].tolist() == [0, 1, 2]
        assert folder.stage("cannot be written", lambda: lambda: 1)() == 1
        raise KeyboardInterrupt
    with RunFolder(tmp_path / "x", {"seed": 2}, force=True) as folder:  # another command's are not taken
        assert folder.stage("noise 0.5", lambda: 7) == 7


def test_a_stage_of_another_version_is_made_again(tmp_path, monkeypatch, robot):
    """What is named by a hash of the source: the release's number does not change with a mended line."""
    told, beside = SimpleNamespace(model_dump=lambda **_: {}, effects=()), FolderPart(out=tmp_path / "x")

    def stage(make, force=False):
        with (
            pytest.raises(KeyboardInterrupt),
            open_folder("loop", told, robot, beside.model_copy(update={"force": force})) as folder,
        ):
            found.append(folder.stage("base", make))
            raise KeyboardInterrupt

    found = []
    stage(lambda: 1)
    stage(refuse)
    monkeypatch.setattr(programs, "source_hash", lambda: "mended")
    with pytest.raises(BadConfiguration, match="another configuration"):
        open_folder("loop", told, robot, beside)
    stage(lambda: 2, force=True)
    assert found == [1, 1, 2]


def test_nothing_kept_leaves_nothing_behind(tmp_path):
    with pytest.raises(KeyboardInterrupt), RunFolder(tmp_path / "x", {}) as folder:
        raise KeyboardInterrupt
    assert not folder.partial.exists()


@pytest.mark.parametrize("text, seconds", [("90s", 90.0), ("5min", 300.0), ("1.5h", 5400.0), ("40", 40.0)])
def test_a_budget_has_a_unit(text, seconds):
    assert LoopBeside(within=text).seconds == seconds


@pytest.fixture
def rig(tmp_path):
    """A folder with a bench's file and its table."""
    world = rigs.world(default_rng(3), "bench", "voltage", rows=(16, 20))
    rigs.case(world).write(tmp_path)
    return ["loop", "table.csv", "--robot", "rig.toml", "--no-report", "--out", "found"]


@pytest.mark.parametrize("end, code", [(KeyboardInterrupt, 130), (OutOfTime, 3)])
def test_an_interrupted_loop_goes_on_after_its_last_stage(rig, mmrjax, monkeypatch, tmp_path, end, code):
    def first(*_, keep, **__):
        keep("verdict", lambda: LoopStages("class"))
        raise end

    at_once = []  # what XLA is at then crashes an ordinary end

    def leave(code):
        at_once.append(code)
        sys.exit(code)

    monkeypatch.setattr(os, "_exit", leave)
    monkeypatch.setattr(command, "discover", first)
    monkeypatch.setattr(
        command.loop_words, "verdict_line", lambda found: f"verdict: {found.verdict}, iron_loss or windage"
    )
    _, _, err = ends(
        mmrjax(*rig, "--within", "5min"),
        "kept: verdict. To continue, run the same command with --out found",
        code=code,
    )
    assert at_once == [code]
    assert ("no verdict within 300 s\n" in err) == (end is OutOfTime)
    assert "s  verdict: class, iron_loss or windage. Next: held-out errors and other noise levels\n" in err  # at once
    assert "verdict: class, iron_loss or windage. Held-out errors and other noise levels are missing" in err
    assert not (tmp_path / "found").exists()

    def again(*_, keep, **__):
        assert keep("verdict", refuse).verdict == "class"
        raise BadConfiguration("as far as this test goes")

    monkeypatch.setattr(command, "discover", again)
    ends(mmrjax(*rig, "--within", "5min"), "as far as this test goes")


def test_a_stage_that_cannot_be_saved_is_not_reported_as_saved(rig, mmrjax, monkeypatch, tmp_path):
    def first(*_, keep, **__):
        keep("verdict", lambda: SimpleNamespace(verdict="none", own=lambda: None))  # which no file takes
        raise KeyboardInterrupt

    monkeypatch.setattr(command, "discover", first)
    monkeypatch.setattr(command.loop_words, "verdict_line", lambda found: found.verdict)
    _, _, err = ends(mmrjax(*rig), "verdict could not be saved. The same command starts anew", code=130)
    assert "kept: verdict" not in err and not (tmp_path / "found.partial").exists()


@pytest.mark.parametrize("within", ["0s", "0.2s"])
def test_time_that_is_out_before_the_verdict_ends_it_there_and_says_so(rig, mmrjax, monkeypatch, tmp_path, within):
    """Between two steps, and in the middle of one."""

    def late(*_, progress, left, **__):
        while left() != 0.0:
            time.sleep(0.01)
        progress("fitting the base model")
        time.sleep(5.0)
        raise AssertionError("went on")

    monkeypatch.setattr(command, "discover", late)
    code, _, err = mmrjax(*rig, "--within", within)
    assert code == 3 and "went on" not in err and "interrupted" not in err
    said = f"no verdict within {within.removesuffix('s')} s, and no fit of the base model; allow more, such as --within 5min"
    assert said in err
    assert signal.getitimer(signal.ITIMER_REAL) == (0.0, 0.0) and not (tmp_path / "found.partial").exists()


def test_a_budget_ends_a_step_that_says_nothing():
    with pytest.raises(OutOfTime), command._time_limit(0.05, lambda: True):
        time.sleep(5.0)
    with command._time_limit(0.01, lambda: False):
        time.sleep(0.05)


@pytest.mark.nightly
def test_a_loop_of_kept_stages_finds_what_it_found(tmp_path):
    rigs.case(rigs.world(default_rng(3), "bench", "voltage", rows=(16, 20)), "iron_loss", 12.0).write(tmp_path)
    robot = robot_file.read_robot(tmp_path / "rig.toml")
    runs = records.read_runs(tmp_path / "table.csv", robot=robot)
    for name in [n for n in runs.columns if "_sd_" in n]:  # so that the noise is assumed, and others tried
        del runs.columns[name]
    written = {}

    def keep(name, make):
        made = make()
        write_stage(tmp_path / name, made)
        written[name] = read_stage(tmp_path / name)
        return made

    def slow(name, make):  # other noises take longer than there is time
        if name.startswith("noise"):
            raise concurrent.futures.TimeoutError
        return written[name]

    found = discover(runs, robot, replicates=250, keep=keep)
    factors = tuple(sorted(float(name.split()[1]) for name in written if name.startswith("noise")))
    assert {"base", "bootstrap 0", "verdict", "result"} <= set(written) and len(factors) == 2
    again = discover(runs, robot, replicates=250, keep=lambda name, make: written[name])
    ended = discover(runs, robot, replicates=250, keep=slow, left=lambda: 0.0)
    assert again.verdict == ended.verdict == found.verdict and again.chi2 == found.chi2
    assert [e.name for e in again.effects] == [e.name for e in found.effects]
    assert again.sensitivity == found.sensitivity and not ended.sensitivity
    assert [n.factors for n in ended.remarks if n.code == "outstanding"] == [factors]
