"""Assembles the result of the loop: errors on held-out data, the fit that is written, and the next experiment."""

from __future__ import annotations

import dataclasses
import functools
from typing import Any

import numpy as np

from calibration.data import Names, posterior_file
from calibration.data.runs import Runs
from calibration.discovery import (
    active_set,
    candidates,
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
    runs, left, run, observe = given.runs, traced.left, traced.run, traced.screened.base.space.bare.observe
    space, base, best = traced.screened.base.space, traced.screened.base.candidate, traced.best
    noise, base_diagnosis, ends, predicted = traced.sds.noise, left, traced.ends, traced.predicted
    if run is not None:  # of a log: its simulation
        noise = noise if observe.reads else given.noise
        best = run.base if best is base else run.best
        space, base, predicted = run.space, run.base, {}
        base_diagnosis, ends = run.diagnosis(base, left), run.diagnosis(best, ends)
    observe, included = space.bare.observe, space.included[: len(runs)]
    # The fit of the result: with the named effects, or with the curve if no name is given.
    curve, z, sd, cost = None, best.z, best.sd, best.cost
    beside = traced.beside if traced.verdict in WITHOUT_NAME and run is None else None
    if beside is not None:
        given.progress(fit_notes.progress_remark("shape"))
        if best is base:
            curve, ends = beside.curve, beside.diagnosis
            z, sd, cost = curve.z, np.sqrt(np.diag(curve.covariance)), curve.chi2[1] / 2
    given.progress(fit_notes.progress_remark("errors"))
    kinds = blocks_room.predictable_blocks(runs, space.bare)
    before, after = (prediction.FittedProblem(*space.fit_of(c.active, c.z)) for c in (base, best))
    predictions = [predicted.get(prediction.candidate_key(c)) for c in (base, best)]
    if curve is not None:
        after, predictions[1] = prediction.FittedProblem(curve.problem, curve.z, None), None
    added = curve is not None or best is not base
    row_readings = prediction.readings_of_rows(runs, noise.sd, kinds, before, after if added else None, *predictions)
    gains = _hold_out_gains(space, runs, predicted, traced.best.effects, row_readings)
    gain = gains[-1][1] if gains and added else None
    # What is written never predicts worse than the refit. A curve, which claims no cause, has to predict better.
    written = gain is None or (gain.mean > gain.se if best is base else gain.mean >= -prediction.WORSE)
    if written and curve is not None:
        robot, converged, posterior = curve.robot, curve.converged, posterior_of_curve(space, best.active, curve)
    else:
        fit, diagnosis = (best, ends) if written else (base, base_diagnosis)
        robot, converged = findings.proposed_robot(space, fit), fit.converged
        posterior = active_set.posterior_of_fit(space, fit.active, fit.z, diagnosis.linear)
    given.progress(fit_notes.progress_remark("next"))
    remaining = candidates.residuals_by_channel(space, runs, ends.linear, row_readings.after, z)
    with np.errstate(invalid="ignore"):
        share = 100 * noise.sd / np.maximum(type(observe).sizes(runs), 1e-12)
    assembled = result.DiscoveryResult(
        verdict=traced.verdict,
        robot=robot,
        refit=findings.proposed_robot(space, base),
        gains=gains,
        written=written,
        converged=converged,
        posterior=posterior,
        runs=runs,
        numbers=given.numbers,
        included=included,
        unusable=tuple(int(given.numbers[k]) for k in traced.screened.base.unusable),
        residual_clusters=find_residual_clusters(remaining, given.settings.seed),
        before=findings.evidence_of_test(left.test, adequate=not left.test.rejected),
        after=findings.evidence_of_test(ends.test, adequate=not ends.test.rejected_with_margin),
        chi2=(2 * base.cost, 2 * cost),
        readings=int(np.sum(space.weight > 0)),
        base_shift=findings.parameter_shifts(space, base.z, z, sd),
        detail=observe.detail(traced.screened.bases, included, base_diagnosis, ends),
        readings_of_rows=row_readings,
        noise={
            name: {"source": noise.source[k], "median_percent": float(np.nanmedian(share[:, k]))}
            for k, name in enumerate(channels.channel_names(noise.channels))
            if noise.source[k] != "no readings"
        },
        settings=given.settings,
        replicates=len(left.test.null.single),
        **_errors(space, runs, row_readings),
        **_claims(given, traced, space, best, curve),
    )
    # A temporary change is not uniform.
    is_event = traced.where is not None and bases_room.window_from_name(traced.where.variable) is not None
    remarks: list[fit_notes.Remark] = []
    if run is not None and run.contradicts:
        remarks.append(fit_notes.Remark("contradicted", promised=run.promised, gained=run.gained))
    if not is_event or traced.sds.factors:
        remarks += result_remarks.noise_remarks_before_verdict(traced.sds, remaining)
    remarks += result_remarks.worse_than_stated(row_readings, noise, included)
    return dataclasses.replace(assembled, remarks=(*remarks, *result_remarks.loop_remarks(assembled)))


def _errors(space: active_set.CandidateSpace, runs: Runs, seen: prediction.ReadingsOfRows) -> dict[str, Any]:
    """Errors of the result by channel: of the robot as stated, fitted, and on held-out rows."""
    included = space.included[: len(runs), None]

    def error(simulated: np.ndarray) -> result.Errors:
        return channel_errors(space.bare.channels, np.where(included, simulated, np.nan), seen.measured, seen.sd)

    held_out = {kind: preference.errors_on_common_rows(*x, error) for kind, x in seen.held_out.items()}
    return {
        "errors_as_stated": error(seen.as_stated),
        "errors": preference.errors_on_common_rows(seen.before, seen.after, error),
        "errors_held_out": held_out,
        "held_out_unpredictable": blocks_room.unpredictable_kinds(runs, space.bare),
        "held_out_worse": preference.worse_predictions(held_out),
    }


def _claims(
    given: loop_input.LoopInput,
    traced: verdict.LoopStages,
    simulated: active_set.CandidateSpace,
    best: candidates.Candidate,
    curve: discrepancy.Discrepancy | None,
) -> dict[str, Any]:
    """What the result claims: the verdict with its evidence, effects, alternatives and the next experiment.

    Args:
        simulated: candidate space of the result, of a log the one of its simulation.
        best: proposed fit there.
        curve: fitted curve if no effect is proposed.
    """
    settings, screened, left, kind = given.settings, traced.screened, traced.left, type(simulated.bare.observe)
    space, decided, alike, location = screened.base.space, traced.best, traced.alike, traced.where
    nameless, compared, p_value = traced.verdict in WITHOUT_NAME, traced.held_out, left.test.p_value
    effects: tuple[result.FoundEffect, ...] = ()
    concealed: tuple[hidden.HiddenEffect, ...] = ()
    if alike is not None:
        candidate = dataclasses.replace(best, cost=decided.cost)
        effects = findings.found_effects(space, screened.base.candidate, candidate, alike, left.test, settings)
        if not nameless and not simulated.bare.observe.long and not compared:
            compared = preference.compare_alternatives(simulated, given.runs, best, alike)
        if not nameless and traced.run is None:
            ask = kind.menu and not simulated.bare.observe.long
            concealed = hidden.find_hidden_effects(space, best, alike, left, traced.ends, settings, ask=ask)
    unnamed = None
    if nameless and traced.beside is not None and location is not None:
        if traced.run is None:
            unnamed = findings.unnamed_discrepancy(traced.beside, location, p_value, len(given.runs))
        else:
            unnamed = findings.unnamed_discrepancy_of_log(traced.beside, location, p_value)
    cost = decided.cost if curve is None else curve.chi2[1] / 2
    ladder = () if traced.searched is None else (alike or traced.searched).ladder
    near, too_large = findings.listed_alternatives(space, decided, cost, ladder, settings)
    scores, both_ways = findings.effect_scores(space, left.scores, settings), goes_both_ways(given.runs)
    summary, library = verdict.verdict_summary(traced, given.numbers), sorted(given.library.items())
    outliers = screened.outliers if space.bare.observe.reads else ()
    return {
        "summary": summary,
        "support": summary.support,
        "cluster": screened.cluster,
        "outliers": tuple(int(given.numbers[k]) for k in outliers),
        "effects": effects,
        "unnamed": unnamed,
        "remains": None if nameless or alike is None else location,
        "next_experiment": _next_experiment(space, traced, settings),
        "cannot_see": findings.invisible_effects(space, left.scores, scores, settings),
        "needs_histories": tuple(name for name, e in library if e.transient and not kind.shows(e)),
        "needs_reverse": tuple(name for name, e in library if e.needs_reverse and not both_ways),
        "alternatives": near,
        "implausible": too_large,
        "alternatives_held_out": compared,
        "hidden": concealed,
        "scores": scores,
    }


def _hold_out_gains(
    space: active_set.CandidateSpace,
    runs: Runs,
    predicted: prediction.Predicted,
    proposed: Names,
    seen: prediction.ReadingsOfRows,
) -> tuple[tuple[Names, prediction.Gain], ...]:
    """Hold-out gain of each set of effects over the refit, ordered by the number of effects. The proposal is last.

    Empty if no block can be held out.
    """
    if not seen.held_out:
        return ()
    refit, proposal = ({k: x[when] for k, x in seen.held_out.items()} for when in (0, 1))
    by_set = {tuple(filter(None, active)): reading for (active, _), reading in predicted.items()}
    sets = sorted((names for names in by_set if names and names != proposed), key=len)
    counts, kinds = space.weight[: len(runs)] > 0, blocks_room.predictable_blocks(runs, space.bare)
    score = functools.partial(
        prediction.score_readings, measured=seen.measured, sd=seen.sd, counts=counts, kinds=kinds
    )
    before, scored = score(refit), [*((names, by_set[names]) for names in sets), (proposed, proposal)]
    return tuple((names, score(reading).gain(before)) for names, reading in scored)


def _next_experiment(
    space: active_set.CandidateSpace, traced: verdict.LoopStages, settings: Settings
) -> experiments.Proposal | None:
    """Next experiment. None if there are no alternatives to separate, or if the model does not describe the runs."""
    if traced.verdict == "undescribed":
        return None
    observe, follows_goal = space.bare.observe, space.bare.base.rig.follows_goal
    if not observe.menu or follows_goal:  # the menu has no such experiments
        remark = fit_notes.Remark("no_menu", word="goals of a controller" if follows_goal else observe.word)
        return experiments.Proposal((experiments.NONE,), remark) if traced.verdict != "none" else None
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
