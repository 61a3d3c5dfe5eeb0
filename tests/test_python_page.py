"""The recipes of docs/python.md run as they stand, where JAX is single, as whoever copies them finds it."""

from __future__ import annotations

import re
from pathlib import Path

import jax
import pytest

PAGE = (Path(__file__).resolve().parents[1] / "docs" / "python.md").read_text("utf-8")
#: By their headings, the blocks that import what they need.
RECIPES = {
    heading: code
    for heading, code in re.findall(r"^## ([^\n]+)\n(?:(?!^## ).)*?```python\n(.*?)```", PAGE, re.M | re.S)
    if "import mmrjax as mm" in code
}


def test_the_page_has_its_four_recipes():
    assert [name.split()[-1] for name in RECIPES] == ["own", "steps", "robots", "else"]
    assert all("assert" in code for code in RECIPES.values())


@pytest.mark.slow
@pytest.mark.parametrize("heading", RECIPES)
@pytest.mark.filterwarnings("default")  # of MuJoCo and its libraries
def test_a_recipe_runs(heading):
    with jax.enable_x64(False):
        exec(compile(RECIPES[heading], heading, "exec"), {"__name__": "recipe"})
