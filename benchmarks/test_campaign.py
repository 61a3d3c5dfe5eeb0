"""Campaigns: cases of every kind, what a scorer says of a verdict, files that were cut off."""

import json
import os
from types import SimpleNamespace

import campaign
import loop
import loop_findings
import loop_scores as scores
import numpy as np
import pytest
from worlds import foreign, laws, tables

from tests.commands import text_file


def line(verdict="none", classes=(), where=None, truth=(), **more):
    return {
        "kind": "x",
        "verdict": verdict,
        "classes": classes,
        "where": where,
        "truth": truth,
        "outliers": [],
        **more,
    }


def test_all_classes_of_several_truths_are_wanted_once_each():
    truth = [{"class": c} for c in "abc"]
    assert scores.everything(line(classes=[["b", "x"], ["a"], ["c", "b"]], truth=truth))
    assert not scores.everything(line(classes=[["b"], ["a", "b"]], truth=truth))
    assert not scores.everything(line(classes=[["a", "b"], ["x"], ["c"]], truth=truth))
    assert not scores.everything(line(classes=[["a"], ["b"], ["c"], ["d"]], truth=truth))


SPEED, TRAVEL = "loss torque that changes with speed", "resistance to travel that changes with speed"


@pytest.mark.parametrize(
    ("found", "right", "wrong"),
    [
        (line("mechanism", mechanism={"families": [SPEED]}), True, False),
        (line("mechanism", mechanism={"families": [TRAVEL, SPEED]}), True, False),
        (line("mechanism", mechanism={"families": [TRAVEL]}), False, True),
        (line("mechanism", mechanism={"families": ["loss torque that changes with load"]}), False, True),
        (line("class", classes=[["churning", "windage"]]), True, False),
        (line("class", classes=[["churning"], ["supply_sag"]]), False, True),
        (line("place"), False, False),
    ],
)
def test_a_mechanism_is_right_where_its_equation_and_its_driver_are(found, right, wrong):
    for truth in ({"class": "stribeck_track"}, {"class": "", "name": "friction_step", "balance": "track"}):
        said = found | {"truth": [truth]}
        assert (scores.mechanism_right(said), scores.mechanism_wrong(said)) == (right, wrong)
    assert scores.mechanism_wrong(found | {"truth": []}) == bool(scores.established_families(found))


def test_a_law_of_an_instrument_is_a_reading_of_its_channel():
    truth = {"class": "", "name": "range_switch", "balance": "sensor", "channel": "total_current"}
    assert scores.same_mechanism("reading of total current that changes with current", truth)
    assert not scores.same_mechanism("reading of speed that changes with current", truth)


def test_what_acts_alike_counts_apart():
    truth = {"class": "", "name": "guide_binding", "balance": "track"}
    assert not scores.same_mechanism("resistance to travel that changes with slope", truth)
    assert scores.same_mechanism("resistance to travel that changes with slope", truth, loosely=True)
    assert not scores.same_mechanism("slip that changes with slope", truth, loosely=True)
    every = {**laws.OUTSIDE, **laws.OUTSIDE_RIGS, **foreign.FOREIGN}
    assert set(every) <= set(scores.DRIVERS)


def test_a_drift_is_placed_over_the_order_in_its_equation():
    truth = [{"balance": "track", "where": {"variable": "order"}}]
    assert scores.in_place(line("unnamed", where=["gearbox", "order", []], truth=truth))
    assert not scores.in_place(line("unnamed", where=["gearbox", "slope", []], truth=truth))
    assert not scores.in_place(line("unnamed", where=["slip", "order", []], truth=truth))
    assert not scores.in_place(line("named", classes=[["churning"]], truth=truth))


def test_a_cluster_and_an_event_are_placed_by_rows_and_by_time():
    truth = [{"balance": "sensor", "where": {"rows": [4, 5, 6, 7]}}]
    assert scores.in_place(line("unnamed", truth=truth, events=[{"rows": [5, 6, 7, 8]}]))
    assert not scores.in_place(line("unnamed", truth=truth, events=[{"rows": [7, 8, 9]}]))
    truth = [{"balance": "supply", "where": {"variable": "time", "window": [0.5, 0.7]}}]
    assert scores.in_place(line("unnamed", truth=truth, events=[{"start": 0.52, "stop": 0.7}]))
    assert not scores.in_place(line("unnamed", truth=truth, events=[{"start": 0.9, "stop": 1.0}]))


