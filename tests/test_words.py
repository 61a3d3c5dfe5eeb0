"""What is said of data, in words: one sentence for each kind of note, and no kind without one."""

import ast
import dataclasses
import re
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from calibration.described import describe, in_words
from calibration.discovery import loop_notes as of_loop
from calibration.discovery.loop_notes import (
    CurveOver,
    FreedValue,
    Mechanism,
    Missing,
    NameSupport,
    NameTest,
    RuledOut,
    Summary,
)
from calibration.discovery.result import Formula, Sensitivity, Worse
from calibration.inference import fit_notes as of_fit
from calibration.inference.fit_notes import Note, Shown, Step
from calibration.inference.lack_of_fit import Adequacy
from calibration.inference.residual_clusters import LevelMean, ResidualCluster
from calibration.inference.series_noise import SeriesNoise
from calibration.sensitivity import sensitivity_notes as of_study
from calibration.words import fit_words, loop_words, step_words, table_words
from calibration.words.note_words import NOTES
from mmrjax.model import channels
from sweeps import console
from sweeps.pages.words import FILES

ROOT = Path(__file__).resolve().parents[1]
#: Notes of every kind; their sentences are in `tests/record/pages/notes.txt`, which `python tests/test_words.py` writes.
SAMPLES = [
    of_fit.HeldByPrior(("a",)),
    of_fit.OnlyTogether((of_fit.Pair("a", "b", 0.99, "ratio", -1.0), of_fit.Pair("a", "c", -1.0, "linear", 0.031))),
    of_fit.HeldByPrior(("a", "b")),
    of_fit.FarFromPrior("m", 3.2, "loop"),
    of_fit.FarFromPrior("m", 3.2, "calibration"),
    of_fit.FarFromPrior("m", 2.7, "edge"),
    of_fit.NoiseOff("", 10.04, "stated"),
    of_fit.NoiseOff("speed", 3.0, "assumed"),
    of_fit.Fact("no grip"),
    of_fit.Unmeasured("6T2A.mass"),
    of_fit.LargerNoise("total_current", 8.3, 12, "stated"),
    of_fit.Repeats("r.csv", (1, 2), "motor_speed_rpm", (4564.6, 4373.6), "6 sd", ("torque",), 2),
    of_fit.Repeats("r.csv", (1, 2), "motor_speed_rpm", (4500.0, 4300.0), "5%", (), 3),
    of_fit.Repeats("r.csv", (1, 2), "motor_speed_rpm", (4500.0, 4300.0), "5%"),
    of_fit.Repeats("r.csv", (1, 2), "motor_speed_rpm", (45.0, 43.0), "5%", ("M_b_mNm",), near="load_torque_mNm"),
    of_fit.Unused("r.csv", (("M_b_Nm", "load_torque_Nm"), ("room", ""))),
    of_fit.Unused("r.csv", (("room", ""),)),
    of_fit.NoLoadGives("r.csv", "output_torque_Nm", "M", 0.974),
    of_fit.NothingVaries("r.csv", 20, "supply_voltage_V"),
    of_fit.NothingVaries("r.csv", 20, "supply_voltage_V", ("a", "b")),
    of_fit.Copied("r.csv", "output_torque_Nm", "motor_current_A", 0.2, -0.5, False),
    of_fit.Copied("r.csv", "output_speed_rpm", "motor_speed_rpm", 0.0, 0.05, True),
    of_fit.Turned("r.csv", "motor_current_A", "Iq", 8.04, 0.31),
    of_fit.StiffSupply("motor_voltage_V", 24.0),
    of_fit.Constant("slope_deg", 5.0, "guides"),
    of_fit.Constant("motor_speed_rpm", 900.0, "speed"),
    of_fit.EndsEarly(("a", "b"), 0.01, 0.4),
    of_fit.EndsEarly(("a",), 0.01, float("nan")),
    of_fit.Thinned("log.csv", 25000, 3600),
    of_fit.ThinnedTable("runs.csv", 50000, 3847),
    of_fit.NeverGrips(("a",), 0.31),
    of_fit.CoarseSteps(90.0, 0.03),
    of_fit.StopsOnSlope(("a", "b")),
    of_fit.InheritedPriors("motor", (("torque_constant", 0.012, 0.0259),), ("motor.a", "motor.b")),
    of_fit.InheritedPriors("motor", (("torque_constant", 0.012, 0.0259),), ("motor.a",)),
    of_fit.OffBy("speed_mm_s", "mm/s", 1 / 3, (), (), "supply_voltage_V"),
    of_fit.OffBy("speed_mm_s", "mm/s", 1000.0, ("um/s", "nm/s"), ("motor_speed_rpm",), "supply_voltage_V"),
    of_fit.SlopesIn("radians", 57.3),
    of_fit.EstimatedNoise((("motor_speed", 1.23), ("speed", 4.0))),
    of_fit.BesideSteady(2, 3, "a", 2.345),
    of_fit.OfRows((1, 2), "limited", 0.01),
    of_fit.OfRows((3,), "jumps"),
    of_fit.OfRows((3,), "slides"),
    of_fit.AtBound("a", "upper"),
    of_fit.ProductAlone("f", "s", True),
    of_fit.ProductAlone("f", "s", False),
    of_fit.PriorOfProduct("f", 0.06, 0.02, 0.98),
    of_fit.NoPrediction("voltage_configuration", 2, 20),
    of_fit.SamePredictions("voltage_configuration", ("voltage", "payload")),
    of_fit.BlockNotConverged("slope"),
    of_fit.Agreement(1, 1, 0, 0.0, 0),
    of_fit.Agreement(1, 0, 0, 0.0, 1),
    of_fit.Agreement(4, 4, 0, 0.0, 0),
    of_fit.Agreement(4, 1, 2, 3.2, 1),
    of_fit.Unsettled(("a", "b")),
    of_fit.Unsettled(()),
    of_fit.Elsewhere(1, 3, ("a", "b")),
    of_fit.InPieces("rig.delay", 2),
    of_fit.Generations(96, 8, True),
    of_fit.Generations(96, 8, False),
    of_fit.LostRows({"tips": 3, "slides": 2, "failed": 1}),
    of_fit.MembersJump(2, (2, 5)),
    of_fit.EndedAtEdge({"a": of_fit.Edge("upper", 9.0), "b": of_fit.Edge("", -2.64)}),
    of_fit.ReadFromMembers(("a", "b"), 0.4),
    of_loop.AssumedNoise(("speed",), "speed=2%"),
    of_loop.NoiseFromSeries(
        (
            SeriesNoise(channels.find_channel("total_current"), 0.0546, 0.0133, 7.45, "slope_deg", 4),
            SeriesNoise(channels.find_channel("speed"), 0.0, 0.0124, 7.44, "slope_deg", 4, 0.004),
        )
    ),
    of_loop.RefitWorse("total_current", 0.44, 0.54, "estimated"),
    of_loop.Copies((3,)),
    of_loop.Copies((3, 4)),
    of_loop.KeptOut((1, 2), "unusable"),
    of_loop.KeptOut((7,), "outliers"),
    of_loop.PhasesDiffer(80.4, 12.0),
    of_loop.StillLacks("motor_speed", "speed_motor"),
    of_loop.Late(0.0312, 0.0004),
    of_loop.Led(("a", "b"), (3.0, 2.0), 0, 0, 1, "fit", "fit", 0.01, 0.0),
    of_loop.Led(("a", "b"), (3.0, 2.0), 1, 0, 1, "held-out", "held-out", 0.01, 1.4),
    of_loop.Led(("a", "b"), (3.0, 2.99), 0, 0, 0, of_loop.DRAW, "held-out", 0.01, 0.0),
    of_loop.Led(("a", "b"), (3.0, 2.0), 0, 0, 1, "held-out", "held-out", 0.01, 0.0),
    of_loop.Outstanding((0.5, 2.0), "assumed"),
    of_loop.NotPredictable(("configuration",)),
    of_loop.LostReplicates(400, 500),
    of_loop.RestsOn(NameTest("slip", 10.57, 3.3, (), 0.0, 2, 2.9, what="run")),
    of_loop.RestsOn(
        NameTest("slip", 10.57, 3.3, (), 0.0, 10, 4.3),
        {"configuration": "6T2A", "supply_voltage_V": 33.0, "slope_deg": 20.0},
        "slope_deg",
        (17.5, 22.5),
    ),
    of_loop.Unwritten(True, 0.13, 0.42),
    of_loop.Unwritten(False, -0.2, 0.05),
    of_loop.TooFewReplicates(100),
    of_study.Sampling("morris", 8),
    of_study.PointsLeftOut(2, 8, False, ("speed", "current")),
    of_study.PointsLeftOut(2, 8, True, ("speed",)),
    of_study.SampleLeftOut(3, 0.0123, ("speed",)),
    of_study.Inert(("a", "b")),
    of_study.Tied(("a", "b")),
    Step("evaluations", (12345, 1234.6)),
    Step("alike", (("a", "b"),)),
    Step("round", (2, 3.25, 7, 1.26)),
]


