"""Search for effects: one at a time, in addition to the best set, as long as the residuals are significant.

For logs, also the ranking of the effects on the equations in weak form, before any simulation.
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from calibration.data import Names
from calibration.discovery.active_set import CandidateSpace
from calibration.discovery.adequacy import Diagnosis
from calibration.discovery.candidates import (
    Candidate,
    candidate_of_fit,
    fill_slots,
    fit_candidates,
    fit_in_addition,
    start_of_fit,
    with_slots,
)
from calibration.discovery.projection import ABSORBED
from calibration.discovery.score_tests import ScoreTable, diagnose_fit
from calibration.inference.bases import Bases
from calibration.inference.fit_notes import Remark, progress_remark
from calibration.inference.linearization import Linearization
from calibration.inference.optimizers import Optimum
from calibration.inference.weak_form import fit_weak_form

#: Largest number of pairs of instances that are examined for pairs of effects.
PAIRS = 4000


@dataclasses.dataclass(frozen=True)
class SearchResult:
    """Result of a search for effects.

    Attributes:
        ladder: all candidates that were fitted.
        best: proposed candidate. None if no candidate is plausible.
        diagnosis: diagnosis of the proposed candidate.
        room: effects in the program of a log's simulations.
    """

    ladder: tuple[Candidate, ...]
    best: Candidate | None
    diagnosis: Diagnosis | None
    room: Names = ()


def diagnose_candidate(
    space: CandidateSpace, fitted: Candidate, bases: Bases, known: Diagnosis, near: Linearization | None = None
) -> Diagnosis:
    """Linearises a candidate's fit and tests its residuals.

    Args:
        known: diagnosis of another fit, with the same test.
        near: as in `diagnose_fit`.
    """
    z = jnp.asarray(fitted.z)
    diagnosis = diagnose_fit(space.problem(fitted.active), z, space.library.scored, bases, near)
    linear, scores, statistics = jax.device_get(diagnosis)
    return Diagnosis(linear, scores, known.test.of(statistics))


def search_effects(
    space: CandidateSpace,
    base: Candidate,
    base_diagnosis: Diagnosis,
    bases: Bases,
    progress: Callable[[Remark], None],
) -> SearchResult:
    """Smallest set of effects that explains the discrepancy of the base to within the margin of the test.

    Args:
        base: fit without effects.
        base_diagnosis: diagnosis of that fit.
    """
    names = _names_by_score(space, base_diagnosis.scores)[: space.bare.observe.policy.batch]
    ladder = fit_in_addition(
        space, [(fill_slots([name], space.settings), base, base_diagnosis.scores) for name in names]
    )
    null = np.asarray(base_diagnosis.test.null.single)
    best, diagnosis, diagnosed = _best_plausible(ladder), None, None
    if best is not None and single_p_value(2 * (base.cost - best.cost), null) > space.settings.family_wise_error:
        best = None
    while best is not None:
        diagnosed = best
        diagnosis = diagnose_candidate(space, best, bases, base_diagnosis)
        if not diagnosis.test.rejected_with_margin or len(best.effects) == int(
            min(space.settings.slots, max(1, space.included.sum() // space.settings.rows_per_effect))
        ):
            break
        progress(progress_remark("more effects", best.effects))
        extensions = _extend_set(space, best, diagnosis, base, base_diagnosis)
        # It has to explain clearly more than every candidate with one effect fewer.
        fewer_costs = [c.cost for c in ladder if c.plausible and len(c.effects) == len(best.effects)]
        best = _best_plausible(extensions)
        if best is not None and not 2 * (min(fewer_costs, default=np.inf) - best.cost) >= space.settings.needed**2:
            best = None
        ladder += extensions
        if best is not None:
            fewer = refit_without_each(space, best)
            ladder += fewer
            gains = [2 * (c.cost - best.cost) for c in fewer]
            if any(single_p_value(gain, null) > space.settings.family_wise_error for gain in gains):
                best = None
    return SearchResult(tuple(ladder), diagnosed, diagnosis)


def best_of_each_size(searched: SearchResult) -> list[Candidate]:
    """Best plausible candidate with each number of effects, up to the size of the proposal."""
    if searched.best is None:
        return []
    sizes = range(1, len(searched.best.effects))
    smaller = [_best_plausible([c for c in searched.ladder if len(c.effects) == size]) for size in sizes]
    return [*(c for c in smaller if c is not None), searched.best]


def single_p_value(gain: float, null: np.ndarray) -> float:
    """p-value of a single effect: share of bootstrap tables in which the strongest effect explains as much.

    At least 1 / (replicates + 1).

    Args:
        gain: decrease of χ² by the effect [σ²].
        null: square root of the strongest score of each bootstrap table [σ].
    """
    return (1 + int(np.sum(null**2 >= gain))) / (1 + len(null))


def refit_without_each(space: CandidateSpace, best: Candidate, ladder: Sequence[Candidate] = ()) -> list[Candidate]:
    """Refits a candidate without each of its effects in turn. The remaining effects are in the first slots.

    Args:
        ladder: fits that are already known.
    """
    fewer = [fill_slots([n for n in best.effects if n != name], space.settings) for name in best.effects]
    fits = {c.active: c for c in ladder}
    unfitted = [(active, start_of_fit(space, best, active)) for active in fewer if active not in fits]
    fits |= {c.active: c for c in fit_candidates(space, unfitted)}
    return [fits[active] for active in fewer]


def _names_by_score(space: CandidateSpace, scores: ScoreTable, last: Sequence[str] = ()) -> list[str]:
    """Names of effects by their best |score|, strongest first. Effects in `last` come last."""
    strength = space.library.largest(np.abs(scores.single))
    strength[np.isin(space.library.names, last)] = 0.0
    return [space.library.names[k] for k in np.argsort(-strength)]


def _extend_set(
    space: CandidateSpace,
    best: Candidate,
    best_diagnosis: Diagnosis,
    base: Candidate,
    base_diagnosis: Diagnosis,
) -> list[Candidate]:
    """Fits the best set with one more effect and, if the best is the base, also pairs of effects."""
    batch = space.bare.observe.policy.batch
    names = _names_by_score(space, best_diagnosis.scores, best.effects)[:batch]
    sources = {fill_slots([*best.effects, name], space.settings): (best, best_diagnosis) for name in names}
    if len(best.effects) == 1:
        pair_scores = np.triu(base_diagnosis.scores.pair)
        strongest = np.unravel_index(np.argsort(-pair_scores, axis=None)[:PAIRS], pair_scores.shape)
        pairs = dict.fromkeys(tuple(sorted(pair)) for pair in space.library.of[np.stack(strongest, 1)].tolist())
        for i, j in itertools.islice((pair for pair in pairs if pair[0] != pair[1]), batch):
            pair = space.library.names[i], space.library.names[j]
            if not {fill_slots(pair, space.settings), fill_slots(pair[::-1], space.settings)} & sources.keys():
                sources[fill_slots(pair, space.settings)] = base, base_diagnosis
    extensions = [(active, fit, ranking.scores) for active, (fit, ranking) in sources.items()]
    return fit_in_addition(space, extensions)


def _best_plausible(candidates: Sequence[Candidate]) -> Candidate | None:
    sound = [c for c in candidates if c.plausible and np.isfinite(c.cost)]
    return min(sound, key=lambda c: c.cost) if sound else None


#: A candidate and its diagnosis.
Proposed = tuple[Candidate, Diagnosis]


@dataclasses.dataclass(frozen=True)
class WeakFormScreening:
    """Results from a log's equations in weak form, before any simulation.

    Attributes:
        base: fit without effects, by regression.
        slides: True if the load may slide on its ground: the equations do not show sliding, so a search must not
            start there.
        scores: score of every instance.
        windows: number of equations.
        null: square root of the strongest score of bootstrap tables without a missing effect [σ], shape
            (replicates,).
    """

    base: Candidate
    slides: bool
    scores: ScoreTable
    windows: int
    null: np.ndarray


def screen_by_weak_form(space: CandidateSpace) -> WeakFormScreening | None:
    """Fits base parameters and effects by regression on a log's equations in weak form. None if the log does not show
    its states (`fit_weak_form`).

    A signature is the derivative of an equation by an amplitude. It ranks every effect in milliseconds, as the
    inverse dynamic identification model of Gautier and Khalil (1990) does with torques. The regression also gives the
    start of the fit of the base.
    """
    problem = space.bare
    equations = fit_weak_form(problem, space.library.scored) if problem.observe.long else None
    if equations is None:
        return None
    q = np.linalg.qr(equations.jacobian)[0]
    columns = np.concatenate([equations.signatures, np.zeros((space.free, equations.signatures.shape[1]))])
    projected = columns - q @ (q.T @ columns)
    norm = np.linalg.norm(projected, axis=0)
    is_visible = norm > ABSORBED * np.maximum(np.linalg.norm(columns, axis=0), 1e-300)
    directions = np.where(is_visible, projected / np.where(is_visible, norm, 1.0), 0.0)
    single = -directions.T @ equations.residual
    empty = np.zeros(0)
    amplitude = np.where(is_visible, single / np.where(is_visible, norm, 1.0), 0.0)
    columns_of_table: tuple[Any, ...] = (single, amplitude, norm, empty, directions.T @ directions, *[empty] * 4)
    scores = ScoreTable(*columns_of_table)
    random = np.random.default_rng(space.settings.seed)
    null = np.max(np.abs(random.standard_normal((space.settings.replicates, len(directions))) @ directions), 1)
    sd = np.sqrt(np.diag(np.linalg.inv(equations.jacobian.T @ equations.jacobian)))
    cost = np.asarray(0.5 * np.sum(equations.residual**2))
    fields: tuple[Any, ...] = (equations.z, sd, np.zeros((0, 0)), cost, np.zeros(()), np.asarray(True), np.asarray(0))
    optimum = with_slots(Optimum(*fields), space)
    base = dataclasses.replace(candidate_of_fit(space, fill_slots((), space.settings), optimum), simulated=False)
    slides = problem.base.has_ground and problem.base.rig.imposed == "voltage"
    return WeakFormScreening(base, slides, scores, len(equations.signatures), null)
