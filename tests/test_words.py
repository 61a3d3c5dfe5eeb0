"""What is said of data, in words: one sentence for each kind of note, and no kind without one."""

import ast
import dataclasses
import re
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from calibration.described import in_words
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
from mmrjax.model import channels
from sweeps import console
from sweeps.pages.words import FILES
from sweeps.report.words import fit_words, loop_words, step_words, table_words
from sweeps.report.words.note_words import NOTES, describe

ROOT = Path(__file__).resolve().parents[1]
#: Notes, and what is said of them.
SAMPLES = [
    (of_fit.HeldByPrior(("a",)), "not determined by these runs (posterior sd above 0.9 of the prior's): a"),
    (
        of_fit.OnlyTogether(
            (of_fit.Pair("a", "b", 0.99, "ratio", -1.0), of_fit.Pair("a", "c", -1.0, "linear", 0.031))
        ),
        "determined only together: the ratio of a and b (correlation +0.990), a + 0.031 · c (correlation -1.000)",
    ),
    (of_fit.HeldByPrior(("a", "b")), "not determined by these runs (posterior sd above 0.9 of the prior's): a, b"),
    (
        of_fit.FarFromPrior("m", 3.2, "loop"),
        "m is implausible, 3.2 prior sds from its prior: it probably absorbs a missing effect",
    ),
    (
        of_fit.FarFromPrior("m", 3.2, "calibration"),
        "m lies 3.2 prior sds from its prior: the prior or the model is wrong",
    ),
    (
        of_fit.FarFromPrior("m", 2.7, "edge"),
        "m: its posterior mean lies 2.7 prior sds from its prior, at the edge of where the search looked: widen the "
        "prior and search again, or doubt the model",
    ),
    (
        of_fit.NoiseOff("", 10.04, "stated"),
        "residuals are 10 times the stated sds in every channel, under all conditions alike: are the sds right?",
    ),
    (
        of_fit.NoiseOff("speed", 3.0, "assumed"),
        "residuals of speed are 3 times the assumed sds, under all conditions alike: are these sds right?",
    ),
    (of_fit.Fact("no grip"), "no run grips: static friction, and slip below it, are known by their priors alone"),
    (
        of_fit.Unmeasured("6T2A.mass"),
        "6T2A.mass: nothing in these data measures it; its value is its prior's. a scale, or runs whose table does not "
        "state total_mass_kg would",
    ),
    (
        of_fit.LargerNoise("total_current", 8.3, 12, "stated"),
        "total_current: 12 pairs of rows at the same conditions scatter 8.3 times as much as the stated noise says; its "
        "sd is taken 8.3 times as large. Check the repeats, or state the noise with --noise",
    ),
    (
        of_fit.Repeats("r.csv", (1, 2), "motor_speed_rpm", (4564.6, 4373.6), "6 sd", ("torque",), 2),
        "r.csv rows 1 and 2, motor_speed_rpm: the same conditions gave 4564.6 and 4373.6, 6 sd apart (and so 2 more); "
        "torque varies there and is not used as a condition: name it under [columns], or give each level of a load a "
        "configuration",
    ),
    (
        of_fit.Repeats("r.csv", (1, 2), "motor_speed_rpm", (4500.0, 4300.0), "5%", (), 3),
        "r.csv rows 1 and 2, motor_speed_rpm: the same conditions gave 4500 and 4300, 5% apart (and so 3 more); if one is "
        "wrong, remove it, else find what changed between such rows that the table does not state",
    ),
    (
        of_fit.Repeats("r.csv", (1, 2), "motor_speed_rpm", (4500.0, 4300.0), "5%"),
        "r.csv rows 1 and 2, motor_speed_rpm: the same conditions gave 4500 and 4300, 5% apart; if one is wrong, "
        "remove it",
    ),
    (
        of_fit.Repeats("r.csv", (1, 2), "motor_speed_rpm", (45.0, 43.0), "5%", ("M_b_mNm",), near="load_torque_mNm"),
        "r.csv rows 1 and 2, motor_speed_rpm: the same conditions gave 45 and 43, 5% apart; M_b_mNm varies there and is "
        'not used as a condition: state [columns] load_torque_mNm = "M_b_mNm", or give each level of a load a '
        "configuration",
    ),
    (
        of_fit.Unused("r.csv", (("M_b_Nm", "load_torque_Nm"), ("room", ""))),
        "r.csv: M_b_Nm, room vary from row to row and are not used; if M_b_Nm is load_torque_Nm, state [columns] "
        'load_torque_Nm = "M_b_Nm" in the robot\'s file',
    ),
    (of_fit.Unused("r.csv", (("room", ""),)), "r.csv: room varies from row to row and is not used"),
    (
        of_fit.NoLoadGives("r.csv", "output_torque_Nm", "M", 0.974),
        "r.csv, M: friction and a constant torque of a load leave 97% of its variance unexplained; if a brake sets it, "
        'it is a condition: state [columns] load_torque_Nm = "M" in the robot\'s file, and take output_torque out of '
        "its channels",
    ),
    (
        of_fit.NothingVaries("r.csv", 20, "supply_voltage_V"),
        "r.csv: nothing varies in these 20 runs but noise, so nothing can be told from them; record runs at several values "
        "of supply_voltage_V or of the load",
    ),
    (
        of_fit.NothingVaries("r.csv", 20, "supply_voltage_V", ("a", "b")),
        "r.csv: nothing varies in these 20 runs but noise, so nothing can be told from them; a, b vary and are not used: "
        "name them under [columns] if they are conditions, or record runs at several values of supply_voltage_V or of "
        "the load",
    ),
    (
        of_fit.Copied("r.csv", "output_torque_Nm", "motor_current_A", 0.2, -0.5, False),
        "r.csv, output_torque_Nm: in every row 0.2 - 0.5 times motor_current_A, to the last digit: it is computed from it "
        "and no reading; remove it from channels and table, or read an instrument",
    ),
    (
        of_fit.Copied("r.csv", "output_speed_rpm", "motor_speed_rpm", 0.0, 0.05, True),
        "r.csv, output_speed_rpm: in every row 0.05 times motor_speed_rpm, to the last digit; if it is computed from it "
        "and no reading, remove it, as its noise then counts twice",
    ),
    (
        of_fit.Turned("r.csv", "motor_current_A", "Iq", 8.04, 0.31),
        "r.csv, Iq: off by 8 (rms) from what the file's numbers give, with the other sign by 0.31; if it is turned "
        'round, state [columns] motor_current_A = {column = "Iq", factor = -1}',
    ),
    (
        of_fit.StiffSupply("motor_voltage_V", 24.0),
        "motor_voltage_V is 24 in every row: taken for a stiff supply; if it is no reading, remove the column",
    ),
    (
        of_fit.Constant("slope_deg", 5.0, "guides"),
        "slope_deg is 5 in every row: rolling resistance, guide friction and Coulomb losses act alike without slopes, "
        "and only their priors tell them apart",
    ),
    (
        of_fit.Constant("motor_speed_rpm", 900.0, "speed"),
        "motor_speed_rpm is 900 in every row: losses that grow with speed and those that do not act alike at one speed, "
        "and only their priors tell them apart",
    ),
    (
        of_fit.EndsEarly(("a", "b"), 0.01, 0.4),
        "runs a, b end after 0.01 s at the latest, at 40% of the speed of steady travel: before the robot is under way, "
        "so what resists its travel is known by its priors; record until the speed is steady",
    ),
    (
        of_fit.EndsEarly(("a",), 0.01, float("nan")),
        "run a ends after 0.01 s at the latest: before the robot is under way, so what resists its travel is known by "
        "its priors; record until the speed is steady",
    ),
    (
        of_fit.Thinned("log.csv", 25000, 3600),
        "log.csv: readings of 3600 of 25000 rows are used, evenly in time, and what drives the runs in all of them; "
        "--rows uses more or fewer, and settle uses all",
    ),
    (
        of_fit.NeverGrips(("a",), 0.31),
        "run a never grips: in the end the robot travels at 31% of the speed of its movers, so what the ground holds "
        "before it slides is not measured there",
    ),
    (
        of_fit.CoarseSteps(90.0, 0.03),
        "runs of 90 s are followed in steps of 30 ms: waves of a shaft faster than some ten steps are not resolved; cut "
        "the runs to look for them",
    ),
    (
        of_fit.StopsOnSlope(("a", "b")),
        "run a, b: the motors are not driven on a slope; histories have smooth friction at rest, and a robot that "
        "should stand there creeps by some mm/s. Leave rows at rest out where their readings are finer than that",
    ),
    (
        of_fit.InheritedPriors("motor", (("torque_constant", 0.012, 0.0259),), ("motor.a", "motor.b")),
        "motor is not the nominal robot's (torque_constant 0.012 for 0.0259), but its motor.a, motor.b still are: those "
        "priors come from another robot; state yours in the robot's file or with --prior",
    ),
    (
        of_fit.InheritedPriors("motor", (("torque_constant", 0.012, 0.0259),), ("motor.a",)),
        "motor is not the nominal robot's (torque_constant 0.012 for 0.0259), but its motor.a still is: that prior "
        "comes from another robot; state yours in the robot's file or with --prior",
    ),
    (
        of_fit.OffBy("speed_mm_s", "mm/s", 1 / 3, (), (), "supply_voltage_V"),
        "speed_mm_s: readings are about 3 times too small for this robot; check the unit, mm/s, and the robot's file",
    ),
    (
        of_fit.OffBy("speed_mm_s", "mm/s", 1000.0, ("um/s", "nm/s"), ("motor_speed_rpm",), "supply_voltage_V"),
        "speed_mm_s: readings are about 1000 times too large for this robot; are they in um/s or nm/s? expected mm/s; "
        "motor_speed_rpm alike: check supply_voltage_V and the robot's file",
    ),
    (
        of_fit.SlopesIn("radians", 57.3),
        "slope_deg: the current rises 57 times as fast with the slope as this robot's; are the slopes in radians? "
        "expected degrees",
    ),
    (
        of_fit.EstimatedNoise((("motor_speed", 1.23), ("speed", 4.0))),
        "no noise was stated for motor speed 1.2 %, speed 4.0 %: estimated from the misfit, so it includes model error "
        "and cannot test whether the model is adequate",
    ),
    (
        of_fit.BesideSteady(2, 3, "a", 2.345),
        "2 of 3 parameters lie within their 95 % intervals of the same problem's optimum with steady; furthest apart is "
        "a, 2.35 sd",
    ),
    (
        of_fit.OfRows((1, 2), "limited", 0.01),
        "rows 1, 2 are within 1% of the adhesion limit: it bounds their static friction from below, and does not explain "
        "all of their slip",
    ),
    (
        of_fit.OfRows((3,), "jumps"),
        "rows 3: the calibrated robot's running gear jumps; it leaves the ground at times",
    ),
    (of_fit.OfRows((3,), "slides"), "rows 3: slides with the calibrated robot"),
    (of_fit.AtBound("a", "upper"), "a is at its upper bound"),
    (of_fit.ProductAlone("f", "s", True), "only the product f x s acts; the priors alone divide it"),
    (of_fit.ProductAlone("f", "s", False), "s is found with f held: only their product acts"),
    (
        of_fit.PriorOfProduct("f", 0.06, 0.02, 0.98),
        "f: its prior, 0.06 ± 0.02, is that of its product with the share of the guides in the other fidelities; the "
        "track model puts 98% of the weight on them",
    ),
    (
        of_fit.NoPrediction("voltage_configuration", 2, 20),
        "held out by voltage and configuration: 2 of 20 rows have no prediction, because the robot fitted without them "
        "slides there; the errors leave them out",
    ),
    (
        of_fit.SamePredictions("voltage_configuration", ("voltage", "payload")),
        "held out by voltage or by payload: the same predictions as held out by voltage and configuration, which stand "
        "for them; these runs do not vary them apart",
    ),
    (of_fit.BlockNotConverged("slope"), "a search without a block of slope did not converge"),
    (of_fit.Agreement(1, 1, 0, 0.0, 0), "one search"),
    (of_fit.Agreement(1, 0, 0, 0.0, 1), "one search, which did not converge"),
    (of_fit.Agreement(4, 4, 0, 0.0, 0), "all 4 starts end at the same optimum"),
    (
        of_fit.Agreement(4, 1, 2, 3.2, 1),
        "1 of 4 starts end at the best optimum, 2 at others (the next costs 3.2 more), 1 did not converge",
    ),
    (of_fit.Elsewhere(1, 3, ("a", "b")), "1 of 3 searches converged at other values of a, b"),
    (
        of_fit.InPieces("rig.delay", 2),
        "rig.delay: the values within its 95 % interval are in 2 pieces, with worse ones between them; samples closer "
        "together would tell them apart",
    ),
    (of_fit.Generations(96, 8, True), "96 members in 8 generations; the last gained nothing that counts"),
    (
        of_fit.Generations(96, 8, False),
        "96 members in 8 generations; the last still gained: go on with more --generations",
    ),
    (
        of_fit.LostRows({"tips": 3, "slides": 2, "failed": 1}),
        "of the members, in some row: 2 slide, 3 turn over, 1 leave the ground for good or cannot be computed; a row "
        "that is lost costs a member its rank",
    ),
    (
        of_fit.MembersJump(2, (2, 5)),
        "2 of the members jump in some row: their running gear drops between guides and pulleys and throws them off the "
        "ground at times; the best in rows 2, 5",
    ),
    (
        of_fit.EndedAtEdge({"a": of_fit.Edge("upper", 9.0), "b": of_fit.Edge("", -2.64)}),
        "the search ended at the edge of what was allowed: its best member has a at its upper bound, b 2.6 prior sd "
        "below the middle of its prior",
    ),
    (
        of_fit.ReadFromMembers(("a", "b"), 0.4),
        "derivatives of the run by a, b are not those of its differences (contacts open and close): what the rows "
        "determine is read from a regression over the members near the best, which leaves 0.4 sd rms",
    ),
    (
        of_loop.AssumedNoise(("speed",), "speed=2%"),
        "no sd is stated for speed: speed=2% is assumed; state yours with --noise",
    ),
    (
        of_loop.NoiseFromSeries(
            (
                SeriesNoise(channels.find("total_current"), 0.0546, 0.0133, 7.45, "slope_deg", 4),
                SeriesNoise(channels.find("speed"), 0.0, 0.0124, 7.44, "slope_deg", 4, 0.004),
            )
        ),
        "no sd is stated for total_current, speed: total current 0.055 A and 1.3 % of the reading, speed 1.2 % of "
        "the reading (its display steps by 14 mm/s) are estimated from how readings scatter along 4 series of slope_deg (7.4 degrees of freedom); state yours with --noise",
    ),
    (
        of_loop.RefitWorse("total_current", 0.44, 0.54, "estimated"),
        "total_current: the refit misses it by 54% of its measured rms and the robot as stated by 44%, so the estimated "
        "noise gives some of its readings too large a weight; state the instrument's with --noise",
    ),
    (of_loop.Copies((3,)), "row 3 is an exact copy of an earlier one and counts once"),
    (of_loop.Copies((3, 4)), "rows 3, 4 are exact copies of earlier ones and count once"),
    (
        of_loop.KeptOut((1, 2), "unusable"),
        "rows 1, 2 are not used: the fitted model slides or fails there",
    ),
    (
        of_loop.KeptOut((7,), "outliers"),
        "rows 7 stand alone: outliers, which no effect explains; they are kept out",
    ),
    (
        of_loop.PhasesDiffer(80.4, 12.0),
        "the wave stands at another angle in each run (it explains 80 σ² free in each, 12 with one phase): robot.toml "
        "holds the mean; start runs from a mark",
    ),
    (
        of_loop.StillLacks("motor_speed", "speed_motor"),
        "what was found does not explain everything: the reading of motor speed still lacks something over speed motor",
    ),
    (
        of_loop.Late(0.0312, 0.0004),
        "what is imposed acts 31.2 ± 0.4 ms later than its column says, and the rig's file states no delay: with [rig] "
        'delay = "0.0312 ± 0.0004" it begins there',
    ),
    (
        of_loop.Led(("a", "b"), (3.0, 2.0), 0, 0, 1, "fit", "fit", 0.01, 0.0),
        "a comes first in its class by the fit to all rows; errors held out: a 3.00 σ, b 2.00 σ; b would come first by "
        "--prefer held-out, where adequate",
    ),
    (
        of_loop.Led(("a", "b"), (3.0, 2.0), 1, 0, 1, "held-out", "held-out", 0.01, 1.4),
        "b comes first in its class by errors held out; errors held out: a 3.00 σ, b 2.00 σ; by the fit to all rows a "
        "would, by Δχ² 1.4",
    ),
    (
        of_loop.Led(("a", "b"), (3.0, 2.99), 0, 0, 0, of_loop.DRAW, "held-out", 0.01, 0.0),
        "a comes first in its class by the fit to all rows, as errors held out are within 1%; errors held out: a 3.00 σ, "
        "b 2.99 σ",
    ),
    (
        of_loop.Led(("a", "b"), (3.0, 2.0), 0, 0, 1, "held-out", "held-out", 0.01, 0.0),
        "a comes first in its class by errors held out; errors held out: a 3.00 σ, b 2.00 σ; b is not as adequate",
    ),
    (
        of_loop.Outstanding((0.5, 2.0), "assumed"),
        "out of time: whether the verdict stands with 0.5 and 2 times the assumed noise is not known; run the same "
        "command without --within",
    ),
    (
        of_loop.NotPredictable(("configuration",)),
        "not predictable from the others, so neither scored nor tested: blocks by configuration that hold all runs of a "
        "configuration with parameters of its own",
    ),
    (
        of_loop.LostReplicates(400, 500),
        "only 400 of 500 bootstrap tables could be fitted again; the thresholds are theirs",
    ),
    (
        of_loop.RestsOn(NameTest("slip", 10.57, 3.3, (), 0.0, 2, 2.9, what="run")),
        "slip rests on run 2 (10.6 σ with it, 2.9 σ without): repeat run 2, and runs at conditions on either side of it",
    ),
    (
        of_loop.RestsOn(
            NameTest("slip", 10.57, 3.3, (), 0.0, 10, 4.3),
            {"configuration": "6T2A", "supply_voltage_V": 33.0, "slope_deg": 20.0},
            "slope_deg",
            (17.5, 22.5),
        ),
        "slip rests on row 10 (10.6 σ with it, 4.3 σ without): repeat row 10 (6T2A, 33 V, 20 deg), and run it at "
        "slope_deg 17.5 and 22.5 too",
    ),
    (
        of_loop.Unwritten(True, 0.13, 0.42),
        "the curve predicts runs that it has not seen no better than the refit (+0.13 ± 0.42 nat a reading): robot.toml "
        "is the refit",
    ),
    (
        of_loop.Unwritten(False, -0.2, 0.05),
        "what was found predicts runs that it has not seen worse than the refit (-0.20 ± 0.05 nat a reading): robot.toml "
        "is the refit",
    ),
    (
        of_loop.TooFewReplicates(100),
        "100 bootstrap tables are too few for every kind of evidence to count; use 500 or more",
    ),
    (of_study.Sampling("morris", 8), "screening by elementary effects, over 8 operating points"),
    (
        of_study.PointsLeftOut(2, 8, False, ("speed", "current")),
        "2 of 8 operating points are left out, since the robot does not travel there (speed, current)",
    ),
    (
        of_study.PointsLeftOut(2, 8, True, ("speed",)),
        "2 of 8 operating points are left out, since too many robots of the sample do not travel there (speed)",
    ),
    (
        of_study.SampleLeftOut(3, 0.0123, ("speed",)),
        "at 3 operating points up to 1.2 % of the sample is left out, since the robot does not travel there: the "
        "indices are of robots that do (speed)",
    ),
    (
        of_study.Inert(("a", "b"), False),
        "not sampled, since every derivative by them is exactly zero where one was taken: a, b",
    ),
    (
        of_study.Inert(("a",), True),
        "every derivative by them is exactly zero where one was taken, so that what effect they have is that of inputs "
        "they are correlated with: a",
    ),
    (of_study.Tied(("a", "b")), "kept at their ratio to another input, and part of what it does: a, b"),
    (Step("evaluations", (12345, 1234.6)), "12,345 model evaluations so far, 1,235 a second"),
    (Step("alike", (("a", "b"),)), "4 of 7, what else explains as much as a and b?"),
    (Step("round", (2, 3.25, 7, 1.26)), "round 2: objective 3.2500 after 7 steps, 1.3 min"),
]