RECORD = ROOT / "tests" / "record" / "pages" / "notes.txt"


def as_text() -> str:
    """The sentence of each sample, a line each."""
    return "".join(f"{type(note).__name__}: {describe(note)}\n" for note in SAMPLES)


@pytest.mark.parametrize("kind", sorted({type(note).__name__ for note in SAMPLES}))
def test_notes_of_a_kind_read_as_recorded(kind):
    recorded, now = (
        [line for line in text.splitlines() if line.startswith(f"{kind}: ")]
        for text in (RECORD.read_text(encoding="utf-8"), as_text())
    )
    assert now == recorded != []


def test_a_callback_for_notes_passes_their_sentences_on():
    told = []
    in_words(told.append)(SAMPLES[0])
    assert told == [describe(SAMPLES[0])]


def kinds():
    """Every kind of note that the rooms have."""
    return {
        kind
        for room in (of_fit, of_loop, of_study)
        for kind in vars(room).values()
        if isinstance(kind, type) and issubclass(kind, Note) and kind is not Note
    }


def test_every_kind_of_note_has_a_sentence_and_a_sample():
    assert kinds() == set(NOTES) == {type(note) for note in SAMPLES}
    assert all(dataclasses.is_dataclass(kind) for kind in kinds())


def test_a_sentence_is_its_own_words_and_what_is_no_note_says_so():
    assert describe("as it is") == "as it is"
    with pytest.raises(TypeError, match="got Note; expected a note or a result"):
        describe(Note())
    with pytest.raises(TypeError, match="got HeldByPrior, header; expected"):
        describe(of_fit.HeldByPrior(("a",)), "header")


