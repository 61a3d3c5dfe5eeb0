"""Python code of the docs runs as it stands, with JAX in single precision as a reader has it."""

import re
import runpy

import jax
import numpy as np
import pytest
from numpy.testing import assert_allclose

from calibration.data import effect_file
from tests.commands import ROOT, read_json

DOCS = ROOT / "docs"
#: Pages whose blocks continue each other; blocks that read what a command wrote are left out.
TUTORIALS = ("start/python", "howto/sweep", "howto/mission", "howto/turn", "howto/formats", "explanation/track-model")


def blocks(page):
    """Python code of a page, by block."""
    return re.findall(r"```python\n(.*?)```", (DOCS / f"{page}.md").read_text("utf-8"), re.S)


#: Recipes by their headings.
RECIPES = dict(
    re.findall(
        r"^## ([^\n]+)\n(?:(?!^## ).)*?```python\n(.*?)```", (DOCS / "howto/jax.md").read_text("utf-8"), re.M | re.S
    )
)


def test_the_page_has_its_four_recipes():
    assert [name.split()[-1] for name in RECIPES] == ["own", "steps", "robots", "environment"]
    assert all("assert" in code and "import mmrjax as mm" in code for code in RECIPES.values())


def test_every_page_with_python_is_run():
    found = {
        str(p.relative_to(DOCS).with_suffix("")) for p in DOCS.rglob("*.md") if "```python\n" in p.read_text("utf-8")
    }
    assert found == {*TUTORIALS, "howto/jax", "howto/own-effect", "reference/plans"}


def test_the_effect_of_the_page_is_accepted(tmp_path):
    path = tmp_path / "mine.py"
    path.write_text("\n".join(blocks("howto/own-effect")), encoding="utf-8")
    assert "puddle" in effect_file.effect_library([path])


@pytest.mark.slow
@pytest.mark.parametrize("heading", RECIPES)
@pytest.mark.filterwarnings("default")  # of MuJoCo and its libraries
def test_a_recipe_runs(heading):
    with jax.enable_x64(False):
        exec(compile(RECIPES[heading], heading, "exec"), {"__name__": "recipe"})


@pytest.mark.slow
@pytest.mark.parametrize(
    "page", [pytest.param(p, marks=pytest.mark.nightly) if p == "start/python" else p for p in TUTORIALS]
)
@pytest.mark.filterwarnings("default")
def test_a_tutorial_runs(page, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    names = {"__name__": "tutorial"}
    with jax.enable_x64(False):
        for code in blocks(page):
            exec(compile(code, page, "exec"), names)


@pytest.mark.nightly
def test_the_tutorial_about_a_log_finds_the_fan(tmp_path, mmrjax):
    """What the page says: 24 settled runs, and windage in the class."""
    bench = DOCS / "start/bench"
    made = runpy.run_path(str(bench / "make.py"))["log"]()
    packed = np.loadtxt(bench / "log.csv", delimiter=",", skiprows=1)
    assert_allclose(packed, made, atol=0.51, rtol=0)
    assert_allclose(packed[:, 2], made[:, 2], atol=6e-4)
    assert mmrjax("rig new rig.toml --kind bench")[0] == 0
    assert mmrjax("settle", bench / "log.csv", "--robot", "rig.toml", "--out", "settled", "--no-report")[0] == 0
    assert len((tmp_path / "settled/settled.csv").read_text().splitlines()) == 25
    assert mmrjax("loop settled/settled.csv --robot rig.toml --out found --no-report")[0] == 0
    found = read_json(tmp_path / "found/result.json")
    assert found["verdict"] == "class" and "loss torque that changes with speed" in found["statement"]
    assert "windage" in found["statement"]
