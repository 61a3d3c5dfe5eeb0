"""Assembles the result of the loop: errors on held-out data, the fit that is written, and the next experiment."""

from __future__ import annotations

import dataclasses
import functools
import itertools
from collections.abc import Mapping, Sequence

import numpy as np

from calibration.data import Names, posterior_file
from calibration.data.runs import Runs
from calibration.discovery import (
    active_set,
    candidates,
    discrepancy,
    experiments,
    findings,
    loop_input,
    prediction,
    result,
    result_remarks,
    verdict,
)
from calibration.discovery.scales import goes_both_ways
from calibration.discovery.settings import WITHOUT_NAME
from calibration.inference import blocks as blocks_room
from calibration.inference import fit_notes
from calibration.inference.residual_clusters import find_residual_clusters
from calibration.inference.simulation_errors import channel_errors
from mmrjax.model import channels, params


def assemble_result(inputs: loop_input.LoopInput, traced: verdict.LoopStages) -> result.DiscoveryResult:
    """Result of the loop. Computes the hold-out errors and the next experiment."""
    runs, settings, numbers, run = inputs.runs, inputs.settings, inputs.numbers, traced.run
    screened, base_diagnosis, alike, where = traced.screened, traced.left, traced.alike, traced.where
    table, nameless = screened.base.space, traced.verdict in WITHOUT_NAME
    # The fits without and with the proposal. For a log, those of its simulation.
    space, base, best, predicted = table, screened.base.candidate, traced.best, traced.predicted
    noise, before, after, is_added = traced.sds.noise, base_diagnosis, traced.ends, best is not base
    if run is not None:
        noise = noise if table.bare.observe.reads else inputs.noise
        space, base, best, predicted = run.space, run.base, run.best if is_added else run.base, {}
        before, after = run.diagnosis(base, base_diagnosis), run.diagnosis(best, after)
    observe, included = space.bare.observe, space.included[: len(runs)]
    kind, kinds = type(observe), blocks_room.predictable_blocks(runs, space.bare)
    refit_problem, proposal_problem = prediction.FittedProblem(*space.fit_of(base.active, base.z)), None
    predicted_by_refit, predicted_by_proposal = (predicted.get(prediction.candidate_key(c)) for c in (base, best))
    curve, z, sd, cost, claimed_cost = None, best.z, best.sd, best.cost, traced.best.cost
    base_curve = traced.beside if nameless and run is None else None
    if base_curve is not None:
        inputs.progress(fit_notes.progress_remark("shape"))
    if is_added:
        proposal_problem = prediction.FittedProblem(*space.fit_of(best.active, best.z))
    elif base_curve is not None:  # no effect is added, but a curve
        curve, after = base_curve.fitted, base_curve.diagnosis
        z, sd, cost = curve.z, np.sqrt(np.diag(curve.covariance)), curve.chi2[1] / 2
        proposal_problem, predicted_by_proposal = prediction.FittedProblem(curve.problem, z, None), None
        claimed_cost = cost
    inputs.progress(fit_notes.progress_remark("errors"))
    readings = prediction.readings_of_rows(
        runs, noise.sd, kinds, refit_problem, proposal_problem, predicted_by_refit, predicted_by_proposal
    )
    gains = _hold_out_gains(space, runs, predicted, traced.best.effects, readings)
    gain = gains[-1][1] if gains and proposal_problem is not None else None
    # What is written never predicts worse than the refit. A curve, which claims no cause, has to predict better.
    written = gain is None or (gain.mean >= -prediction.WORSE if is_added else gain.mean > gain.se)
    if written and curve is not None:
        robot, converged, posterior = curve.robot, curve.converged, posterior_of_curve(space, best.active, curve)
    else:
        fit, diagnosis = (best, after) if written else (base, before)
        robot, converged = findings.proposed_robot(space, fit), fit.converged
        posterior = active_set.posterior_of_fit(space, fit.active, fit.z, diagnosis.linear)
    inputs.progress(fit_notes.progress_remark("next"))
    # What the loop claims: effects or an unnamed discrepancy, and what may be present in addition or instead.
    claimed = dataclasses.replace(best, cost=traced.best.cost)
    effects = (
        ()
        if alike is None
        else findings.found_effects(table, screened.base.candidate, claimed, alike, base_diagnosis.test)
    )
    hidden: tuple[findings.HiddenEffect, ...] = ()
    if alike is not None and not nameless and run is None:
        named = tuple(itertools.chain(*alike.members))
        hidden = findings.find_hidden_effects(table, named, base_diagnosis.scores, traced.ends.scores)
    unnamed = None
    if nameless and traced.beside is not None and where is not None:
        p_value, simulated = base_diagnosis.test.p_value, run is not None
        unnamed = findings.unnamed_discrepancy(traced.beside, where, p_value, len(runs), simulated)
    ladder = () if traced.searched is None else (alike or traced.searched).ladder
    plausible, implausible = findings.listed_alternatives(table, traced.best, claimed_cost, ladder)
    scores, both_ways = findings.effect_scores(table, base_diagnosis.scores), goes_both_ways(runs)
    summary, library = verdict.verdict_summary(traced, numbers), sorted(inputs.library.items())
    remaining = candidates.residuals_by_channel(space, runs, after.linear, readings.after, z)
    with np.errstate(invalid="ignore"):
        relative_sd = 100 * noise.sd / np.maximum(kind.sizes(runs), 1e-12)

    errors = functools.partial(errors_on_common_rows, space.bare.channels, readings, included)
    held_out = {word: errors(*x) for word, x in readings.held_out.items()}
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
        outliers=tuple(int(numbers[k]) for k in screened.outliers if table.bare.observe.reads),
        unusable=tuple(int(numbers[k]) for k in screened.base.unusable),
        effects=effects,
        unnamed=unnamed,
        remains=None if nameless or alike is None else where,
        next_experiment=_next_experiment(table, traced),
        cannot_see=findings.invisible_effects(table, base_diagnosis.scores, scores),
        needs_histories=tuple(name for name, e in library if e.transient and not kind.shows(e)),
        needs_reverse=tuple(name for name, e in library if e.needs_reverse and not both_ways),
        alternatives=plausible,
        implausible=implausible,
        hidden=hidden,
        support=summary.support,
        cluster=screened.cluster,
        residual_clusters=find_residual_clusters(remaining, settings.seed),
        before=base_diagnosis.test,
        after=after.test,
        chi2=(2 * base.cost, 2 * cost),
        readings=int(np.sum(space.weight > 0)),
        base_shift=findings.parameter_shifts(space, base.z, z, sd),
        scores=scores,
        detail=observe.detail(screened.bases, included, before, after),
        readings_of_rows=readings,
        errors_as_stated=errors(readings.as_stated)[0],
        errors=errors(readings.before, readings.after),
        errors_held_out=held_out,
        held_out_unpredictable=blocks_room.unpredictable_kinds(runs, space.bare),
        held_out_worse=worse_predictions(held_out),
        noise={
            name: {"source": noise.source[k], "median_percent": float(np.nanmedian(relative_sd[:, k]))}
            for k, name in enumerate(channels.channel_names(noise.channels))
            if noise.source[k] != "no readings"
        },
        settings=settings,
        replicates=len(base_diagnosis.test.null.single),
    )
    return dataclasses.replace(assembled, remarks=result_remarks.loop_remarks(assembled, traced, noise, remaining))


