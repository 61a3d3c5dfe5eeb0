"""What is said of data, in words: one sentence for each kind of note, and no kind without one."""

import ast
import copy
import dataclasses
import inspect
import re
import string
from types import SimpleNamespace

import numpy as np
import pytest
from synthetic import LOST_MOTION

from calibration.described import describe, report_in_words
from calibration.discovery import loop_notes as of_loop
from calibration.discovery.formula import Proposal
from calibration.discovery.loop_notes import (
    AlternativeValue,
    Mechanism,
    MissingEffect,
    NameSupport,
    NameTest,
    PlacedCurve,
    RuledOut,
    VerdictSummary,
)
from calibration.discovery.result import NoiseVerdict, WorseChannel
from calibration.inference import fit_notes as of_fit
from calibration.inference.fit_notes import AdequacyFinding, Remark, progress_remark
from calibration.inference.lack_of_fit import Adequacy
from calibration.inference.residual_clusters import LevelMean, ResidualCluster
from calibration.inference.series_noise import SeriesNoise
from calibration.inference.shown_states import MissingStates
from calibration.words import experiment_words, fit_words, loop_words, step_words, table_words
from calibration.words.note_words import NOTES
from mmrjax.model import channels
from sweeps import console
from sweeps.pages.words import FILES
from tests.commands import ROOT

