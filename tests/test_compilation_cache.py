"""The compilation cache: a second process compiles nothing, broken entries harm nothing, it can be switched off."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from sweeps import compilation_cache
from tests.commands import ROOT

#: Solves two runs with derivatives; `{more}` is put in before. Prints the answer and what the cache was asked.
PROGRAM = """
import json, sys
from sweeps import compilation_cache
folder = compilation_cache.keep_programs()
import jax
jax.config.update("jax_enable_x64", True)
import jax.numpy as jnp
events = []
jax.monitoring.register_event_listener(lambda event, **_: events.append(event.rpartition("/")[2]))
from mmrjax.model import params; from mmrjax.model import paper_robots as robots
from mmrjax.model.conditions import Conditions
from mmrjax.fidelities.steady import steady
robot, runs = robots.nominal(), Conditions(voltage=[15.0, 33.0], slope_deg=5.0)
def current(resistance, run):
    return steady(params.replace(robot, {"motor.resistance": resistance}), run).total_current
slope = jax.jit(jax.vmap(jax.jacfwd(current), in_axes=(None, 0)))(jnp.asarray(0.611), runs)
more = lambda: None
{more}
more()
print(json.dumps({"folder": folder and str(folder), "answer": slope.tolist(),
                  "kept": events.count("cache_misses"), "read": events.count("cache_hits")}))
"""


def process(cache, more="", **environment):
    """Output of one process with this value of MMRJAX_CACHE. Warnings are errors."""
    clean = {k: v for k, v in os.environ.items() if not k.startswith(("JAX_", "XDG_", "TF_CPP"))}
    answer = subprocess.run(
        [sys.executable, "-W", "error:Error", "-c", PROGRAM.replace("{more}", more)],
        cwd=ROOT, env={**clean, "MMRJAX_CACHE": str(cache), **environment}, capture_output=True, text=True,
        timeout=300, check=False,
    )  # fmt: skip
    assert answer.returncode == 0 and not answer.stderr, answer.stderr
    return json.loads(answer.stdout)


@pytest.fixture(scope="module")
def first(tmp_path_factory):
    """A cache, and what the process that filled it did."""
    cache = tmp_path_factory.mktemp("cache")
    return cache, process(cache)


@pytest.mark.nightly
def test_second_process_compiles_nothing_and_answers_the_same(first, monkeypatch):
    cache, began = first
    again = process(cache)
    assert began["kept"] > 2 and began["read"] == 0
    assert again["kept"] == 0 and again["read"] == began["kept"]
    assert again["answer"] == began["answer"]
    monkeypatch.setenv("MMRJAX_CACHE", str(cache))
    described = compilation_cache.describe_cache()
    assert described.startswith(f"{began['folder']}: {began['kept']} programs, ")
    assert float(described.split()[-2]) > 0.0


@pytest.mark.slow
def test_broken_entries_are_compiled_again(tmp_path):
    began = process(tmp_path)
    entries = sorted(path for path in Path(began["folder"]).iterdir() if path.is_file())
    for k, entry in enumerate(entries):  # cut short, emptied, overwritten
        entry.write_bytes((entry.read_bytes()[: entry.stat().st_size // 2], b"", b"no program at all")[k % 3])
    again = process(tmp_path)
    assert again["answer"] == began["answer"]
    assert again["read"] == 0


@pytest.mark.parametrize("word", ["off", "OFF", "0"])
def test_cache_switched_off_has_no_folder(word, monkeypatch):
    monkeypatch.setenv("MMRJAX_CACHE", word)
    assert compilation_cache.cache_location() is None
    assert compilation_cache.keep_programs() is None
    assert compilation_cache.describe_cache() == "off (MMRJAX_CACHE=off)"


@pytest.mark.slow
def test_unwritable_folder_switches_the_cache_off(tmp_path):
    (tmp_path / "file").write_text("")
    done = process(tmp_path / "file")
    assert done["folder"] is None and done["kept"] == 0


def test_default_folder_is_in_the_users_cache(monkeypatch, tmp_path):
    monkeypatch.delenv("MMRJAX_CACHE", raising=False)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert compilation_cache.cache_location().parent == tmp_path / "mmrjax"
    for ignored in ("", "relative"):
        monkeypatch.setenv("XDG_CACHE_HOME", ignored)
        monkeypatch.setenv("HOME", str(tmp_path))
        assert compilation_cache.cache_location().parent == tmp_path / ".cache/mmrjax"
    import jaxlib

    assert f"-{jaxlib.__version__}-" in compilation_cache.cache_location().name


@pytest.mark.slow
def test_cache_from_jax_settings_takes_precedence(tmp_path):
    done = process(tmp_path / "ours", JAX_COMPILATION_CACHE_DIR=str(tmp_path / "theirs"))
    assert done["folder"] == str(tmp_path / "theirs") and not (tmp_path / "ours").exists()


def test_oldest_entries_are_dropped(tmp_path, monkeypatch):
    monkeypatch.setattr(compilation_cache, "LIMIT", 100)
    for k in range(12):
        entry = tmp_path / f"xla-{k % 2}" / f"program-{k}"
        entry.parent.mkdir(exist_ok=True)
        entry.write_bytes(bytes(10))
        os.utime(entry, (k, k))
    (tmp_path / "xla-0/xla_gpu_per_fusion_autotune_cache_dir").mkdir()  # XLA's own, where there is a GPU
    os.utime(tmp_path / "xla-0/xla_gpu_per_fusion_autotune_cache_dir", (0, 0))
    compilation_cache._delete_oldest(tmp_path)
    left = sorted(int(path.name.rpartition("-")[2]) for path in tmp_path.rglob("program-*"))
    assert left == [7, 8, 9, 10, 11]
    compilation_cache._delete_oldest(tmp_path)
    assert len(list(tmp_path.rglob("program-*"))) == 5
