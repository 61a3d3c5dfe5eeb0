"""Statuses and limits in words: one row each, for the console and the reports."""

from __future__ import annotations

from collections.abc import Mapping

#: Phrases for a status that means something else in one model, by both names.
VERDICTS = {("climb", "converged"): "have a verdict"}
#: Label and meaning of each end of a run.
STATUSES: dict[str, tuple[str, str]] = {
    "converged": ("settled", "found a steady operating point"),
    "stalled": ("stands", "static friction holds the robot, or the motors cannot turn the load"),
    "slides": ("slides", "traction demand above the adhesion limit μ_s N, so tracks or wheels spin"),
    "not_settled": (
        "not settled",
        "still accelerates at the end (longer --duration), or the turn has no steady state (--model drive)",
    ),
    "battery_empty": ("battery empty", "the battery's capacity is used up"),
    "failed": ("failed", "no solution found. Please report the conditions"),
    "tips": ("tips over", "the centre of mass is outside the base of support, or inertia carries it over"),
    "reverses": ("reverses", "found a steady operating point backward"),
    "rolls_back": ("rolls back", "gravity drives the robot downhill at a steady speed"),
    "cut_off": ("cut off", "the cells were below their cut-off voltage for too long"),
}

#: Files of a run folder other than its page.
FILES = {
    "drive.xml": "the drive for MuJoCo",
    "scene.xml": "a scene with drive.xml",
    "actuator.py": "the drive law in JAX, without mmrjax",
    "actuator.jaxexport": "the same for jax.export.deserialize",
    "actuator.onnx": "the drive law in ONNX",
    "mjlab_actuator.py": "the drive law in PyTorch, for mjlab",
    "feed_forward.csv": "voltage, current and losses by speed and torque",
    "feed_forward.h": "the same tables for C",
    "draws.npz": "samples from the posterior",
    "LAW.md": "description of the drive law",
    "robot.toml": "the robot, for --robot",
    "runs.csv": "every run",
    "windows.csv": "voltage, velocity and acceleration of windows",
    "feedforward.json": "constants, gains and remarks",
    "rows.csv": "readings and residuals of every row",
    "comparison.csv": "readings and errors of every row",
    "history.csv": "state and readings at every instant",
    "reactions.csv": "loads inside the running gear",
    "segments.csv": "energy, distance and peaks by segment",
    "requirements.csv": "every requirement",
    "requirements.toml": "the requirements as given",
    "posterior.nc": "posterior of the parameters, for --posterior",
    "points.csv": "outputs at every operating point",
    "turns.csv": "settled turns",
    "posture.csv": "lever angles and contact loads",
    "derivatives.csv": "every derivative",
    "modes.csv": "natural frequencies of the chassis",
    "peaks.csv": "peaks of the ripple",
    "indices.csv": "every sensitivity index",
    "settled.csv": "the settled runs, for loop and calibrate",
    "stretches.csv": "stretches of the log, and why they were left out",
    "results.zarr/": "outputs of every point",
    "identity.json": "settings, to resume the sweep",
    "result.json": "all results, for programs",
    "config.resolved.toml": "all options",
    "manifest.json": "versions, machine, time, hashes",
    "figures/": "the figures, as SVG",
}


#: Meanings of `verdict` in result.json of the loop, the least established first. Former words follow their new ones.
LOOP_VERDICTS = {
    "none": "the residuals of the fitted model are consistent with noise",
    "undescribed": (
        "error or noise of a channel exceeds a quarter of the measured rms after the refit. No set of effects halves "
        "it on unseen runs and brings it below a quarter"
    ),
    "place": "a term is missing in one equation, or in one of several that data cannot distinguish",
    "unnamed": "former word for place, and up to schema mmrjax.loop/3 for mechanism",
    "mechanism": (
        "the equation of the missing term and its variable are established: the term explains half of the misfit "
        "beyond noise and is found without any block of runs"
    ),
    "class": "a missing term is one of several effects that data cannot distinguish",
    "named": "each missing term is one established effect",
}

#: Uses of the energy of a mission, short enough for labels of bars.
SINKS = {
    "battery": "battery cells", "other": "other consumers", "driver": "motor driver",
    "winding": "windings, brushes, leads", "motor": "motor friction", "gearbox": "gearboxes",
    "track": "tracks and guides", "sliding": "sliding over the ground", "rolling": "rolling resistance",
    "lift": "lift (net of recovery downhill)",
}  # fmt: skip


