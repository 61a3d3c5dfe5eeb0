"""Stages of the loop: from the fit of the base to the claim, see `discover.STAGES`."""

from __future__ import annotations

import dataclasses
import functools
from typing import Any

import numpy as np

from calibration.discovery import (
    candidates,
    classes,
    discrepancy,
    findings,
    loop_notes,
    outliers,
    prediction,
    preference,
    search,
    verdict,
)
from calibration.discovery.adequacy import Diagnosis
from calibration.discovery.discrepancy import BaseCurve
from calibration.discovery.location import varied_by_duty
from calibration.discovery.loop_input import LoopInput
from calibration.discovery.mechanism import find_mechanism
from calibration.discovery.outliers import Screening
from calibration.discovery.search import Proposed, SearchResult
from calibration.discovery.settings import HELD_OUT
from calibration.discovery.verdict import VerdictNoise
from calibration.inference.fit_notes import progress_remark
from calibration.inference.lack_of_fit import common_factors, noise_remarks
from calibration.inference.noise import Noise

#: Number of times that rows are screened for isolated outliers, with the effects found.
SCREENINGS = 4
#: Largest root of a score above which programs of later stages are compiled before the bootstrap decides [σ].
LIKELY = 4.0


def fit_base_and_noise(given: LoopInput, begin: candidates.Candidate | None) -> tuple[Screening, VerdictNoise]:
    """Fits the base. If its residuals have no structure but exceed the noise by one factor, rescales the noise."""
    known_stages, noise = given.known, given.noise
    screened = _fit_base(given, noise, None if known_stages is None else known_stages.screened.base, begin)
    base, free = screened.base, screened.base.space.free
    residuals = candidates.residuals_by_channel(
        base.space, given.runs, screened.diagnosed[0], base.reading, base.candidate.z[:free]
    )
    skip = screened.cluster is not None or not base.space.bare.observe.reads
    factors = {} if skip else common_factors(residuals)
    sds = VerdictNoise(noise, factors, tuple(noise_remarks(residuals, noise.word)))
    if factors:
        given.progress(progress_remark("sds"))
        sds = dataclasses.replace(sds, noise=noise.scaled(factors))
        screened = _fit_base(given, sds.noise, screened.base, begin)
    return screened, sds


def _fit_base(
    given: LoopInput, noise: Noise, before: candidates.BaseFit | None, begin: candidates.Candidate | None
) -> Screening:
    """Fits the base with this noise and excludes outliers. `before` is an earlier fit with other noise.

    For logs, the equations in weak form give the start of the fit, and rank the library unless effects would only
    stand in for a backlash.
    """
    settings, same = given.settings, noise is given.noise
    space = given.equations or (given if same else dataclasses.replace(given, noise=noise)).space
    near = None if before is None else before.candidate
    if before is None:
        if begin is not None:  # as near as a simulated fit, and its effects are ranked
            near = dataclasses.replace(begin, simulated=True)
        elif (ranking := search.screen_by_weak_form(space, settings)) is not None:
            make = functools.partial(findings.rank_effects_by_weak_form, space, ranking, settings)
            if not given.shows_unmodelled_backlash:
                given.ranked.append(given.keep("ranking", make))
            near = None if ranking.slides else ranking.base
        if given.others is not None:
            given.later.append(given.others.enter_context(outliers.compile_ahead(space, given.runs, settings)))
    if given.equations is None or not space.bare.observe.reads:  # linear readings have a fit
        given.progress(progress_remark("base"))
    return outliers.screen_outliers(
        candidates.fit_base(space, settings, given.runs.source, near), given.runs, settings
    )


def search_until_clean(
    given: LoopInput, screened: Screening, sds: VerdictNoise
) -> tuple[Screening, Diagnosis, SearchResult | None]:
    """Searches for effects, again whenever new outliers appear. No search if the base fits, or if the log shows
    backlash that the robot lacks.
    """
    settings, keep, progress = given.settings, given.keep, given.progress
    for k in range(SCREENINGS):
        progress(progress_remark("bootstrap", settings.replicates))
        screened, diagnosis = keep(f"bootstrap {k}", functools.partial(_test_base, given, sds, screened))
        if k == 0 and not given.ranked and not given.shows_unmodelled_backlash:
            keep("ranking", functools.partial(findings.rank_library, screened.base.space, diagnosis, settings))
        if given.shows_unmodelled_backlash or (not diagnosis.test.rejected and screened.cluster is None):
            return screened, diagnosis, None  # effects of the library would only stand in for a backlash
        progress(progress_remark("effects"))
        screened, diagnosis, searched = keep(
            f"search {k}", functools.partial(_search_effects, given, screened, diagnosis)
        )
        after = searched.diagnosis
        if after is None or not after.test.rejected_with_margin:
            break
        more = outliers.screen_with_effects(screened, after.scores, given.runs, settings)
        if more is None:
            break
        progress(progress_remark("alone"))
        screened = more
    return screened, diagnosis, searched


def _test_base(given: LoopInput, sds: VerdictNoise, screened: Screening) -> tuple[Screening, Diagnosis]:
    """Tests the base fit by bootstrap. If an effect is probably missing, also compiles programs of later stages."""
    known_stages, weight = given.known, screened.base.space.weight
    null = (
        None
        if known_stages is None or np.any(known_stages.screened.base.space.weight != weight)
        else known_stages.left.test.null
    )
    if np.max(np.abs(screened.diagnosed[1].single)) > LIKELY:
        while given.later:
            given.later.pop()(screened.base)
    return screened, outliers.diagnose_base_by_bootstrap(screened, given.settings, sds.noise.freedom, null)