@pytest.mark.parametrize(("note", "said"), SAMPLES, ids=lambda x: type(x).__name__ if isinstance(x, Note) else "")
def test_a_note_is_said(note, said):
    assert describe(note) == said
    told = []
    in_words(told.append)(note)
    assert told == [said]


def kinds():
    """Every kind of note that the rooms have."""
    return {
        kind
        for room in (of_fit, of_loop, of_study)
        for kind in vars(room).values()
        if isinstance(kind, type) and issubclass(kind, Note) and kind is not Note
    }


def test_every_kind_of_note_has_a_sentence_and_a_sample():
    assert kinds() == set(NOTES) == {type(note) for note, _ in SAMPLES}
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
    assert loop_words.size(SimpleNamespace(parameters={"amplitude": amplitude})) == said


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
            "a explains 1.2 σ beside smooth curves (slip balance over slope), and chance reaches 3.4; b is a worse "
            "explanation than a smooth curve in its place and rests on row 10; c is chosen again in 75 % of the data "
            "with a block left out, has a rival of an implausible size (d and e) and leaves something in its own "
            "equation",
        ),
        (
            NameSupport(False, "none by itself", tests=(NameTest("a", 1.2, 3.41, (), 0.0),)),
            "a explains 1.2 σ, and chance reaches 3.4",
        ),
        (
            NameSupport(
                True,
                "beside",
                tests=(NameTest("a", 6.91, 3.27, (OVER,), 1.0, 11, 5.8), NameTest("b", 5.0, 3.27, (), 0.0)),
            ),
            "each by itself, at the fit of the others, explains more than chance would: a 6.9 σ (chance 3.3, without row 11 "
            "5.8), b 5.0 σ (chance 3.3)",
        ),
    ],
)
def test_why_names_stand_or_not(support, said):
    assert loop_words.reason(support) == said