@pytest.mark.parametrize(
    ("kind", "rows"),
    [("Step", step_words.STEPS), ("Fact", fit_words.FACTS), ("RuledOut", loop_words.RULED_OUT)],
)
def test_names_of_rows_are_those_of_the_code(kind, rows):
    """A name without a row would fail only where it is said, and a row without a name is never said."""
    used = set()
    for room in ("inference", "discovery", "sensitivity", "sizing"):
        for file in (ROOT / "calibration" / room).rglob("*.py"):
            for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
                if isinstance(node, ast.Call) and ast.unparse(node.func) == kind and node.args:
                    at = 0 if kind in ("Step", "Fact") else 1
                    used |= {node.args[at].value} if len(node.args) > at else {""}
    assert used | ({""} & set(rows)) == set(rows)


def test_every_reason_and_every_doubt_has_its_words():
    text = (ROOT / "calibration" / "discovery" / "standing.py").read_text(encoding="utf-8")
    assert all(f'"{why}"' in text for why in loop_words.REASONS if why)
    whys = {a.value for c in ast.walk(ast.parse(text)) if isinstance(c, ast.Call) for a in c.args[1:2]
            if ast.unparse(c.func) == "NameSupport" and isinstance(a, ast.Constant)}  # fmt: skip
    assert whys <= set(loop_words.REASONS)
    worst = NameTest("a", 0.0, 3.0, (), -99.0, 1, 0.0, 0.0, ("b",), True, varies=4.0, over="speed")
    schema = (ROOT / "docs" / "schemas" / "loop.schema.json").read_text(encoding="utf-8")
    assert all(f'"{doubt}"' in schema for doubt in loop_words.DOUBTS)
    rests = dataclasses.replace(worst, root=4.0)  # below chance with all its rows it rests on none
    assert {*worst.fails, *rests.fails} == set(loop_words.DOUBTS) and not NameTest("a", 4.0, 3.0, (), 0.0).fails


