"""Search for effects: one at a time, in addition to the best set, as long as the residuals are significant."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence

import jax
import jax.numpy as jnp
import numpy as np

from calibration.data import Names
from calibration.discovery.active_set import CandidateSpace
from calibration.discovery.adequacy import AdequacyTest, Diagnosis
from calibration.discovery.candidates import (
    UNLIKELY,
    Candidate,
    fill_slots,
    fit_candidates,
    fit_in_addition,
    start_of_fit,
)
from calibration.discovery.score_tests import ScoreTable, StrongestStatistics, diagnose_fit
from calibration.discovery.screening import ScreenedSets, confirm_by_simulation, fit_by_regression
from calibration.discovery.settings import Settings
from calibration.inference.bases import Bases
from calibration.inference.fit_notes import Remark, progress_remark

#: Largest number of pairs of instances that are examined for pairs of effects.
PAIRS = 4000


@dataclasses.dataclass(frozen=True)
class SearchResult:
    """Result of a search for effects.

    Attributes:
        ladder: all candidates that were fitted.
        best: proposed candidate. None if no candidate is plausible.
        diagnosis: diagnosis of the proposed candidate.
        asked, otherwise: number of simulated sets, and of those that simulation did not confirm, see
            `screening.ScreenedSets`.
        room: effects in the program of these fits.
    """

    ladder: tuple[Candidate, ...]
    best: Candidate | None
    diagnosis: Diagnosis | None
    asked: int = 0
    otherwise: int = 0
    room: Names = ()


def diagnose_candidate(
    space: CandidateSpace, fitted: Candidate, bases: Bases, null: StrongestStatistics, settings: Settings
) -> Diagnosis:
    """Linearises a candidate's fit and tests its residuals."""
    z = jnp.asarray(fitted.z)
    diagnosis = diagnose_fit(space.problem(fitted.active), z, space.library.scored, bases)
    linear, scores, statistics = jax.device_get(diagnosis)
    return Diagnosis(linear, scores, AdequacyTest(statistics, null, settings))


