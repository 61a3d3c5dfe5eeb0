"""One sentence answers: the same in the terminal, on the page and in result.json."""

import json

import pytest
from commands import command
from pages import Tables
from test_documents import check, comparison, size

from calibration.discovery.loop_notes import Headline
from calibration.words import loop_words
from sweeps.report import loop_report, page_renderer, terminal_renderer
from sweeps.report.document import plain_text


@pytest.mark.parametrize("made", [check, size, comparison])
def test_terminal_and_page_open_with_the_same_sentence(made, tmp_path, capsys):
    document = made()
    page = Tables(page_renderer.write_report_page(tmp_path, document).read_text("utf-8"))
    terminal_renderer.print_document(document)
    first = capsys.readouterr().out.splitlines()[0]
    assert first == plain_text(document.answer) and first in page.text


@pytest.mark.parametrize(
    "words", [("compare", "measured"), pytest.param(("check", "paper", "--no-changes"), marks=pytest.mark.slow)]
)
def test_a_command_answers_with_one_sentence(words, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert command([*words, "--out", "x"]) == 0
    statement = json.loads((tmp_path / "x" / "result.json").read_text("utf-8"))["statement"]
    page = Tables((tmp_path / "x" / "report.html").read_text("utf-8"))
    assert capsys.readouterr().out.startswith(statement) and statement in page.text


class Found:
    """A result of the loop with a verdict at the estimated noise, and the claim that holds at every noise."""

    def __init__(self, verdict, level, factors=(0.7, 1.0, 1.4)):
        self.verdict, self.headline = verdict, Headline(level, (("churning", "windage"),), factors, (1,))


@pytest.mark.parametrize(
    ("verdict", "level", "begins"),
    [("class", "open", "Perhaps. "), ("class", "place", "No. "), ("class", "class", "Missing. ")],
)
def test_the_answer_of_the_loop_is_the_claim_that_holds_at_every_noise(verdict, level, begins, monkeypatch):
    """«No: missing is ...» was once printed beside «whether anything is missing depends on the noise»."""
    monkeypatch.setattr(loop_words, "completeness_answer", lambda found: "Missing.")
    found = Found(verdict, level)
    answer = loop_report.loop_answer(found)
    assert answer == f"{begins}{loop_words.loop_headline(found.headline)}."
    alone = Found(verdict, level, (1.0,))
    assert loop_report.loop_answer(alone) == "Missing."