@pytest.mark.parametrize(("unit", "said"), [("-", "-0.0154 ± 0.00014"), ("ohm", "-0.0154 ± 0.00014 ohm")])
def test_a_size_has_a_unit_where_there_is_one(unit, said):
    amplitude = SimpleNamespace(value=-0.01541, sd=0.000141, unit=unit)
    assert loop_words.effect_amplitude(SimpleNamespace(parameters={"amplitude": amplitude})) == said


# --- verdicts -------------------------------------------------------------------------------------------

OVER = CurveOver("slip", ("slope",))


@pytest.mark.parametrize(
    ("support", "said"),
    [
        (None, ""),
        (NameSupport(True), ""),
        (NameSupport(False, "implausible"), "no effect of the library that explains it is of a plausible size"),
        (NameSupport(False, "larger", ("a", "b")), "a and b would explain more, but not at a plausible size"),
        (
            NameSupport(False, "better curve", ("a",), (CurveOver("speed", ("speed_motor", "slope")),)),
            "one smooth surface in the reading of speed over speed motor and slope is the better explanation than a",
        ),
        (
            NameSupport(False, "curve alone", curves=(OVER,)),
            "one smooth curve in the slip balance over slope leaves nothing",
        ),
        (
            NameSupport(
                False,
                "none by itself",
                tests=(
                    NameTest("a", 1.2, 3.41, (OVER,), 0.0),
                    NameTest("b", 5.0, 3.41, (), -20.0, 10, 2.0),
                    NameTest("c", 5.0, 3.41, (), 9.0, again=0.75, larger=("d", "e"), remains=True),
                ),
            ),
            "a explains 1.2 σ next to smooth curves (slip balance over slope); chance alone reaches 3.4; b is a worse "
            "explanation than a smooth curve in its place and rests on row 10; c is chosen again in 75 % of the data "
            "with a block left out, has a rival of an implausible size (d and e) and leaves something in its own "
            "equation",
        ),
        (
            NameSupport(False, "none by itself", tests=(NameTest("a", 1.2, 3.41, (), 0.0),)),
            "a explains 1.2 σ; chance alone reaches 3.4",
        ),
        (
            NameSupport(
                True,
                "beside",
                tests=(NameTest("a", 6.91, 3.27, (OVER,), 1.0, 11, 5.8), NameTest("b", 5.0, 3.27, (), 0.0)),
            ),
            "each one, added to the fit of the others, explains more than chance would: a 6.9 σ (chance 3.3, without row 11 "
            "5.8), b 5.0 σ (chance 3.3)",
        ),
    ],
)
def test_why_names_stand_or_not(support, said):
    assert loop_words.support_reasons(support) == said


def test_verdict_of_a_complete_model():
    off = of_fit.NoiseOff("", 2.0, "stated")
    said = "Nothing is missing: the residuals are consistent with noise (family-wise p = 0.4)."
    assert loop_words.verdict_sentences(Summary("none", 0.4, None)) == said
    assert loop_words.verdict_sentences(Summary("none", 0.4, None, noise=(off,))) == f"{said} But {describe(off)}"
    aside = loop_words.verdict_sentences(Summary("none", 0.4, None, aside=10, of=100))
    assert aside == f"10 of 100 rows (10 %) are outliers and are set aside. {said}"


