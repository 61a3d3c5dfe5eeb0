"""Screening for long runs: sets of effects are fitted to linearised equations before any of them is simulated.

A signature is the derivative of the readings by an amplitude. With the signatures at one fit, a fit of any set of
effects is a least-squares problem of a few unknowns. (Gautier and Khalil 1990 do so with torques, their inverse
dynamic identification model.) It ranks every effect in milliseconds. Simulation then confirms the first of them,
because a signature does not show the nonlinearity of a run. The equations of a log in weak form rank every effect
before the first simulation, and give the start of the base fit (`screen_by_weak_form`).
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np

from calibration.data import Names
from calibration.discovery.active_set import CandidateSpace
from calibration.discovery.adequacy import Diagnosis
from calibration.discovery.candidates import Candidate, candidate_of_fit, empty_slots, fill_slots, fit_candidates
from calibration.discovery.score_tests import ABSORBED, ScoreTable
from calibration.discovery.settings import Settings
from calibration.inference.linearization import Linearization
from calibration.inference.optimizers import Optimum
from calibration.inference.weak_form import WeakFormFit, fit_weak_form

#: Number of sets that are simulated in a round: the first by regression and its nearest rivals, one of them from
#: another family.
CONFIRMED = 3
#: Number of further ones if simulation does not confirm the first.
FURTHER = 3


#: Largest initial amplitude of a fit [prior sds of a fit].
FAR = 1.5
#: Distance of a start from the prior mean up to which a fit is not repeated from there [prior sd].
BESIDE = 1.0
#: Gain that a set must promise for another program, and that simulation may lack for no other set to be tried, as a
#: share of the largest gain of any set.
ANOTHER = 0.05
#: Number of effects in the first program of a log's fits, and of those among them that are similar to the first.
ROOM, NEAR = 8, 5


@dataclasses.dataclass(frozen=True)
class ScreenedSets:
    """Sets of effects after a round of screening, with the most promising ones simulated.

    Attributes:
        candidates: one candidate for each set: the simulated fit if there is one, otherwise the regression.
        asked: number of sets that were simulated.
        otherwise: number of these that explain less than their regression by more than `Settings.same`.
        room: names of the effects in the program of these fits, see `CandidateSpace`.
    """

    candidates: tuple[Candidate, ...]
    asked: int = 0
    otherwise: int = 0
    room: Names = ()


class LinearisedFits:
    """Fits sets of effects to the linearised equations of one fit.

    Args:
        at: the fit.
        linear, scores: its linearization, and the scores of effects on its residuals.
    """

    def __init__(
        self,
        space: CandidateSpace,
        at: Candidate,
        linear: Linearization | WeakFormFit,
        scores: ScoreTable,
        settings: Settings,
    ) -> None:
        self.space, self.at, self.scores, self.settings = space, at, scores, settings
        self.jacobian, self.residual = np.asarray(linear.jacobian), np.asarray(linear.residual)
        self.signatures = np.asarray(linear.signatures)

    def __call__(self, active: Names) -> Candidate:
        """Candidate with these effects. New effects have the shape of their grid with the best score."""
        p, s, at = self.space.free, self.settings.slots, self.at
        size = self.jacobian.shape[1]  # residuals of the priors come last, in the order of the coordinates
        slopes, residual, prior_residual = self.jacobian[:-size], self.residual[:-size].copy(), self.residual[-size:]
        for old, name in enumerate(at.active):
            if name and name not in active:  # at amplitude 0
                residual -= slopes[:, p + old] * at.z[p + old]
        z, columns, places = np.concatenate([at.z[:p], np.zeros(2 * s)]), [slopes[:, :p]], [*range(p)]
        for slot, name in enumerate(active):
            if not name:
                continue
            slot_places = [p + slot, p + s + slot]
            if name in at.active:
                former_places = [p + at.active.index(name), p + s + at.active.index(name)]
                columns.append(slopes[:, former_places])
                z[slot_places] = at.z[former_places]
            else:
                m = self.space.library.best_instance(name, np.asarray(self.scores.single))
                columns.append(np.zeros((len(slopes), 2)))
                columns[-1][: len(self.signatures), 0] = self.settings.width * self.signatures[:, m]
                z[slot_places[1]] = self.space.library.at[m]
            places += slot_places
        columns_and_prior = np.concatenate([np.concatenate(columns, 1), np.eye(len(places))])
        target = np.concatenate([residual, prior_residual[:p], z[places[p:]]])
        covariance = np.linalg.inv(columns_and_prior.T @ columns_and_prior)
        step = -covariance @ (columns_and_prior.T @ target)
        z[places] += step
        sd = np.ones(len(z))
        sd[places] = np.sqrt(np.diag(covariance))
        cost = np.asarray(0.5 * np.sum((target + columns_and_prior @ step) ** 2))
        parts: tuple[Any, ...] = (z, sd, covariance, cost, np.asarray(0.0), np.asarray(True), np.asarray(0))
        optimum = Optimum(*parts)
        return dataclasses.replace(candidate_of_fit(self.space, active, optimum, self.settings), simulated=False)


def confirm_by_simulation(space: CandidateSpace, screened: Sequence[Candidate], settings: Settings) -> ScreenedSets:
    """Simulates the most promising sets of a round that was screened by regression.

    These are the best plausible set, its closest competitor, the closest one of another family, and any implausible
    set that explains more. If the compiled program has the best set but not a competitor, that stays a regression. If
    the best set explains less than its regression by more than `Settings.same` and `ANOTHER`, the simulation decides,
    and the next best set is tried. Further sets must be in the program, or must promise more.
    """
    fits = lambda c: {*c.effects} <= {*space.room}  # noqa: E731
    # Sets outside the program need another program, and have to promise that much more. For verdicts at other noises
    # they are omitted.
    screened = [c for c in screened if fits(c)] if space.near else screened
    costs = [c.cost for c in screened if np.isfinite(c.cost)]
    more = max(settings.same / 2, ANOTHER * float(np.ptp(costs))) if costs else 0.0
    order = sorted(screened, key=lambda c: c.cost + (0.0 if fits(c) else more))
    order = [c for c in order if np.isfinite(c.cost)]
    within = [c for c in order if fits(c)] if order and fits(order[0]) else order
    first, simulated = _first_to_simulate(space, within), dict[Names, Candidate]()
    space = space.with_room([*space.room, *(n for c in first for n in c.effects)])  # one program for all of them
    by_regression = {c.active: c for c in order}

    def explains_less(c: Candidate, by: float) -> bool:
        return c.cost - by_regression[c.active].cost > by

    def simulate(those: Sequence[Candidate]) -> None:
        """Simulates these sets from the coordinates of their regressions.

        A set that then explains less is repeated from the prior mean, unless that is near, because without the effect
        the fit may have gone astray.
        """
        fits = fit_candidates(space, [(c.active, _start_of_simulation(space, c)) for c in those], settings)
        simulated.update({c.active: c for c in fits})
        new = [c for c in those if c.active not in space.near]
        elsewhere = [c for c in new if np.abs(c.z[: space.free]).max() > BESIDE]
        doubted = [c for c in elsewhere if explains_less(simulated[c.active], more)]
        at_mean = [np.where(np.arange(len(c.z)) < space.free, 0.0, _start_of_simulation(space, c)) for c in doubted]
        refits = fit_candidates(space, [(c.active, z) for c, z in zip(doubted, at_mean, strict=True)], settings)
        simulated.update({c.active: c for c in refits if c.cost < simulated[c.active].cost})

    simulate(first)
    leader = first[0] if first else None
    for _ in range(FURTHER):
        best = min((c.cost for c in simulated.values() if c.plausible), default=np.inf)
        not_simulated = [c for c in order if c.active not in simulated and c.plausible]
        promising = [c for c in not_simulated if c.cost < best or fits(c)]
        if leader is None or not explains_less(simulated[leader.active], more) or not promising:
            break
        leader = promising[0]
        simulate([leader])
    confirmed = tuple(simulated.get(c.active, c) for c in screened)
    return ScreenedSets(
        confirmed, len(simulated), sum(explains_less(c, settings.same / 2) for c in simulated.values()), space.room
    )


def _start_of_simulation(space: CandidateSpace, screened: Candidate) -> np.ndarray:
    """Start of a simulation of a screened set: its regression, with amplitudes limited to the largest step of a
    search.
    """
    z, p, slots = screened.z.copy(), space.free, len(screened.active)
    z[p : p + slots] = np.clip(z[p : p + slots], -FAR, FAR)
    return z


def _first_to_simulate(space: CandidateSpace, order: Sequence[Candidate]) -> list[Candidate]:
    """Sets that are simulated first. `order`: the sets by what they explain."""
    families = lambda c: frozenset(space.library[n].family() for n in c.effects)  # noqa: E731
    sound = [c for c in order if c.plausible]
    if not sound:
        return list(order[:1])
    of_others = [c for c in sound if families(c) != families(sound[0])]
    candidates = [sound[0], *of_others[:1], *sound[1:]]
    candidates = list({c.active: c for c in candidates}.values())[:CONFIRMED]
    return [*candidates, *(c for c in order[:1] if not c.plausible)]


@dataclasses.dataclass(frozen=True)
class WeakFormScreening:
    """Results from a log's equations in weak form, before any simulation.

    Attributes:
        base: fit without effects, by regression. None if the load may slide on its ground: the equations do not show
            sliding, so a search must not start there.
        room: effects for the program of all fits, if the equations show that one is missing.
        alone: fits with one effect each, by regression, the best first. Empty if nothing is missing.
        scores: score of every instance.
        windows: number of equations.
        null: square root of the strongest score of bootstrap tables without a missing effect [σ], shape
            (replicates,).
    """

    base: Candidate | None
    room: Names
    alone: tuple[Candidate, ...]
    scores: ScoreTable
    windows: int
    null: np.ndarray


def screen_by_weak_form(space: CandidateSpace, settings: Settings) -> WeakFormScreening | None:
    """Fits base parameters and effects by regression on a log's equations in weak form. None if the log does not show
    its states (`fit_weak_form`).
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
    ways = np.where(is_visible, projected / np.where(is_visible, norm, 1.0), 0.0)
    single = -ways.T @ equations.residual
    none = np.zeros(0)
    amplitude = np.where(is_visible, single / np.where(is_visible, norm, 1.0), 0.0)
    parts: tuple[Any, ...] = (single, amplitude, norm, none, ways.T @ ways, *[none] * 4)
    scores = ScoreTable(*parts)
    random = np.random.default_rng(settings.seed)
    null = np.max(np.abs(random.standard_normal((settings.replicates, len(ways))) @ ways), 1)
    slots = np.zeros(2 * settings.slots)
    sd = np.sqrt(np.diag(np.linalg.inv(equations.jacobian.T @ equations.jacobian)))
    z, sd = np.concatenate([equations.z, slots]), np.concatenate([sd, slots + 1])
    cost = np.asarray(0.5 * np.sum(equations.residual**2))
    of_fit: tuple[Any, ...] = (z, sd, np.zeros((0, 0)), cost, np.asarray(0.0), np.asarray(True), np.asarray(0))
    optimum = Optimum(*of_fit)
    base = dataclasses.replace(candidate_of_fit(space, empty_slots(settings), optimum, settings), simulated=False)
    slides = problem.base.has_ground and problem.base.rig.imposed == "voltage"
    missing = np.mean(null >= np.max(np.abs(single))) < settings.family_wise_error
    alone = _fit_single_effects(space, base, equations, scores, settings) if missing else ()
    room = _likely_effects(space, alone, scores, settings) if missing else ()
    return WeakFormScreening(None if slides else base, room, alone, scores, equations.windows, null)


