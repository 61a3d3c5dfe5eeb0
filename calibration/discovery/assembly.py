"""Assembles the result of the loop: errors on held-out data, the fit that is written, and the next experiment."""

from __future__ import annotations

import dataclasses
import functools

import numpy as np

from calibration.data import Names, posterior_file
from calibration.data.runs import Runs
from calibration.discovery import (
    active_set,
    discrepancy,
    experiments,
    findings,
    hidden,
    loop_input,
    prediction,
    preference,
    result,
    result_remarks,
    verdict,
)
from calibration.discovery.candidates import residuals_by_channel
from calibration.discovery.scales import goes_both_ways
from calibration.discovery.settings import WITHOUT_NAME, Settings
from calibration.inference import bases as bases_room
from calibration.inference import blocks as blocks_room
from calibration.inference import fit_notes
from calibration.inference.residual_clusters import find_residual_clusters
from calibration.inference.simulation_errors import channel_errors
from mmrjax.model import channels, params


def assemble_result(given: loop_input.LoopInput, traced: verdict.LoopStages) -> result.DiscoveryResult:
    """Result of the loop. Computes the hold-out errors and the next experiment."""
    runs, numbers, settings, progress = given.runs, given.numbers, given.settings, given.progress
    screened, diagnosis, noise = traced.screened, traced.left, traced.sds.noise
    space, base, best, ends = screened.base.space, screened.base.candidate, traced.best, traced.ends
    nameless = traced.verdict in WITHOUT_NAME
    decided, shown = (space, best), diagnosis
    if (run := traced.run) is not None:
        best = run.base if best is base else run.best
        noise = noise if space.bare.observe.reads else given.noise
        space, base, traced = run.space, run.base, dataclasses.replace(traced, predicted={})
        shown, ends = run.diagnosis(base, diagnosis), run.diagnosis(best, ends)
    observe, included = space.bare.observe, space.included[: len(runs)]
    # The fit of the result: with the named effects, or with the curve if no name is given.
    beside = traced.beside if nameless and run is None else None
    if beside is not None:
        progress(fit_notes.progress_remark("shape"))
    before, curve = prediction.FittedProblem(*space.fit_of(base.active, base.z)), None
    after, z, sd, cost = None, best.z, best.sd, best.cost
    if beside is not None and best is base:
        curve, ends = beside.curve, beside.diagnosis
        z, sd, cost = curve.z, np.sqrt(np.diag(curve.covariance)), curve.chi2[1] / 2
        after = prediction.FittedProblem(curve.problem, z, None)
    elif best is not base:
        after = prediction.FittedProblem(*space.fit_of(best.active, z))
    progress(fit_notes.progress_remark("errors"))
    predictions = [traced.predicted.get(prediction.candidate_key(c)) for c in (base, best)]
    kinds = blocks_room.predictable_blocks(runs, space.bare)
    row_readings = prediction.readings_of_rows(
        runs, noise.sd, kinds, before, after, predictions[0], None if best is base else predictions[1]
    )
    compared = traced.held_out
    if traced.alike is not None and not nameless and not compared and not observe.long:
        compared = preference.compare_alternatives(space, runs, best, traced.alike)
    gains = _hold_out_gains(space, runs, traced, row_readings)
    gain = gains[-1][1] if gains and after is not None else None
    # What is written never predicts worse than the refit. A curve, which claims no cause, has to predict better.
    written = gain is None or (gain.mean > gain.se if best is base else gain.mean >= -prediction.WORSE)
    if written and curve is not None:
        robot, converged, posterior = curve.robot, curve.converged, posterior_of_curve(space, best.active, curve)
    else:
        fit, of_fit = (best, ends) if written else (base, shown)
        robot, converged = findings.proposed_robot(space, fit), fit.converged
        posterior = active_set.posterior_of_fit(space, fit.active, fit.z, of_fit.linear)
    progress(fit_notes.progress_remark("next"))
    remaining = residuals_by_channel(space, runs, ends.linear, row_readings.after, z)

    def error(simulated: np.ndarray) -> result.Errors:
        simulated = np.where(included[:, None], simulated, np.nan)
        return channel_errors(space.bare.channels, simulated, row_readings.measured, row_readings.sd)

    errors_held_out = {k: preference.errors_on_common_rows(*x, error) for k, x in row_readings.held_out.items()}
    ladder = () if traced.searched is None else (traced.alike or traced.searched).ladder
    cost_there = decided[1].cost if curve is None else cost
    near, too_large = findings.listed_alternatives(*decided, cost_there, ladder, settings)
    effects: tuple[result.FoundEffect, ...] = ()
    concealed: tuple[hidden.HiddenEffect, ...] = ()
    if traced.alike is not None:
        named, base_there = dataclasses.replace(best, cost=decided[1].cost), screened.base.candidate
        effects = findings.found_effects(decided[0], base_there, named, traced.alike, diagnosis.test, settings)
        if not nameless and run is None:
            ask = observe.menu and not observe.long
            concealed = hidden.find_hidden_effects(
                space, best, traced.alike, diagnosis, traced.ends, settings, ask=ask
            )
    scores = findings.effect_scores(decided[0], diagnosis.scores, settings)
    summary, kind = verdict.verdict_summary(traced, numbers), type(observe)
    with np.errstate(invalid="ignore"):
        share = 100 * noise.sd / np.maximum(kind.sizes(runs), 1e-12)
    unnamed, p_value = None, diagnosis.test.p_value
    if beside is not None and traced.where is not None:
        unnamed = findings.unnamed_discrepancy(beside, traced.where, p_value, len(runs))
    elif nameless and traced.beside is not None and traced.where is not None:
        unnamed = findings.unnamed_discrepancy_of_log(traced.beside, traced.where, p_value)
    assembled = result.DiscoveryResult(
        verdict=traced.verdict,
        summary=summary,
        robot=robot,
        refit=findings.proposed_robot(space, base),
        gains=gains,
        written=written,
        converged=converged,
        posterior=posterior,
        runs=runs,
        numbers=numbers,
        included=included,
        outliers=tuple(int(numbers[k]) for k in screened.outliers if screened.base.space.bare.observe.reads),
        unusable=tuple(int(numbers[k]) for k in screened.base.unusable),
        effects=effects,
        unnamed=unnamed,
        remains=None if nameless or traced.alike is None else traced.where,
        next_experiment=_next_experiment(decided[0], traced, settings),
        cannot_see=findings.invisible_effects(decided[0], diagnosis.scores, settings),
        needs_histories=tuple(sorted(name for name, e in given.library.items() if e.transient and not kind.shows(e))),
        needs_reverse=tuple(
            sorted(name for name, e in given.library.items() if e.needs_reverse and not goes_both_ways(runs))
        ),
        alternatives=near,
        implausible=too_large,
        hidden=concealed,
        support=summary.support,
        cluster=screened.cluster,
        residual_clusters=find_residual_clusters(remaining, settings.seed),
        before=findings.evidence_of_test(diagnosis.test, adequate=not diagnosis.test.rejected),
        after=findings.evidence_of_test(ends.test, adequate=not ends.test.rejected_with_margin),
        chi2=(2 * base.cost, 2 * cost),
        readings=int(np.sum(space.weight > 0)),
        base_shift=findings.parameter_shifts(space, base.z, z, sd),
        scores=scores,
        detail=observe.detail(screened.bases, included, shown, ends),
        readings_of_rows=row_readings,
        errors_as_stated=error(row_readings.as_stated),
        errors=preference.errors_on_common_rows(row_readings.before, row_readings.after, error),
        errors_held_out=errors_held_out,
        held_out_unpredictable=blocks_room.unpredictable_kinds(runs, space.bare),
        held_out_worse=preference.worse_predictions(errors_held_out),
        alternatives_held_out=compared,
        noise={
            name: {"source": noise.source[k], "median_percent": float(np.nanmedian(share[:, k]))}
            for k, name in enumerate(channels.channel_names(noise.channels))
            if noise.source[k] != "no readings"
        },
        settings=settings,
        replicates=len(diagnosis.test.null.single),
    )
    # A temporary change is not uniform.
    is_event = traced.where is not None and bases_room.window_from_name(traced.where.variable) is not None
    of_noise = (
        ()
        if is_event and not traced.sds.factors
        else result_remarks.noise_remarks_before_verdict(traced.sds, remaining)
    )
    if run is not None and run.contradicts:
        of_noise = (fit_notes.Remark("contradicted", promised=run.promised, gained=run.gained), *of_noise)
    return dataclasses.replace(
        assembled,
        remarks=(
            *of_noise,
            *result_remarks.worse_than_stated(row_readings, noise, included),
            *result_remarks.loop_remarks(assembled),
        ),
    )