def test_verdict_of_a_complete_model():
    off = of_fit.NoiseOff("", 2.0, "stated")
    said = "Nothing is missing: what the fitted model leaves is what noise leaves (family-wise p = 0.4)."
    assert loop_words.statement(Summary("none", 0.4, None)) == said
    assert loop_words.statement(Summary("none", 0.4, None, noise=(off,))) == f"{said} But {describe(off)}"
    aside = loop_words.statement(Summary("none", 0.4, None, aside=10, of=100))
    assert aside == f"10 of 100 rows (10 %) lie off alone and are set aside. {said}"


def test_verdict_tells_what_is_tentative():
    test = NameTest("b", 5.0, 3.4, (), 9.0, 10, 2.0)
    sure, tentative = Missing(("a",), (), ("drop",)), Missing(("b",), (), ("slip",), False, test)
    assert loop_words.statement(Summary("named", 0.001, None, (sure, tentative))) == (
        "Missing: a (family-wise p ≤ 0.001). Tentative, in the model since it predicts better: b, which rests on row 10."
    )
    # where no name stands and it was not tested by itself, what speaks against all of them
    curve = NameSupport(False, "curve alone", curves=(OVER,))
    place = SimpleNamespace(
        place="slip", variable="slope", alike=("slip",), variables_alike=(), family="slip", by_duty=False
    )
    only = Missing(("b",), (), ("slip",), False)
    said = loop_words.statement(Summary("place", 0.001, place, (only,), support=curve))
    assert "no effect of the library is established" in said
    assert said.endswith("predicts better: b (one smooth curve in the slip balance over slope leaves nothing).")


