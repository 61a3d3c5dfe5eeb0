"""Progress messages of long computations."""

import sys
import time

import jax
import jax.numpy as jnp
import pytest

from calibration.described import describe
from calibration.inference.fit_notes import progress_remark
from calibration.words import step_words as steps
from sweeps import console
from sweeps.console import step_reporter


def test_step_is_repeated_with_its_time_after_a_silence():
    lines = []
    with step_reporter(lines.append, "reading", silence=0.2, rewrite=lines.append) as report_step:
        time.sleep(0.5)
        report_step("fitting")
        jax.jit(lambda x: jnp.cosh(x) * 0.137)(jnp.ones(3))
        time.sleep(0.7)
        report_step("searching")
        time.sleep(0.05)
    count = len(lines)
    time.sleep(0.2)
    first = lines.index("fitting")
    assert first >= 1 and all(text.startswith("still reading (") for text in lines[:first])
    lines = lines[first:]
    count -= first
    assert lines[-1] == "searching" and count == len(lines)
    between = lines[1:-1]
    assert len(between) >= 2 and all(text.startswith("still fitting (") for text in between)
    assert "compiled)" in between[-1]


@pytest.mark.parametrize("terminal", [True, False])
def test_progress_line_is_rewritten_on_a_terminal_and_absent_in_a_file(monkeypatch, capsys, terminal):
    monkeypatch.setattr(sys.stderr, "isatty", lambda: terminal, raising=False)
    with step_reporter(console.print_message, "reading", silence=0.05):
        time.sleep(0.3)
    err = capsys.readouterr().err
    assert err.count("\r\x1b[Kstill") >= 2 * terminal and bool(err) == terminal, repr(err)


def test_stage_of_the_loop_has_a_number_and_an_expected_time():
    text = describe(progress_remark("bootstrap", 500))
    assert text.startswith(f"2 of {steps.OF}, bootstrap of 500")
    assert steps.expected_time(text, 45.0) == pytest.approx(55.0)  # 45 % are over when it begins
    assert steps.expected_time("writing the report", 45.0) is steps.expected_time("1 of 7, fitting", 9.0) is None
    assert set(steps.STAGES) <= set(steps.STEPS)


def test_slow_command_reports_that_it_is_working(monkeypatch, capsys):
    monkeypatch.setattr(console, "FIRST_MESSAGE", 0.2)
    with console.report_working("rig check"):
        pass
    with console.report_working("size"):
        time.sleep(0.4)
    assert capsys.readouterr().err == "size: working\n"
