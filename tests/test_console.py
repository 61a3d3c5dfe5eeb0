"""What a long computation says while it goes on."""

import time

import jax
import jax.numpy as jnp

from calibration.words.steps import still
from sweeps import console
from sweeps.console import pulse


def test_silence_is_broken_by_what_goes_on():
    said = []
    with pulse(said.append, "reading", silence=0.2) as tell:
        time.sleep(0.5)
        tell("fitting")
        jax.jit(lambda x: jnp.cosh(x) * 0.137)(jnp.ones(3))
        time.sleep(0.7)
        tell("searching")
        time.sleep(0.05)
    count = len(said)
    time.sleep(0.2)
    first = said.index("fitting")
    assert first >= 1 and all(text.startswith("still reading (") for text in said[:first])
    said = said[first:]
    count -= first
    assert said[-1] == "searching" and count == len(said)
    between = said[1:-1]
    assert len(between) >= 2 and all(text.startswith("still fitting (") for text in between)
    assert "compiled)" in between[-1]


def test_what_goes_on_is_said_with_what_was_compiled():
    assert still("fitting", 41.6, 0) == "still fitting (42 s)"
    assert still("fitting", 41.6, 1) == "still fitting (42 s, 1 program compiled)"
    assert still("fitting", 9.6, 12) == "still fitting (10 s, 12 programs compiled)"


def test_a_command_says_soon_that_it_works(monkeypatch, capsys):
    monkeypatch.setattr(console, "FIRST", 0.2)
    with console.working("rig check"):
        pass
    with console.working("size"):
        time.sleep(0.4)
    assert capsys.readouterr().err == "size: working\n"
