"""The campaign of rigs' logs: its cases, and how it sums up what the loop answered."""

import pytest
import rig_logs
from worlds import logs


def line(kind, seed, verdict="none", classes=(), **more):
    held = {"refit": 1.2, "found": 1.05, "own": 1.3, "own_with_term": 1.0}
    truth = [] if kind == "clean" else [{"name": "churning", "class": "churning", "balance": "track", "sigmas": 9.0}]
    made = {"imposed": logs.IMPOSED[seed % 3], "every": 0.01, "delay": 0.0}
    return {"kind": kind, "seed": seed, "verdict": verdict, "classes": [list(c) for c in classes], "where": None,
            "truth": truth, "made": made, "seconds": 60.0, "read_again": True, "held_out": held, "written": True,
            "delay": [0.0001, 0.0001], **more}  # fmt: skip


def test_a_campaign_says_what_its_logs_came_to():
    lines = [
        line("clean", 0), line("library", 1, "named", [("churning",)]), line("library", 2, "unnamed"),
        line("outside", 3, "named", [("churning",)], held_out={"refit": 1.0, "found": 1.2, "own": 1.0, "own_with_term": 1.0}),
    ]  # fmt: skip
    said = "\n".join(rig_logs.summary(lines))
    assert "churning: right 1 of 2; {'unnamed': 1}" in said
    shares = {text[:60].strip(): text[76:].split("%")[0].strip() for text in said.split("\n") if "%  [" in text}
    assert shares["clean: a false finding (goal <= 5 %)"] == "0.0"
    assert shares["outside: a wrong established name (goal <= 3 %)"] == "100.0"
    assert [v for k, v in shares.items() if k.startswith("held out")] == ["75.0", "75.0"]


@pytest.mark.slow
@pytest.mark.parametrize("kind", rig_logs.KINDS)
def test_cases_are_of_their_kind(kind):
    for seed in range(3):
        case = rig_logs.attempt(kind, seed)
        assert isinstance(case, str) or case.label["kind"] == kind
