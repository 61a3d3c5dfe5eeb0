"""What commands refuse: one line on stderr, an exit code, and nothing left. The cases are in refusals.toml."""

import re
import shlex
import tomllib

import pytest
from test_rig_commands import of_kind, words_of_others

from tests.commands import ROOT, text_file

CASES = tomllib.loads((ROOT / "tests/refusals.toml").read_text(encoding="utf-8"))
FILES = CASES.pop("files")
KINDS = "bench", "linear", "pendulum", "wheeled"
RIGS = {f"{kind}{end}.toml" for kind in KINDS for end in ("", "_speed")}


def content(source):
    """The text of a file: as stated, or that of another file with some of its texts replaced."""
    if isinstance(source, str):
        return source
    name, *changes = source
    text = FILES[name] if name in FILES else (ROOT / "tests/data" / name).read_text(encoding="utf-8")
    for old, new in zip(changes[::2], changes[1::2], strict=True):
        text = text.replace(old, new) if old else text + new
    return text


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """The files of `refusals.toml`, and a rig of each kind."""
    path = tmp_path_factory.mktemp("refusals")
    for name, text in FILES.items():
        text_file(path / name, text)
    for kind in KINDS:
        of_kind(path, kind)
        of_kind(path, kind, speed=True)
    return path


@pytest.mark.parametrize(
    "name", [pytest.param(n, marks=[pytest.mark.slow] * ("slow" in case)) for n, case in CASES.items()]
)
def test_command_is_refused_in_one_line_and_leaves_nothing(mmrjax, folder, monkeypatch, name):
    case = CASES[name]
    monkeypatch.chdir(folder)
    for file, text in {**FILES, **case.get("files", {})}.items():
        text_file(folder / file, content(text))
    before = {*folder.iterdir()}
    words = shlex.split(case["words"])
    code, out, err = mmrjax(words[0], *words[1:])
    assert (code, out) == (case.get("code", 2), ""), err
    assert re.search(case["matches"], err) if "matches" in case else case["says"] in err, err
    left = {path.name for path in {*folder.iterdir()} - before}
    assert err.count("\n") == case.get("lines", 1) and left <= {"__pycache__", "runs"}, (
        left
    )  # where folders without a name are
    assert not set(words) & RIGS or words_of_others(err) == []