#: Notes of every kind; their sentences are in `tests/record/pages/notes.txt`, which `python tests/test_words.py` writes.
SAMPLES = [
    Remark("feedforward_sign"),
    Remark("feedforward_speed_sign"),
    Remark("feedforward_unit", ratio=60.1, near=60.0),
    Remark("feedforward_delay", delay=0.04),
    Remark("feedforward_filter", lag=0.06),
    Remark("feedforward_limit", level=3.2, current=40.0),
    Remark("feedforward_skid", level=3.2),
    Remark("feedforward_direction", forward=0.3, backward=0.2),
    Remark("feedforward_sag", rest=12.5, low=9.8),
    Remark("feedforward_missing", tests=("dynamic-forward", "dynamic-reverse")),
    Remark("feedforward_no_kA", share=0.8, missing=["dynamic-forward"]),
    Remark("feedforward_gains_delayed", delay=0.04, slow=0.5, prompt=1.2),
    Remark("held_by_prior", names=("a",)),
    Remark(
        "only_together",
        pairs=(
            of_fit.DependentPair("a", "b", 0.99, "ratio", -1.0),
            of_fit.DependentPair("a", "c", -1.0, "linear", 0.031),
        ),
    ),
    Remark("held_by_prior", names=("a", "b")),
    Remark("far_from_prior", name="m", sds=3.2, kind="loop"),
    Remark("far_from_prior", name="m", sds=3.2, kind="calibration"),
    Remark("far_from_prior", name="m", sds=2.7, kind="edge"),
    Remark("noise_off", channel="", factor=10.04, source="stated"),
    Remark("noise_off", channel="speed", factor=3.0, source="assumed"),
    Remark("no_grip"),
    Remark("no_covariance"),
    Remark("not_profiled"),
    Remark(
        "residual_cluster",
        cluster=ResidualCluster(
            "wheel",
            "speed",
            "mm/s",
            "",
            False,
            (LevelMean("1", "", -14.42, 9), LevelMean("2", "", 3.6, 9)),
            None,
            2e-7,
            (),
            (),
        ),
    ),
    Remark("unmeasured", name="6T2A.mass"),
    Remark("larger_noise", channel="total_current", factor=8.3, pairs=12, source="stated"),
    Remark(
        "repeats",
        source="r.csv",
        rows=(1, 2),
        column="motor_speed_rpm",
        values=(4564.6, 4373.6),
        apart="6 sd",
        unused=("torque",),
        more=2,
    ),
    Remark(
        "repeats",
        source="r.csv",
        rows=(1, 2),
        column="motor_speed_rpm",
        values=(4500.0, 4300.0),
        apart="5%",
        unused=(),
        more=3,
    ),
    Remark("repeats", source="r.csv", rows=(1, 2), column="motor_speed_rpm", values=(4500.0, 4300.0), apart="5%"),
    Remark(
        "repeats",
        source="r.csv",
        rows=(1, 2),
        column="motor_speed_rpm",
        values=(45.0, 43.0),
        apart="5%",
        unused=("M_b_mNm",),
        near="load_torque_mNm",
    ),
    Remark("unused", source="r.csv", columns=(("M_b_Nm", "load_torque_Nm"), ("room", ""))),
    Remark("unused", source="r.csv", columns=(("room", ""),)),
    Remark("no_load_gives", source="r.csv", column="output_torque_Nm", theirs="M", share=0.974),
    Remark("nothing_varies", source="r.csv", rows=20, column="supply_voltage_V"),
    Remark("nothing_varies", source="r.csv", rows=20, column="supply_voltage_V", unused=("a", "b")),
    Remark(
        "copied",
        source="r.csv",
        column="output_torque_Nm",
        other="motor_current_A",
        intercept=0.2,
        slope=-0.5,
        tied=False,
    ),
    Remark(
        "copied",
        source="r.csv",
        column="output_speed_rpm",
        other="motor_speed_rpm",
        intercept=0.0,
        slope=0.05,
        tied=True,
    ),
    Remark("turned", source="r.csv", column="motor_current_A", theirs="Iq", off=8.04, turned=0.31),
    Remark("stiff_supply", column="motor_voltage_V", value=24.0),
    Remark("constant", column="slope_deg", value=5.0, alike="guides"),
    Remark("constant", column="motor_speed_rpm", value=900.0, alike="speed"),
    LOST_MOTION,
    Remark("ends_early", runs=("a", "b"), lasts=0.01, share=0.4),
    Remark("ends_early", runs=("a",), lasts=0.01, share=float("nan")),
    Remark("thinned", source="log.csv", rows=25000, kept=3600),
    Remark("thinned_table", source="runs.csv", rows=50000, kept=3847),
    *(Remark("settled_runs", source="log.csv", why=why, runs=12, lasts=11.23) for why in ("sides", "unfitted")),
    Remark("few_points", source="log.csv", runs=12, lasts=11.23, points=3, needed=6, each=0.4),
    Remark("never_grips", runs=("a",), share=0.31),
    Remark("coarse_steps", lasts=90.0, step=0.03),
    Remark("stops_on_slope", runs=("a", "b")),
    Remark(
        "inherited_priors", part="motor", changed=(("torque_constant", 0.012, 0.0259),), kept=("motor.a", "motor.b")
    ),
    Remark("inherited_priors", part="motor", changed=(("torque_constant", 0.012, 0.0259),), kept=("motor.a",)),
    Remark("off_by", column="speed_mm_s", unit="mm/s", factor=1 / 3, units=(), others=(), imposed="supply_voltage_V"),
    Remark(
        "off_by",
        column="speed_mm_s",
        unit="mm/s",
        factor=1000.0,
        units=("um/s", "nm/s"),
        others=("motor_speed_rpm",),
        imposed="supply_voltage_V",
    ),
    Remark("slopes_in", unit="radians", rise=57.3),
    Remark("estimated_noise", percent=(("motor_speed", 1.23), ("speed", 4.0))),
    Remark("of_rows", rows=(1, 2), what="limited", share=0.01),
    Remark("of_rows", rows=(3,), what="jumps"),
    Remark("of_rows", rows=(3,), what="slides"),
    Remark("at_bound", name="a", side="upper"),
    Remark("after_steps", channel="motor_current", share=0.932, rows=24, total=6000),
    Remark("freed_delay", channel="motor_current", share=0.95),
    Remark("shifted", channel="output_speed", share=0.62, shift=0.0034),
    Remark("product_alone", friction="f", share="s", free=True),
    Remark("product_alone", friction="f", share="s", free=False),
    Remark("prior_of_product", name="f", mean=0.06, sd=0.02, share=0.98),
    Remark("no_prediction", kind="voltage_configuration", rows=2, total=20),
    Remark("block_not_converged", kind="slope"),
    Remark("agreement", starts=1, agree=1, elsewhere=0, more=0.0, open=0),
    Remark("agreement", starts=1, agree=0, elsewhere=0, more=0.0, open=1),
    Remark("agreement", starts=4, agree=4, elsewhere=0, more=0.0, open=0),
    Remark("agreement", starts=4, agree=1, elsewhere=2, more=3.2, open=1),
    Remark("agreement", starts=2, agree=0, elsewhere=0, more=0.0, open=2),
    Remark("unsettled", names=("a", "b")),
    Remark("unsettled", names=()),
    Remark("elsewhere", searches=1, total=3, names=("a", "b")),
    Remark("in_pieces", name="rig.delay", pieces=2),
    Remark("generations", members=96, generations=8, settled=True),
    Remark("generations", members=96, generations=8, settled=False),
    Remark("ended_at_edge", edge={"a": of_fit.ReachedBound("upper", 9.0), "b": of_fit.ReachedBound("", -2.64)}),
    Remark("assumed_noise", channels=("speed",), usual="speed=2%"),
    Remark(
        "noise_from_series",
        noise=(
            SeriesNoise(channels.find_channel("total_current"), 0.0546, 0.0133, 7.45, "slope_deg", 4),
            SeriesNoise(channels.find_channel("speed"), 0.0, 0.0124, 7.44, "slope_deg", 4, 0.004),
        ),
    ),
    Remark("refit_worse", channel="total_current", stated=0.44, refit=0.54, word="estimated"),
    Remark("copies", rows=(3,)),
    Remark("copies", rows=(3, 4)),
    Remark("kept_out", rows=(1, 2), why="unusable"),
    Remark("kept_out", rows=(7,), why="outliers"),
    Remark("phases_differ", free=80.4, held=12.0),
    Remark("still_lacks", place="motor_speed", variable="speed_motor"),
    Remark("late", delay=0.0312, sd=0.0004),
    Remark("late", delay=-0.2, sd=0.001, ends=True),
    *(Remark("unshown", source="log.csv", why=why.value) for why in MissingStates),
    Remark("outstanding", factors=(0.5, 2.0), word="assumed"),
    Remark("lost_replicates", settled=400, asked=500),
    Remark("run_differs", test=NameTest("slip", 10.57, 3.3, (), 0.0, 2, changed="motor.inertia", root_changed=11.2)),
    Remark("run_differs", test=NameTest("slip", 10.57, 3.3, (), 0.0, 2, changed="track", root_changed=11.2)),
    Remark(
        "rests_on",
        test=NameTest("slip", 10.57, 3.3, (), 0.0, 10, 4.3),
        conditions={"configuration": "6T2A", "supply_voltage_V": 33.0, "slope_deg": 20.0},
        axis="slope_deg",
        beside=(17.5, 22.5),
    ),
    Remark("contradicted", promised=0.7, gained=0.2),
    Remark("unwritten", curve=True, gain=0.13, se=0.42),
    Remark("unwritten", curve=False, gain=-0.2, se=0.05),
    Remark("too_few_replicates", settled=100),
    Remark("sampling", method="morris", points=8),
    Remark("points_left_out", points=2, total=8, sampled=False, outputs=("speed", "current")),
    Remark("points_left_out", points=2, total=8, sampled=True, outputs=("speed",)),
    Remark("sample_left_out", points=3, share=0.0123, outputs=("speed",)),
    Remark("inert", inputs=("a", "b")),
    Remark("tied", inputs=("a", "b")),
    progress_remark("evaluations", 12345, 1234.6),
    progress_remark("alike", ("a", "b")),
    progress_remark("round", 2, 3.25, 7, 1.26),
]


