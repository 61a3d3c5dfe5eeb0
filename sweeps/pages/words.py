"""Statuses and limits in words: one row each, for the console and the reports."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple


class StatusWords(NamedTuple):
    """Words for the end of a run: `short` in figures, `why` in one line, `meaning` for the reader of a report."""

    short: str
    why: str
    meaning: str


#: Phrases for a status that means something else in one model, by both names.
VERDICTS = {("climb", "converged"): "came to a verdict"}
STATUSES: dict[str, StatusWords] = {
    "converged": StatusWords("settled", "steady travel", "found a steady operating point"),
    "stalled": StatusWords(
        "stands",
        "held by friction, or the motors cannot turn the load",
        "the robot does not move: static friction holds it, or the motors cannot turn the load and draw "
        "their stall current",
    ),
    "slides": StatusWords(
        "slides",
        "traction demand above the adhesion limit",
        "slope and rolling resistance demand more traction than adhesion gives (demand above μ_s N), so the "
        "movers "
        "spin and the robot does not climb",
    ),
    "not_settled": StatusWords(
        "not settled",
        "still accelerating at the end of the run (try a longer --duration), or a turn without a steady state "
        "(use --model drive to simulate it over time)",
        "still accelerating at the end of the simulated time, or a turn for which no steady state was found, "
        "for example because friction falls with sliding speed",
    ),
    "battery_empty": StatusWords("battery empty", "the battery is empty", "the battery's capacity is used up"),
    "failed": StatusWords(
        "failed", "the solver gave up", "the solver found no solution; please report the conditions"
    ),
    "tips": StatusWords(
        "tips over",
        "the robot turns over: its line of gravity passes outside the contacts, or its own motion throws it over",
        "the robot turns over: its line of gravity passes outside the contacts, or its own motion throws it over",
    ),
    "reverses": StatusWords(
        "reverses", "steady travel backward", "found a steady operating point, travelling backward"
    ),
    "rolls_back": StatusWords(
        "rolls back",
        "gravity drives the robot, against its motors or with no voltage",
        "gravity drives the robot, against its motors or with no voltage: it travels downhill steadily",
    ),
    "cut_off": StatusWords(
        "cut off",
        "a cell is below its cut-off voltage, so the battery switches off",
        "the cells stayed below their cut-off voltage for longer than permitted, with charge left",
    ),
}

#: Files of a run folder other than its page.
FILES = {
    "drive.xml": "the drive for MuJoCo, for <include>",
    "scene.xml": "a MuJoCo scene that includes drive.xml and can be run",
    "actuator.py": "the drive law in JAX, without a dependency on mmrjax",
    "actuator.jaxexport": "the same law as a compiled program, for jax.export.deserialize",
    "actuator.onnx": "the drive law as an ONNX model",
    "mjlab_actuator.py": "the drive law in PyTorch, with a configuration for mjlab",
    "feed_forward.csv": "voltage, current and losses over speed and torque",
    "feed_forward.h": "the same tables for C",
    "draws.npz": "samples from the posterior, for NumPy",
    "draws.json": "the same samples as JSON",
    "LAW.md": "description of the drive law for readers who do not know mmrjax",
    "robot.toml": "the robot; every command takes it with --robot",
    "runs.csv": "every run, one row each",
    "windows.csv": "windows of a log: voltage, velocity, acceleration",
    "feedforward.json": "feedforward constants, gains and remarks",
    "rows.csv": "every row: measured, simulated, residuals",
    "comparison.csv": "every row: measured, simulated, errors",
    "history.csv": "every instant",
    "reactions.csv": "loads inside the running gear at every instant",
    "segments.csv": "every segment of the mission",
    "requirements.csv": "every requirement, one row each",
    "requirements.toml": "the requirements as given",
    "posterior.nc": "posterior distribution of the fitted parameters, for --posterior",
    "points.csv": "every operating point",
    "turns.csv": "settled turns, from straight travel to turning on the spot",
    "posture.csv": "posture: lever angles and contact loads",
    "derivatives.csv": "every derivative, one row each",
    "modes.csv": "every natural frequency",
    "peaks.csv": "every ripple peak",
    "indices.csv": "every index, one row each",
    "settled.csv": "the settled runs, for loop and calibrate",
    "stretches.csv": "every segment of the log, with the reason if it was left out",
    "results.zarr/": "every point, as a Zarr store",
    "identity.json": "settings that the store was created with, needed to resume the sweep",
    "result.json": "everything on this page, for programs",
    "config.resolved.toml": "every option of the command",
    "manifest.json": "versions, machine, time, hashes",
    "figures/": "the figures, as SVG",
}


#: What `verdict` in result.json of the loop means, the least first; an alias after its word.
LOOP_VERDICTS = {
    "none": "nothing is missing as far as these runs can show: the residuals of the fitted model are noise",
    "undescribed": "the error of the refitted model in one channel exceeds a quarter of the measured rms, or "
    "the noise is "
    "estimated to be that large. No set of effects halves that error on unseen runs and brings it below a "
    "quarter. No effect is named, and the statement lists what to check first",
    "place": "something is missing in one equation, or in one of several that these data cannot separate; no "
    "more is known",
    "unnamed": "former word for place; until schema mmrjax.loop/3 it also covered mechanism",
    "mechanism": "the equation of the missing term and the variable that it depends on are established; its "
    "exact law is not",
    "class": "an effect is established for each missing term, but for at least one of them these data cannot "
    "tell which of "
    "several effects it is",
    "named": "one effect of the library is established for each missing term",
}

#: Uses of the energy of a mission, short enough for labels of bars.
SINKS = {
    "battery": "battery cells", "other": "other consumers", "driver": "motor driver",
    "winding": "windings, brushes, leads", "motor": "motor friction", "gearbox": "gearboxes",
    "track": "tracks and guides", "sliding": "sliding over the ground", "rolling": "rolling resistance",
    "lift": "lift (net of energy recovered downhill)",
}  # fmt: skip


def sink_labels(on_ground: bool) -> dict[str, str]:
    """Labels of the uses of energy. A shaft has no tracks."""
    return SINKS if on_ground else SINKS | {"track": "friction of the load"}


#: Words of the pages, for docs/reference/glossary.md.
GLOSSARY = {
    "balance": "one equation of the model, for instance the sum of voltages in the motor circuit or of "
    "torques at the "
    "driving wheel. Every effect enters one balance",
    "effect": "a term that the model may lack. `mmrjax explain NAME` prints its equation, its typical size and a "
    "bench test for it",
    "established": "an effect that chance, a smooth curve, one run or one block of runs cannot explain",
    "tentative": "an effect that improves predictions and is included in robot.toml, although it failed one "
    "of the listed tests",
    "class": "effects that these data cannot distinguish",
    "mechanism": "the equation that lacks a term and the variable that the term depends on, but not its exact "
    "law. Such a "
    "term explains at least half of the misfit beyond noise, predicts held-out runs, and is found again when blocks "
    "of runs "
    "are left out",
    "place": "the equation that lacks a term, or several that these data cannot distinguish. No mechanism is "
    "established",
    "misfit beyond noise": "χ² minus the part that noise explains, which is about one per reading",
    "refit": "the same model with its parameters fitted to the runs, without new effects",
    "seen": "errors on the runs used in the fit",
    "held out": "errors on runs left out of the fit, one slope, voltage or configuration at a time",
    "noise": "standard deviation of an instrument. State it with --noise or in `_sd` columns, or it is estimated",
    "rms error": "root mean square of simulated minus measured, in percent of the rms of the measured readings",
    "σ": "standard deviation of an instrument: 2 of 3 readings are within 1 σ of the truth, 19 of 20 within 2 σ",
    "χ²": "sum of (simulated minus measured)² / σ² over all readings. Noise alone gives about one per reading",
    "prior": "value and standard deviation of a parameter from a bench or a data sheet, before any run is used",
    "p": "probability that noise alone gives a result as extreme as this one",
    "log likelihood": "logarithm of the probability of readings. With 60 readings, a gain of 0.1 per held-out "
    "reading is significant",
    "reached": "runs in which the simulated robot has a steady state. In the others it slides or does not move",
    "voltage_limit": "largest voltage that the loop may propose for an experiment, from `[motor]` of the robot file",
}

FLAGS = {
    "motor_overspeed": "motor above its permitted speed",
    "gearbox_overspeed": "gearbox input above its permitted speed",
    "winding_hot": "winding hotter than permitted after long running at this current",
    "slips": "slides faster than V_s on average, although it travels steadily",
    "jumps": "the weight passes between guides and pulleys so hard that the robot leaves the ground at times",
    "overvoltage": "current flows back into the battery: the cells are above their charge voltage, or the "
    "charging current is too high",
    "cut_off": "a cell is below its cut-off voltage",
    "battery_overcurrent": "a cell current above its limit",
    "current_limited": "the motor driver limits the current",
    "gearbox_overload": "torque above the gearbox's continuous rating",
    "too_hot": "winding hotter than permitted",
    "demand_missed": "the commanded speed was not reached",
    "voltage_rising": "a cell voltage rises during discharge: the parabola of its curve is past its minimum",
    "current_returned": "current flows back into the external supply, which few bench supplies can absorb",
}


#: Shown for the final temperature of a winding at a current for which the temperature never settles.
NONE_SETTLES = "none settles"
#: Shown for a current at which the winding never reaches its limit.
FOR_EVER = "continuously"

#: Statuses of runs that ended in a steady state; `signals.DONE` by name.
SETTLED = ("converged", "reverses")
#: Statuses of runs from standstill in which the robot starts to move.
UNDER_WAY = (*SETTLED, "rolls_back", "not_settled")


def every_run_solved(counted: Mapping[str, int]) -> bool:
    """True if the solver gave an answer for every run, from counts by status."""
    return not counted.get("failed")


#: Outcomes of a requirement's quantity other than the status of a run, in one line.
OUTCOMES = {
    "unbounded": "no value: the temperature never settles",
}


#: Reason for a turn without a settled value.
NO_TURN = (
    "no settled turn, for example because friction falls with sliding speed; simulate --model drive computes it "
    "over time"
)


def reason_without_value(outcome: str) -> str:
    """Reason why a quantity has no value, in one line."""
    return STATUSES[outcome].why if outcome in STATUSES else OUTCOMES[outcome]


def short_status(status: str) -> str:
    """A status as figures show it."""
    return STATUSES[status].short if status in STATUSES else status


def status_meaning(status: str) -> str:
    """A status for the reader of a report."""
    return STATUSES[status].meaning if status in STATUSES else ""


_PAPERS_NAMES = {"nominal": "nominal (PM)", "sm1": "SM-1", "sm2": "SM-2"}


def displayed_robot_name(name: str) -> str:
    """A robot's name as a page shows it."""
    return _PAPERS_NAMES.get(name, name)


def short_name(name: str) -> str:
    """A parameter's name without the group names that carry no information."""
    return name.replace("ground.", "").replace("track.", "").replace("effects.", "")