def _search_effects(
    given: LoopInput, screened: Screening, left: Diagnosis
) -> tuple[Screening, Diagnosis, SearchResult]:
    """Searches for effects that explain the residuals of the base fit."""
    space, base = screened.base.space, screened.base.candidate
    return screened, left, search.search_effects(space, base, left, screened.bases, given.settings, given.progress)


def end_without_search(
    given: LoopInput,
    screened: Screening,
    left: Diagnosis,
    sds: VerdictNoise,
    searched: SearchResult | None,
) -> verdict.LoopStages | None:
    """Verdict on a base without a search for effects: nothing is missing, or the model does not describe the runs."""
    if searched is not None:
        return None
    missed = verdict.missed_channels(screened.base.space, given.runs, sds.noise, left.linear)
    # If the rigid model leaves only noise, there is no backlash.
    loose = given.shows_unmodelled_backlash and left.test.rejected
    word = "undescribed" if missed or loose else "none"
    return verdict.LoopStages(word, screened, left, sds, missed=missed, unused=verdict.unused_inputs(given.runs))


def confirm_search(
    given: LoopInput,
    screened: Screening,
    left: Diagnosis,
    sds: VerdictNoise,
    searched: SearchResult,
) -> SearchResult:
    """The search with the set of effects that a simulation confirms, for equations of a log."""
    return searched if given.confirm is None else given.confirm(screened, left, searched, sds.noise)


def curve_of_base(given: LoopInput, screened: Screening, left: Diagnosis) -> BaseCurve:
    """Smooth curve of the base's discrepancy, which is fitted when it is needed."""
    return BaseCurve(screened.base.space, screened.base.candidate, left, screened.bases)


def check_described(
    given: LoopInput,
    sds: VerdictNoise,
    searched: SearchResult,
    chosen: Proposed | None,
    beside: BaseCurve,
    predicted: prediction.Predicted,
    screened: Screening,
) -> tuple[loop_notes.MissedChannel, ...] | verdict.LoopStages:
    """Channels that the refit misses but effects describe. Ends the loop if no set of effects describes the runs."""
    runs, space, left = given.runs, beside.space, beside.left
    missed = verdict.missed_channels(space, runs, sds.noise, left.linear)
    if not missed:
        return ()
    given.progress(progress_remark("held out"))
    refit = prediction.cached_hold_out_score(space, runs, beside.base, predicted)
    sets = (chosen and chosen[0], searched.best, *search.best_of_each_size(searched))
    for fit in {c.key: c for c in sets if c}.values():
        with_effects = prediction.cached_hold_out_score(space, runs, fit, predicted)
        if leaves := verdict.remaining_errors(space, runs, missed, refit, with_effects):
            return leaves
    return verdict.LoopStages(
        "undescribed", screened, left, sds, searched, beside=beside, predicted=predicted, missed=missed,
        unused=verdict.unused_inputs(runs),
    )  # fmt: skip


def trace_mechanism(
    given: LoopInput,
    searched: SearchResult,
    chosen: Proposed | None,
    standing: loop_notes.NameSupport,
    beside: BaseCurve,
    predicted: prediction.Predicted,
) -> loop_notes.Mechanism | None:
    """Equation and driving variable of the discrepancy. None if the name of an effect is established."""
    if chosen is not None and any(map(standing.established, chosen[0].effects)):
        return None
    given.progress(progress_remark("mechanism"))
    ladder = [*searched.ladder, *([] if chosen is None else chosen[:1])]
    return find_mechanism(beside, given.runs, ladder, predicted)


def find_alternatives(
    given: LoopInput, searched: SearchResult, chosen: Proposed | None, beside: BaseCurve
) -> tuple[SearchResult, classes.Classes | None]:
    """The search with the chosen effects, and the alternatives to each of them. None without effects."""
    if chosen is None:
        return searched, None
    best, after = chosen
    given.progress(progress_remark("alike", best.effects))
    alike = classes.find_classes(beside, best, searched.ladder, after)
    return dataclasses.replace(searched, best=best, diagnosis=after), alike


def reach_verdict(
    given: LoopInput,
    searched: SearchResult,
    chosen: Proposed | None,
    alike: classes.Classes | None,
    standing: loop_notes.NameSupport,
    beside: BaseCurve,
    mechanism: loop_notes.Mechanism | None,
) -> tuple[Any, ...]:
    """Verdict: effects, classes of effects, a mechanism, or a place. Hold-out errors may choose leading effects."""
    named = [] if chosen is None else [standing.established(e) for e in chosen[0].effects]
    if chosen is None or alike is None or not any(named):
        level = "place" if mechanism is None or mechanism.fails else "mechanism"
        return (
            level,
            searched,
            alike,
            standing,
            dataclasses.replace(beside.where, by_duty=varied_by_duty(given.runs)),
            (),
        )
    (best, after), held_out = chosen, verdict.LoopStages.held_out
    if given.settings.prefer == HELD_OUT:
        given.progress(progress_remark("held out"))
        leading, after, alike, held_out = preference.prefer_by_held_out(beside, given.runs, best, after, alike)
        searched = dataclasses.replace(searched, best=leading, diagnosis=after)
        standing = standing.with_leaders(dict(zip(best.active, leading.active, strict=True)))
    rejected = after.test.rejected_with_margin
    rest = discrepancy.locate_discrepancy(after, beside.bases, beside.space.included) if rejected else None
    alone = all(one for one, name in zip(alike.alone, named, strict=True) if name)
    return "named" if alone else "class", searched, alike, standing, rest, held_out
