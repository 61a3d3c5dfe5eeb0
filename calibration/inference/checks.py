"""What makes data unfit for a calibration, each said in one sentence, and what is worth saying of the rest."""

from __future__ import annotations

from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np

from calibration.data.errors import BadConfiguration, BadData, number
from calibration.inference.noise import Noise
from calibration.data.runs import CONDITIONS, MEASURED, Runs
from calibration.inference.problem import SETTLED, is_series
from mmrjax.fidelities.drive import drive_batch
from mmrjax.robot import Robot
from mmrjax.signals import CONVERGED

#: Replicates further apart than this many sds of their difference contradict each other.
CONTRADICTION = 6.0
#: The same for replicates whose sd is not known, as a share of their mean.
CONTRADICTION_SHARE = 0.25

_WORD = {"tracked": "6T2A", "wheeled": "4W2T"}

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


def check(runs: Runs, names: Sequence[str], noise: Noise) -> list[str]:
    """Refuse data that cannot be fitted; return what should be said of data that can.

    Raises:
        BadData: too few rows, a stuck channel, contradictory replicates, samples of one run under
            different conditions.
        BadConfiguration: a free parameter of a configuration that has no rows.
    """
    _configurations(runs, names)
    _enough(runs, names, noise)
    _stuck(runs)
    if is_series(runs):
        _series(runs)
    else:
        _replicates(runs, noise)
    return _constant_conditions(runs)


def _configurations(runs: Runs, names: Sequence[str]) -> None:
    present = set(runs["configuration"])
    for name in names:
        word = _WORD.get(name.split(".")[0])
        if word is not None and word not in present:
            raise BadConfiguration(
                f"--free {name}: {runs.source} has no {word} rows, so nothing measures it; "
                f"add {word} runs or leave it fixed"
            )


def _enough(runs: Runs, names: Sequence[str], noise: Noise) -> None:
    levels = int(noise.estimated.sum())
    needed = max(2, -(-(len(names) + levels) // 3) + (levels > 0))
    if len(runs) < needed:
        also = f" and estimate {levels} noise levels" if levels else ""
        cure = "fix some with --fix, or state --noise" if levels else "fix some with --fix"
        raise BadData(
            f"{runs.source}: {len(runs)} rows of 3 channels cannot fit {len(names)} parameters{also}; "
            f"at least {needed} rows are needed, or {cure}"
        )


def _stuck(runs: Runs) -> None:
    conditions = np.stack([runs[c] for c in CONDITIONS if runs.has(c)], 1)
    if len(np.unique(conditions, axis=0)) < 2 and not is_series(runs):
        return
    for column in MEASURED:
        if len(runs) > 2 and np.ptp(runs[column]) == 0:
            raise BadData(
                f"{runs.source}, {column}: {number(runs[column][0])} in every row although the conditions vary; "
                "the instrument was stuck or the column is a copy"
            )


def _series(runs: Runs) -> None:
    names = runs["run_id"] if runs.has("run_id") else np.zeros(len(runs), str)
    for name in np.unique(names):
        for column in ("configuration", *CONDITIONS):
            if runs.has(column) and len(np.unique(runs[column][names == name])) > 1:
                raise BadData(
                    f"{runs.source}, {column}: run {name or '(no run_id)'} has several values; "
                    "a run has one condition, so give each its own run_id"
                )


def from_rest(runs: Runs, noise: Noise) -> None:
    """Histories begin when the supply is switched on, the robot at rest, and show one sample at a time.

    Raises:
        BadData: a run whose first sample, at 0 s, shows it moving, or with two samples at one time.
    """
    names = runs["run_id"] if runs.has("run_id") else np.zeros(len(runs), str)
    moving = runs.measured()[:, 1:]
    for name in np.unique(names):
        mine = np.flatnonzero(names == name)
        first = mine[np.argmin(runs["time_s"][mine])]
        times, count = np.unique(runs["time_s"][mine], return_counts=True)
        if (count > 1).any():
            raise BadData(
                f"{runs.source}, time_s: run {name or '(no run_id)'} has {count.max()} samples at "
                f"{number(times[count.argmax()])} s; give each run its own run_id"
            )
        limit = np.maximum(0.2 * np.abs(moving[mine]).max(0), 5 * noise.sd[first, 1:])
        if runs["time_s"][first] < 0.005 and (np.abs(moving[first]) > limit).any():
            raise BadData(
                f"{runs.source} row {first + 1}, time_s: run {name or '(no run_id)'} is moving at "
                f"{number(runs['time_s'][first])} s ({number(runs['motor_speed_rpm'][first])} rpm); a history starts "
                "from rest when the supply is switched on, at 0 s. Settled travel is one row a run, without time_s"
            )


def _replicates(runs: Runs, noise: Noise) -> None:
    columns = [c for c in ("configuration", *CONDITIONS, "surface") if runs.has(c)]
    keys = ["|".join(str(runs[c][k]) for c in columns) for k in range(len(runs))]
    measured = runs.measured()
    for first, key in enumerate(keys):
        for second in range(first + 1, len(keys)):
            if keys[second] != key:
                continue
            apart = np.abs(measured[first] - measured[second])
            mean = np.abs(measured[first] + measured[second]) / 2
            sd = np.hypot(noise.sd[first], noise.sd[second])
            allowed = np.where(noise.estimated, CONTRADICTION_SHARE * mean, CONTRADICTION * sd)
            for k in np.flatnonzero(apart > allowed):
                column = list(MEASURED)[k]
                known = f"{apart[k] / sd[k]:.0f} sd" if not noise.estimated[k] else f"{apart[k] / mean[k]:.0%}"
                raise BadData(
                    f"{runs.source} rows {first + 1} and {second + 1}, {column}: the same conditions gave "
                    f"{number(runs[column][first])} and {number(runs[column][second])}, {known} apart; "
                    "remove the wrong one or state a larger --noise"
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
