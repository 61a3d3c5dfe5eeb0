"""The campaign on rigs: cases of every kind, and what its summary says of lines."""

import campaign
import numpy as np
import pytest
import rigs


@pytest.mark.parametrize(
    "kind", ["clean", *(pytest.param(k, marks=pytest.mark.slow) for k in ("library", "outside"))]
)
def test_cases_are_of_their_kind_and_strong_enough(kind):
    cases = [rigs.attempt(kind, seed) for seed in range(3)]
    assert sum(isinstance(c, str) for c in cases) <= 1
    for seed, case in enumerate(cases):
        if isinstance(case, str):
            continue
        assert case.label["kind"] == kind and case.label["rows_lost"] == 0
        assert case.toml == rigs.attempt(kind, seed).toml
        for effect in case.label["effects"]:
            assert effect["sizes"] < campaign.SIZES
            assert effect["sigmas"] > 0.9 * rigs.SIGMAS[kind][0]
            assert (effect["class"] == "") == (kind == "outside")


@pytest.mark.slow
def test_confounded_tables_are_in_the_order_of_their_drive():
    for seed in range(4):
        case = rigs.attempt("confounded", seed)
        column = "motor_speed_rpm" if case.world.rig.wide else "supply_voltage_V"
        drive = np.abs(case.table[column] * case.table.get("duty", 1.0))
        assert (np.diff(drive) >= 0).all() and np.corrcoef(drive, np.arange(len(drive)))[0, 1] > 0.95
        assert np.corrcoef(case.table["case_temperature_C"], drive)[0, 1] > 0.8
        assert [bool(e["class"]) for e in case.label["effects"]] == [[True], [], [True], [False]][seed]


MADE = {"load": "bench", "imposed": "voltage", "channels": ["total_current"], "sides": 1, "supply": 12.0, "rows": 30,
        "reverse": False, "unsigned": [], "quantum": {}}  # fmt: skip


def line(kind, verdict="none", classes=(), ratio=0.5, held=False, own=0.5, **truth):
    truth = [
        {
            "name": "x",
            "class": "x",
            "balance": "motor",
            "sigmas": 9.0,
            "class_oracle": ["x"],
            "best_other": 9.0,
            **truth,
        }
    ]
    return {
        "kind": kind, "seed": 0, "verdict": verdict, "classes": [list(c) for c in classes], "where": None, "made": MADE,
        "truth": [] if kind == "clean" else truth, "seconds": 1.0,
        "parameters": {"motor.resistance": {"ratio": ratio, "held": held, "own": own}},
    }  # fmt: skip


def figure(lines, start):
    return next(x for x in rigs.summary(lines) if x.startswith(start))


def test_summary_counts_false_findings_right_classes_and_wrong_names():
    lines = [line("clean")] * 19 + [line("clean", "unnamed")]
    lines += [line("library", "class", [["y", "x"]])] * 9 + [line("library", "named", [["y"]])]
    lines += [line("outside", "unnamed")] * 24 + [line("outside", "named", [["y"]])]
    assert " 5.0 %" in figure(lines, "clean: a false finding")
    assert "90.0 %" in figure(lines, "library, >= 5 sigma left: class right")
    assert " 4.0 %" in figure(lines, "outside: wrong single name")
    assert any("ABOVE 5 %" in x for x in rigs.summary([line("clean", "named", [["y"]])] * 3))


def test_an_effect_too_weak_for_the_goal_does_not_count():
    lines = [line("library", "named", [["x"]]), line("library", sigmas=4.9)]
    assert "100.0 %" in figure(lines, "library, >= 5 sigma left: class right")


@pytest.mark.parametrize(
    ("ratio", "held", "own", "wrong", "wrong_own"),
    [
        (0.95, False, 0.5, True, False),
        (0.95, True, 0.99, False, False),
        (0.5, False, 0.99, False, True),
        (0.89, False, 0.96, False, False),
        (0.95, False, None, True, False),
    ],
)
def test_what_the_data_do_not_say_has_to_be_reported(ratio, held, own, wrong, wrong_own):
    x = line("clean", ratio=ratio, held=held, own=own)
    assert bool(rigs.missed(x)) == wrong and bool(rigs.missed_own(x)) == wrong_own
    said = figure([x], "rigs whose parameters above 0.9")
    assert ("  0.0 %" if wrong else "100.0 %") in said


def test_errors_and_refused_cases_are_listed():
    said = rigs.summary(
        [{"kind": "clean", "seed": 0, "error": "BadData: x"}, {"kind": "library", "seed": 1, "skipped": "y"}]
    )
    assert "error: clean: BadData: x: 1" in said and "skipped: library: y: 1" in said


@pytest.mark.nightly
def test_a_clean_rig_goes_through_the_loop():
    from campaign import Task

    seed = next(s for s in range(20) if rigs.attempt("clean", s).world.rig.kind == "bench")
    found = rigs.work(Task("clean", seed, replicates=100))
    assert found["verdict"] == "none" and not rigs.missed(found) and not rigs.missed_own(found)


def test_summary_counts_wrong_mechanisms_of_confounded_tables():
    """The truth is windage: a class of the motor's losses with speed is right, a drift that leads is not."""
    right = line("confounded", "named", [["windage"]], **{"name": "windage", "class": "windage"})
    drift = {"families": ["voltage drop that changes with order"]}
    wrong = right | {"verdict": "mechanism", "mechanism": drift, "where": ("electrical", "order", [])}
    lines = [right] * 3 + [wrong]
    assert "25.0 %" in figure(lines, "confounded: a wrong mechanism")
    assert "25.0 %" in figure(lines, "  led by the order")