def test_verdict_tells_what_is_tentative():
    test = NameTest("b", 5.0, 3.4, (), 9.0, 10, 2.0)
    sure, tentative = Missing(("a",), (), ("drop",)), Missing(("b",), (), ("slip",), False, test)
    assert loop_words.verdict_sentences(Summary("named", 0.001, None, (sure, tentative))) == (
        "Missing: a (family-wise p ≤ 0.001). Tentative, in the model since it predicts better: b, which rests on row 10."
    )
    # where no name stands and it was not tested by itself, what speaks against all of them
    curve = NameSupport(False, "curve alone", curves=(OVER,))
    place = SimpleNamespace(
        place="slip", variable="slope", alike=("slip",), variables_alike=(), family="slip", by_duty=False
    )
    only = Missing(("b",), (), ("slip",), False)
    said = loop_words.verdict_sentences(Summary("place", 0.001, place, (only,), support=curve))
    assert "no effect of the library is established" in said
    assert said.endswith("predicts better: b (one smooth curve in the slip balance over slope leaves nothing).")


def test_a_mechanism_is_stated_with_what_it_explains_and_predicts():
    found = Mechanism(("loss torque that changes with speed", "slip"), ("a",), 0.99, 0.8, 0.1, 1.0)
    place = SimpleNamespace(
        place="track", variable="speed_motor", alike=("track",), variables_alike=(), family="x", by_duty=False
    )
    said = loop_words.verdict_sentences(Summary("mechanism", 0.001, place, mechanism=found))
    assert said.startswith(
        "Missing: a loss torque that changes with speed or a slip, established as a mechanism: it "
    )
    assert "explains 99 % of the excess misfit, gains 0.8 nat" in said and "8.0 standard errors" in said
    weak = dataclasses.replace(found, families=("slip",), share=0.3, gain=0.1)
    said = loop_words.verdict_sentences(Summary("place", 0.001, place, mechanism=weak))
    assert (
        "No mechanism is established: the best one is a slip, but it explains only 30 % of the excess misfit and"
        in said
    )
    assert loop_words.brief_verdict(Summary("mechanism", 0.001, place, mechanism=weak)) == "mechanism: slip"


def test_a_mechanism_is_stated_with_its_window_and_why_no_name_stands():
    """A discrepancy of some runs alone: its window stands in verdict and answer, and what leaves nothing comes first."""
    here = SimpleNamespace(
        place="slip", variable="order 30 to 44", alike=("slip",), variables_alike=("order 31 to 44",), by_duty=False,
        family="slip that changes with order", window={"axis": "order", "low": 30.0, "high": 44.0},
    )  # fmt: skip
    mechanism = Mechanism((here.family,), (), 0.99, 0.8, 0.1, 1.0)
    summary = Summary("mechanism", 0.001, here, mechanism=mechanism)
    within = "order, in runs 30 to 44 (as well in runs 31 to 44)"
    assert loop_words.verdict_sentences(summary).startswith(
        f"Missing: a slip that changes with {within}, established as a mechanism"
    )
    other = dataclasses.replace(mechanism, families=("slip that changes with load",))
    assert "in runs" not in loop_words.verdict_sentences(dataclasses.replace(summary, mechanism=other))
    support = NameSupport(False, "none by itself", tests=(NameTest("a", 1.2, 3.41, (), 0.0),))
    found = SimpleNamespace(
        verdict="mechanism", summary=summary, effects=(), unnamed=here, support=support, after=SimpleNamespace(adequate=True)
    )  # fmt: skip
    assert (
        loop_words.completeness_answer(found)
        == f"No: missing is a slip that changes with {within}. Its exact law is not established."
    )
    said = (
        "one constant in the slip balance in runs 30 to 44 leaves nothing; a explains 1.2 σ; chance alone reaches 3.4"
    )
    assert loop_words.naming_reasons(found) == said
    found.after.adequate = False
    assert loop_words.naming_reasons(found) == loop_words.support_reasons(support)


