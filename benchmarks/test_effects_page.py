"""docs/reference/effects.md is what the library gives."""

import importlib.util
import re
from pathlib import Path

import numpy as np
import pytest

ROOT = Path(__file__).resolve().parent.parent
NUMBER = re.compile(r"[-+]?\d+\.?\d*(?:e[-+]?\d+)?")


@pytest.fixture(scope="module")
def written():
    spec = importlib.util.spec_from_file_location("effects_page", ROOT / "benchmarks" / "effects.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module.page()


def same(page, other):
    """Equal words, and numbers equal to their two digits give or take rounding."""
    assert NUMBER.sub("#", page) == NUMBER.sub("#", other)
    numbers = [np.array([float(x) for x in NUMBER.findall(text)]) for text in (page, other)]
    np.testing.assert_allclose(*numbers, rtol=0.06, atol=6e-4)


@pytest.mark.nightly
def test_effects_page_is_what_the_library_gives(written):
    same((ROOT / "docs" / "reference" / "effects.md").read_text(encoding="utf-8"), written)