def test_a_mechanism_is_stated_with_what_it_explains_and_predicts():
    found = Mechanism(("loss torque that changes with speed", "slip"), ("a",), 0.99, 0.8, 0.1, 1.0)
    place = SimpleNamespace(
        place="track", variable="speed_motor", alike=("track",), variables_alike=(), family="x", by_duty=False
    )
    said = loop_words.statement(Summary("mechanism", 0.001, place, mechanism=found))
    assert said.startswith(
        "Missing: a loss torque that changes with speed or a slip, established as a mechanism: it "
    )
    assert "explains 99 % of the excess misfit, gains 0.8 nat" in said and "8.0 standard errors" in said
    weak = dataclasses.replace(found, families=("slip",), share=0.3, gain=0.1)
    said = loop_words.statement(Summary("place", 0.001, place, mechanism=weak))
    assert (
        "No mechanism is established: the best one is a slip, but it explains only 30 % of the excess misfit and"
        in said
    )
    assert loop_words.brief(Summary("mechanism", 0.001, place, mechanism=weak)) == "mechanism: slip"


def test_a_mechanism_is_stated_with_its_window_and_why_no_name_stands():
    """A discrepancy of some runs alone: its window stands in verdict and answer, and what leaves nothing comes first."""
    here = SimpleNamespace(
        place="slip", variable="order 30 to 44", alike=("slip",), variables_alike=("order 31 to 44",), by_duty=False,
        family="slip that changes with order", window={"axis": "order", "low": 30.0, "high": 44.0},
    )  # fmt: skip
    mechanism = Mechanism((here.family,), (), 0.99, 0.8, 0.1, 1.0)
    summary = Summary("mechanism", 0.001, here, mechanism=mechanism)
    within = "order, in runs 30 to 44 (as well in runs 31 to 44)"
    assert loop_words.statement(summary).startswith(
        f"Missing: a slip that changes with {within}, established as a mechanism"
    )
    other = dataclasses.replace(mechanism, families=("slip that changes with load",))
    assert "in runs" not in loop_words.statement(dataclasses.replace(summary, mechanism=other))
    support = NameSupport(False, "none by itself", tests=(NameTest("a", 1.2, 3.41, (), 0.0),))
    found = SimpleNamespace(
        verdict="mechanism", summary=summary, effects=(), unnamed=here, support=support, after=SimpleNamespace(adequate=True)
    )  # fmt: skip
    assert (
        loop_words.answer(found)
        == f"No: missing is a slip that changes with {within}. Its exact law is not established."
    )
    said = (
        "one constant in the slip balance in runs 30 to 44 leaves nothing; a explains 1.2 σ, and chance reaches 3.4"
    )
    assert loop_words.why(found) == said
    found.after.adequate = False
    assert loop_words.why(found) == loop_words.reason(support)


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
    assert loop_words.course(curve) == said
    assert loop_words.course(SimpleNamespace(**vars(curve) | {"window": {}})) == ""


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
    assert loop_words.statement(Summary("class", 0.0004, None, (one, two))) == (
        "Missing: losses, a, or motor.resistance is 1.94 ohm (these data cannot tell which); one of b, c (these data "
        "cannot tell which) (family-wise p ≤ 0.0004)."
    )
    assert loop_words.statement(Summary("named", 0.002, None, (Missing(("a",), (), ("x",)),))) == (
        "Missing: a (family-wise p ≤ 0.002)."
    )


