"""What `mmrjax explain` says of every name, and what is near an unknown one."""

import pytest

from mmrjax.effects import BY_NAME, OF_CHANNELS, OF_TURNS
from mmrjax.errors import allowed_words, similar_words
from sweeps.commands import explain
from sweeps.pages.words import FLAGS, GLOSSARY
from tests.commands import ends

EVERY = BY_NAME | OF_TURNS | OF_CHANNELS


def said(kind, name):
    return list(explain.explanations(EVERY)[kind][name]())


@pytest.fixture
def unsimulated(monkeypatch):
    """Without the runs that say what an effect changes: a program of its own each."""
    monkeypatch.setattr(explain, "_change_sentences", lambda effect: iter(["as simulated"]))


def test_every_name_has_an_explanation_of_its_kind(unsimulated):
    for by_name in explain.explanations(EVERY).values():
        for name, about in by_name.items():
            lines = list(about())
            assert lines and all(text and "None" not in text for _, text in lines), (name, lines)


@pytest.mark.slow
def test_a_typical_size_is_simulated():
    """0.5 ohm in series take 0.5 V/A · I of 24 V less what drives: the motors slow down by that."""
    changes = list(explain._change_sentences(BY_NAME["series_resistance"]()))
    assert len(changes) == 2 and changes[0].startswith(
        "change at its typical size (6T2A, 24 V, 5°, 3 kg): total current -"
    )
    assert "motor speed -3.3 %" in changes[0]
    assert list(explain._change_sentences(BY_NAME["armature_inductance"]())) == []


def test_the_command_prints_80_columns_and_every_meaning_of_a_name(mmrjax):
    _, out, _ = ends(mmrjax("explain cut_off"), "cut_off: status", "cut_off: flag", code=0)
    assert FLAGS["cut_off"] in " ".join(out.split())
    assert max(map(len, out.splitlines())) <= 80
    _, out, _ = ends(mmrjax("explain held out"), code=0)
    assert GLOSSARY["held out"] in " ".join(out.split())
    ends(mmrjax("explain speed_mm_s"), "speed_mm_s: channel", code=0)
    ends(mmrjax("explain"), "series_resistance", "motor.resistance", "converged", code=0)


def test_near_words_have_the_word_as_a_part_whatever_its_capitals():
    outputs = ["total_current", "motor_speed", "peak_current", "slip"]
    near = {"current": ["total_current"], "SLIP": ["slip"], "slop": ["slip"], "xyzzy": []}
    assert {word: similar_words(word, outputs) for word in near} == near
    assert similar_words("current", outputs, 3) == ["total_current", "peak_current"]
    assert allowed_words("Motor_Speed", outputs).startswith("did you mean motor_speed? allowed: total_current")
