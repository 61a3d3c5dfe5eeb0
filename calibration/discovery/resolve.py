"""Test of whether a different running gear, in the track model, explains a discrepancy in slip, track or ground.

The lumped laws assume smooth contacts. The track model has grousers and guides, and vibrates. Friction is fitted
through it twice to the rows on tracks, once with the running gear as stated and once with its constants free.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import numpy as np
from scipy.special import chdtrc

from calibration.data import Names
from calibration.data.input_errors import BadConfiguration
from calibration.data.runs import Runs
from calibration.discovery.loop_notes import TrackModelQuestion
from calibration.discovery.result import PLAUSIBLE, DiscoveryResult, ParameterEstimate, TrackModelResult
from calibration.inference import noise as noise_room
from calibration.inference import observers
from calibration.inference.calibration import calibrate
from calibration.inference.fit_notes import Remark, progress_remark
from calibration.inference.population import StoreStage, compute_without_storing
from calibration.inference.result import CalibrationResult
from mmrjax.effects import UNNAMED
from mmrjax.model import channels
from mmrjax.model.robot import Robot

#: Balances that the resolved running gear affects.
BALANCES = ("slip", "track", "ground")
#: Free constants of the running gear, and free friction of each configuration on tracks.
GEAR = ("guide_recess", "guide_gap", "contact_stiffness", "contact_damping", "centre_offset", "payload_height")
FRICTION = ("ground.friction.static", "ground.friction.dynamic", "ground.friction.speed_static")
#: Members of a generation, and most generations.
POPULATION, GENERATIONS = 128, 20


def question_of_verdict(found: DiscoveryResult) -> TrackModelQuestion | None:
    """Finding that a different running gear could explain. None if there is none."""
    places = [w for w in (found.unnamed, found.remains) if w is not None]
    for place in places:
        for balance in (place.balance, *place.balances_alike):
            if balance in BALANCES:
                return TrackModelQuestion("missing", balance, place.variable)
    balance_effects = [e.name for e in found.effects if e.balance in BALANCES]
    if balance_effects:
        return TrackModelQuestion("found", effects=tuple(balance_effects))
    weighed = [a for a in found.alternatives if any(enters_gear_balance(name, found) for name in a.effects)]
    if weighed:
        return TrackModelQuestion(
            "near", effects=tuple(n for n in weighed[0].effects if enters_gear_balance(n, found))
        )
    return None


def enters_gear_balance(name: str, found: DiscoveryResult) -> bool:
    """True if an effect of the library enters a balance of the running gear (`BALANCES`)."""
    return any(s.name == name and s.balance in BALANCES for s in found.scores)


def check_resolvable(runs: Runs) -> None:
    """Rejects input that `fit_track_model` cannot use, before the loop starts.

    Raises:
        BadConfiguration: the data are histories.
    """
    if not observers.observer_kind(runs).rows_tell:
        raise BadConfiguration("--resolve: the track model needs settled rows; got time histories")


def fit_track_model(
    found: DiscoveryResult,
    *,
    noise: str | None = None,
    population: int | None = None,
    generations: int | None = None,
    keep: StoreStage = compute_without_storing,
    seed: int = 0,
    tell: Callable[[Remark | str], None] = lambda note: None,
) -> TrackModelResult | None:
    """Fits the track model to the rows on tracks, to test if a different running gear explains the finding of the
    loop.

    Args:
        found: result of the loop, from settled rows.
        noise: noise option as given to the loop.
        population, generations, keep, seed: options of the search, see `calibrate`.
        tell: callback for progress messages.

    Returns:
        None if there is no finding in slip, track or ground, or no row on tracks.

    Raises:
        BadConfiguration: the data are histories.
    """
    check_resolvable(found.runs)
    reason, robot = question_of_verdict(found), found.robot
    tracked = [name for name, chassis in robot.configurations.items() if float(chassis.on_tracks) > 0.5]
    rows = found.runs.where(found.included & np.isin(found.runs["configuration"], tracked))
    if reason is None or not len(rows):
        return None
    present = {str(c) for c in rows["configuration"]}
    lumped = {f.name for f in found.effects if f.balance in BALANCES} | set(UNNAMED)
    other_effects = tuple(
        e for e in robot.effects if not (e.resolved or (e.name in lumped and e.balance in BALANCES))
    )
    robot = dataclasses.replace(robot, effects=other_effects)
    friction = tuple(f"{name}.{part}" for name in tracked if name in present for part in FRICTION)
    gear = tuple(f"running_gear.{name}" for name in GEAR)
    sds = _noise_option(found, noise)

    size = POPULATION if population is None else population
    most = GENERATIONS if generations is None else generations

    def fit(free: Names, which: str) -> CalibrationResult:
        return calibrate(
            rows, robot, free=free, noise=sds, model="track", population=size, generations=most,
            keep=lambda name, make: keep(f"gear {which}, {name}", make),
            seed=seed, profiles=False, blocks=False, tell=tell,
        )  # fmt: skip

    tell(progress_remark("gear stated"))
    fitted_robot = fit(friction, "stated")
    tell(progress_remark("gear free"))
    free = fit((*friction, *gear), "free")
    fall = 2 * (fitted_robot.objective - free.objective)
    return TrackModelResult(
        asked=reason,
        rows=len(rows),
        robot=free.robot,
        constants={n: ParameterEstimate(p.value, p.sd, p.unit, p.held_by_prior) for n, p in free.parameters.items()},
        alike=tuple(free.identifiability.correlated()),
        outside=tuple(n for n, p in free.parameters.items() if n in gear and abs(p.shift) > PLAUSIBLE),
        settled=fitted_robot.converged and free.converged,
        fall=float(fall),
        p=float(chdtrc(len(gear), max(fall, 0.0))),
        chi2=(fitted_robot.chi_square.value, free.chi_square.value),
        readings=int(np.isfinite(rows.measured()).sum()),
        rms_percent={
            c.name: (fitted_robot.errors_after[c.name].rms_percent, free.errors_after[c.name].rms_percent)
            for c in found.channels
        },
        slip_rms=(_slip_rms(fitted_robot, robot), _slip_rms(free, robot)),
        remarks=free.remarks,
    )


def _noise_option(found: DiscoveryResult, stated: str | None) -> str | None:
    """Option `noise` of `calibrate` that gives the same sds as the loop used."""
    assumed = [name for name, about in found.noise.items() if about["source"] == "assumed"]
    return (
        ",".join(part for part in (stated, noise_room.default_noise(channels.channels_named(assumed))) if part)
        or None
    )


def _slip_rms(fitted: CalibrationResult, robot: Robot) -> float:
    """rms difference of measured and simulated slip 1 - V / (r_k ω_k) [percentage points], over rows with both
    speeds.
    """
    motor = fitted.readings["motor_speed"]
    speed = fitted.readings["speed"]
    ratio = float(robot.gearbox.ratio) / float(robot.radius_pulley)
    with np.errstate(all="ignore"):
        simulated, measured = 1 - speed.after * ratio / motor.after, 1 - speed.measured * ratio / motor.measured
    return float(100 * np.sqrt(np.nanmean((simulated - measured) ** 2)))