@pytest.mark.parametrize(("sampled", "said"), [
    (False, "angle_friction (at 1.5 times its largest plausible size), torque_offset (time histories alone tell that)"),
    (True, "angle_friction (at 1.5 times its largest plausible size)"),
])  # fmt: skip
def test_what_settled_runs_cannot_tell_from_an_effect_is_said_of_them_alone(sampled, said):
    members = {"directional_friction": SimpleNamespace(size=0.1), "angle_friction": SimpleNamespace(size=1.5)}
    effect = SimpleNamespace(members=members, stated={})
    assert loop_words.alike(SimpleNamespace(runs=SimpleNamespace(sampled=sampled)), effect) == said


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
        ((10, 4.3, 4.72), (10, 10), "motor speed 4.3 → 4.7 %"),
        ((10, 0.141, 0.149), (10, 10), "motor speed 0.14 → 0.15 %"),
        ((8, 4.0, 5.0), (8, 10), "motor speed 4.0 → 5.0 % (of the 8 rows that both predict)"),
        (None, (10, 8), "2 rows fewer predicted"),
        (None, (10, 9), "1 row fewer predicted"),
        (None, (10, 10), ""),
    ],
)
def test_what_is_predicted_worse_is_said_with_its_rows(found, predicted, said):
    worse = () if found is None else (Worse("voltage", "motor_speed", *found),)
    whole = f"Held out, what was found predicts worse: by voltage {said}."
    assert loop_words.worse(worse, {"voltage": predicted}) == (whole if said else "")


