"""Run folders: nothing that is not ours is deleted, one process at a time works on one, others' work is left alone."""

from __future__ import annotations

import json
import os
import threading

import pytest

from calibration.data.input_errors import BadConfiguration
from sweeps.store import RunFolder

LOOP, SWEEP = {"command": "loop", "seed": 1}, {"command": "sweep", "seed": 1}


def names(folder):
    return sorted(str(p.relative_to(folder)) for p in folder.rglob("*"))


def finished(path, identity=LOOP, **options):
    with RunFolder(path, identity, **options) as folder:
        folder.write_text("robot.toml", "")
        folder.finish({})
    return path


def interrupted(path, identity=LOOP):
    with pytest.raises(KeyboardInterrupt), RunFolder(path, identity) as folder:
        folder.stage("base", lambda: 1)
        raise KeyboardInterrupt
    return folder.partial


def test_a_finished_folder_holds_what_its_manifest_lists(tmp_path):
    folder = finished(tmp_path / "x")
    assert names(folder) == ["manifest.json", "robot.toml"]
    assert json.loads((folder / "manifest.json").read_text())["contents"] == names(folder)
    finished(tmp_path / "x", force=True)
    assert names(tmp_path) == ["x", "x/manifest.json", "x/robot.toml"]


@pytest.mark.parametrize(
    "manifest", ["{}", "[]", '{"schema": "theirs/1", "contents": ["manifest.json"]}', "\xff", None]
)
def test_force_replaces_no_folder_that_is_none_of_ours(tmp_path, manifest):
    folder = finished(tmp_path / "x")
    if manifest is None:  # ours, with something of the user's in it
        (folder / "thesis.txt").write_text("years of work")
    else:
        (folder / "manifest.json").write_bytes(manifest.encode("latin1"))
    before = names(tmp_path)
    with pytest.raises(BadConfiguration, match="thesis.txt" if manifest is None else "it is no run folder"):
        finished(tmp_path / "x", force=True)
    assert names(tmp_path) == before


FOREIGN = [
    ("identity", "of a person"),
    ("lock", "theirs"),
    ("lock", '{"schema": "theirs/1"}'),
    ("chunks/base.stage", ""),
]


@pytest.mark.parametrize(("name", "text"), FOREIGN)
@pytest.mark.parametrize("force", [False, True])
def test_a_foreign_partial_folder_is_left_alone(tmp_path, name, text, force):
    file = tmp_path / "x.partial" / name
    file.parent.mkdir(parents=True)
    file.write_text(text)
    (tmp_path / "x.partial" / "thesis.txt").write_text("years of work")
    before = names(tmp_path)
    with pytest.raises(BadConfiguration, match=r"x\.partial is in the way and is no run of ours"):
        RunFolder(tmp_path / "x", LOOP, force=force)
    assert names(tmp_path) == before


def test_a_partial_folder_that_is_a_link_is_left_alone(tmp_path):
    partial = interrupted(tmp_path / "y")
    (tmp_path / "x.partial").symlink_to(partial)
    with pytest.raises(BadConfiguration, match="no run of ours"):
        RunFolder(tmp_path / "x", SWEEP, force=True)
    assert (partial / "chunks" / "base.stage").is_file()


def test_interrupted_work_of_another_command_is_left_alone(tmp_path, capsys):
    partial = interrupted(tmp_path / "x")
    with pytest.raises(
        BadConfiguration, match=r"x\.partial holds an interrupted loop, which the same command takes up"
    ):
        RunFolder(tmp_path / "x", SWEEP)
    assert (partial / "chunks" / "base.stage").is_file()
    RunFolder(tmp_path / "x", LOOP | {"seed": 2}).close()  # another configuration begins anew, and says so
    assert not (partial / "chunks" / "base.stage").exists()
    assert "x.partial: of another configuration; begun anew" in capsys.readouterr().err
    RunFolder(tmp_path / "x", SWEEP).close()  # nothing of the loop's is left
    interrupted(tmp_path / "x", SWEEP)
    with RunFolder(tmp_path / "x", LOOP, force=True) as folder:
        assert not folder.keeps("base")


def test_a_folder_killed_before_its_mark_was_written_is_taken_up(tmp_path):
    (tmp_path / "x.partial").mkdir()
    (tmp_path / "x.partial" / "lock").touch()
    finished(tmp_path / "x")
    assert names(tmp_path) == ["x", "x/manifest.json", "x/robot.toml"]


def test_a_second_process_is_refused_at_once_and_disturbs_nothing(tmp_path):
    with RunFolder(tmp_path / "x", LOOP) as first:
        first.stage("base", lambda: 1)
        before = names(tmp_path)
        for identity in (LOOP, LOOP | {"seed": 2}, SWEEP):
            with pytest.raises(BadConfiguration, match=r"(another process is at work on|holds an interrupted loop)"):
                RunFolder(tmp_path / "x", identity)
            with pytest.raises(BadConfiguration, match=r"another process is at work on \S*x\.partial; wait for it"):
                RunFolder(tmp_path / "x", identity, force=True)
        assert names(tmp_path) == before
        first.write_text("robot.toml", "")
        first.finish({})
    with pytest.raises(BadConfiguration, match="x exists already"):
        RunFolder(tmp_path / "x", LOOP)
    assert names(tmp_path) == ["x", "x/manifest.json", "x/robot.toml"]


def test_of_many_processes_at_once_one_finishes(tmp_path):
    ends, start = [], threading.Barrier(6)

    def run():
        start.wait()
        try:
            finished(tmp_path / "x")
            ends.append("done")
        except BadConfiguration as error:
            ends.append(str(error))

    threads = [threading.Thread(target=run) for _ in range(6)]
    for t in threads:
        t.start()
    for t in threads:
        t.join()
    assert ends.count("done") == 1 and len(ends) == 6, ends
    assert names(tmp_path) == ["x", "x/manifest.json", "x/robot.toml"]


def test_what_appears_at_the_path_meanwhile_is_left_alone_and_so_is_the_result(tmp_path):
    with pytest.raises(OSError, match="exists") as refused, RunFolder(tmp_path / "x", LOOP) as folder:
        (tmp_path / "x").mkdir()
        (tmp_path / "x" / "thesis.txt").write_text("years of work")
        folder.write_text("robot.toml", "")
        folder.finish({})
    assert refused.value.filename == str(tmp_path / "x")
    assert (tmp_path / "x" / "thesis.txt").is_file() and (tmp_path / "x.partial" / "manifest.json").is_file()


@pytest.mark.parametrize("ended", [MemoryError(), RuntimeError(), OSError(28, os.strerror(28)), KeyboardInterrupt()])
def test_whatever_ends_a_command_before_anything_was_kept_leaves_nothing(tmp_path, ended):
    with pytest.raises(type(ended)), RunFolder(tmp_path / "x", LOOP) as folder:
        folder.write_text("robot.toml", "")
        raise ended
    assert names(tmp_path) == []
