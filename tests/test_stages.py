"""Stages in files: what is read is what was written, to the bit, and no file runs code or names what it may not."""

import contextlib
import dataclasses
import os
import pickle
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from calibration.data import effect_file
from calibration.data import runs as records
from calibration.discovery import menu
from calibration.inference.noise import Noise
from mmrjax import effects
from mmrjax.effects import curve
from mmrjax.effects.base import scaled_effect
from mmrjax.model import channels, paper_robots
from sweeps import stage_files
from sweeps.store import RunFolder
from tests.commands import text_file

OWN = '''
import jax.numpy as jnp
from mmrjax.effects import Effect, amplitude
from mmrjax.model.params import Scalar

class Mine(Effect):
    """x = a. «Source: a test»"""
    balance = "electrical"
    amplitude: Scalar = amplitude(unit="V", meaning="m", bounds=(-1.0, 1.0), sd=0.1, source="a test")
    def term(self, robot, signals):
        return self.amplitude * signals.direction
'''


def again(tmp_path, value):
    stage_files.write_stage(tmp_path / "x.stage", value)
    return stage_files.read_stage(tmp_path / "x.stage")


def test_values_are_read_as_they_were_written(tmp_path):
    plain = (None, True, 3, -0.1, "ü", [1, (2,)], {("a", 1): {2}, 3: frozenset()}, 10**400)
    assert again(tmp_path, plain) == plain
    odd = again(tmp_path, (np.nan, np.inf, -np.inf, -0.0))
    assert np.isnan(odd[0]) and odd[1:3] == (np.inf, -np.inf) and str(odd[3]) == "-0.0"
    made = np.arange(6.0).reshape(2, 3)
    given = (
        made,
        made.T,
        made > 2,
        made.astype("f4"),
        np.array(["a", "bc"]),
        np.array([None, "x"], object),
        made[0, 1],
    )
    for was, now in zip(given, again(tmp_path, given), strict=True):
        assert was.dtype == now.dtype and was.shape == now.shape and np.array_equal(was, now)
        assert was.flags.f_contiguous == now.flags.f_contiguous
    twice = again(tmp_path, [made, made])
    assert twice[0] is twice[1] and twice[0].flags.writeable


def test_arrays_on_devices_keep_what_programs_are_compiled_for(tmp_path):
    given = (jnp.asarray(1.0), jnp.full(3, 2), jnp.asarray(np.arange(3)))
    assert [x.weak_type for x in given] == [True, True, False]
    now = again(tmp_path, given)
    assert [jax.typeof(x) for x in now] == [jax.typeof(x) for x in given]
    assert [x.tolist() for x in now] == [x.tolist() for x in given]


def test_our_own_classes_come_back_by_name(tmp_path):
    robot = paper_robots.nominal()
    strong = scaled_effect(effects.BY_NAME["iron_loss"], (2.0, 1.0, 3.0))
    robot = dataclasses.replace(robot, effects=(strong(), next(iter(curve.CURVES.values()))()))
    now = again(tmp_path, (robot, Noise, channels.find_channel("speed"), menu.locked, records.read_runs("measured")))
    assert jax.tree.structure(now[0]) == jax.tree.structure(robot)
    assert all(map(np.array_equal, jax.tree.leaves(now[0]), jax.tree.leaves(robot)))
    assert type(now[0].effects[0]) is strong
    assert now[1] is Noise and now[2] is channels.find_channel("speed") and now[3] is menu.locked
    assert list(now[4].columns) == list(records.read_runs("measured").columns)


def test_an_effect_of_the_users_own_comes_back_only_once_it_is_loaded(tmp_path, monkeypatch):
    (mine,) = effect_file.read_effect_file(text_file(tmp_path / "own.py", OWN))
    assert type(again(tmp_path, mine())) is mine
    monkeypatch.delitem(sys.modules, mine.__module__)
    with pytest.raises(stage_files.Unreadable, match="a class of mmrjax_user_effects_"):
        stage_files.read_stage(tmp_path / "x.stage")


@pytest.mark.parametrize("value", [lambda: 1, object(), os.system, subprocess.Popen])
def test_what_has_no_place_in_a_file_is_refused(tmp_path, value):
    with pytest.raises((stage_files.Unwritable, stage_files.Unreadable)):
        stage_files.write_stage(tmp_path / "x", value)


