"""Stages of the loop: from the fit of the base to the verdict, see `discover.STAGES`."""

from __future__ import annotations

import dataclasses
import functools
import itertools

import numpy as np

from calibration.discovery import (
    adequacy,
    candidates,
    classes,
    discrepancy,
    findings,
    outliers,
    prediction,
    score_tests,
    search,
    verdict,
)
from calibration.discovery.discrepancy import BaseCurve
from calibration.discovery.location import varied_by_duty
from calibration.discovery.loop_input import LoopInput
from calibration.discovery.loop_notes import NameSupport
from calibration.discovery.mechanism import find_mechanism
from calibration.discovery.search import Proposed, SearchResult
from calibration.discovery.standing import judge_names
from calibration.discovery.verdict import LoopStages, VerdictNoise
from calibration.inference import blocks as blocks_room
from calibration.inference.fit_notes import progress_remark
from calibration.inference.lack_of_fit import common_factors, noise_remarks
from calibration.inference.noise import Noise

#: Number of times that rows are screened for isolated outliers, with the effects found.
SCREENINGS = 4
#: Largest root of a score above which programs of later stages are compiled before the bootstrap decides [σ].
LIKELY = 4.0


def fit_base_and_noise(
    given: LoopInput, begin: candidates.Candidate | None
) -> tuple[outliers.Screening, VerdictNoise]:
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
) -> outliers.Screening:
    """Fits the base with this noise and excludes outliers. `before` is an earlier fit with other noise.

    For logs, the equations in weak form give the start of the fit, and rank the library unless effects would only
    stand in for a backlash.
    """
    settings, near = given.settings, None if before is None else before.candidate
    space = given.equations
    if space is None:
        space = (given if noise is given.noise else dataclasses.replace(given, noise=noise)).space
    elif noise is not given.noise:
        space = space.with_noise(noise.sd, space.weight)
    if before is None:
        if begin is not None:  # as near as a simulated fit, and its effects are ranked
            near = dataclasses.replace(begin, simulated=True)
        elif (ranking := search.screen_by_weak_form(space)) is not None:
            make = functools.partial(findings.rank_effects_by_weak_form, space, ranking)
            if not given.shows_unmodelled_backlash:
                given.ranked.append(given.keep("ranking", make))
            near = None if ranking.slides else ranking.base
        if given.others is not None:
            given.later.append(given.others.enter_context(outliers.compile_ahead(space, given.runs)))
    if given.equations is None or not space.bare.observe.reads:  # linear readings have a fit
        given.progress(progress_remark("base"))
    return outliers.screen_outliers(candidates.fit_base(space, given.runs.source, near), given.runs, settings)


def search_until_clean(
    given: LoopInput, screened: outliers.Screening, sds: VerdictNoise
) -> tuple[outliers.Screening, adequacy.Diagnosis, SearchResult | None]:
    """Searches for effects, again whenever new outliers appear. No search if the base fits, or if the log shows
    backlash that the robot lacks.
    """
    settings, keep, progress = given.settings, given.keep, given.progress

    def test_base(screened: outliers.Screening) -> tuple[outliers.Screening, adequacy.Diagnosis]:
        """Tests the base fit by bootstrap. If an effect is probably missing, also compiles later programs."""
        space, known_stages = screened.base.space, given.known
        linear, scores, statistics = screened.diagnosed
        if np.max(np.abs(scores.single)) > LIKELY:
            while given.later:
                given.later.pop()(screened.base)
        if known_stages is not None and np.all(known_stages.screened.base.space.weight == space.weight):
            null = known_stages.left.test.null
        else:
            null = score_tests.bootstrap_statistics(
                space.bare, screened.base.candidate.z[: space.free], linear, space.library.scored, screened.bases,
                settings.replicates, settings.seed, sds.noise.freedom,
            )  # fmt: skip
        return screened, adequacy.Diagnosis(linear, scores, adequacy.AdequacyTest(statistics, null, settings))

    def search_effects(
        screened: outliers.Screening, left: adequacy.Diagnosis
    ) -> tuple[outliers.Screening, adequacy.Diagnosis, SearchResult]:
        space, base = screened.base.space, screened.base.candidate
        return screened, left, search.search_effects(space, base, left, screened.bases, progress)

    for k in range(SCREENINGS):
        progress(progress_remark("bootstrap", settings.replicates))
        screened, diagnosis = keep(f"bootstrap {k}", functools.partial(test_base, screened))
        if k == 0 and not given.ranked and not given.shows_unmodelled_backlash:
            keep("ranking", functools.partial(findings.rank_library, screened.base.space, diagnosis))
        if given.shows_unmodelled_backlash or (not diagnosis.test.rejected and screened.cluster is None):
            return screened, diagnosis, None  # effects of the library would only stand in for a backlash
        progress(progress_remark("effects"))
        screened, diagnosis, searched = keep(f"search {k}", functools.partial(search_effects, screened, diagnosis))
        after = searched.diagnosis
        if after is None or not after.test.rejected_with_margin or k + 1 == SCREENINGS:
            break
        more = outliers.screen_with_effects(screened, after.scores, given.runs, settings)
        if more is None:
            break
        progress(progress_remark("alone"))
        screened = more
    return screened, diagnosis, searched