def test_every_doubt_about_a_mechanism_has_words():
    none = Mechanism(tuple(f"loss torque that changes with {x}" for x in "abcd"), (), 0.1, 0.0, np.inf, 0.0)
    assert set(none.fails) == set(loop_words.NO_MECHANISM) and all(loop_words.no_mechanism(none).split())


@pytest.mark.parametrize(
    ("value", "said"),
    [
        ([4.0, 1.0, 0.5], "falls from 4 N·m at 95.5 rpm to 0.5 N·m at 955 rpm"),
        ([0.5, 6.0, 1.0], "rises from 0.5 N·m at 95.5 rpm to 1 N·m at 955 rpm, by way of 6 N·m at 191 rpm"),
    ],
)
def test_the_course_of_a_curve_is_told_by_its_ends(value, said):
    at = np.array([10.0, 20.0, 100.0])
    curve = SimpleNamespace(window=None, variable="speed_motor", at=at, value=np.array(value), unit="N·m")
    assert loop_words.curve_course(curve) == said
    assert loop_words.curve_course(SimpleNamespace(**vars(curve) | {"window": {}})) == ""


def test_verdicts_at_other_noise_are_one_sentence():
    def other(factor, verdict, *missing):
        return Sensitivity(factor, verdict, Summary(verdict, 0.01, None, missing), (), True)

    sure, weak = Missing(("a", "c"), (), ("x",)), Missing(("b",), (), ("y",), False)
    assert loop_words.at_other_noise(()) == ""
    assert loop_words.at_other_noise([other(0.7, "class", sure, weak), other(1.4, "class", sure, weak)]) == (
        "with 0.7 and with 1.4 times that noise the verdict is class: a established, b tentative"
    )
    assert loop_words.at_other_noise([other(0.5, "place", weak), other(2, "none")]) == (
        "with 0.5 times that noise the verdict is place: b tentative; with 2 times that noise the verdict is none"
    )


def test_verdict_lists_what_cannot_be_told_apart():
    value = FreedValue("motor.resistance", 1.9377, "ohm")
    one = Missing(("a",), (value,), ("losses",))
    two = Missing(("b", "c"), (), ("leads", "supply"))
    assert loop_words.verdict_sentences(Summary("class", 0.0004, None, (one, two))) == (
        "Missing: losses, a, or motor.resistance is 1.94 ohm (these data cannot tell which); one of b, c (these data "
        "cannot tell which) (family-wise p ≤ 0.0004)."
    )
    assert loop_words.verdict_sentences(Summary("named", 0.002, None, (Missing(("a",), (), ("x",)),))) == (
        "Missing: a (family-wise p ≤ 0.002)."
    )


@pytest.mark.parametrize(("sampled", "said"), [
    (False, "angle_friction (at 1.5 times its largest plausible size), torque_offset (time histories alone tell that)"),
    (True, "angle_friction (at 1.5 times its largest plausible size)"),
])  # fmt: skip
def test_what_settled_runs_cannot_tell_from_an_effect_is_said_of_them_alone(sampled, said):
    members = {"directional_friction": SimpleNamespace(size=0.1), "angle_friction": SimpleNamespace(size=1.5)}
    effect = SimpleNamespace(members=members, stated={})
    assert (
        loop_words.indistinguishable_effects(SimpleNamespace(runs=SimpleNamespace(sampled=sampled)), effect) == said
    )


def test_a_formula_without_terms_says_so():
    assert Formula("", "mark", (), (), 0.0, 9).formula == "no single term explains 90 % of it"
    assert Formula("ΔU = 1 V", "mark", (1.0,), (0.1,), 3.0, 9).to_json()["formula"] == "ΔU = 1 V"


def test_why_an_effect_is_ruled_out():
    reasons = (RuledOut("a", "power"), RuledOut("b", "size", 2.94, ("x", "y")), RuledOut("c", "edge"))
    assert loop_words.why_ruled_out(reasons) == (
        "a would make its balance supply power; b at 2.9 times its largest plausible size; check x and y; c is within an sd of the "
        "largest plausible size"
    )


