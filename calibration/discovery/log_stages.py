"""Stages of logs: the loop on their windows and on their linear readings, each confirmed by one simulation."""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Callable
from typing import Any

import numpy as np

from calibration.discovery import active_set, verdict
from calibration.discovery.adequacy import Diagnosis
from calibration.discovery.candidates import Candidate, excess_misfit
from calibration.discovery.log_simulation import refine_by_simulation, simulate_models
from calibration.discovery.loop_input import LoopInput
from calibration.discovery.loop_notes import MissedChannel
from calibration.discovery.mechanism import find_mechanism
from calibration.discovery.outliers import Screening
from calibration.discovery.search import SearchResult, best_of_each_size, diagnose_candidate
from calibration.discovery.settings import settings_for
from calibration.discovery.verdict import LoopStages
from calibration.inference import observers
from calibration.inference.fit_notes import progress_remark
from calibration.inference.noise import Noise
from calibration.inference.observers.linear_rows import Windows, problem_of_readings, problem_of_windows
from calibration.inference.priors import DELAY
from calibration.inference.weak_form import fit_weak_form

#: Steps of the longest run from which windows decide the verdict of a log. A simulated fit would take minutes.
LONG = 4000
#: Difference of a delay from whole rows up to which a simulation begins at these [rows].
NEAREST = 0.25
#: Sds of a χ² above its mean up to which a simulated base leaves no more than noise.
CHANCE = 3.0
#: Single effects that are simulated if the best of them leaves a discrepancy in the linear readings.
RIVALS = 3


def windows_of_log(log_input: LoopInput) -> LoopInput | None:
    """The same input with the windows of a log as its table. None if the log does not show its states, or if its
    longest run has fewer than `LONG` steps, and for equations or other known results.

    Windows use every row of a log, except for an angle alone. Simulations use fewer.
    """
    if log_input.equations is not None:
        return None
    if log_input.known is not None and not isinstance(log_input.known.screened.base.space.bare.observe, Windows):
        return None
    space, runs, sd, numbers = log_input.space, log_input.runs.whole, log_input.noise.sd, log_input.numbers
    observe: Any = space.bare.observe
    if not observe.long or observe.times.shape[1] < LONG:
        return None
    bare = space.bare
    motions = [c.settled for c in bare.channels if c.zero_at_rest]
    # A log of an angle alone keeps its thinned rows. With all of them, the class of EMPS is only tentative, and a
    # pendulum leaves twice its noise.
    if log_input.runs.log is not None and (any(motions) or not motions):
        sd = np.broadcast_to(np.median(sd, 0), runs.measured().shape)
        bare, numbers = observers.pose_problem(runs, bare.base, bare.coordinates, sd), np.arange(1, len(runs) + 1)
        observe = bare.observe
    fit = fit_weak_form(bare, space.library.scored)
    if fit is None:
        return None

    def columns(rows: np.ndarray) -> dict[str, np.ndarray]:
        table = {name: x[rows] for name, x in runs.columns.items() if x.dtype.kind == "f"}
        return {**table, "configuration": np.asarray(observe.of_rows.configuration)[rows]}

    settings = log_input.settings
    posed, rows = problem_of_windows(bare, fit, space.library.scored, columns, settings.width)
    shares = settings_for(type(posed.observe), settings.replicates).shares
    settings = dataclasses.replace(settings, shares=shares)
    table = active_set.candidate_space(posed, space.library.effects, log_input.library, settings)
    noise = dataclasses.replace(log_input.noise, sd=sd[rows])
    return dataclasses.replace(
        log_input, runs=runs.where(rows), numbers=numbers[rows], noise=noise, equations=table, known=None,
        settings=settings,
    )  # fmt: skip


def readings_of_log(log_input: LoopInput, screened: Screening, sds: verdict.VerdictNoise, ranked: bool) -> LoopInput:
    """The same input with the readings of a log as linear equations about the simulated fit of its base.

    Args:
        screened, sds: simulated fit of the base, and its noise.
        ranked: True if the effects have been ranked.
    """
    space, settings, measured = screened.base.space, log_input.settings, log_input.runs.measured()
    weight = space.weight.copy()
    weight[list(screened.outliers)] = np.isfinite(measured[list(screened.outliers)])
    problem = space.with_noise(None, weight).bare
    z = screened.base.candidate.z[: space.free]
    posed = problem_of_readings(problem, z, space.library.scored, settings.width)
    equations = active_set.candidate_space(posed, space.library.effects, log_input.library, settings)
    store_apart = log_input.kept_apart("readings")

    def keep(name: str, make: Callable[[], Any]) -> Any:
        """Stores a stage apart, except a second ranking."""
        return None if ranked and name == "ranking" else store_apart(name, make)

    confirm = functools.partial(smallest_confirmed, space)
    return dataclasses.replace(
        log_input, equations=equations, noise=sds.noise, known=None, keep=keep, confirm=confirm
    )  # fmt: skip