def test_what_cannot_be_told_from_the_place_counts_apart():
    """With three voltages a level is as good as a curve over the motor's speed."""
    truth = [{"name": "voltage.slip", "balance": "slip", "where": {"rows": [4, 5, 6, 7]}}]
    said = {"where": ["slip", "speed_motor", []], "truth": truth}
    for more in ({"variables_alike": ["voltage"]}, {"events_alike": [{"rows": [4, 5, 6, 7, 8]}]}):
        found = line("unnamed", **said, **more)
        assert scores.in_place(found, alike=True) and not scores.in_place(found)
    assert not scores.in_place(line("unnamed", **said, events_alike=[{"rows": [1, 2, 3]}]), alike=True)


def test_strata_that_are_too_high_are_marked():
    made = {"surface": {"6T2A": {"adhesion": 0.9, "V_s": 0.01}}, "robot": {"mass": 13.1}, "rows": 90}
    lines = [
        line("unnamed" if k < 12 else "none", stratum="long", made=made, seconds=1.0) | {"kind": "clean_wide"}
        for k in range(80)
    ]
    said = loop.summary(lines)
    assert any("stratum long" in x and "ABOVE" in x for x in said) and any("adhesion 0.75 to 1" in x for x in said)
    assert not any("ABOVE" in x for x in loop.summary(lines[12:]))


def test_wilson_intervals():
    assert scores.wilson(0, 100)[1] == pytest.approx(3.70, abs=0.01)
    assert scores.wilson(5, 100) == pytest.approx((2.15, 11.18), abs=0.01)


def test_skipped_cases_are_listed_by_reason():
    lines = [{"kind": "pairs", "seed": k, "skipped": "too large" if k else "slides"} for k in range(4)]
    said = loop.summary(lines)
    assert "skipped: pairs: too large: 3" in said and "skipped: pairs: slides: 1" in said


def test_a_line_that_was_cut_off_is_done_again(tmp_path):
    assert campaign.known(
        text_file(tmp_path / "x.jsonl", json.dumps({"kind": "clean", "seed": 1}) + '\n{"kind": "cle')
    ) == [{"kind": "clean", "seed": 1}]


def test_what_a_result_holds_is_written_as_json():
    held = {"a": np.float64(1.0), "b": (np.arange(2), SimpleNamespace(x=1)), "c": tables.PAPER.instruments}
    assert json.loads(json.dumps(loop_findings.plain(held)))["b"][0] == [0, 1]


@pytest.mark.parametrize("kind", [k for k in loop.KINDS if k != "blind"])
def test_cases_of_every_kind(kind):
    made = next(m for m in (loop.attempt(kind, s) for s in range(8)) if not isinstance(m, str))
    kind = loop.NOISES.get(kind, (kind,))[0]
    count = {"pairs": 2, "compensating": 2, "triples": 3, "clean": 0, "clean_wide": 0, "noise": 0}.get(kind, 1)
    effects = made.label["effects"]
    assert len(effects) == count or kind == "coverage"
    assert made.label["rows_lost"] == 0
    if kind not in ("compensating", "drift", "cluster"):
        assert all(e["sizes"] < loop.SIZES and e["sigmas"] > 0.9 * loop.SIGMAS[kind][0] for e in effects)
    if kind == "noise":
        assert made.label["noise"] in (0.5, 2.0)


def test_blind_cases_come_from_the_foreign_laws(monkeypatch):
    law = laws.Law("", "electrical", lambda s, q: s.I * np.sin(s.w / q["at"]), 0.2, {"at": (100.0, 200.0)})
    monkeypatch.setattr(foreign, "FOREIGN", {"odd": law})
    monkeypatch.setitem(tables.EVERY, "odd", law)
    made = next(m for m in (loop.attempt("blind", s) for s in range(8)) if not isinstance(m, str))
    assert made.label["kind"] == "foreign" and made.label["effects"][0]["name"] == "odd"
    assert tables.oracle(made)[0]["best_other"] > 1.0


def test_workers_keep_to_the_programs_that_they_have_compiled():
    tasks = [(campaign.Task("x", k), "ab"[k % 2]) for k in range(8)]
    shares = campaign.Shares(tasks)
    one, two = shares.next(None), shares.next(None)
    assert {one[1], two[1]} == {"a", "b"}
    for _ in range(3):
        one, before = shares.next(one[1]), one[1]
        assert one[1] == before
    assert [shares.next(two[1])[1], shares.next(None)[1]] == [two[1], two[1]]  # the other shape is dealt out
    assert shares.next(None)[1] == two[1] and shares.next(None) is None


