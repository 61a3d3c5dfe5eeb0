"""What makes data unfit for a calibration, each said in one sentence, and what is worth saying of the rest."""

from __future__ import annotations

from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np

from calibration.data.errors import BadConfiguration, BadData, number
from calibration.data.runs import CONDITIONS, Runs
from calibration.inference import observers
from calibration.inference.noise import Noise
from mmrjax import channels
from mmrjax.fidelities.drive import drive_batch
from mmrjax.robot import Robot
from mmrjax.signals import CONVERGED

#: What would measure a parameter that the data do not, by the start or end of its name.
WOULD_MEASURE = {
    "battery.": "runs on the on-board battery (Source Mode 1)",
    "motor.inductance": "a time history of the start-up current, with samples every tenth of a millisecond",
    "motor.inertia": "a time history of the start",
    ".inertia": "a time history of the start",
    "motor.resistance_thermal": "long runs at high current with the effect winding_heating present",
    "motor.temperature_ambient": "runs at several room temperatures with the effect winding_heating present",
    ".friction.dynamic": "a history in which the movers spin faster than V_d (a start on a slippery slope)",
    ".friction.speed_dynamic": "a history in which the movers spin faster than V_s (a start on a slippery slope)",
    ".guide_share": "the fidelities steady and drive (the track model puts it out; free guide_friction there)",
    ".mass": "a scale, or runs whose table does not state total_mass_kg",
}


def would_measure(name: str) -> str:
    """What would measure a parameter that nothing in the data does."""
    for key, what in WOULD_MEASURE.items():
        if name.startswith(key) or name.endswith(key):
            return what
    return "runs under conditions in which it acts"


def check(runs: Runs, robot: Robot, names: Sequence[str], noise: Noise) -> list[str]:
    """Refuse data that cannot be fitted; return what should be said of data that can.

    Raises:
        BadData: too few rows, a stuck channel, contradictory replicates, samples of one run under
            different conditions.
        BadConfiguration: a free parameter of a configuration that has no rows.
    """
    _configurations(runs, robot, names)
    _enough(runs, names, noise)
    _stuck(runs)
    return [*observers.kind(runs).check(runs, noise), *_constant_conditions(runs)]


def _configurations(runs: Runs, robot: Robot, names: Sequence[str]) -> None:
    present = {robot.configurations.names[k] for k in np.unique(runs.configurations(robot))}
    for name in names:
        word = name.split(".")[0]
        if word in robot.configurations and word not in present:
            raise BadConfiguration(
                f"--free {name}: {runs.source} has no {word} rows, so nothing measures it; "
                f"add {word} runs or leave it fixed"
            )


def _enough(runs: Runs, names: Sequence[str], noise: Noise) -> None:
    levels = int(noise.estimated.sum())
    shown = sum(word != "no readings" for word in noise.source)
    needed = max(2, -(-(len(names) + levels) // max(shown, 1)) + (levels > 0))
    if len(runs) < needed:
        also = f" and estimate {levels} noise levels" if levels else ""
        cure = "fix some with --fix, or state --noise" if levels else "fix some with --fix"
        raise BadData(
            f"{runs.source}: {len(runs)} rows of {shown} channels cannot fit {len(names)} parameters{also}; "
            f"at least {needed} rows are needed, or {cure}"
        )


def _stuck(runs: Runs) -> None:
    columns = [c for c in (*CONDITIONS, "time_s") if runs.has(c)]
    if len(np.unique(np.stack([runs[c] for c in columns], 1), axis=0)) < 2:
        return
    for channel in channels.CHANNELS:
        readings = (
            runs[channel.column][np.isfinite(runs[channel.column])] if runs.has(channel.column) else np.zeros(0)
        )
        if len(readings) > 2 and np.ptp(readings) == 0:
            raise BadData(
                f"{runs.source}, {channel.column}: {number(readings[0])} in every row although the conditions vary; "
                "the instrument was stuck or the column is a copy"
            )


def _constant_conditions(runs: Runs) -> list[str]:
    says = {
        "slope_deg": "rolling resistance, guide friction and Coulomb losses act alike without slopes",
        "supply_voltage_V": "losses that grow with speed and those that do not act alike at one voltage",
    }
    return [
        f"{column} is {number(runs[column][0])} in every row: {why}, and only their priors tell them apart"
        for column, why in says.items()
        if np.ptp(runs[column]) == 0
    ]


def unmeasured(names: Sequence[str], sensitivity: np.ndarray) -> dict[str, str]:
    """Name → sentence, for each free parameter that moves no reading."""
    return {
        name: f"{name}: nothing in these data measures it; its value is its prior's. {would_measure(name)} would"
        for name, s in zip(names, sensitivity, strict=True)
        if s < 1e-6
    }


def too_stiff(runs: Runs, robot: Robot) -> list[str]:
    """A sentence if the track model's step is too long for some row, so that its readings are not to be trusted."""
    from mmrjax.fidelities.stability import largest_step
    from mmrjax.fidelities.track import STEP

    limits = largest_step(robot, runs.command())
    rows = ", ".join(str(k + 1) for k in np.flatnonzero(limits < STEP))
    if not rows:
        return []
    return [
        f"rows {rows}: the track model's step of {STEP:g} s is above the largest stable one of the calibrated robot, "
        f"{limits.min():.2g} s, so its readings there are not to be trusted; V_s is too small for μ_s"
    ]


def from_standstill(runs: Runs, robot: Robot) -> list[str]:
    """A sentence if `drive` settles on some row only because it was rolling."""
    run = drive_batch(robot, runs.command(), jnp.asarray([0.0, SETTLED]))
    rows = ", ".join(str(k + 1) for k in np.flatnonzero(np.asarray(run.result.status) != CONVERGED))
    if not rows:
        return []
    return [
        f"rows {rows}: read from a rolling start; from standstill the calibrated robot does not settle there within "
        f"{SETTLED:g} s, since it starts by sliding at μ_d"
    ]


def infeasible(
    runs: Runs, slides: np.ndarray, names: Sequence[str], spec_adhesion: dict[str, float]
) -> BadConfiguration:
    """The error for rows that slide at the best point found, from every start."""
    rows = ", ".join(str(k + 1) for k in np.flatnonzero(slides))
    chassis = sorted({"wheeled" if w == "4W2T" else "tracked" for w in runs["configuration"][slides]})
    parameter = " and ".join(f"{c}.ground.friction.static" for c in chassis)
    at = ", ".join(f"{spec_adhesion[c]:.3g}" for c in chassis)
    fixed = [c for c in chassis if f"{c}.ground.friction.static" not in names]
    cure = "free it, or raise it in --robot" if fixed else "widen its prior"
    return BadConfiguration(
        f"no start is feasible: {runs.source} rows {rows} were measured in steady travel, but the model slides there "
        f"({parameter} = {at} cannot carry the demand); {cure}"
    )
