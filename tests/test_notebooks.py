"""The notebooks run and their asserts hold. What is committed with outputs is what the paired script says."""

import os
import re
import subprocess
import sys

import pytest

from tests.commands import ROOT

jupytext = pytest.importorskip("jupytext")
pytest.importorskip("IPython")

NOTEBOOKS = ROOT / "notebooks"
SCRIPTS = sorted(NOTEBOOKS.glob("*.py"))


def test_there_are_notebooks():
    assert len(SCRIPTS) >= 3


@pytest.mark.nightly
@pytest.mark.parametrize("script", SCRIPTS, ids=[p.stem for p in SCRIPTS])
def test_notebook_runs(script, tmp_path):
    env = {
        **os.environ,
        "PYTHONPATH": os.pathsep.join(filter(None, [str(NOTEBOOKS.parent), os.environ.get("PYTHONPATH")])),
    }
    run = subprocess.run(
        [sys.executable, str(script)], cwd=tmp_path, env=env, capture_output=True, text=True, timeout=600, check=False
    )
    assert run.returncode == 0, run.stderr[-2000:]


@pytest.mark.parametrize("script", SCRIPTS, ids=lambda p: p.stem)
def test_notebook_is_the_script_with_outputs(script):
    paired = jupytext.read(script.with_suffix(".ipynb"))
    written = jupytext.read(script)
    assert [(c.cell_type, c.source) for c in paired.cells] == [(c.cell_type, c.source) for c in written.cells]
    code = [c for c in paired.cells if c.cell_type == "code"]
    assert all(c.execution_count for c in code), "run the notebook and commit its outputs"
    assert any(c.outputs for c in code) and "assert" in code[-1].source
    outputs = " ".join(str(c.outputs) for c in code)
    assert "Traceback" not in outputs and "/home/" not in outputs and "/tmp/" not in outputs


@pytest.mark.parametrize("script", SCRIPTS, ids=lambda p: p.stem)
def test_notebook_uses_the_public_door_alone(script):
    text = script.read_text("utf-8")
    assert not re.findall(r"^(?:from|import) (?:mmrjax\.|mmrjax import|calibration|sweeps).*", text, re.M)