RECORD = ROOT / "tests/record/pages/notes.txt"


def as_text():
    """The sentence of each sample, a line each."""
    return "".join(f"{note.code}: {describe(note)}\n" for note in SAMPLES)


@pytest.mark.parametrize("kind", sorted({note.code for note in SAMPLES}))
def test_notes_of_a_kind_read_as_recorded(kind):
    recorded, now = (
        [line for line in text.splitlines() if line.startswith(f"{kind}: ")]
        for text in (RECORD.read_text(encoding="utf-8"), as_text())
    )
    assert now == recorded != []


def test_a_callback_for_notes_passes_their_sentences_on():
    told = []
    report_in_words(told.append)(SAMPLES[0])
    assert told == [describe(SAMPLES[0])]


def made_in_code():
    """Code of each remark that the code makes, with the names of its values."""
    for file in (ROOT / "calibration").rglob("*.py"):
        for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
            if (
                isinstance(node, ast.Call)
                and ast.unparse(node.func) == "Remark"
                and isinstance(node.args[0], ast.Constant)
            ):
                yield node.args[0].value, {keyword.arg for keyword in node.keywords}


def test_each_remark_of_the_code_has_a_sample_and_a_sentence_with_its_values():
    made = list(made_in_code())
    of_experiments = {*experiment_words.SAID}  # of which test_words_experiments has samples
    assert {code for code, _ in made} == set(NOTES) == {note.code for note in SAMPLES} | of_experiments
    for code, names in made:
        if isinstance(NOTES[code], str):
            assert names >= {field for _, field, _, _ in string.Formatter().parse(NOTES[code]) if field}, code
        else:
            inspect.signature(NOTES[code]).bind(**dict.fromkeys(names))