def test_names_say_what_would_explain_more_than_they():
    def of(verdict, *ruled_out):
        return SimpleNamespace(verdict=verdict, implausible=ruled_out, settings=SimpleNamespace(same=6.0))

    def candidate(rise, *names):
        return SimpleNamespace(effects=dict.fromkeys(names, 1.0), rise_chi2=rise, why="too large")

    near, better = candidate(-2.0, "a"), candidate(-30.4, "b", "c")
    assert loop_words.ruled_out(of("named", candidate(6.5, "a"))) == "" == loop_words.ruled_out(of("place"))
    assert loop_words.ruled_out(of("named", near)).startswith("a would explain as much as what is proposed, but is")
    assert loop_words.ruled_out(of("class", near, better)) == (
        "b and c would explain 30 σ² more than what is proposed, but are ruled out by size or sign alone: too large."
    )
    assert loop_words.ruled_out(of("place", better, near)).startswith("a would explain as much as the curve, but is")


@pytest.mark.parametrize(
    ("found", "predicted", "said"),
    [
        ((10, 4.3, 4.72), (10, 10), "motor speed 4.3 → 4.7 % (same 10 rows)"),
        ((10, 0.141, 0.149), (10, 10), "motor speed 0.14 → 0.15 % (same 10 rows)"),
        ((8, 4.0, 5.0), (8, 10), "motor speed 4.0 → 5.0 % (same 8 rows)"),
        (None, (10, 8), "2 rows fewer predicted"),
        (None, (10, 9), "1 row fewer predicted"),
        (None, (10, 10), ""),
    ],
)
def test_what_is_predicted_worse_is_said_with_its_rows(found, predicted, said):
    worse = () if found is None else (Worse("voltage", "motor_speed", *found),)
    whole = f"Predicts worse on held-out rows: by voltage {said}."
    assert loop_words.rising_errors_sentence(worse, {"voltage": predicted}) == (whole if said else "")


@pytest.mark.parametrize(
    ("about", "said"),
    [
        (("missing", "slip", "speed_motor"), "what is missing in the slip balance over speed motor"),
        (("found", "", "", ("a", "b")), "a, b, found by the lumped model"),
        (("near", "", "", ("a",)), "a, which explains the readings nearly as well"),
    ],
)
def test_what_the_track_model_is_asked_about(about, said):
    assert loop_words.track_model_question(of_loop.Asked(*about)) == said


# --- whether a fit is adequate --------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("found", "said"),
    [
        (
            Adequacy(False, 812.3, 600.0, 1e-9, Shown(what="stated"), True),
            "Not adequate: the residuals exceed the stated noise (χ² 812.3 on 600 degrees of freedom, p < 1e-6), so "
            "something is missing and the parameters may absorb it; run mmrjax loop to find it",
        ),
        (
            Adequacy(False, 60.0, 60.0, 0.0021, Shown("motor_speed", "follow", "slope_deg"), False),
            "Not adequate: the residuals of motor speed follow slope_deg (p = 0.0021, the noise estimated from them), "
            "so something is missing and the parameters may absorb it; run mmrjax loop to find it",
        ),
        (
            Adequacy(True, 61.0, 60.0, 0.4, Shown(what="repeats"), True),
            "Adequate: the residuals are consistent with the stated noise (χ² 61 on 60 degrees of freedom, p = 0.4)",
        ),
        (
            Adequacy(True, 50.0, 50.0, 0.4, Shown(), False),
            "Adequate as far as can be tested: the residuals show no structure (p = 0.4); the noise was estimated from "
            "them, so χ² tests nothing",
        ),
        (
            Adequacy(None, 5.0, 2.5, None, Shown(), False),
            "Adequacy cannot be tested: the noise was estimated from the misfit, and 2.5 degrees of freedom cannot show "
            "structure; state it with --noise",
        ),
    ],
)
def test_adequacy_is_said(found, said):
    assert found.statement == said and found.to_json()["statement"] == said
    assert found.to_json()["shown_by"] == fit_words.shown_by(found.shown_by)


