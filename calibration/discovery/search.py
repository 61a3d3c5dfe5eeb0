"""Search for effects: single ones, then further ones in addition to the best, while the fit is rejected."""

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
from calibration.discovery.score_tests import ScoreTable, Statistics, diagnose_fit
from calibration.discovery.screening import Confirmed, confirm_by_simulation, fit_by_regression
from calibration.discovery.settings import Settings
from calibration.inference.bases import Bases
from calibration.inference.fit_notes import Remark, next_step

#: Largest number of pairs of instances that are examined for pairs of effects.
PAIRS = 4000


@dataclasses.dataclass(frozen=True)
class Search:
    """Outcome of the search.

    Attributes:
        ladder: every candidate that was fitted.
        best: the proposed one, None without a plausible one.
        diagnosis: diagnosis of its residuals.
        asked, otherwise: number of simulated sets that were screened by regression, and of unconfirmed ones
            among them, see `screening.Confirmed`.
        room: effects in the program of these fits.
    """

    ladder: tuple[Candidate, ...]
    best: Candidate | None
    diagnosis: Diagnosis | None
    asked: int = 0
    otherwise: int = 0
    room: Names = ()


def diagnose_candidate(
    space: CandidateSpace, fitted: Candidate, bases: Bases, null: Statistics, settings: Settings
) -> Diagnosis:
    """Diagnosis of a fit."""
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
) -> Search:
    """Smallest set of effects that explains the discrepancy of the base to within the test's margin.

    Args:
        base: the fit without effects.
        left: its diagnosis.
    """
    names = _rank_by_score(space, left.scores)
    if not space.bare.observe.long:
        names = names[: _batch(space)]
    at, by = _linearised_fit(space, base, left, bases, settings)
    rounds = [_fit_sets(space, [(fill_slots([name], settings), at, by) for name in names], settings)]
    space = space.with_room(rounds[0].room)
    ladder = list(rounds[0].candidates)
    null = np.asarray(left.test.null.single)
    best, diagnosis, diagnosed = _best(ladder), None, None
    if best is not None and single_p_value(2 * (base.cost - best.cost), null) > settings.family_wise_error:
        best = None
    while best is not None:
        diagnosed = best
        diagnosis = diagnose_candidate(space, best, bases, left.test.null, settings)
        if not diagnosis.test.rejected_with_margin or len(best.effects) == int(
            min(settings.slots, max(1, space.included.sum() // settings.rows_per_effect))
        ):
            break
        progress(next_step("more effects", best.effects))
        rounds.append(_extend_set(space, best, diagnosis, at, by, settings))
        more, space = list(rounds[-1].candidates), space.with_room(rounds[-1].room)
        best = _accepted(_best(more), ladder, settings)
        ladder += more
        if best is not None:
            fewer = without_each(space, best, settings)
            ladder += fewer
            gains = [2 * (c.cost - best.cost) for c in fewer]
            if any(single_p_value(gain, null) > settings.family_wise_error for gain in gains):
                best = None
    simulated_count, otherwise = (sum(getattr(r, name) for r in rounds) for name in ("asked", "otherwise"))
    return Search(tuple(ladder), diagnosed, diagnosis, simulated_count, otherwise, space.room)


def _linearised_fit(
    space: CandidateSpace, base: Candidate, left: Diagnosis, bases: Bases, settings: Settings
) -> tuple[Candidate, Diagnosis]:
    """Fit whose linearised equations rank the effects, and its diagnosis.

    The base, unless it ends `UNLIKELY` far from its prior: the signatures there are no guide. Then the set that the
    log's equations rank first, simulated from their coordinates.
    """
    if not space.begins or np.abs(base.z[: space.free]).max() <= UNLIKELY:
        return base, left
    (fitted,) = fit_candidates(space, list(space.begins.items()), settings)
    if not 2 * (base.cost - fitted.cost) > settings.same:
        return base, left
    return fitted, diagnose_candidate(space, fitted, bases, left.test.null, settings)


def best_of_each_size(found: Search) -> list[Candidate]:
    """Best plausible candidate of each number of effects, up to the number in the search's proposal."""
    if found.best is None:
        return []
    sizes = range(1, len(found.best.effects))
    smaller = [_best([c for c in found.ladder if len(c.effects) == size]) for size in sizes]
    return [*(c for c in smaller if c is not None), found.best]


def single_p_value(gain: float, null: np.ndarray) -> float:
    """Share of bootstrap tables in which the strongest single effect explains as much [σ²], never below
    1 / (replicates + 1).

    Args:
        null: root of its score in each table [σ].
    """
    return (1 + int(np.sum(null**2 >= gain))) / (1 + len(null))


def without_each(
    space: CandidateSpace, best: Candidate, settings: Settings, ladder: Sequence[Candidate] = ()
) -> list[Candidate]:
    """The candidate without each of its effects in turn, refitted. Those that remain take the first slots.

    Args:
        ladder: known fits, which are not repeated.
    """
    fewer = [fill_slots([n for n in best.effects if n != name], settings) for name in best.effects]
    simulated = {c.active: c for c in ladder if c.simulated}
    new = fit_candidates(
        space, [(w, start_of_fit(space, best, w, settings)) for w in fewer if w not in simulated], settings
    )
    simulated |= {c.active: c for c in new}
    return [simulated[w] for w in fewer]


def _rank_by_score(space: CandidateSpace, scores: ScoreTable, without: Sequence[str] = ()) -> list[str]:
    """Effects by their best |score|, the strongest first. Those in `without` come last."""
    strength = space.library.largest(np.abs(np.asarray(scores.single)))
    strength[list(space.library.indices(without))] = 0.0
    return [space.library.names[k] for k in np.argsort(-strength)]


def _fit_sets(
    space: CandidateSpace, wanted: Sequence[tuple[Names, Candidate, Diagnosis]], settings: Settings
) -> Confirmed:
    """Sets of effects, each in addition to another fit and its diagnosis. For long runs first screened by
    regression."""
    if not space.bare.observe.long:
        return Confirmed(tuple(fit_in_addition(space, [(w, at, by.scores) for w, at, by in wanted], settings)))
    return confirm_by_simulation(space, fit_by_regression(space, wanted, settings), settings)


def _batch(space: CandidateSpace) -> int:
    return space.bare.observe.policy.batch


def _extend_set(
    space: CandidateSpace,
    best: Candidate,
    left_by_best: Diagnosis,
    at: Candidate,
    left: Diagnosis,
    settings: Settings,
) -> Confirmed:
    """Sets with one more effect than the best, and pairs for another fit if that is the base."""
    names = _rank_by_score(space, left_by_best.scores, best.effects)[: _batch(space)]
    sources = {fill_slots([*best.effects, name], settings): (best, left_by_best) for name in names}
    if len(best.effects) == 1 and not at.effects:
        for pair in _pair_batch(space, left.scores):
            one, swapped = fill_slots(pair, settings), fill_slots(pair[::-1], settings)
            if one not in sources and swapped not in sources:
                sources[one] = (at, left)
    return _fit_sets(space, [(w, at, by) for w, (at, by) in sources.items()], settings)


def _pair_batch(space: CandidateSpace, scores: ScoreTable) -> list[tuple[str, str]]:
    """One batch of pairs of effects by their joint score, the strongest first."""
    effect, names = space.library.of, space.library.names
    pair = np.triu(np.asarray(scores.pair))
    pairs: list[tuple[str, str]] = []
    for flat in np.argsort(-pair, axis=None)[:PAIRS]:
        i, j = sorted((int(effect[flat // len(effect)]), int(effect[flat % len(effect)])))
        if i != j and (names[i], names[j]) not in pairs:
            pairs.append((names[i], names[j]))
        if len(pairs) == _batch(space):
            break
    return pairs


def _best(candidates: Sequence[Candidate]) -> Candidate | None:
    sound = [c for c in candidates if c.plausible and c.simulated and np.isfinite(c.cost)]
    return min(sound, key=lambda c: c.cost) if sound else None


def _accepted(c: Candidate | None, ladder: Sequence[Candidate], settings: Settings) -> Candidate | None:
    """The candidate, if it explains clearly more than any candidate with one effect fewer."""
    if c is None:
        return None
    fewer = [x.cost for x in ladder if len(x.effects) == len(c.effects) - 1 and x.plausible]
    return c if 2 * (min(fewer, default=np.inf) - c.cost) >= settings.needed**2 else None