def test_a_remark_is_a_value_and_its_values_are_attributes():
    note = Remark("in_pieces", name="a", pieces=2)
    assert note.pieces == 2 and note == copy.deepcopy(note) and note != Remark("in_pieces", name="a", pieces=3)
    with pytest.raises(AttributeError, match="remark in_pieces: no value parts"):
        note.parts  # noqa: B018


def test_a_sentence_is_its_own_words_and_what_is_no_note_says_so():
    assert describe("as it is") == "as it is"
    with pytest.raises(TypeError, match="got int; expected a note or a result"):
        describe(3)
    with pytest.raises(TypeError, match="got Remark, header; expected"):
        describe(Remark("held_by_prior", names=("a",)), "header")


@pytest.mark.parametrize(
    ("kind", "rows"),
    [("progress_remark", step_words.STEPS), ("RuledOut", loop_words.RULED_OUT)],
)
def test_names_of_rows_are_those_of_the_code(kind, rows):
    """A name without a row would fail only where it is said, and a row without a name is never said."""
    used = set()
    for room in ("inference", "discovery", "sensitivity", "sizing"):
        for file in (ROOT / "calibration" / room).rglob("*.py"):
            for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
                if isinstance(node, ast.Call) and ast.unparse(node.func) == kind and node.args:
                    at = 0 if kind == "progress_remark" else 1
                    used |= {node.args[at].value} if len(node.args) > at else {""}
    assert used | ({""} & set(rows)) == set(rows)


def test_every_reason_and_every_doubt_has_its_words():
    text = (ROOT / "calibration/discovery/standing.py").read_text(encoding="utf-8")
    assert all(f'"{why}"' in text for why in loop_words.REASONS if why)
    whys = {a.value for c in ast.walk(ast.parse(text)) if isinstance(c, ast.Call) for a in c.args[1:2]
            if ast.unparse(c.func) == "NameSupport" and isinstance(a, ast.Constant)}  # fmt: skip
    assert whys <= set(loop_words.REASONS)
    worst = NameTest("a", 0.0, 3.0, (), -99.0, 1, 0.0, 0.0, ("b",), True, varies=4.0, over="speed", offset=0.01)
    schema = (ROOT / "docs/schemas/loop.schema.json").read_text(encoding="utf-8")
    assert all(f'"{doubt}"' in schema for doubt in loop_words.DOUBTS)
    rests = dataclasses.replace(worst, root=4.0)  # below chance with all its rows it rests on none
    differs = dataclasses.replace(rests, changed="motor.inertia", root_changed=9.0)
    assert {*worst.fails, *rests.fails, *differs.fails} == set(loop_words.DOUBTS) and not NameTest(
        "a", 4.0, 3.0, (), 0.0
    ).fails


@pytest.mark.parametrize(("unit", "said"), [("-", "-0.0154 ± 0.00014"), ("ohm", "-0.0154 ± 0.00014 ohm")])
def test_a_size_has_a_unit_where_there_is_one(unit, said):
    amplitude = SimpleNamespace(value=-0.01541, sd=0.000141, unit=unit)
    assert loop_words.effect_amplitude(SimpleNamespace(parameters={"amplitude": amplitude})) == said


# --- verdicts -------------------------------------------------------------------------------------------

OVER = PlacedCurve("slip", ("slope",))


