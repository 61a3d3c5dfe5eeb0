"""The docs: made pages follow from the code, every page is on its shelf and in the site, every schema is valid."""

import importlib.util
import inspect
import re

import jsonschema
import pytest

import mmrjax as mm
from tests.commands import ROOT, read_json

DOCS = ROOT / "docs"


def site():
    """The module that makes pages."""
    spec = importlib.util.spec_from_file_location("docs_site", DOCS / "site.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


SITE = site()
#: Pages that programs write: they count as reference and not as prose.
MADE = {f"reference/{name}.md" for name in (*SITE.PAGES, "effects")} | {
    "lab/emps.md",
    "lab/gears.md",
    *(f"actuators/{p.name}" for p in (DOCS / "actuators").glob("*.md")),
}


@pytest.mark.parametrize("name", SITE.PAGES)
def test_a_page_that_is_made_is_what_makes_it(name):
    """Else: python docs/site.py."""
    assert (DOCS / "reference" / f"{name}.md").read_text("utf-8") == SITE.PAGES[name]()


def test_the_written_docs_can_be_read():
    """Words of everything that people wrote, and of a task: a screen."""
    words = {p: len(re.findall(r"\S*\w\S*", p.read_text("utf-8"))) for p in DOCS.rglob("*.md")}
    assert sum(n for p, n in words.items() if str(p.relative_to(DOCS)) not in MADE) <= 30_000
    assert all(n <= 600 for p, n in words.items() if p.parent.name == "howto")
    assert words[DOCS / "explanation/loop.md"] <= 1300


def test_every_page_that_code_names_exists():
    """A path under docs that sources, tests or templates write out."""
    folders = ("mmrjax", "calibration", "sweeps", "tests", "benchmarks", "notebooks", "docs")
    files = [f for folder in folders for kind in ("py", "toml", "j2") for f in (ROOT / folder).rglob(f"*.{kind}")]
    named = {m for f in files for m in re.findall(r"docs/[\w/.-]+\.(?:md|csv|json|toml|py)\b", f.read_text("utf-8"))}
    assert len(named) > 20 and {path for path in named if not (ROOT / path).exists()} == set()


PUBLIC = [n for n in mm.__all__ if n.islower() and not n.startswith("_")]


@pytest.mark.parametrize("name", PUBLIC)
def test_every_public_name_has_a_docstring_with_what_it_takes(name):
    doc = inspect.getdoc(getattr(mm, name)) or ""
    taken = [p for p in inspect.signature(getattr(mm, name)).parameters.values() if p.kind is not p.VAR_KEYWORD]
    assert doc and ("Args:" in doc or not taken) and all(re.search(rf"\b{p.name}\b", doc) for p in taken)


def test_every_page_is_in_the_site():
    named = set(re.findall(r"[\w/-]+\.md", (ROOT / "mkdocs.yml").read_text("utf-8")))
    assert named == {str(p.relative_to(DOCS)) for p in DOCS.rglob("*.md")}


def test_the_site_asks_nothing_of_a_network():
    """Its search neither: the plugin `offline` takes its worker from a network, unless there is one of such a name."""
    text = (ROOT / "mkdocs.yml").read_text("utf-8")
    assert "font: false" in text and "plugins: [search, offline]" in text and not re.search(r"https?://", text)
    (worker,) = re.findall(r"polyfills: \[(.*iframe-worker.*)\]", text)
    assert "http" not in (DOCS / worker).read_text("utf-8")


@pytest.mark.parametrize("path", sorted((DOCS / "schemas").glob("*.json")), ids=lambda path: path.stem)
def test_every_schema_is_one_and_is_listed(path):
    jsonschema.validators.validator_for(schema := read_json(path)).check_schema(schema)
    assert f"schemas/{path.name}" in (DOCS / "reference/schemas.md").read_text("utf-8")


def test_sentences_of_the_example_follow_from_the_recorded_result():
    """Else: make gallery."""
    assert SITE.example(SITE.RECORD) == (DOCS / "start/table.md").read_text("utf-8")


def test_pictures_are_of_todays_pages():
    """Else: make gallery."""
    made = read_json(DOCS / "gallery/sources.json")
    assert made == {p.stem: SITE.picture_source(p.stem) for p in (DOCS / "gallery").glob("*.png")}


@pytest.mark.nightly
def test_the_example_is_what_the_loop_says_today(tmp_path, mmrjax):
    """Else: mmrjax loop measured --out found, python docs/site.py found."""
    assert mmrjax("loop measured --out found --no-report")[0] == 0
    numbers = r"[-+−]?\d+(?:\.\d+)?"
    said, made = (DOCS / "start/table.md").read_text("utf-8"), SITE.example(tmp_path / "found/result.json")
    assert re.sub(numbers, "N", said) == re.sub(numbers, "N", made)
    for a, b in zip(re.findall(numbers, said), re.findall(numbers, made), strict=True):
        assert float(a) == pytest.approx(float(b), rel=0.02, abs=0.11), (a, b)
