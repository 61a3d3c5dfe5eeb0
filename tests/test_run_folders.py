"""Run folders: nothing that is not ours is deleted, one process at a time works on one, others' work is left alone."""

import json
import os
import resource
import threading
from pathlib import Path

import numpy as np
import pytest

from calibration.data import writing
from calibration.data.input_errors import BadConfiguration
from sweeps.commands.rig_new import write_new_rig
from sweeps.store import RunFolder, lock_text
from tests.commands import read_json, refused

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
    assert read_json(folder / "manifest.json")["contents"] == names(folder)
    finished(tmp_path / "x", force=True)
    assert names(tmp_path) == ["x", "x/manifest.json", "x/robot.toml"]


@pytest.mark.parametrize(
    "manifest", ["{}", "[]", '{"schema": "theirs/1", "contents": ["manifest.json"]}', "\xff", None]
)
def test_force_does_not_replace_a_foreign_folder(tmp_path, manifest):
    folder = finished(tmp_path / "x")
    if manifest is None:  # ours, with something of the user's in it
        (folder / "thesis.txt").write_text("years of work")
    else:
        (folder / "manifest.json").write_bytes(manifest.encode("latin1"))
    before = names(tmp_path)
    with refused("thesis.txt" if manifest is None else "--force replaces only run folders", BadConfiguration):
        finished(tmp_path / "x", force=True)
    assert names(tmp_path) == before


FOREIGN = [
    ("identity", "of a person"),
    ("lock", "theirs"),
    ("lock", '{"schema": "theirs/1"}'),
    ("chunks/base.stage", ""),
    (None, "a link to ours"),
]


@pytest.mark.parametrize("name, text", FOREIGN)
@pytest.mark.parametrize("force", [False, True])
def test_a_foreign_partial_folder_is_left_alone(tmp_path, name, text, force):
    partial = tmp_path / "x.partial"
    if name is None:
        partial.symlink_to(interrupted(tmp_path / "y"))
    else:
        (partial / name).parent.mkdir(parents=True)
        (partial / name).write_text(text)
        (partial / "thesis.txt").write_text("years of work")
    before = names(tmp_path)
    with refused(r"x\.partial was not created by mmrjax", BadConfiguration):
        RunFolder(tmp_path / "x", LOOP, force=force)
    assert names(tmp_path) == before


def test_interrupted_work_of_another_command_is_left_alone(tmp_path, capsys):
    partial = interrupted(tmp_path / "x")
    with refused(r"x\.partial contains an interrupted loop; choose another path or --force", BadConfiguration):
        RunFolder(tmp_path / "x", SWEEP)
    other = LOOP | {"seed": 2}
    with refused(r"x\.partial contains interrupted work of another configuration.*--force", BadConfiguration):
        RunFolder(tmp_path / "x", other)
    assert (partial / "chunks/base.stage").is_file()
    RunFolder(tmp_path / "x", other, force=True).close()
    assert not (partial / "chunks/base.stage").exists()
    assert "x.partial: was made with another configuration and is started again" in capsys.readouterr().err
    RunFolder(tmp_path / "x", SWEEP).close()  # nothing of the loop's is left
    interrupted(tmp_path / "x", SWEEP)
    with RunFolder(tmp_path / "x", LOOP, force=True) as folder:
        assert not folder.keeps("base")


@pytest.mark.parametrize("place", ["notes.txt", "chunks/notes.txt"])
@pytest.mark.parametrize("identity", [LOOP, LOOP | {"seed": 2}, SWEEP])
def test_a_foreign_file_in_our_partial_folder_is_left_alone(tmp_path, place, identity):
    partial = interrupted(tmp_path / "x")
    (partial / place).write_text("years of work")
    before = names(tmp_path)
    with refused(rf"x\.partial contains {place}, which its command did not write", BadConfiguration):
        RunFolder(tmp_path / "x", identity, force=True)
    assert names(tmp_path) == before


def test_a_forged_mark_costs_no_file(tmp_path):
    partial = tmp_path / "x.partial"
    partial.mkdir()
    (partial / "thesis.txt").write_text("years of work")
    (partial / "lock").write_text(lock_text("loop"))
    with refused(r"thesis\.txt, which its command did not write", BadConfiguration):
        finished(tmp_path / "x")
    (partial / "lock").write_text(json.dumps(json.loads(lock_text("loop")) | {"foreign": []}))
    with refused("or --force to start again", BadConfiguration):
        finished(tmp_path / "x")
    assert (partial / "thesis.txt").is_file()