@pytest.mark.parametrize(
    ("support", "said"),
    [
        (None, ""),
        (NameSupport(True), ""),
        (NameSupport(False, "implausible"), "every effect that explains it has an implausible size"),
        (NameSupport(False, "larger", ("a", "b")), "a and b would explain more, but only at an implausible size"),
        (
            NameSupport(False, "better curve", ("a",), (PlacedCurve("speed", ("speed_motor", "slope")),)),
            "a smooth surface in the reading of speed over motor speed and slope explains the data better than a",
        ),
        (
            NameSupport(False, "curve alone", curves=(OVER,)),
            "a single smooth curve in the slip balance over slope leaves no significant misfit",
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
            "a explains 1.2 σ next to smooth curves (slip balance over slope), where chance alone reaches 3.4 σ; b is a worse "
            "explanation than a smooth curve in its place and depends on row 10 alone; c is chosen again in only 75 % of the "
            "fits without one block, explains less than d and e at an implausible size and leaves an error in "
            "its own equation",
        ),
        (
            NameSupport(False, "none by itself", tests=(NameTest("a", 1.2, 3.41, (), 0.0),)),
            "a explains 1.2 σ, where chance alone reaches 3.4 σ",
        ),
        (
            NameSupport(
                True,
                "beside",
                tests=(NameTest("a", 6.91, 3.27, (OVER,), 1.0, 11, 5.8), NameTest("b", 5.0, 3.27, (), 0.0)),
            ),
            "each effect, added to the others, explains more than chance: a scores 6.9 σ (chance "
            "alone reaches 3.3 σ, and 5.8 σ remain without row 11), b scores 5.0 σ (chance alone reaches 3.3 σ)",
        ),
    ],
)
def test_why_names_stand_or_not(support, said):
    assert loop_words.support_reasons(support) == said


def test_verdict_of_a_complete_model():
    off = Remark("noise_off", channel="", factor=2.0, source="stated")
    said = "Nothing is missing: the residuals are consistent with noise (family-wise p = 0.4)."
    assert loop_words.verdict_sentences(VerdictSummary("none", 0.4, None)) == said
    assert (
        loop_words.verdict_sentences(VerdictSummary("none", 0.4, None, noise=(off,))) == f"{said} But {describe(off)}"
    )
    aside = loop_words.verdict_sentences(VerdictSummary("none", 0.4, None, aside=10, of=100))
    assert aside == f"10 of 100 rows (10 %) are set aside as outliers. {said}"


def test_verdict_tells_what_is_tentative():
    test = NameTest("b", 5.0, 3.4, (), 9.0, 10, 2.0)
    sure, tentative = MissingEffect(("a",), (), ("drop",)), MissingEffect(("b",), (), ("slip",), False, test)
    assert loop_words.verdict_sentences(VerdictSummary("named", 0.001, None, (sure, tentative))) == (
        "Missing: a (family-wise p ≤ 0.001). Tentative, kept in the model because it improves predictions: b, which depends on row 10 alone."
    )
    # where no name stands and it was not tested by itself, what speaks against all of them
    curve = NameSupport(False, "curve alone", curves=(OVER,))
    place = SimpleNamespace(
        place="slip", variable="slope", alike=("slip",), variables_alike=(), family="slip", by_duty=False
    )
    only = MissingEffect(("b",), (), ("slip",), False)
    said = loop_words.verdict_sentences(VerdictSummary("place", 0.001, place, (only,), support=curve))
    assert "No effect of the library is established" in said
    assert said.endswith(
        "improves predictions: b (a single smooth curve in the slip balance over slope leaves no significant misfit)."
    )


def test_a_mechanism_is_stated_with_what_it_explains_and_predicts():
    found = Mechanism(("loss torque that changes with speed", "slip"), ("a",), 0.99, 0.8, 0.1, 1.0)
    place = SimpleNamespace(
        place="track", variable="speed_motor", alike=("track",), variables_alike=(), family="x", by_duty=False
    )
    said = loop_words.verdict_sentences(VerdictSummary("mechanism", 0.001, place, mechanism=found))
    assert said.startswith(
        "Missing: a loss torque that changes with speed or a slip, established as a mechanism. It "
    )
    assert (
        "explains 99 % of the misfit beyond noise, raises the log likelihood of held-out runs by 0.8 per" in said
        and "8.0 standard errors" in said
    )
    weak = dataclasses.replace(found, families=("slip",), share=0.3, gain=0.1)
    said = loop_words.verdict_sentences(VerdictSummary("place", 0.001, place, mechanism=weak))
    assert (
        "No mechanism is established: the best candidate is a slip, but it explains only 30 % of the misfit beyond noise and"
        in said
    )
    assert loop_words.brief_verdict(VerdictSummary("mechanism", 0.001, place, mechanism=weak)) == "mechanism: slip"