def _hold_out_gains(
    space: active_set.CandidateSpace, runs: Runs, traced: verdict.LoopStages, seen: prediction.ReadingsOfRows
) -> tuple[tuple[Names, prediction.Gain], ...]:
    """Hold-out gain of each set of effects over the refit, ordered by the number of effects. The proposal is last.

    Empty if no block can be held out.
    """
    if not seen.held_out:
        return ()
    counts, kinds = space.weight[: len(runs)] > 0, blocks_room.predictable_blocks(runs, space.bare)
    refit, proposal = ({k: x[when] for k, x in seen.held_out.items()} for when in (0, 1))
    by_set = {tuple(filter(None, active)): reading for (active, _), reading in traced.predicted.items()}
    sets = sorted((names for names in by_set if names and names != traced.best.effects), key=len)
    scored = [*((names, by_set[names]) for names in sets), (traced.best.effects, proposal)]
    score = functools.partial(
        prediction.score_readings, measured=seen.measured, sd=seen.sd, counts=counts, kinds=kinds
    )
    return tuple((names, score(reading).gain(score(refit))) for names, reading in scored)


def _next_experiment(
    space: active_set.CandidateSpace, traced: verdict.LoopStages, settings: Settings
) -> experiments.Proposal | None:
    """Next experiment. None if there are no alternatives to separate, or if the model does not describe the runs."""
    if traced.verdict == "undescribed":
        return None
    if not space.bare.observe.menu or space.bare.base.rig.follows_goal:
        return experiments.propose_nothing(space) if traced.verdict != "none" else None
    if traced.verdict in WITHOUT_NAME and traced.where is not None:
        return experiments.propose_denser_runs(space, traced.where, settings)
    return (
        None if traced.alike is None else experiments.propose_separating(space, traced.best, traced.alike, settings)
    )


def posterior_of_curve(
    space: active_set.CandidateSpace, active: Names, curve: discrepancy.Discrepancy
) -> posterior_file.Posterior:
    """Posterior distribution of a fit with a smooth curve. The ordinates are linear in their coordinates and come
    last.
    """
    shaped: discrepancy.CurveCoordinates = curve.problem.coordinates
    inner = len(shaped.base)
    turn = np.eye(len(shaped))
    turn[inner:, inner:] = np.asarray(shaped.root)
    base, kept_places = active_set.coordinate_groups(shaped.base, space, active, curve.z[:inner])
    spec = {p.name: p.spec for p in params.walk_parameters(curve.problem.base)}
    ordinates = active_set.clipped_parameters(
        shaped.names, [spec[n] for n in shaped.names], np.asarray(shaped.root) @ curve.z[inner:]
    )
    places = [*kept_places, *range(inner, len(shaped))]
    covariance = (turn @ curve.covariance @ turn.T)[np.ix_(places, places)]
    return posterior_file.join_posteriors([*base, ordinates], covariance)