def fit_by_regression(
    space: CandidateSpace, wanted: Sequence[tuple[Names, Candidate, Diagnosis]], settings: Settings
) -> list[Candidate]:
    """Fits sets of effects by regression, each in addition to another fit.

    Args:
        wanted: (active effects, other fit, its diagnosis).
    """
    regressions = {
        id(diagnosis): LinearisedFits(space, at, diagnosis.linear, diagnosis.scores, settings)
        for _, at, diagnosis in wanted
    }
    return [regressions[id(diagnosis)](active) for active, _, diagnosis in wanted]


def include_likely_effects(
    space: CandidateSpace, base: Candidate, linear: Linearization, scores: ScoreTable, settings: Settings
) -> CandidateSpace:
    """Candidate space whose compiled fits include the effects that are likely to be needed, see `_likely_effects`.

    Returns the space unchanged if the model is not a rollout or if these effects have already been chosen.
    """
    if not space.bare.observe.long or space.room:
        return space
    alone = _fit_single_effects(space, base, linear, scores, settings)
    return space.with_room(_likely_effects(space, alone, scores, settings))


def _fit_single_effects(
    space: CandidateSpace,
    base: Candidate,
    linear: Linearization | WeakFormFit,
    scores: ScoreTable,
    settings: Settings,
) -> tuple[Candidate, ...]:
    """Fits with one effect each, by regression, the best first."""
    beside = LinearisedFits(space, base, linear, scores, settings)
    return tuple(sorted((beside(fill_slots([name], settings)) for name in space.library.names), key=lambda c: c.cost))


def _likely_effects(
    space: CandidateSpace, order: Sequence[Candidate], scores: ScoreTable, settings: Settings
) -> Names:
    """Effects for the compiled program: those to be simulated first, similar ones, and the best of other families.

    Args:
        order: fits with one effect each, the best first.
    """
    library = space.library
    first = [c.active[0] for c in _first_to_simulate(space, order)]
    cosine = np.abs(np.asarray(scores.cosine)[library.best_instance(first[0], np.asarray(scores.single))])
    alike = library.largest(cosine)
    near = [library.names[k] for k in np.argsort(-alike) if alike[k] > settings.alike]
    best = {library[c.active[0]].family(): c for c in reversed(order)}  # of each family
    first_effects = [c.active[0] for c in sorted(best.values(), key=lambda c: c.cost)]
    return tuple(dict.fromkeys((*first, *near[:NEAR], *first_effects)))[:ROOM]