def test_a_mechanism_is_stated_with_its_window_and_why_no_name_stands():
    """A discrepancy of some runs alone: its window stands in verdict and answer, and what leaves no significant misfit comes first."""
    here = SimpleNamespace(
        place="slip", variable="order 30 to 44", alike=("slip",), variables_alike=("order 31 to 44",), by_duty=False,
        family="slip that changes with order", window={"axis": "order", "low": 30.0, "high": 44.0},
    )  # fmt: skip
    mechanism = Mechanism((here.family,), (), 0.99, 0.8, 0.1, 1.0)
    summary = VerdictSummary("mechanism", 0.001, here, mechanism=mechanism)
    within = "order, in runs 30 to 44 (equally clear in runs 31 to 44)"
    assert loop_words.verdict_sentences(summary).startswith(
        f"Missing: a slip that changes with {within}, established as a mechanism"
    )
    other = dataclasses.replace(mechanism, families=("slip that changes with load",))
    assert "in runs" not in loop_words.verdict_sentences(dataclasses.replace(summary, mechanism=other))
    support = NameSupport(False, "none by itself", tests=(NameTest("a", 1.2, 3.41, (), 0.0),))
    found = SimpleNamespace(
        verdict="mechanism", summary=summary, effects=(), unnamed=here, support=support, after=SimpleNamespace(adequate=True)
    )  # fmt: skip
    said = "a single constant in the slip balance in runs 30 to 44 leaves no significant misfit; a explains 1.2 σ, where chance alone reaches 3.4 σ"
    assert loop_words.naming_reasons(found) == said
    found.after.adequate = False
    assert loop_words.naming_reasons(found) == loop_words.support_reasons(support)


def test_every_doubt_about_a_mechanism_has_words():
    none = Mechanism(
        tuple(f"loss torque that changes with {x}" for x in "abcd"), (), 0.1, 0.0, np.inf, 0.0, run=2, changed="track"
    )
    assert set(none.fails) == set(loop_words.NO_MECHANISM) and all(loop_words.no_mechanism(none).split())


@pytest.mark.parametrize(
    ("value", "said"),
    [
        ([4.0, 1.0, 0.5], "falls from 4 N·m at 95.5 rpm to 0.5 N·m at 955 rpm"),
        ([0.5, 6.0, 1.0], "rises from 0.5 N·m at 95.5 rpm to 1 N·m at 955 rpm, passing 6 N·m at 191 rpm"),
    ],
)
def test_the_course_of_a_curve_is_told_by_its_ends(value, said):
    at = np.array([10.0, 20.0, 100.0])
    curve = SimpleNamespace(window=None, variable="speed_motor", at=at, value=np.array(value), unit="N·m")
    assert loop_words.curve_course(curve) == said
    assert loop_words.curve_course(SimpleNamespace(**vars(curve) | {"window": {}})) == ""


def test_verdicts_at_other_noise_are_one_sentence():
    def other(factor, verdict, *missing):
        return NoiseVerdict(factor, verdict, VerdictSummary(verdict, 0.01, None, missing), (), True)

    sure, weak = MissingEffect(("a", "c"), (), ("x",)), MissingEffect(("b",), (), ("y",), False)
    assert loop_words.at_other_noise(()) == ""
    assert loop_words.at_other_noise([other(0.7, "class", sure, weak), other(1.4, "class", sure, weak)]) == (
        "with 0.7 and with 1.4 times the noise, the verdict is class: a established, b tentative"
    )
    assert loop_words.at_other_noise([other(0.5, "place", weak), other(2, "none")]) == (
        "with 0.5 times the noise, the verdict is place: b tentative, and with 2 times the noise, the verdict is none"
    )