def _judge(task):
    if task.seed == 3:
        os._exit(7)
    return {"verdict": "none", "pid": os.getpid()}


def test_a_worker_that_dies_costs_its_case_alone():
    shares = campaign.Shares((campaign.Task("x", k), k % 2) for k in range(10))
    lines = list(campaign.judged(_judge, shares, 2))
    assert sorted(x["seed"] for x in lines) == list(range(10))
    assert [x["seed"] for x in lines if "error" in x] == [3] and "7" in next(
        x["error"] for x in lines if "error" in x
    )


# --- findings, each by itself ---------------------------------------------------------------------------


def found(*effects, truth=(), gain=0.0, written=True, stated=True, kind="x", **more):
    """A line with effects of (standing, class)."""
    listed = [{"standing": s, "class": list(c), "name": c[0]} for s, c in effects]
    further = {"gain": [gain, 0.01], "rms_sigma": {"speed": [1.0, 1.0, 9, 9]}} if listed else {}
    return line(
        "named" if listed else "none", truth=[{"class": c, "sigmas": 9.0} for c in truth], effects=listed,
        elsewhere=further, made={"stated": stated}, written=written, **({"gain": [0.0, 0.0]} if listed else {}), **more,
    ) | {"kind": kind}  # fmt: skip


def figure(lines, start):
    f = scores.Figures(lines)
    scores.findings(f)
    return next(x for x in f.out if x.strip().startswith(start))


def test_an_effect_is_right_or_wrong_by_its_class_and_counts_by_its_standing():
    lines = [found(("established", "ab"), truth="a")] * 2 + [found(("tentative", "a"), truth="a"), found(truth="a")]
    lines += [found(("established", "c"), ("tentative", "d"), truth="a")]
    assert " 40.0 %" in figure(lines, "x, >= 5 sigma left: every truth established")
    assert " 60.0 %" in figure(lines, "established or tentative")
    assert " 20.0 %" in figure(lines, "something wrong established")
    assert " 20.0 %" in figure(lines, "something wrong tentative")


def test_both_of_a_pair_have_to_be_found():
    lines = [found(("established", "a"), ("tentative", "b"), truth="ab"), found(("established", "a"), truth="ab")]
    assert "  0.0 %" in figure(lines, "x, >= 5 sigma left: every truth established")
    assert " 50.0 %" in figure(lines, "established or tentative")


def test_clean_tables_without_stated_sds_are_counted_apart():
    lines = [found(), found(), found(("established", "a"), stated=False), found(stated=False)]
    assert "  0.0 %" in figure(lines, "x, sds stated: rejected")
    assert " 50.0 %" in figure(lines, "x, sds not stated: rejected")


def test_what_is_written_counts_by_what_it_predicts_elsewhere():
    worse = found(("established", "a"), truth="a", gain=-0.2)
    lines = [worse, worse | {"written": False}, found(("established", "a"), truth="a", gain=0.3), found(truth="a")]
    assert " 75.0 %" in figure(lines, "elsewhere not below the refit")
    assert " 50.0 %" in figure(lines, "of those with effects written")


@pytest.mark.parametrize("kind", [k for k in loop.NOISES if k.startswith("clean")])
def test_kinds_with_a_noise_of_their_own_say_whether_sds_are_stated(kind):
    for seed in (2, 3):
        case = loop.attempt(kind, seed)
        stated = "speed_sd_mm_s" in case.table
        assert stated == case.label["stated"] == (kind != "clean_unstated" and seed % 2 == 0)
        assert case.label["law"] == {"clean_heavy": "heavy", "clean_uneven": "uneven"}.get(kind, "normal")


def test_errors_are_of_the_rows_that_both_fits_predict():
    before, after = np.array([[3.0], [1.0], [np.nan]]), np.array([[1.0], [np.nan], [2.0]])
    assert loop_findings._rms(before, after, ["speed"]) == {"speed": [3.0, 1.0, 2, 2]}


@pytest.mark.nightly
def test_a_line_holds_what_the_findings_rest_on():
    """A resistance of five sigmas, told nothing of the noise."""
    x = loop.work(campaign.Task("library_unstated", 3, replicates=100, brief=True, stratum="plain"))
    assert x["noise"]["speed"]["source"] == "series" and x["noise"]["speed"]["freedom"] > 20
    assert {e["name"] for e in x["effects"]} <= {t["effect"] for t in x["tests"]}
    assert np.isfinite(x["gain"]).all() and np.isfinite(x["elsewhere"]["gain"]).all()