class Harm:
    def __reduce__(self):
        return os.system, ("touch harmed",)


def call(name, *arguments):
    """A pickle that calls what a module has by that name."""
    module, _, attribute = name.rpartition(".")
    names = "".join(f"V{argument}\n" for argument in arguments)
    return f"c{module}\n{attribute}\n({names}tR.".encode()


FORGED = {
    "a pickle": pickle.dumps(Harm()),
    "an array of objects": pickle.dumps(np.array([Harm()], object)),
    "an array of JAX around a function": call("jax._src.array._reconstruct_array", "os", "2", "3", "4"),
    "a function of the system": call("os.system", "touch harmed"),
    "a function of ours that is no setup": call("calibration.data.writing.write_text", "harmed", "x"),
    "a class of another package": call("subprocess.Popen", "touch harmed"),
    "another class as a type": call("builtins.eval", "1"),
    "a module of another package": b"cthis\nc\n.",
    "a module that ours imports": b"cmmrjax.compile.programs\nos\n.",
    "a function in a module that ours imports": b"\x80\x04\x8c\x17mmrjax.compile.programs\x8c\x09os.system\x93.",
    "a class that ours imports": call("mmrjax.compile.programs.Path", "x"),
    "a class that is no dataclass": call("mmrjax.compile.programs.Programs", "x"),
    "a field that there is not": call(
        "calibration.inference.noise.Noise", "1", "2", "3", "4", "5", "6", "7", "8", "9"
    ),
    "an object that there is not": b"P7\n.",
    "no kind": b"nonsense",
}


@pytest.mark.parametrize("what", FORGED)
def test_a_forged_stage_runs_nothing_and_is_made_again(tmp_path, monkeypatch, capsys, what):
    monkeypatch.chdir(tmp_path)
    with RunFolder(tmp_path / "x", {"command": "loop"}) as folder:
        folder.stage("base", lambda: 1)
        file = folder.partial / "chunks/base.stage"
        file.write_bytes(stage_files.sealed(FORGED[what]))
        assert folder.stage("base", lambda: "anew") == "anew"
        assert folder.stage("base", lambda: "no more") == "anew"
    assert not (tmp_path / "harmed").exists() and "this" not in sys.modules
    assert capsys.readouterr().err.count("base.stage: damaged, so it is computed again") == 1


def test_a_damaged_stage_or_chunk_is_made_again_with_a_note(tmp_path, capsys):
    generator = np.random.default_rng(0)
    with RunFolder(tmp_path / "x", {"command": "loop"}) as folder:
        for k in range(30):
            folder.stage(f"s {k}", lambda k=k: (k, np.arange(50.0) + k))
            folder.keep_chunk(f"c{k}", {"x": np.arange(50.0) + k})
        files = sorted((folder.partial / "chunks").iterdir())
        for k, file in enumerate(files):
            content = bytearray(file.read_bytes())
            if k % 3 == 2:
                content[generator.integers(len(content))] ^= 1 << generator.integers(8)
            file.write_bytes((b"", content[: generator.integers(len(content))], content)[k % 3])
        for k in range(30):  # a bit turned in a field that no reader needs is no damage
            now = folder.stage(f"s {k}", lambda k=k: (k, np.arange(50.0) + k))
            assert now[0] == k and np.array_equal(now[1], np.arange(50.0) + k)
            chunk = folder.chunk(f"c{k}")
            assert chunk is None or np.array_equal(chunk["x"], np.arange(50.0) + k)
    said = capsys.readouterr().err
    assert said.count("computed again") >= 40 and "Traceback" not in said


def test_effects_are_those_of_the_file_that_is_read_and_not_of_bytes_beside_it(tmp_path):
    import importlib.util
    import py_compile

    file = tmp_path / "own.py"
    py_compile.compile(
        text_file(file, "import pathlib\npathlib.Path('harmed').touch()\n" + OWN),
        invalidation_mode=py_compile.PycInvalidationMode.UNCHECKED_HASH,
    )
    assert os.path.exists(importlib.util.cache_from_source(str(file)))
    file.write_text(OWN)
    with contextlib.chdir(tmp_path):
        (mine,) = effect_file.read_effect_file(file)
    assert mine.name == "mine" and not (tmp_path / "harmed").exists()
