"""Python code of the docs runs as it stands, with JAX in single precision as a reader has it."""

from __future__ import annotations

import re
from pathlib import Path

import jax
import pytest

from calibration.data import effect_file

DOCS = Path(__file__).resolve().parents[1] / "docs"
#: Pages whose blocks continue each other; blocks that read what a command wrote are left out.
TUTORIALS = ("start/python", "howto/sweep", "howto/mission", "howto/turn", "explanation/track-model")


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
    assert [name.split()[-1] for name in RECIPES] == ["own", "steps", "robots", "else"]
    assert all("assert" in code and "import mmrjax as mm" in code for code in RECIPES.values())


def test_every_page_with_python_is_run():
    found = {
        str(p.relative_to(DOCS).with_suffix("")) for p in DOCS.rglob("*.md") if "```python\n" in p.read_text("utf-8")
    }
    assert found == {*TUTORIALS, "howto/jax", "howto/own-effect", "reference/plans"}


def test_the_effect_of_the_page_is_accepted(tmp_path):
    path = tmp_path / "mine.py"
    path.write_text("\n".join(blocks("howto/own-effect")), encoding="utf-8")
    assert "puddle" in effect_file.library([path])


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