def errors_on_common_rows(
    measured_channels: Sequence[channels.Channel],
    readings: prediction.ReadingsOfRows,
    included: np.ndarray,
    *fits: np.ndarray,
) -> tuple[result.Errors, ...]:
    """Errors of fits by channel, over the included readings that all of them predict."""
    common = included[:, None] & np.isfinite(fits).all(0)
    return tuple(
        channel_errors(measured_channels, np.where(common, x, np.nan), readings.measured, readings.sd) for x in fits
    )


#: Least relative difference of hold-out errors that counts; less is invisible in two digits.
TOLD = 0.01


def worse_predictions(errors: Mapping[str, tuple[result.Errors, ...]]) -> tuple[result.WorseChannel, ...]:
    """Channels whose hold-out error rises with the effects, for each kind of block.

    Args:
        errors: kind of block → hold-out errors without and with the effects, over the rows that both fits predict.
    """
    return tuple(
        result.WorseChannel(kind, channel, int(new["rows"]), float(old["rms_percent"]), float(new["rms_percent"]))
        for kind, (before, after) in errors.items()
        for channel, new in after.items()
        if new["rms_percent"] > (1 + TOLD) * (old := before[channel])["rms_percent"]
    )


def _hold_out_gains(
    space: active_set.CandidateSpace,
    runs: Runs,
    predicted: prediction.Predicted,
    proposed: Names,
    readings: prediction.ReadingsOfRows,
) -> tuple[tuple[Names, prediction.Gain], ...]:
    """Hold-out gain of each set of effects over the refit, ordered by the number of effects. The proposal is last.

    Empty if no block can be held out.
    """
    if not readings.held_out:
        return ()
    refit, proposal = ({k: x[when] for k, x in readings.held_out.items()} for when in (0, 1))
    by_set = {tuple(filter(None, active)): reading for (active, _), reading in predicted.items()}
    sets = sorted((names for names in by_set if names and names != proposed), key=len)
    included, kinds = space.weight[: len(runs)] > 0, blocks_room.predictable_blocks(runs, space.bare)
    score = functools.partial(
        prediction.score_readings, measured=readings.measured, sd=readings.sd, included=included, kinds=kinds
    )
    before, scored = score(refit), [*((names, by_set[names]) for names in sets), (proposed, proposal)]
    return tuple((names, score(reading).gain(before)) for names, reading in scored)