def reach_verdict(
    given: LoopInput,
    screened: outliers.Screening,
    left: adequacy.Diagnosis,
    sds: VerdictNoise,
    searched: SearchResult | None,
) -> LoopStages:
    """Verdict on the base: effects, classes of effects, a mechanism or a place. Without a search, nothing is missing,
    or the model does not describe the runs.
    """
    runs, space, predicted = given.runs, screened.base.space, prediction.Predicted()
    missed = verdict.missed_channels(space, runs, sds.noise, left.linear)
    if searched is None:
        # If the rigid model leaves only noise, there is no backlash.
        loose = given.shows_unmodelled_backlash and left.test.rejected
        word = "undescribed" if missed or loose else "none"
        return LoopStages(word, screened, left, sds, missed=missed, unused=verdict.unused_inputs(runs))
    if given.confirm is not None:  # equations of a log: the set of effects that a simulation confirms
        searched = given.confirm(screened, left, searched, sds.noise)
    beside = BaseCurve(space, screened.base.candidate, left, screened.bases)
    chosen, searched, standing = choose_effects(given, searched, beside, predicted)
    if missed:
        given.progress(progress_remark("held out"))
        refit = prediction.cached_hold_out_score(space, runs, beside.base, predicted)
        sets = (chosen and chosen[0], searched.best, *search.best_of_each_size(searched))
        with_effects = (
            prediction.cached_hold_out_score(space, runs, fit, predicted)
            for fit in {c.key: c for c in sets if c}.values()
        )
        remaining = (verdict.remaining_errors(space, runs, missed, refit, score) for score in with_effects)
        described = next(filter(None, remaining), None)
        if described is None:
            return LoopStages(
                "undescribed", screened, left, sds, searched, beside=beside, predicted=predicted, missed=missed,
                unused=verdict.unused_inputs(runs),
            )  # fmt: skip
        missed = described
    traced = LoopStages(
        "", screened, left, sds, searched, standing=standing, beside=beside, predicted=predicted, missed=missed
    )
    named = [] if chosen is None else [standing.established(e) for e in chosen[0].effects]
    if not any(named):
        given.progress(progress_remark("mechanism"))
        ladder = [*searched.ladder, *([] if chosen is None else chosen[:1])]
        mechanism = find_mechanism(beside, runs, ladder, predicted)
        level = "place" if mechanism is None or mechanism.fails else "mechanism"
        where = dataclasses.replace(beside.where, by_duty=varied_by_duty(runs))
        traced = dataclasses.replace(traced, verdict=level, mechanism=mechanism, where=where)
    if chosen is None:
        return traced
    best, after = chosen
    given.progress(progress_remark("alike", best.effects))
    alike = classes.find_classes(beside, best, searched.ladder, after)
    searched = dataclasses.replace(searched, best=best, diagnosis=after)
    traced = dataclasses.replace(traced, searched=searched, alike=alike)
    if not any(named):
        return traced
    rejected, is_alone = after.test.rejected_with_margin, all(itertools.compress(alike.alone, named))
    rest = discrepancy.locate_discrepancy(after, beside.bases, space.included) if rejected else None
    return dataclasses.replace(traced, verdict="named" if is_alone else "class", where=rest)


def choose_effects(
    given: LoopInput, searched: SearchResult, beside: BaseCurve, predicted: prediction.Predicted
) -> tuple[Proposed | None, SearchResult, NameSupport]:
    """Effects to add to the model (None for no effects), the updated search, and the tests of their names.

    The effects are those whose names are established, and those of the smallest set that predicts as well as any.
    Effects that only imitate a curve are left out. If the largest set leaves no discrepancy, its effects are tested,
    otherwise those of the predictive set.

    Args:
        beside: the base fit, its diagnosis and the smooth curve of its discrepancy.
        predicted: cache of hold-out predictions of fits. This function adds to it.
    """
    space, base, settings = beside.space, beside.base, given.settings
    best, after = searched.best, searched.diagnosis
    if best is None or after is None:
        return None, searched, judge_names(beside, searched)
    adequate = not after.test.rejected_with_margin
    blocks = prediction.masks_of_blocks(blocks_room.predictable_blocks(given.runs, space.bare))
    stood = judge_names(beside, searched, blocks=blocks) if adequate else None
    if stood is not None and all(map(stood.established, best.effects)):
        return (best, after), searched, stood

    def diagnosed(fit: candidates.Candidate) -> Proposed:
        return fit, after if fit is best else search.diagnose_candidate(space, fit, beside.bases, beside.left)

    given.progress(progress_remark("held out"))
    path = search.best_of_each_size(searched)
    few = prediction.smallest_predictive_set(space, given.runs, base, path, predicted)
    proposed = best, after
    if stood is None:
        proposed = diagnosed(best if few is None else few)
        stood = judge_names(beside, searched, proposed, blocks)
    names = [e for e in proposed[0].effects if stood.established(e)]
    predictive = () if few is None else few.effects
    added_effects = [e for e in predictive if e not in names and not stood.imitates_curve(e)]
    names += added_effects[: settings.slots - len(names)]
    if not names:
        return None, searched, stood
    fit = next((c for c in (proposed[0], best, *searched.ladder) if c.key == frozenset(names)), None)
    if fit is None:
        active = candidates.fill_slots(names, settings)
        begins = candidates.start_of_fit(space, proposed[0], active, beside.left.scores)
        (fit,) = candidates.fit_candidates(space, [(active, begins)])
        searched = dataclasses.replace(searched, ladder=(*searched.ladder, fit))
    return proposed if fit is proposed[0] else diagnosed(fit), searched, stood