def test_verdict_lists_what_cannot_be_told_apart():
    value = AlternativeValue("motor.resistance", 1.9377, "ohm")
    one = MissingEffect(("a",), (value,), ("losses",))
    two = MissingEffect(("b", "c"), (), ("leads", "supply"))
    assert loop_words.verdict_sentences(VerdictSummary("class", 0.0004, None, (one, two))) == (
        "Missing: losses, a, or motor.resistance is 1.94 ohm (these data cannot distinguish them) and one of b, c (these "
        "data cannot distinguish them) (family-wise p ≤ 0.0004)."
    )
    assert loop_words.verdict_sentences(
        VerdictSummary("named", 0.002, None, (MissingEffect(("a",), (), ("x",)),))
    ) == ("Missing: a (family-wise p ≤ 0.002).")


@pytest.mark.parametrize(("sampled", "said"), [
    (False, "angle_friction (at 1.5 times its largest plausible size), torque_offset (only time histories can tell)"),
    (True, "angle_friction (at 1.5 times its largest plausible size)"),
])  # fmt: skip
def test_what_settled_runs_cannot_tell_from_an_effect_is_said_of_them_alone(sampled, said):
    members = {"directional_friction": SimpleNamespace(size=0.1), "angle_friction": SimpleNamespace(size=1.5)}
    effect = SimpleNamespace(members=members, stated={})
    assert (
        loop_words.indistinguishable_effects(SimpleNamespace(runs=SimpleNamespace(sampled=sampled)), effect) == said
    )


def test_a_formula_without_terms_says_so():
    assert Proposal("", (), (), (), (), 0.0, 0.0, 9).formula == "no single term explains 90 % of the curve"
    assert Proposal("ΔU = 1 V", (), (1.0,), (0.1,), (), 0.0, 3.0, 9).formula == "ΔU = 1 V"


def test_why_an_effect_is_ruled_out():
    reasons = (RuledOut("a", "power"), RuledOut("b", "size", 2.94, ("x", "y")), RuledOut("c", "edge"))
    assert loop_words.why_ruled_out(reasons) == (
        "a would supply power instead of losing it; b would have 2.9 times its largest plausible size, so check x and y; c is within one sd of its "
        "largest plausible size"
    )


@pytest.mark.parametrize(
    ("found", "predicted", "said"),
    [
        ((10, 4.3, 4.72), (10, 10), "motor speed 4.3 → 4.7 % (same 10 rows)"),
        ((10, 0.141, 0.149), (10, 10), "motor speed 0.14 → 0.15 % (same 10 rows)"),
        ((8, 4.0, 5.0), (8, 10), "motor speed 4.0 → 5.0 % (same 8 rows)"),
        (None, (10, 8), "2 rows can no longer be predicted"),
        (None, (10, 9), "1 row can no longer be predicted"),
        (None, (10, 10), ""),
    ],
)
def test_what_is_predicted_worse_is_said_with_its_rows(found, predicted, said):
    worse = () if found is None else (WorseChannel("voltage", "motor_speed", *found),)
    whole = f"Predictions of held-out rows get worse: by voltage {said}."
    assert loop_words.rising_errors_sentence(worse, {"voltage": predicted}) == (whole if said else "")


@pytest.mark.parametrize(
    ("about", "said"),
    [
        (("missing", "slip", "speed_motor"), "the error of the slip balance over motor speed"),
        (("found", "", "", ("a", "b")), "a, b, found by the lumped model"),
        (("near", "", "", ("a",)), "a, which explains the readings nearly as well"),
    ],
)
def test_what_the_track_model_is_asked_about(about, said):
    assert loop_words.track_model_question(of_loop.TrackModelQuestion(*about)) == said