def clustered(levels, **other):
    """Residuals of speed that go with a column; levels: means by name."""
    means = tuple(LevelMean(name, "", mean, 9) for name, mean in levels.items())
    known = dict(
        column="wheel", channel="speed", unit="mm/s", within="", reversing=False, levels=means, correlation=None, p=2e-7,
        alike=(), coarser=(), at=np.zeros(0), residual=np.zeros(0),
    )  # fmt: skip
    return ResidualCluster(**{**known, **other})


@pytest.mark.parametrize(
    ("found", "said"),
    [
        (
            clustered({"1": -14.42, "2": 3.6}, alike=("direction_deg",)),
            "residuals of speed cluster by wheel (simulated less measured at levels 1: -14 mm/s, 2: +3.6 mm/s; p = 2e-07), "
            "a column without a role (as well by direction_deg): give each level its own configuration, or find what "
            "differs",
        ),
        (
            clustered({"1": -1.0, "2": 1.0}, reversing=True, within="configuration", coarser=(("axle", 0.91),)),
            "residuals of speed cluster by wheel within configuration, with opposite signs in the two directions of travel "
            "(simulated less measured at levels 1: -1 mm/s, 2: +1 mm/s; p = 2e-07), a column without a role (axle alone "
            "91% of it): give each level its own configuration, or find what differs",
        ),
        (
            clustered({}, correlation=-0.456),
            "residuals of speed go with wheel (rank correlation -0.46; p = 2e-07), a column without a role: find what "
            "differs with it",
        ),
    ],
)
def test_what_residuals_cluster_by_is_said(found, said):
    assert found.statement == said == describe(found) == found.to_json()["statement"]


def test_six_levels_that_are_furthest_off_are_listed():
    said = clustered({str(k): k - 5.0 for k in range(1, 10)}).statement
    assert [int(k) for k in re.findall(r"(\d): [+-]", said)] == [1, 2, 3, 7, 8, 9] and ", ...;" in said


def test_tests_that_are_as_improbable_are_named_in_the_order_of_their_words():
    """Of several that are zero to rounding the first is named: data are compared as their sentences are."""
    every = [Shown(what="stated"), Shown(what="repeats")]
    every += [Shown(c, "follow", v) for c in ("total_current", "speed") for v in ("the fitted speed", "slope_deg")]
    every += [Shown(c, "remember") for c in ("motor_speed", "total_current")]
    assert sorted(every) == sorted(every, key=fit_words.shown_by)


def test_what_would_measure_is_found_by_either_end_of_a_name():
    assert table_words.would_measure("motor.inductance").startswith("a time history of the start-up current")
    assert re.search("slippery slope", table_words.would_measure("6T2A.ground.friction.dynamic"))
    assert table_words.would_measure("x.y") == "runs under conditions in which it acts"


def test_lines_of_a_terminal_have_80_columns_and_those_of_a_file_are_whole(monkeypatch, capsys):
    text = "- " + "a sentence that goes on " * 8 + "\n" + "x" * 100
    lines = console.wrap_for_terminal(text).split("\n")
    assert all(len(line) <= 80 for line in lines[:-1]) and lines[-1] == "x" * 100 and lines[1].startswith("  ")
    assert " ".join(console.wrap_for_terminal(text).split()) == " ".join(text.split())
    console.print_output(text)
    assert capsys.readouterr().out.rstrip("\n") == text


def test_what_lies_beside_a_page_is_said():
    """Every table that a command writes has a line in the list of files."""
    sources = [path.read_text() for path in (ROOT / "sweeps").rglob("*.py")]
    written = {name for text in sources for name in re.findall(r'write_table\("([a-z_.]+)"', text)}
    assert len(written) > 10
    assert written <= set(FILES)


if __name__ == "__main__":
    RECORD.write_text(as_text(), encoding="utf-8")