def sink_labels(on_ground: bool) -> dict[str, str]:
    """Labels of the uses of energy. A shaft has no tracks."""
    return SINKS if on_ground else SINKS | {"track": "friction of the load"}


#: Words of the pages, for docs/reference/glossary.md.
GLOSSARY = {
    "balance": "one equation of the model, such as the sum of torques at the wheel. Every effect enters one",
    "effect": "a term that the model may lack, see `mmrjax explain NAME`",
    "established": "not explained by chance, a smooth curve, one run or one block of runs",
    "tentative": "improves predictions and is in robot.toml, but failed a test of established effects",
    **{verdict: LOOP_VERDICTS[verdict] for verdict in ("class", "mechanism", "place")},
    "misfit beyond noise": "χ² minus the part of noise, about one per reading",
    "refit": "the model fitted to the runs without new effects",
    "seen": "errors on the runs that the fit used",
    "held out": "errors on runs left out of the fit, one slope, voltage or configuration at a time",
    "noise": "standard deviation of readings: --noise, `_sd` columns or an estimate",
    "rms error": "root mean square of simulated minus measured, in percent of the measured rms",
    "σ": "standard deviation of an instrument: 19 of 20 readings are within 2 σ of the truth",
    "χ²": "sum of (simulated minus measured)² / σ² over all readings",
    "prior": "value and standard deviation of a parameter before the fit",
    "p": "probability that noise alone gives as extreme a result",
    "log likelihood": (
        "logarithm of the probability density of the readings. With 60 readings, 0.1 per reading is significant"
    ),
    "reached": "runs in which the simulation reaches a steady state",
    "voltage_limit": "largest voltage of a proposed experiment, from `[motor]` of the robot file",
}

FLAGS = {
    "motor_overspeed": "the motor is above its permitted speed",
    "gearbox_overspeed": "the gearbox input is above its permitted speed",
    "winding_hot": "the winding gets too hot in long running at this current",
    "slips": "tracks or wheels slide faster than V_s on average",
    "jumps": "the robot leaves the ground at times",
    "overvoltage": "charge voltage or charging current of the cells is too high",
    "cut_off": "a cell is below its cut-off voltage",
    "battery_overcurrent": "the current of a cell is above its limit",
    "current_limited": "the motor driver limits the current",
    "gearbox_overload": "the torque is above the gearbox's continuous rating",
    "too_hot": "the winding is hotter than permitted",
    "demand_missed": "the commanded speed was not reached",
    "voltage_rising": "a cell voltage rises during discharge",
    "current_returned": "current flows back into the supply",
}


#: Text for the final temperature of a winding at a current for which the temperature never settles.
NONE_SETTLES = "none settles"
#: Text for the permissible time of a current at which the winding never reaches its limit.
FOR_EVER = "continuously"

#: Statuses of runs that ended in a steady state; `signals.DONE` by name.
SETTLED = ("converged", "reverses")
#: Statuses of runs from standstill in which the robot starts to move.
UNDER_WAY = (*SETTLED, "rolls_back", "not_settled")


def every_run_solved(counted: Mapping[str, int]) -> bool:
    """True if the solver gave an answer for every run, from counts by status."""
    return not counted.get("failed")


#: Outcomes of a requirement's quantity that are not statuses of a run.
OUTCOMES = {
    "unbounded": "no value: the temperature never settles",
}


#: Reason for a turn without a settled value.
NO_TURN = "there is no settled turn. Simulate it with --model drive"


def short_status(status: str) -> str:
    """Label of a status for figures and tables."""
    return STATUSES.get(status, (status, ""))[0]


def status_meaning(status: str) -> str:
    """Meaning of a status in one sentence."""
    return STATUSES.get(status, (status, ""))[1]


_PAPERS_NAMES = {"nominal": "nominal (PM)", "sm1": "SM-1", "sm2": "SM-2"}


def displayed_robot_name(name: str) -> str:
    """Name of a robot on pages."""
    return _PAPERS_NAMES.get(name, name)


def short_name(name: str) -> str:
    """Name of a parameter without the groups `ground`, `track` and `effects`."""
    return name.replace("ground.", "").replace("track.", "").replace("effects.", "")
