"""What README and docs say of commands, files and Python holds."""

import re
import shlex

import pytest
from typer.main import get_command

from calibration.data import profiles, requirements_file
from sweeps import cli
from tests.commands import ROOT, read_rig, text_file

PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]


def commands(text):
    """Lines of shell blocks that call the program, without remarks."""
    for block in re.findall(r"```sh\n(.*?)```", text, re.S):
        for line in block.replace("\\\n", " ").splitlines():
            if line.startswith("mmrjax "):
                yield shlex.split(line, comments=True)[1:]


def unknown(words):
    """What of a command line the program does not know."""
    command = get_command(cli.app)
    while hasattr(command, "commands") and not words[0].startswith("--"):
        if words[0] not in command.commands:
            return words[0]
        command, words = command.commands[words[0]], words[1:]
    known = {name for p in command.params for name in (*p.opts, *p.secondary_opts)}
    return next((w for w in words if w.startswith("--") and w.partition("=")[0] not in known), None)


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_every_command_of_a_page_and_its_options_exist(page):
    for words in commands(page.read_text(encoding="utf-8")):
        assert unknown(words) is None, words


def test_a_command_that_does_not_exist_is_found():
    assert unknown(["simulat"]) == "simulat" and unknown(["simulate", "--slop", "3"]) == "--slop"
    assert unknown(["rig", "check", "a.toml"]) is None and unknown(["--version"]) is None
    assert unknown(["--versio"]) == "--versio"


def anchor(heading):
    """What a link to a heading of a page says after `#`."""
    return re.sub(r"[^\w\- ]", "", heading.lower()).strip().replace(" ", "-")


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_every_link_of_a_page_resolves(page):
    text = page.read_text(encoding="utf-8")
    for link in re.findall(r"\]\(([^)\s]+)[^)]*\)", text):
        if "://" in link:
            continue
        file, _, place = link.partition("#")
        target = page.parent / file if file else page
        assert target.exists(), link
        if place and target.suffix == ".md":
            headings = re.findall(r"^#+ (.*)", target.read_text(encoding="utf-8"), re.M)
            assert place in map(anchor, headings), link


def test_the_readme_can_be_read_in_a_minute():
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    assert len(text.splitlines()) <= 80 and len(list(commands(text))) == 5


@pytest.mark.slow
def test_python_of_the_readme_runs():
    (code,) = re.findall(r"```python\n(.*?)```", (ROOT / "README.md").read_text(encoding="utf-8"), re.S)
    names = {}
    exec(code, names)
    assert names["found"].converged


def block(page, kind):
    """The first block of code of a kind in a page of the docs."""
    return re.search(rf"```{kind}\n(.*?)```", (ROOT / "docs" / page).read_text(encoding="utf-8"), re.S)[1]


def test_files_of_the_how_to_pages_are_read(tmp_path):
    assert requirements_file.parse_requirements(block("howto/requirements.md", "toml"), "x.toml")
    for page in ("howto/describe-a-rig.md", "howto/turn.md"):
        assert read_rig(tmp_path, block(page, "toml"), "robot.toml").sides == 2
    assert profiles.read_profile(text_file(tmp_path / "mission.csv", block("howto/mission.md", "csv"))).cycles == 40