@pytest.mark.parametrize(
    ("about", "said"),
    [
        (("missing", "slip", "speed_motor"), "what is missing in the slip balance over speed motor"),
        (("found", "", "", ("a", "b")), "a, b, found by the lumped model"),
        (("near", "", "", ("a",)), "a, which explains the readings nearly as well"),
    ],
)
def test_what_the_track_model_is_asked_about(about, said):
    assert loop_words.asked(of_loop.Asked(*about)) == said


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
            "Adequate: the residuals are what the stated noise leaves (χ² 61 on 60 degrees of freedom, p = 0.4)",
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
    lines = console.wrapped(text).split("\n")
    assert all(len(line) <= 80 for line in lines[:-1]) and lines[-1] == "x" * 100 and lines[1].startswith("  ")
    assert " ".join(console.wrapped(text).split()) == " ".join(text.split())
    console.say(text)
    assert capsys.readouterr().out.rstrip("\n") == text


def test_what_lies_beside_a_page_is_said():
    """Every table that a command writes has a line in the list of files."""
    sources = [path.read_text() for path in (ROOT / "sweeps").rglob("*.py")]
    written = {name for text in sources for name in re.findall(r'write_table\("([a-z_.]+)"', text)}
    assert len(written) > 10
    assert written <= set(FILES)