def _next_experiment(space: active_set.CandidateSpace, traced: verdict.LoopStages) -> experiments.Proposal | None:
    """Next experiment. None if there are no alternatives to separate, or if the model does not describe the runs."""
    if traced.verdict == "undescribed":
        return None
    observe, follows_goal = space.bare.observe, space.bare.base.rig.follows_goal
    if not observe.menu or follows_goal:  # the menu has no such experiments
        remark = fit_notes.Remark("no_menu", word="goals of a controller" if follows_goal else observe.word)
        return experiments.Proposal((experiments.NONE,), remark) if traced.verdict != "none" else None
    if traced.verdict in WITHOUT_NAME and traced.where is not None:
        return experiments.propose_denser_runs(space, traced.where, space.settings)
    return None if traced.alike is None else experiments.propose_separating(space, traced.best, traced.alike)


def posterior_of_curve(
    space: active_set.CandidateSpace, active: Names, curve: discrepancy.FittedCurve
) -> posterior_file.Posterior:
    """Posterior distribution of a fit with a smooth curve. The ordinates are linear in their coordinates and come
    last.
    """
    shaped: discrepancy.CurveCoordinates = curve.problem.coordinates
    inner = len(shaped.base)
    transform = np.eye(len(shaped))
    transform[inner:, inner:] = np.asarray(shaped.root)
    base, used = active_set.coordinate_groups(shaped.base, space, active, curve.z[:inner])
    spec = {p.name: p.spec for p in params.walk_parameters(curve.problem.base)}
    ordinates = active_set.clipped_parameters(
        shaped.names, [spec[n] for n in shaped.names], np.asarray(shaped.root) @ curve.z[inner:]
    )
    places = [*used, *range(inner, len(shaped))]
    covariance = (transform @ curve.covariance @ transform.T)[np.ix_(places, places)]
    return posterior_file.join_posteriors([*base, ordinates], covariance)