# --- whether a fit is adequate --------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("found", "said"),
    [
        (
            Adequacy(False, 812.3, 600.0, 1e-9, AdequacyFinding(what="stated"), True),
            "Not adequate: the residuals exceed the stated noise (χ² 812.3 on 600 degrees of freedom, p < 1e-6), so "
            "a term is missing, which parameters may absorb. Run mmrjax loop to find it",
        ),
        (
            Adequacy(False, 60.0, 60.0, 0.0021, AdequacyFinding("motor_speed", "follow", "slope_deg"), False),
            "Not adequate: the residuals of motor speed depend on slope_deg (p = 0.0021, with estimated noise), "
            "so a term is missing, which parameters may absorb. Run mmrjax loop to find it",
        ),
        (
            Adequacy(True, 61.0, 60.0, 0.4, AdequacyFinding(what="repeats"), True),
            "Adequate: the residuals are consistent with the stated noise (χ² 61 on 60 degrees of freedom, p = 0.4)",
        ),
        (
            Adequacy(True, 50.0, 50.0, 0.4, AdequacyFinding(), False),
            "Adequate as far as can be tested: the residuals show no structure (p = 0.4). The noise was estimated from "
            "them",
        ),
        (
            Adequacy(None, 5.0, 2.5, None, AdequacyFinding(), False),
            "Adequacy cannot be tested: the noise was estimated from the misfit, with only 2.5 degrees of freedom. "
            "State it with --noise",
        ),
    ],
)
def test_adequacy_is_said(found, said):
    assert found.statement == said and found.to_json()["statement"] == said
    assert found.to_json()["shown_by"] == fit_words.adequacy_finding_in_words(found.shown_by)


def clustered(levels, **other):
    """Residuals of speed that go with a column. `levels`: means by name."""
    means = tuple(LevelMean(name, "", mean, 9) for name, mean in levels.items())
    known = dict(
        column="wheel", channel="speed", unit="mm/s", within="", reversing=False, levels=means, correlation=None, p=2e-7,
        alike=(), coarser=(),
    )  # fmt: skip
    return ResidualCluster(**{**known, **other})


@pytest.mark.parametrize(
    ("found", "said"),
    [
        (
            clustered({"1": -14.42, "2": 3.6}, alike=("direction_deg",)),
            "residuals of speed differ between the levels of wheel (simulated minus measured: 1: -14 mm/s, 2: +3.6 mm/s, p = 2e-07), "
            "a column that the model does not use (as well by direction_deg). Give each level its own configuration, or find what "
            "differs",
        ),
        (
            clustered({"1": -1.0, "2": 1.0}, reversing=True, within="configuration", coarser=(("axle", 0.91),)),
            "residuals of speed differ between the levels of wheel within configuration, with opposite signs in the two directions of travel "
            "(simulated minus measured: 1: -1 mm/s, 2: +1 mm/s, p = 2e-07), a column that the model does not use (axle alone "
            "91% of it). Give each level its own configuration, or find what differs",
        ),
        (
            clustered({}, correlation=-0.456),
            "residuals of speed are correlated with wheel (rank correlation -0.46, p = 2e-07), a column that the model does not use. Find "
            "what changes with it",
        ),
    ],
)
def test_what_residuals_cluster_by_is_said(found, said):
    assert found.statement == said == describe(found) == found.to_json()["statement"]


def test_six_levels_that_are_furthest_off_are_listed():
    said = clustered({str(k): k - 5.0 for k in range(1, 10)}).statement
    assert [int(k) for k in re.findall(r"(\d): [+-]", said)] == [1, 2, 3, 7, 8, 9] and ", ..., p" in said


def test_tests_that_are_as_improbable_are_named_in_the_order_of_their_words():
    """Of several that are zero to rounding the first is named: data are compared as their sentences are."""
    every = [AdequacyFinding(what="stated"), AdequacyFinding(what="repeats")]
    every += [
        AdequacyFinding(c, "follow", v) for c in ("total_current", "speed") for v in ("the fitted speed", "slope_deg")
    ]
    every += [AdequacyFinding(c, "remember") for c in ("motor_speed", "total_current")]
    assert sorted(every) == sorted(every, key=fit_words.adequacy_finding_in_words)


def test_what_would_measure_is_found_by_either_end_of_a_name():
    assert table_words.would_measure("motor.inductance").startswith("a history of the starting current")
    assert re.search("faster than V_d", table_words.would_measure("6T2A.ground.friction.dynamic"))
    assert table_words.would_measure("x.y") == "runs under conditions in which it has an effect"


def test_lines_of_a_terminal_have_80_columns_and_those_of_a_file_are_whole(capsys):
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