def confirm_readings(
    log_input: LoopInput, readings: LoopInput, screened: Screening, sds: verdict.VerdictNoise, traced: LoopStages
) -> LoopStages:
    """Stages of a log's linear readings after the simulation of the model that they choose.

    Args:
        readings: input of these stages, see `readings_of_log`.
        screened, sds: simulated fit of the base, and its noise.
        traced: results of these stages.
    """
    if not traced.sds.factors:
        traced = dataclasses.replace(
            traced, sds=dataclasses.replace(traced.sds, factors=sds.factors, remarks=sds.remarks)
        )
    linear_fit = traced.screened.base
    space = screened.base.space.with_noise(traced.sds.noise.sd, linear_fit.space.weight)
    log_input.progress(progress_remark("confirm"))
    best = _chosen_fit(traced)
    space = space if traced.searched is None else space.with_room(traced.searched.room)
    simulation = simulate_models(space, linear_fit.candidate, best, screened.base.candidate)
    traced = dataclasses.replace(traced, run=simulation)
    if traced.searched is None:
        return traced
    confirmed = traced.left.test.confirmed(max(0.0, 2 * (simulation.base.cost - simulation.best.cost)))
    if not confirmed.rejected and traced.screened.cluster is None:
        base_diagnosis = dataclasses.replace(traced.left, test=confirmed)
        without_effects = dataclasses.replace(simulation, best=simulation.base, promised=0.0, gained=0.0)
        return LoopStages("none", traced.screened, base_diagnosis, traced.sds, run=without_effects)
    return _lower_if_contradicted(readings, traced)


def smallest_confirmed(
    space: active_set.CandidateSpace, screened: Screening, base_diagnosis: Diagnosis,
    searched: SearchResult, noise: Noise,
) -> SearchResult:  # fmt: skip
    """The search with the smallest set whose simulation leaves no discrepancy, or else the largest set.

    The diagnosis belongs to the simulation of that set.

    Readings are linear near the fit of the base only. A large effect therefore leaves residuals that another one
    would explain.

    Args:
        space: space of the simulated log. If it has room for effects, only sets of these are simulated.
        screened, base_diagnosis, searched: linear fit of the base, its diagnosis, and the search from it.
        noise: noise of the readings.
    """
    best = searched.best
    if best is None or searched.diagnosis is None:
        return searched
    if len(best.effects) == 1 and not searched.diagnosis.test.rejected_with_margin:
        return searched
    single = sorted((c for c in searched.ladder if len(c.effects) == 1 and c.plausible), key=lambda c: c.cost)
    sets_by_size = [single[:RIVALS], *([c] for c in best_of_each_size(searched) if len(c.effects) > 1)]
    sets_by_size = [[c for c in sets if _has_room(space, c)] for sets in sets_by_size]
    space = space.with_noise(noise.sd, screened.base.space.weight)
    space = space.with_room([*space.room, *(name for sets in sets_by_size for c in sets for name in c.effects)])
    for sets in filter(None, sets_by_size):
        fits = [refine_by_simulation(space, c, [c.z]) for c in sets]
        k = min(range(len(fits)), key=lambda k: fits[k].cost)
        diagnosis = diagnose_candidate(space, fits[k], screened.bases, base_diagnosis, base_diagnosis.linear)
        searched = dataclasses.replace(searched, best=sets[k], diagnosis=diagnosis, room=space.room)
        if not diagnosis.test.rejected_with_margin:
            break
    return searched


def _has_room(space: active_set.CandidateSpace, fit: Candidate) -> bool:
    """True if the program of a log's simulations has room for a set of effects, or has not been determined."""
    return not space.room or {*fit.effects} <= {*space.room}


def best_simulated_size(
    space: active_set.CandidateSpace, screened: Screening, base_diagnosis: Diagnosis,
    searched: SearchResult, noise: Noise,
) -> SearchResult:  # fmt: skip
    """The search in the windows of a log with the largest set that lowers the misfit of a simulation.

    Windows of many rows can show a second effect. In a simulation, two effects may still fit worse than one.

    Args: as for `smallest_confirmed`, of the windows. The noise of the simulated log is that of `space`.
    """
    sets = [c for c in best_of_each_size(searched) if _has_room(space, c)]
    space = space.with_room([*space.room, *(name for c in sets for name in c.effects)])
    searched = dataclasses.replace(searched, room=space.room)
    if len(sets) < 2:
        return searched
    costs = [refine_by_simulation(space, c, [c.z]).cost for c in sets]
    best = sets[int(np.argmin(costs))]
    if best is searched.best:
        return searched
    diagnosis = diagnose_candidate(screened.base.space, best, screened.bases, base_diagnosis)
    return dataclasses.replace(searched, best=best, diagnosis=diagnosis)