def test_a_foreign_file_that_comes_during_the_run_is_not_listed_as_ours(tmp_path):
    with RunFolder(tmp_path / "x", LOOP) as folder:
        (folder.partial / "notes.txt").write_text("years of work")
        folder.write_text("robot.toml", "")
        folder.finish({})
    assert read_json(tmp_path / "x/manifest.json")["contents"] == ["manifest.json", "robot.toml"]
    with refused(r"--force would delete notes\.txt", BadConfiguration):
        finished(tmp_path / "x", force=True)
    with pytest.raises(KeyboardInterrupt), RunFolder(tmp_path / "y", LOOP) as folder:
        (folder.partial / "notes.txt").write_text("years of work")
        raise KeyboardInterrupt
    assert (tmp_path / "y.partial/notes.txt").is_file()


def test_a_folder_killed_while_its_results_or_its_lock_were_written_is_resumed(tmp_path):
    folder = RunFolder(tmp_path / "x", LOOP)
    folder.write_text("rows.csv", "")
    folder.close()
    finished(tmp_path / "x")
    assert names(tmp_path / "x") == ["manifest.json", "robot.toml", "rows.csv"]
    (tmp_path / "y.partial").mkdir()
    (tmp_path / "y.partial/lock").touch()
    assert names(finished(tmp_path / "y")) == ["manifest.json", "robot.toml"]


def test_rejected_input_keeps_resumed_work(tmp_path):
    partial = interrupted(tmp_path / "x")
    with refused("refused", BadConfiguration), RunFolder(tmp_path / "x", LOOP):
        raise BadConfiguration("refused")
    assert (partial / "chunks/base.stage").is_file()


@pytest.mark.parametrize("there", ["my own rig", None])
def test_a_full_disk_leaves_a_file_as_it_was(tmp_path, there):
    file = tmp_path / "rig.toml"
    if there is not None:
        file.write_text(there)
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (100, limits[1]))
    try:
        with refused(r"rig\.toml: cannot be written", BadConfiguration):
            write_new_rig(file, "tracked", force=True)
        with pytest.raises(OSError, match=r"rig\.toml"):
            writing.write_table(file, {"x": np.arange(1000)})
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert [p.read_text() for p in tmp_path.iterdir()] == [there] * (there is not None)


def test_writing_follows_links_keeps_modes_and_writes_to_pipes(tmp_path):
    file, link = tmp_path / "rig.toml", tmp_path / "link.toml"
    file.write_text("old")
    file.chmod(0o640)
    link.symlink_to(file)
    writing.write_text(link, "new")
    assert link.is_symlink() and file.read_text() == "new" and file.stat().st_mode & 0o777 == 0o640
    writing.write_text(Path("/dev/null"), "new")
    assert not Path("/dev/null").is_file()


def test_a_second_process_is_refused_at_once_and_disturbs_nothing(tmp_path):
    with RunFolder(tmp_path / "x", LOOP) as first:
        first.stage("base", lambda: 1)
        before = names(tmp_path)
        for identity in (LOOP, LOOP | {"seed": 2}, SWEEP):
            with refused(r"(another process is using|contains an interrupted loop)", BadConfiguration):
                RunFolder(tmp_path / "x", identity)
            with refused(r"another process is using \S*x\.partial; wait for it", BadConfiguration):
                RunFolder(tmp_path / "x", identity, force=True)
        assert names(tmp_path) == before
        first.write_text("robot.toml", "")
        first.finish({})
    with refused("x exists already", BadConfiguration):
        RunFolder(tmp_path / "x", LOOP)
    assert names(tmp_path) == ["x", "x/manifest.json", "x/robot.toml"]


def test_one_of_many_concurrent_processes_finishes(tmp_path):
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


def test_path_created_during_the_run_and_the_result_are_both_kept(tmp_path):
    with pytest.raises(OSError, match="exists") as refused, RunFolder(tmp_path / "x", LOOP) as folder:
        (tmp_path / "x").mkdir()
        (tmp_path / "x/thesis.txt").write_text("years of work")
        folder.write_text("robot.toml", "")
        folder.finish({})
    assert refused.value.filename == str(tmp_path / "x")
    assert (tmp_path / "x/thesis.txt").is_file() and (tmp_path / "x.partial/manifest.json").is_file()


@pytest.mark.parametrize("ended", [MemoryError(), RuntimeError(), OSError(28, os.strerror(28)), KeyboardInterrupt()])
def test_command_that_ends_before_its_first_chunk_leaves_no_folder(tmp_path, ended):
    with pytest.raises(type(ended)), RunFolder(tmp_path / "x", LOOP) as folder:
        folder.write_text("robot.toml", "")
        raise ended
    assert names(tmp_path) == []
