"""One sentence answers: the same in the terminal, on the page and in result.json."""

import dataclasses

import pytest
from commands import command
from pages import Tables
from test_documents import check, comparison, size

from calibration.described import describe
from calibration.discovery.loop_notes import Headline
from calibration.words import loop_words
from sweeps.report import page_renderer, terminal_renderer
from sweeps.report.document import plain_text
from tests.commands import read_json


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
    statement = read_json(tmp_path / "x/result.json")["statement"]
    page = Tables((tmp_path / "x/report.html").read_text("utf-8"))
    assert capsys.readouterr().out.startswith(statement) and statement in page.text


LAW = dict(claims=(("churning", "windage"),), families=(("loss torque that changes with speed",),), values=((),))
#: Level of the claim that holds at every noise, and the answer to "is the model complete?" that it begins with.
ANSWERS = {
    "none": "Yes, ", "undescribed": "No verdict", "open": "Perhaps. ", "named": "No: ", "class": "No: ",
    "mechanism": "No: ", "place": "No: ",
}  # fmt: skip


@pytest.mark.parametrize("level", ANSWERS)
def test_the_answer_of_the_loop_is_the_claim_that_holds_at_every_noise(level):
    """«No: ... is missing» was once printed next to «whether anything is missing depends on the noise»."""
    found = Headline(level, factors=(0.7, 1.0, 1.4), shared=(2,), **LAW)
    answer = describe(found)
    assert answer.startswith(ANSWERS[level]) and "at 0.7, 1 and 1.4 times the noise" in answer
    assert ("is missing" in answer) == answer.startswith(("No: ", "Perhaps"))
    assert ("established" in answer) == (level in ("mechanism", "place"))
    alone = describe(dataclasses.replace(found, factors=(1.0,)))
    assert "times the noise" not in alone and alone[:2] == answer[:2]


def test_a_parameter_that_moved_is_stated_with_its_ratio():
    said = loop_words.moved_parameter("motor.friction_viscous", 1.2e-5, 4e-6, "N·m·s", 2.3)
    assert said == "`motor.friction_viscous` is 1.2e-05 N·m·s, 3 times the stated value 4e-06 (+2.3 prior sds)"
    of_zero = loop_words.moved_parameter("motor.friction_viscous", 4e-3, 0.0, "N·m·s", 4.1)
    assert of_zero == "`motor.friction_viscous` is 0.004 N·m·s, stated value 0 (+4.1 prior sds)"