def _chosen_fit(traced: LoopStages) -> Candidate:
    """Fit of the verdict: the proposal, or else the best set of its mechanism."""
    base, searched, mechanism = traced.screened.base.candidate, traced.searched, traced.mechanism
    if searched is None or traced.best is not base:
        return traced.best
    effect_names = frozenset(() if mechanism is None else mechanism.effects)
    return min(searched.ladder, key=lambda c: (c.key != effect_names, not c.plausible, c.cost))


def delayed_by_rows(log_input: LoopInput, fit: Candidate) -> Candidate:
    """The fit of a log's windows with a delay of whole rows, if that is near.

    A quantity that is held between rows jumps at each of them. So a fast current jumps when the delay crosses a row,
    and the steps of a fit do not lead across.
    """
    coordinates, steps = log_input.space.coordinates.base, np.diff(log_input.runs.whole["time_s"])
    if DELAY not in coordinates.names or log_input.robot.rig.between_rows == "linear":
        return fit
    k, step = coordinates.names.index(DELAY), float(np.median(steps[steps > 0]))
    delay = float(coordinates.value(fit.z[: log_input.space.free])[k])
    offset = round(delay / step) * step - delay
    if abs(offset) > NEAREST * step:
        return fit
    return dataclasses.replace(fit, z=fit.z + np.eye(len(fit.z))[k] * offset / float(coordinates.spread[k]))


def _lower_if_contradicted(equations: LoopInput, traced: LoopStages) -> LoopStages:
    """Stages whose claim falls by one level if the simulation gains too little of what the equations promised."""
    simulation, searched, base_curve = traced.run, traced.searched, traced.beside
    if (
        simulation is None
        or searched is None
        or base_curve is None
        or not simulation.contradicts
        or traced.verdict == "place"
    ):
        return traced
    if traced.verdict == "mechanism" and traced.mechanism is not None:  # a curve is not simulated
        return dataclasses.replace(traced, verdict="place") if traced.mechanism.effects else traced
    mechanism = find_mechanism(base_curve, equations.runs, searched.ladder, traced.predicted)
    level = "place" if mechanism is None or mechanism.fails else "mechanism"
    return dataclasses.replace(traced, verdict=level, mechanism=mechanism, where=base_curve.where)


def confirm_windows(log_input: LoopInput, windows: LoopInput, traced: LoopStages) -> LoopStages | None:
    """Stages of a log's windows after the simulation of the base model and of the chosen one.

    None if nothing is missing: in the windows, or because the simulated base leaves no more than noise or the effects
    gain no more than chance there. If they gain less than half of what the windows promised, the claim falls by one
    level. No effect is named if the simulation misses a channel.
    """
    screened, base_diagnosis, searched, base_curve = traced.screened, traced.left, traced.searched, traced.beside

    def undescribed(channels_missed: tuple[MissedChannel, ...]) -> LoopStages:
        return dataclasses.replace(
            LoopStages("undescribed", screened, base_diagnosis, traced.sds, searched), beside=base_curve,
            run=traced.run, predicted=traced.predicted,
            missed=channels_missed, unused=verdict.unused_inputs(log_input.runs),
        )  # fmt: skip

    if log_input.known is not None:  # only the noise differs
        if log_input.known.verdict == "undescribed":
            return undescribed(log_input.known.missed)
        refuted = log_input.known.run is not None and log_input.known.run.contradicts
        return dataclasses.replace(traced, verdict="place") if refuted and traced.verdict != "none" else traced
    if searched is None or base_curve is None:
        return None
    log_input.progress(progress_remark("confirm"))
    window_fit, base = _chosen_fit(traced), delayed_by_rows(log_input, screened.base.candidate)
    best = base if window_fit is screened.base.candidate else delayed_by_rows(log_input, window_fit)
    simulation = simulate_models(log_input.space.with_room(searched.room), base, best, disturbed=True)
    confirmed = base_diagnosis.test.confirmed(max(0.0, 2 * (simulation.base.cost - simulation.best.cost)))
    chance_misfit = CHANCE * math.sqrt(2 * float(np.sum(simulation.space.weight > 0)))
    if not confirmed.rejected or (
        not simulation.disturbed and excess_misfit(simulation.space, simulation.base) < chance_misfit
    ):
        return None
    traced = dataclasses.replace(traced, run=simulation)
    channels_missed_by_base, channels_missed = (
        functools.partial(
            verdict.missed_channels,
            simulation.space,
            log_input.runs,
            log_input.noise,
            simulation.diagnosis(x, base_diagnosis).linear,
        )
        for x in (simulation.base, simulation.best)
    )
    if channels_missed():
        return undescribed(channels_missed_by_base())
    return _lower_if_contradicted(windows, traced)
