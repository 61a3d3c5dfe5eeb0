"""What is said of data, in words: one sentence for each kind of note, and no kind without one."""

import ast
import dataclasses
import inspect
import re
import string
import tomllib
from types import SimpleNamespace

import numpy as np
import pytest
from synthetic import LOST_MOTION

from calibration.described import describe
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
from calibration.words import experiment_words, loop_words, step_words
from calibration.words.note_words import NOTES
from mmrjax.model import channels
from sweeps import console
from sweeps.pages.words import FILES
from tests.commands import ROOT
from tests.pages import recorded


def as_tuples(value):
    return tuple(map(as_tuples, value)) if isinstance(value, list) else value


REMARKS = (ROOT / "tests/record/pages/remarks.toml").read_text(encoding="utf-8")
#: Notes of every kind, most of `remarks.toml`; their sentences are in `tests/record/pages/notes.txt`, which `python tests/test_words.py` writes.
SAMPLES = [
    *(
        Remark(code, **{name: as_tuples(value) for name, value in values.items()})
        for code, each in tomllib.loads(REMARKS).items()
        for values in each
    ),
    Remark(
        "only_together",
        pairs=(
            of_fit.DependentPair("a", "b", 0.99, "ratio", -1.0),
            of_fit.DependentPair("a", "c", -1.0, "linear", 0.031),
        ),
    ),
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
    LOST_MOTION,
    Remark("edge", bound="", sds=-2.64),
    Remark("determined", held=False, others=("a", "b")),
    Remark(
        "ended_at_edge", edge={"a": Remark("edge", bound="upper", sds=9.0), "b": Remark("edge", bound="", sds=-2.64)}
    ),
    Remark(
        "noise_from_series",
        noise=(
            SeriesNoise(channels.find_channel("total_current"), 0.0546, 0.0133, 7.45, "slope_deg", 4),
            SeriesNoise(channels.find_channel("speed"), 0.0, 0.0124, 7.44, "slope_deg", 4, 0.004),
        ),
    ),
    *(Remark("unshown", source="log.csv", why=why) for why in loop_words.UNSHOWN),
    Remark("run_differs", test=NameTest("slip", 10.57, 3.3, (), 0.0, 2, changed="motor.inertia", root_changed=11.2)),
    Remark("run_differs", test=NameTest("slip", 10.57, 3.3, (), 0.0, 2, changed="track", root_changed=11.2)),
    Remark(
        "rests_on",
        test=NameTest("slip", 10.57, 3.3, (), 0.0, 10, 4.3),
        conditions={"configuration": "6T2A", "supply_voltage_V": 33.0, "slope_deg": 20.0},
        axis="slope_deg",
        beside=(17.5, 22.5),
    ),
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
    then, now = (
        [line for line in text.splitlines() if line.startswith(f"{kind}: ")]
        for text in (RECORD.read_text(encoding="utf-8"), as_text())
    )
    assert now == then != []


def made_in_code():
    """Code of each remark that the code makes, with the names of its values."""
    for file in (ROOT / "calibration").rglob("*.py"):
        for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
            if (
                isinstance(node, ast.Call)
                and ast.unparse(node.func).rpartition(".")[2] == "Remark"
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


@pytest.mark.parametrize(
    "kind, rows",
    [("progress_remark", step_words.STEPS), ("RuledOut", loop_words.RULED_OUT)],
)
def test_names_of_rows_are_those_of_the_code(kind, rows):
    """A name without a row would fail only where it is said, and a row without a name is never said."""
    used = set()
    for room in ("inference", "discovery", "sensitivity", "sizing"):
        for file in (ROOT / "calibration" / room).rglob("*.py"):
            for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
                if isinstance(node, ast.Call) and ast.unparse(node.func).rpartition(".")[2] == kind and node.args:
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


# --- sentences ------------------------------------------------------------------------------------------

OVER = PlacedCurve("slip", ("slope",))
CHANCE = NameTest("a", 1.2, 3.41, (), 0.0)
SURE, TENTATIVE = MissingEffect(("a", "c"), (), ("x",)), MissingEffect(("b",), (), ("y",), False)
SPEED = "loss torque that changes with speed"
MECHANISM = Mechanism((SPEED, "slip"), ("a",), 0.99, 0.8, 0.1, 1.0)
PLACE = SimpleNamespace(
    place="slip", variable="slope", alike=("slip",), variables_alike=(), family="slip", by_duty=False, window=None
)
SUPPORTS = (
    None,
    NameSupport(True),
    NameSupport(False, "implausible"),
    NameSupport(False, "larger", ("a", "b")),
    NameSupport(False, "better curve", ("a",), (PlacedCurve("speed", ("speed_motor", "slope")),)),
    NameSupport(False, "curve alone", curves=(OVER,)),
    NameSupport(False, "none by itself", tests=(
        NameTest("a", 1.2, 3.41, (OVER,), 0.0), NameTest("b", 5.0, 3.41, (), -20.0, 10, 2.0),
        NameTest("c", 5.0, 3.41, (), 9.0, again=0.75, larger=("d", "e"), remains=True),
    )),
    NameSupport(False, "none by itself", tests=(CHANCE,)),
    NameSupport(True, "beside", tests=(
        NameTest("a", 6.91, 3.27, (OVER,), 1.0, 11, 5.8), NameTest("b", 5.0, 3.27, (), 0.0),
    )),
)  # fmt: skip


def verdicts():
    """Verdicts of every kind: complete, with outliers and wrong noise, named, tentative, classes, and mechanisms."""
    yield "none", 0.4, None, {}
    yield "none", 0.4, None, {"noise": (Remark("noise_off", channel="", factor=2.0, source="stated"),)}
    yield "none", 0.4, None, {"aside": 10, "of": 100}
    yield "named", 0.002, None, {"missing": (MissingEffect(("a",), (), ("x",)),)}
    rests = MissingEffect(("b",), (), ("slip",), False, NameTest("b", 5.0, 3.4, (), 9.0, 10, 2.0))
    yield "named", 0.001, None, {"missing": (MissingEffect(("a",), (), ("drop",)), rests)}
    # where no name stands and it was not tested by itself, what speaks against all of them
    yield "place", 0.001, PLACE, {"missing": (TENTATIVE,), "support": SUPPORTS[5]}
    value = AlternativeValue("motor.resistance", 1.9377, "ohm")
    alike = MissingEffect(("a",), (value,), ("losses",)), MissingEffect(("b", "c"), (), ("leads", "supply"))
    yield "class", 0.0004, None, {"missing": alike}
    yield "mechanism", 0.001, PLACE, {"mechanism": MECHANISM}
    weak = dataclasses.replace(MECHANISM, families=("slip",), share=0.3, gain=0.1)
    yield "place", 0.001, PLACE, {"mechanism": weak}


def windows():
    """Verdict of a mechanism in some runs alone, of another one, and why no name stands, by an adequate fit and another."""
    here = SimpleNamespace(**vars(PLACE) | {
        "variable": "order 30 to 44", "variables_alike": ("order 31 to 44",), "family": "slip that changes with order",
        "window": {"axis": "order", "low": 30.0, "high": 44.0},
    })  # fmt: skip
    own = dataclasses.replace(MECHANISM, families=(here.family,), effects=())
    summary = VerdictSummary("mechanism", 0.001, here, mechanism=own)
    other = dataclasses.replace(own, families=("slip that changes with load",))
    for each in (summary, dataclasses.replace(summary, mechanism=other)):
        yield loop_words.verdict_sentences(each)
    for adequate in (True, False):
        yield loop_words.naming_reasons(SimpleNamespace(
            verdict="mechanism", summary=summary, effects=(), unnamed=here, support=SUPPORTS[7], adequate_after=adequate,
        ))  # fmt: skip


def other_noise():
    def other(factor, verdict, *missing):
        return NoiseVerdict(factor, verdict, VerdictSummary(verdict, 0.01, None, missing), (), True)

    yield ()
    yield other(0.7, "class", SURE, TENTATIVE), other(1.4, "class", SURE, TENTATIVE)
    yield other(0.5, "place", TENTATIVE), other(2, "none")


WORSE = [
    ((10, 4.3, 4.72), (10, 10)), ((10, 0.141, 0.149), (10, 10)), ((8, 4.0, 5.0), (8, 10)), (None, (10, 8)),
    (None, (10, 9)), (None, (10, 10)),
]  # fmt: skip
ADEQUACY = (
    Adequacy(False, 812.3, 600.0, 1e-9, AdequacyFinding(what="stated"), True),
    Adequacy(False, 60.0, 60.0, 0.0021, AdequacyFinding("motor_speed", "follow", "slope_deg"), False),
    Adequacy(True, 61.0, 60.0, 0.4, AdequacyFinding(what="repeats"), True),
    Adequacy(True, 50.0, 50.0, 0.4, AdequacyFinding(), False),
    Adequacy(None, 5.0, 2.5, None, AdequacyFinding(), False),
)


def clustered(levels, **other):
    """Residuals of speed that go with a column. `levels`: means by name."""
    means = tuple(LevelMean(name, "", mean, 9) for name, mean in levels.items())
    known = dict(
        column="wheel", channel="speed", unit="mm/s", within="", reversing=False, levels=means, correlation=None, p=2e-7,
        alike=(), coarser=(),
    )  # fmt: skip
    return ResidualCluster(**{**known, **other})


CLUSTERS = (
    clustered({"1": -14.42, "2": 3.6}, alike=("direction_deg",)),
    clustered({"1": -1.0, "2": 1.0}, reversing=True, within="configuration", coarser=(("axle", 0.91),)),
    clustered({}, correlation=-0.456),
    clustered({str(k): k - 5.0 for k in range(1, 10)}),  # the six that are furthest off
)


def sentences():
    """Function and sentence of each case."""
    for unit in ("-", "ohm"):
        amplitude = SimpleNamespace(value=-0.01541, sd=0.000141, unit=unit)
        yield loop_words.effect_amplitude(SimpleNamespace(parameters={"amplitude": amplitude}))
    yield from map(loop_words.support_reasons, SUPPORTS)
    for verdict, p, place, more in verdicts():
        summary = VerdictSummary(verdict, p, place, **more)
        yield f"{loop_words.brief_verdict(summary)} | {loop_words.verdict_sentences(summary)}"
    yield from windows()
    for value in ([4.0, 1.0, 0.5], [0.5, 6.0, 1.0]):
        curve = {
            "variable": "speed_motor",
            "at": np.array([10.0, 20.0, 100.0]),
            "value": np.array(value),
            "unit": "N·m",
        }
        yield from (loop_words.curve_course(SimpleNamespace(**curve, window=window)) for window in (None, {}))
    yield from map(loop_words.at_other_noise, other_noise())
    members = {"directional_friction": SimpleNamespace(size=0.1), "angle_friction": SimpleNamespace(size=1.5)}
    for sampled in (False, True):  # only histories can tell some effects apart
        seen, effect = (
            SimpleNamespace(runs=SimpleNamespace(sampled=sampled)),
            SimpleNamespace(members=members, stated={}),
        )
        yield loop_words.indistinguishable_effects(seen, effect)
    yield Proposal("", (), (), (), (), 0.0, 0.0, 9).formula
    yield Proposal("ΔU = 1 V", (), (1.0,), (0.1,), (), 0.0, 3.0, 9).formula
    reasons = RuledOut("a", "power"), RuledOut("b", "size", 2.94, ("x", "y")), RuledOut("c", "edge")
    yield loop_words.why_ruled_out(reasons)
    for found, predicted in WORSE:
        worse = () if found is None else (WorseChannel("voltage", "motor_speed", *found),)
        yield loop_words.rising_errors_sentence(worse, {"voltage": predicted})
    yield from (found.statement for found in (*ADEQUACY, *CLUSTERS))


def test_sentences_read_as_recorded():
    text = "".join(f"{sentence}\n" for sentence in sentences())
    assert text == recorded("sentences", text)


def test_every_doubt_about_a_mechanism_has_words():
    none = Mechanism(
        tuple(f"loss torque that changes with {x}" for x in "abcd"), (), 0.1, 0.0, np.inf, 0.0, run=2, changed="track"
    )
    assert set(none.fails) == set(loop_words.NO_MECHANISM) and all(loop_words.no_mechanism(none).split())


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