def search_effects(
    space: CandidateSpace,
    base: Candidate,
    left: Diagnosis,
    bases: Bases,
    settings: Settings,
    progress: Callable[[Remark], None],
) -> SearchResult:
    """Smallest set of effects that explains the discrepancy of the base to within the margin of the test.

    Args:
        base: fit without effects.
        left: diagnosis of that fit.
    """
    names = _names_by_score(space, left.scores)
    if not space.bare.observe.long:
        names = names[: _batch_size(space)]
    at, rankings = _fit_to_rank_at(space, base, left, bases, settings)
    rounds = [_fit_sets(space, [(fill_slots([name], settings), at, rankings) for name in names], settings)]
    space = space.with_room(rounds[0].room)
    ladder = list(rounds[0].candidates)
    null = np.asarray(left.test.null.single)
    best, diagnosis, diagnosed = _best_plausible(ladder), None, None
    if best is not None and single_p_value(2 * (base.cost - best.cost), null) > settings.family_wise_error:
        best = None
    while best is not None:
        diagnosed = best
        diagnosis = diagnose_candidate(space, best, bases, left.test.null, settings)
        if not diagnosis.test.rejected_with_margin or len(best.effects) == int(
            min(settings.slots, max(1, space.included.sum() // settings.rows_per_effect))
        ):
            break
        progress(progress_remark("more effects", best.effects))
        rounds.append(_extend_set(space, best, diagnosis, at, rankings, settings))
        more, space = list(rounds[-1].candidates), space.with_room(rounds[-1].room)
        best = _accept_if_better(_best_plausible(more), ladder, settings)
        ladder += more
        if best is not None:
            fewer = refit_without_each(space, best, settings)
            ladder += fewer
            gains = [2 * (c.cost - best.cost) for c in fewer]
            if any(single_p_value(gain, null) > settings.family_wise_error for gain in gains):
                best = None
    simulated_count, otherwise = (sum(getattr(r, name) for r in rounds) for name in ("asked", "otherwise"))
    return SearchResult(tuple(ladder), diagnosed, diagnosis, simulated_count, otherwise, space.room)


def _fit_to_rank_at(
    space: CandidateSpace, base: Candidate, left: Diagnosis, bases: Bases, settings: Settings
) -> tuple[Candidate, Diagnosis]:
    """Fit that ranks the effects, and its diagnosis.

    It is the base fit, unless that is `UNLIKELY` far from its prior and its sensitivities mislead. Then it is the set
    that the log's equations rank first, simulated from the coordinates of the equations.
    """
    if not space.begins or np.abs(base.z[: space.free]).max() <= UNLIKELY:
        return base, left
    (fitted,) = fit_candidates(space, list(space.begins.items()), settings)
    if not 2 * (base.cost - fitted.cost) > settings.same:
        return base, left
    return fitted, diagnose_candidate(space, fitted, bases, left.test.null, settings)


def best_of_each_size(found: SearchResult) -> list[Candidate]:
    """Best plausible candidate with each number of effects, up to that of the proposal."""
    if found.best is None:
        return []
    sizes = range(1, len(found.best.effects))
    smaller = [_best_plausible([c for c in found.ladder if len(c.effects) == size]) for size in sizes]
    return [*(c for c in smaller if c is not None), found.best]


def single_p_value(gain: float, null: np.ndarray) -> float:
    """p-value of a single effect: share of bootstrap tables in which the strongest effect explains as much.

    At least 1 / (replicates + 1).

    Args:
        gain: decrease of χ² by the effect [σ²].
        null: square root of the strongest score of each bootstrap table [σ].
    """
    return (1 + int(np.sum(null**2 >= gain))) / (1 + len(null))


def refit_without_each(
    space: CandidateSpace, best: Candidate, settings: Settings, ladder: Sequence[Candidate] = ()
) -> list[Candidate]:
    """Refits a candidate without each of its effects in turn. The remaining effects are in the first slots.

    Args:
        ladder: fits that are already known.
    """
    fewer = [fill_slots([n for n in best.effects if n != name], settings) for name in best.effects]
    simulated = {c.active: c for c in ladder if c.simulated}
    new = fit_candidates(
        space, [(w, start_of_fit(space, best, w, settings)) for w in fewer if w not in simulated], settings
    )
    simulated |= {c.active: c for c in new}
    return [simulated[w] for w in fewer]


def _names_by_score(space: CandidateSpace, scores: ScoreTable, last: Sequence[str] = ()) -> list[str]:
    """Names of effects by their best |score|, strongest first. Effects in `last` come last."""
    strength = space.library.largest(np.abs(np.asarray(scores.single)))
    strength[list(space.library.indices(last))] = 0.0
    return [space.library.names[k] for k in np.argsort(-strength)]


def _fit_sets(
    space: CandidateSpace, wanted: Sequence[tuple[Names, Candidate, Diagnosis]], settings: Settings
) -> ScreenedSets:
    """Fits sets of effects, each in addition to another fit. For long runs they are first screened by regression."""
    if not space.bare.observe.long:
        return ScreenedSets(
            tuple(
                fit_in_addition(space, [(w, base_fit, ranking.scores) for w, base_fit, ranking in wanted], settings)
            )
        )
    return confirm_by_simulation(space, fit_by_regression(space, wanted, settings), settings)


def _batch_size(space: CandidateSpace) -> int:
    return space.bare.observe.policy.batch


def _extend_set(
    space: CandidateSpace,
    best: Candidate,
    left_by_best: Diagnosis,
    at: Candidate,
    left: Diagnosis,
    settings: Settings,
) -> ScreenedSets:
    """Fits the best set with one more effect and, if the best is the base, also pairs of effects."""
    names = _names_by_score(space, left_by_best.scores, best.effects)[: _batch_size(space)]
    sources = {fill_slots([*best.effects, name], settings): (best, left_by_best) for name in names}
    if len(best.effects) == 1 and not at.effects:
        for pair in _best_pairs(space, left.scores):
            pair_set, swapped = fill_slots(pair, settings), fill_slots(pair[::-1], settings)
            if pair_set not in sources and swapped not in sources:
                sources[pair_set] = (at, left)
    return _fit_sets(space, [(w, at, ranking) for w, (at, ranking) in sources.items()], settings)


def _best_pairs(space: CandidateSpace, scores: ScoreTable) -> list[tuple[str, str]]:
    """As many pairs of effects as fit in one batch, by their joint score, strongest first."""
    effect, names = space.library.of, space.library.names
    pair = np.triu(np.asarray(scores.pair))
    pairs: list[tuple[str, str]] = []
    for flat in np.argsort(-pair, axis=None)[:PAIRS]:
        i, j = sorted((int(effect[flat // len(effect)]), int(effect[flat % len(effect)])))
        if i != j and (names[i], names[j]) not in pairs:
            pairs.append((names[i], names[j]))
        if len(pairs) == _batch_size(space):
            break
    return pairs


def _best_plausible(candidates: Sequence[Candidate]) -> Candidate | None:
    sound = [c for c in candidates if c.plausible and c.simulated and np.isfinite(c.cost)]
    return min(sound, key=lambda c: c.cost) if sound else None


def _accept_if_better(c: Candidate | None, ladder: Sequence[Candidate], settings: Settings) -> Candidate | None:
    """The candidate, if it explains clearly more than every candidate with one effect fewer. Otherwise None."""
    if c is None:
        return None
    fewer = [x.cost for x in ladder if len(x.effects) == len(c.effects) - 1 and x.plausible]
    return c if 2 * (min(fewer, default=np.inf) - c.cost) >= settings.needed**2 else None
