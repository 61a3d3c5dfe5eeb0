"""Statuses and limits in words: one row each, for the console and the reports."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple


class Status(NamedTuple):
    """Words for the end of a run: `short` in figures, `why` in one line, `meaning` for the reader of a report."""

    short: str
    why: str
    meaning: str


#: What is said of a status of a model where it means something else, by both names.
VERDICTS = {("climb", "converged"): "came to a verdict"}
STATUSES: dict[str, Status] = {
    "converged": Status("settled", "steady travel", "found a steady operating point"),
    "stalled": Status(
        "stands",
        "friction holds it, or the motors cannot turn the load",
        "the robot stands: friction at rest holds it, or the motors cannot turn against the load and draw "
        "their stall current",
    ),
    "slides": Status(
        "slides",
        "traction demand above the adhesion limit",
        "slope and rolling resistance demand more traction than adhesion gives (demand above μ_s N), so the movers "
        "spin and the robot does not climb; an operating point does not exist",
    ),
    "not_settled": Status(
        "not settled",
        "still accelerating at the end of the run (try a longer --duration), or a turn that has no steady state, "
        "which --model drive follows",
        "still gaining speed when the simulated time ended, or a turn for which no steady state was found, as where "
        "friction falls with sliding",
    ),
    "battery_empty": Status("battery empty", "the battery has no charge left", "the battery's capacity is used up"),
    "failed": Status("failed", "the solver gave up", "the solver found no answer; please report the conditions"),
    "tips": Status(
        "tips over",
        "the robot turns over: its line of gravity passes outside the contacts, or its own motion throws it over",
        "the robot turns over: its line of gravity passes outside the contacts, or its own motion throws it over",
    ),
    "reverses": Status("reverses", "steady travel backward", "found a steady operating point, travelling backward"),
    "rolls_back": Status(
        "rolls back",
        "gravity drives the robot, against its motors or without their voltage",
        "gravity drives the robot, against its motors or without their voltage: it travels downhill steadily",
    ),
    "cut_off": Status(
        "cut off",
        "a cell below its cut-off voltage, where the battery switches itself off",
        "the cells stayed below their cut-off voltage for longer than they may, with charge left",
    ),
}

#: What lies in a run folder beside its page.
FILES = {
    "drive.xml": "the drive for MuJoCo, for <include>",
    "scene.xml": "a model that runs with it",
    "actuator.py": "the law in JAX, which needs nothing else",
    "actuator.jaxexport": "the same as a program, for jax.export.deserialize",
    "actuator.onnx": "the law as an ONNX model",
    "mjlab_actuator.py": "the law in PyTorch, with a configuration for mjlab",
    "feed_forward.csv": "voltage, current and losses over speed and torque",
    "feed_forward.h": "the same tables for C",
    "draws.npz": "draws of the posterior, for NumPy",
    "draws.json": "the same draws as JSON",
    "LAW.md": "the law for people who have never seen this program",
    "robot.toml": "the robot; every command takes it with --robot",
    "runs.csv": "every run, one row each",
    "windows.csv": "windows of a log: voltage, velocity, acceleration",
    "feedforward.json": "constants, gains and remarks",
    "rows.csv": "every row: measured, simulated, residuals",
    "comparison.csv": "every row: measured, simulated, errors",
    "history.csv": "every instant",
    "reactions.csv": "loads inside the running gear, every instant",
    "segments.csv": "every segment of the mission",
    "requirements.csv": "every requirement, one row each",
    "requirements.toml": "what was required",
    "posterior.nc": "what the fit leaves open, for --posterior",
    "points.csv": "every operating point",
    "turns.csv": "settled turns from straight travel to the spot",
    "posture.csv": "how the robot stands: its levers, what bears",
    "derivatives.csv": "every derivative, one row each",
    "modes.csv": "every natural frequency",
    "peaks.csv": "every peak of ripple",
    "indices.csv": "every index, one row each",
    "settled.csv": "the settled runs, for loop and calibrate",
    "stretches.csv": "every stretch of the log, and why it is left out",
    "results.zarr/": "every point, as a Zarr store",
    "identity.json": "what the store was made with, to go on with it",
    "result.json": "everything on this page, for programs",
    "config.resolved.toml": "every option of the command",
    "manifest.json": "versions, machine, time, hashes",
    "figures/": "the figures, as SVG",
}


#: What `verdict` in result.json of the loop means, the least first; an alias after its word.
LOOP_VERDICTS = {
    "none": "nothing is missing as far as these runs can show: what the fitted model leaves is noise",
    "undescribed": "the refitted model misses a channel by more than a quarter of its measured rms, or noise is "
    "estimated as that large. No set of effects removes half of that error on unseen runs and leaves less than a "
    "quarter. The statement says what to check first, and no effect is named",
    "place": "something is missing in one equation, or in several that these data cannot separate; no more is known",
    "unnamed": "former word for place; a mechanism was called so too until schema mmrjax.loop/3",
    "mechanism": "what drives the missing term is established, and its equation; its exact law is not",
    "class": "laws are established, and of at least one these data cannot tell which it is",
    "named": "one law of the library is established for each thing that is missing",
}

#: Names of where the energy of a mission goes, as bars have room for.
SINKS = {
    "battery": "cells of the battery", "other": "other consumers", "driver": "driver",
    "winding": "windings, brushes, leads", "motor": "friction of the motors", "gearbox": "gearboxes",
    "track": "tracks and guides", "sliding": "sliding over the ground", "rolling": "rolling resistance",
    "lift": "lift (net of what comes back)",
}  # fmt: skip


def sink_labels(on_ground: bool) -> dict[str, str]:
    """Labels of the uses of energy. A shaft has no tracks."""
    return SINKS if on_ground else SINKS | {"track": "friction of the load"}


#: Words of the pages, for docs/reference/glossary.md.
GLOSSARY = {
    "balance": "one equation of the model, for instance the voltages along the motor's circuit or the torques at the "
    "driving wheel. Every effect enters one balance",
    "effect": "a term that the model may lack, with an equation and a size. `mmrjax explain NAME` gives both, and a "
    "test for it",
    "established": "an effect that chance, a smooth curve, one run or one block of runs cannot explain",
    "tentative": "an effect that improves predictions and is in the robot, although a listed test failed",
    "class": "effects that these data cannot distinguish",
    "mechanism": "the incomplete equation and its driver, without the exact law. It explains at least half of the "
    "excess misfit, predicts held-out runs, and is found again when blocks of runs are left out",
    "place": "the incomplete equation, or several that these data cannot distinguish. No mechanism is established",
    "excess misfit": "χ² beyond the part that noise explains, which is about one per reading",
    "refit": "the same model with its parameters fitted to the runs, without new effects",
    "seen": "errors on the runs used in the fit",
    "held out": "errors on runs left out of the fit, one slope, voltage or configuration at a time",
    "noise": "standard deviation of an instrument. State it with --noise or in `_sd` columns, or it is estimated",
    "rms error": "root mean square of simulated minus measured, in percent of the rms of the measured readings",
    "σ": "standard deviation of an instrument: 2 of 3 readings are within 1 σ of the truth, 19 of 20 within 2 σ",
    "χ²": "sum of (simulated minus measured)² / σ² over all readings. Noise alone gives about one per reading",
    "prior": "value and standard deviation of a parameter from a bench or a data sheet, before any run is used",
    "p": "probability that noise alone gives a result as extreme as this one",
    "nat": "unit of log probability of held-out readings. With 60 readings, a gain of 0.1 per reading is significant",
    "reached": "runs in which the robot has a steady state. In the others it slides or does not move",
    "voltage_limit": "largest voltage that the loop may propose for an experiment, from `[motor]` of the robot file",
}

FLAGS = {
    "motor_overspeed": "motor faster than it is permitted to turn",
    "gearbox_overspeed": "gearbox input faster than its catalogue permits",
    "winding_hot": "winding hotter than permitted after long running at this current",
    "slips": "slides faster than V_s on average, though it goes on steadily",
    "jumps": "the weight passes between guides and pulleys so hard that the robot leaves the ground at times",
    "overvoltage": "current flows back into the battery: its cells are above their charge voltage or take too much",
    "cut_off": "a cell below its cut-off voltage",
    "battery_overcurrent": "more current than a cell may give",
    "current_limited": "the motor driver's current limit acts",
    "gearbox_overload": "more torque than the gearbox may carry for long",
    "too_hot": "winding hotter than permitted",
    "demand_missed": "a demanded speed was not reached",
    "voltage_rising": "a cell's voltage that rises as it discharges: the parabola of its curve has turned up",
    "current_returned": "current flows back into the external supply, which few bench supplies take",
}


#: In place of a winding's temperature after long running, at a current that heats it without an end.
NONE_SETTLES = "none settles"
#: A current that never brings a winding to its limit.
FOR_EVER = "continuously"

#: Statuses of runs that ended as their conditions ask, with numbers; `signals.DONE` by name.
SETTLED = ("converged", "reverses")
#: Those of runs from standstill that get under way, so that there are stages of the start to tell apart.
UNDER_WAY = (*SETTLED, "rolls_back", "not_settled")


def every_run_solved(counted: Mapping[str, int]) -> bool:
    """True if the solver gave an answer for every run, from counts by status."""
    return not counted.get("failed")


#: What a requirement's quantity may come to beside a status of a run: in one line.
OUTCOMES = {
    "unbounded": "no value: the temperature never settles",
}


#: Why a settled turn has no value where none was found.
NO_TURN = "no settled turn, as where friction falls with sliding; simulate --model drive follows it over time"


def reason_without_value(outcome: str) -> str:
    """In one line why a quantity has no value."""
    return STATUSES[outcome].why if outcome in STATUSES else OUTCOMES[outcome]


def short_status(status: str) -> str:
    """A status as figures show it."""
    return STATUSES[status].short if status in STATUSES else status


def status_meaning(status: str) -> str:
    """A status for the reader of a report."""
    return STATUSES[status].meaning if status in STATUSES else ""


_PAPERS_NAMES = {"nominal": "nominal (PM)", "sm1": "SM-1", "sm2": "SM-2"}


def words_shown(name: str) -> str:
    """A robot's name as a page shows it."""
    return _PAPERS_NAMES.get(name, name)


def short_name(name: str) -> str:
    """A parameter's name without the words that every such name has."""
    return name.replace("ground.", "").replace("track.", "").replace("effects.", "")
