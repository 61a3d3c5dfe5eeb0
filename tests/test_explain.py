"""What `mmrjax explain` says of every name, and what is near an unknown one."""

import pytest

from calibration.words.experiment_words import effect_summary, effect_tests
from mmrjax.effects import BY_NAME, OF_CHANNELS, OF_TURNS
from mmrjax.errors import allowed_words, similar_words
from mmrjax.model import channels
from mmrjax.model.params import walk_parameters
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


def test_an_effect_is_explained_by_what_its_class_states(unsimulated):
    for name, effect in EVERY.items():
        lines = dict(said("effect", name))
        spec = next(p.spec for p in walk_parameters(effect()) if p.spec.amplitude)
        equation, meaning, source = effect_summary(effect)
        assert (lines["equation"], lines["stands for"], lines["source"]) == (equation, meaning, source)
        assert lines["typical size"].startswith(f"{spec.sd:g} {spec.unit}") and spec.source in lines["typical size"]
        assert effect.balance in lines["enters"] and lines["in data"].startswith(effect.family())
        assert "on a bench" in lines and list(effect_tests(effect))


def test_an_effect_of_ones_own_may_go_with_anything():
    own = type("Damp", (BY_NAME["churning"],), {"driver": "humidity"})
    assert list(effect_tests(own))[-1] == "Vary the humidity"


@pytest.mark.slow
def test_a_typical_size_is_simulated():
    """0.5 ohm in series take 0.5 V/A · I of 24 V less what drives: the motors slow down by that."""
    changes = list(explain._change_sentences(BY_NAME["series_resistance"]()))
    assert len(changes) == 2 and changes[0].startswith(
        "change at its typical size (6T2A, 24 V, 5°, 3 kg): total current -"
    )
    assert "motor speed -3.3 %" in changes[0]
    assert list(explain._change_sentences(BY_NAME["armature_inductance"]())) == []


def test_parameters_and_channels_are_explained_by_their_rows(robot):
    known = {p.name: p for p in walk_parameters(robot)}
    lines = dict(said("parameter", "motor.resistance"))
    spec = known["motor.resistance"].spec
    assert (
        lines["means"] == f"{spec.meaning} [{spec.unit}]" and lines["nominal"] == f"0.611 ohm. Source: {spec.source}"
    )
    assert lines["equation"].startswith("U_e = C_E ω + I R") and "5 %" in lines["prior"]
    assert dict(said("parameter", "6T2A.ground.friction.static"))["equation"]
    lines = dict(said("channel", "speed"))
    assert "speed_sd_mm_s" in lines["column"] and lines["other units"].startswith("m/s, km/h")
    assert lines["typical noise"].startswith(f"{100 * channels.find_channel('speed').sd_share:g} %")
    assert "by its instrument: drawn from the supply by all motors" in dict(said("channel", "total_current"))["is"]
    assert dict(said("output", "slip"))["equation"].startswith("1 - V / V_theoretical, eq. (33)")


def test_the_command_prints_80_columns_and_every_meaning_of_a_name(mmrjax):
    _, out, _ = ends(mmrjax("explain cut_off"), "cut_off: status", "cut_off: flag", code=0)
    assert FLAGS["cut_off"] in " ".join(out.split())
    assert max(map(len, out.splitlines())) <= 80
    _, out, _ = ends(mmrjax("explain held out"), code=0)
    assert GLOSSARY["held out"] in " ".join(out.split())
    ends(mmrjax("explain speed_mm_s"), "speed_mm_s: channel", code=0)
    ends(mmrjax("explain"), "series_resistance", "motor.resistance", "converged", code=0)


@pytest.mark.parametrize(
    "name, says",
    [
        ("resistance", "did you mean one of these? battery.resistance, motor.resistance"),
        ("slidez", "did you mean slides"),
        ("xyzzy", "explain: got xyzzy; mmrjax explain lists all names"),
    ],
)
def test_an_unknown_name_is_answered_by_what_is_near(name, says, mmrjax):
    ends(mmrjax("explain", name), says)


def test_near_words_have_the_word_as_a_part_whatever_its_capitals():
    outputs = ["total_current", "motor_speed", "peak_current", "slip"]
    near = {"current": ["total_current"], "SLIP": ["slip"], "slop": ["slip"], "xyzzy": []}
    assert {word: similar_words(word, outputs) for word in near} == near
    assert similar_words("current", outputs, 3) == ["total_current", "peak_current"]
    assert allowed_words("Motor_Speed", outputs).startswith("did you mean motor_speed? allowed: total_current")
