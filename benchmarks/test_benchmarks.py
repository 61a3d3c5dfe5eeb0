"""Scripts of benchmarks/: each says what it takes, and the commands that the documents cite run, at a small size."""

import contextlib
import importlib
import io
import os
import re
import runpy
import shlex
import subprocess
import sys
from pathlib import Path

import jax
import pytest

ROOT = Path(__file__).resolve().parents[1]
SCRIPTS = [p for p in sorted((ROOT / "benchmarks").glob("*.py")) if not p.name.startswith("test_")]
COMMANDS = [s for s in SCRIPTS if '__name__ == "__main__"' in s.read_text(encoding="utf-8")]


@pytest.fixture
def unchanged(monkeypatch):
    """Puts back the environment, the path and the precision, which some scripts change as they are imported."""
    precise = jax.config.jax_enable_x64
    monkeypatch.setattr(os, "environ", os.environ.copy())
    monkeypatch.setattr(sys, "path", [*sys.path])
    yield
    jax.config.update("jax_enable_x64", precise)


def test_every_script_is_imported_or_prints_its_help(unchanged, monkeypatch):
    for script in SCRIPTS:
        if script not in COMMANDS:
            importlib.import_module(script.stem)
            continue
        text = script.read_text(encoding="utf-8")
        parsed = "ArgumentParser(" in text or re.search(r"\b(parser|campaign)\(", text)
        assert parsed, f"{script.name} takes no --help, and would run"
        shown = io.StringIO()
        monkeypatch.setattr(sys, "argv", [str(script), "--help"])
        with contextlib.redirect_stdout(shown), pytest.raises(SystemExit) as end:
            runpy.run_path(str(script), run_name="__main__")
        assert not end.value.code and shown.getvalue().startswith("usage:"), script.name


def test_a_killed_tier_counts_what_has_finished(tmp_path):
    everything, log = importlib.import_module("everything"), tmp_path / "quick.jsonl"
    assert everything.summary("quick", log)["state"] == "not run"
    everything.note(log, command="pytest")
    everything.note(log, selected=3)
    for test, outcome in {"a.py::one": "passed", "a.py::two": "failed"}.items():
        everything.note(log, test=test, outcome=outcome)
    with log.open("a") as file:
        file.write('{"test": "a.py::thr')  # killed here
    row = everything.summary("quick", log)
    assert [row[n] for n in ("passed", "failed", "skipped", "left", "state")] == [1, 1, 0, 1, "not finished"]
    with log.open("a") as file:
        file.write("\n")
    everything.note(log, command="pytest --go-on")
    everything.note(log, selected=1)
    everything.note(log, test="a.py::three", outcome="skipped")
    everything.note(log, code=1)
    row = everything.summary("quick", log)
    assert [row[n] for n in ("passed", "failed", "skipped", "left", "state")] == [1, 1, 1, 0, "finished"]


#: Options that make a cited command small, after its own; None: why it is not run here.
_ONE = "--clean 1 --library 0 --outside 0 --replicates 20 --jobs 1 --out cases.jsonl"
SMALL = {
    "read_tables.py": "--parquet-rows 1000 --csv-rows 1000",
    "actuator.py": "--environments 8 --steps 10 --joints 2",
    "climb_search.py": "--members 4 --generations 1 --tries 1",
    "door.py": "--points 64 --rounds 1",
    "draw_mutants.py": "--number 1",
    "drive.py": "--batches 2 --repeats 1",
    "effects.py": "--check",
    "weight.py": None,  # benchmarks/test_weight.py
    "everything.py": None,  # test_a_killed_tier_counts_what_has_finished
    "emps.py": None,  # needs the record, which is not in the project
    "fastsim_comparison.py": None,  # benchmarks/test_fastsim_comparison.py
    "free_chain.py": None,  # a chain of 168 masses takes half a minute
    "gears.py": None,  # needs the logs, which are not in the project
    "head_to_head.py": "--quick --out lines.jsonl",
    "loop.py": _ONE,
    "loop_baselines.py": None,  # PySINDy, of the extra bench
    "loop_series.py": "--clean-wide 1 --replicates 20 --jobs 1 --out cases.jsonl",
    "missions.py": "--robots 10 --rounds 1",
    "mutants.py": "--only electrical_adds_back_emf",
    "paper_rows.py": "--only nothing",
    "passes.py": "--no-report --replicates 20",
    "record.py": None,  # tests/test_record.py compares with the record
    "rig_logs.py": f"{_ONE} --brief",
    "rigs.py": _ONE,
    "sensitivity.py": "--seeds 1 --size 8 --reference-size 16 --points 1000 --repeats 1",
    "shaking.py": "--parts 1",
    "sizing.py": "--starts 8 --grid 1000",
    "steady.py": "--batches 4 --repeats 1",
    "steady_yardstick.py": "--platform cpu --batches 64 --rounds 1",
    "sweep_options.py": "--slopes 0:1:1 --payloads 0,1 --repeats 1",
    "sweep_scale.py": "--points 1000",
    "track.py": None,  # minutes of compiling
    "track_table.py": "--population 4 --generations 1 --parts 1",
    "turning.py": "--points 64",
    "turning_data.py": None,  # records of others, and an hour
    "vibration.py": "--gears 2",
}
#: Words that stand for a value in a cited command.
VALUES = {"N": "2", "FILE": "members.npz", "NAME": "electrical_adds_back_emf"}


def cited():
    """Commands `python benchmarks/...` in the documents, once each."""
    files = [*sorted((ROOT / "docs").rglob("*.md")), ROOT / "README.md", ROOT / "CONTRIBUTING.md"]
    text = "\n".join(f.read_text(encoding="utf-8") for f in files)
    found = re.findall(r"python (benchmarks/\w+\.py[^`\n#|]*)", text)
    return list(dict.fromkeys(" ".join(command.split()).rstrip(".,)") for command in found))


def test_every_cited_command_is_a_script_with_a_small_size():
    commands = cited()
    assert len(commands) > 20
    for command in commands:
        script = shlex.split(command)[0]
        assert (ROOT / script).is_file() and Path(script).name in SMALL, command


@pytest.mark.slow
@pytest.mark.parametrize("command", cited())
def test_cited_commands_run(tmp_path, command):
    script, *given = shlex.split(command)
    small = SMALL[Path(script).name]
    if small is None:
        pytest.skip("run by its own tests")
    words = [VALUES.get(word, word) for word in given]
    folders = os.pathsep.join(filter(None, [str(ROOT), os.environ.get("PYTHONPATH")]))
    environment = {**os.environ, "PYTHONPATH": folders}
    done = subprocess.run(
        [sys.executable, ROOT / script, *words, *small.split()],
        cwd=tmp_path, env=environment, capture_output=True, text=True, timeout=1200, check=False,
    )  # fmt: skip
    assert done.returncode == 0, f"{done.stdout[-1000:]}{done.stderr[-2000:]}"
