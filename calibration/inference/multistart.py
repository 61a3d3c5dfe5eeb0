"""Searches from several starts. Noise that is not stated is estimated between searches."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np

from calibration.described import describe
from calibration.inference import identifiability, optimizers, scans, series_noise
from calibration.inference import noise as noise_room
from calibration.inference.fit_notes import Remark, progress_remark
from calibration.inference.noise import Noise
from calibration.inference.population import PopulationSearch
from calibration.inference.problem import Observation, Problem
from mmrjax.model.robot import Robot

#: Costs closer than this to the best [½σ²] are the same optimum.
AGREE = 1e-3
#: Rounds of fitting and estimating the noise, and the change of a share at which they end.
ROUNDS, SETTLED_SHARE = 30, 1e-3
#: Number of draws from which the starts of a rollout's searches are chosen.
DRAWS = 2000
#: Number of times that the penalty on adhesion is increased, tenfold each.
TIGHTENINGS = 3
T = TypeVar("T")


@dataclasses.dataclass(frozen=True)
class StartOutcomes:
    """Outcomes of searches from several starts.

    Attributes:
        cost: objective at the end of each search [½σ²], shape (starts,).
        converged: True for each search that converged.
        infeasible: number of starts at whose end a row slides or fails.
        z: end of each search, shape (starts, parameters). None if not kept.
    """

    cost: np.ndarray
    converged: np.ndarray
    infeasible: int
    z: np.ndarray | None = None

    @property
    def _at_best(self) -> np.ndarray:
        return self.cost < self.cost.min() + AGREE * (1 + self.cost.min())

    @property
    def agree(self) -> int:
        """Number of converged searches that ended at the best optimum."""
        return int(np.sum(self.converged & self._at_best))

    @property
    def agreement(self) -> Remark:
        """Remark on how well the starts agree."""
        is_elsewhere = self.converged & ~self._at_best
        cost_difference = float(self.cost[is_elsewhere].min() - self.cost.min()) if is_elsewhere.any() else 0.0
        return Remark(
            "agreement",
            starts=len(self.cost),
            agree=self.agree,
            elsewhere=int(is_elsewhere.sum()),
            more=cost_difference,
            open=int(np.sum(~self.converged)),
        )

    def statement(self) -> str:
        """Agreement of the starts, as a sentence."""
        return describe(self.agreement)


@dataclasses.dataclass(frozen=True)
class MultistartResult:
    """Result of searches from several starts.

    Attributes:
        problem: problem with the noise (and penalty stiffness) of the last round.
        best: best optimum found.
        starts: outcome of each search.
        shares: estimated sd of each channel, relative to its size. NaN if the sd was known.
        searched: population of the search by generations that came first, None without one.
    """

    problem: Problem
    best: optimizers.Optimum
    starts: StartOutcomes
    shares: np.ndarray
    searched: PopulationSearch | None = None


def search_from_starts(problem: Problem, noise: Noise, points: np.ndarray) -> MultistartResult:
    """Searches from all points in one batch. Unknown noise is estimated and the search repeated until the noise
    settles.

    The best optimum so far is one more start, so that every round runs the same compiled program.
    """
    z = points[0]
    shares = initial_noise_shares(noise)
    for _ in range(ROUNDS):
        problem, optima, feasible = _search_until_feasible(
            problem, np.concatenate([points, z[None]]), optimizers.search_starts
        )
        best = _pick_member(optima, int(np.nanargmin(optima.cost)))
        z = np.asarray(best.z)
        new_shares = _reestimate_shares(problem, noise, z, shares)
        if new_shares is None:
            break
        shares = new_shares
        problem = with_noise_shares(problem, noise, shares)
    return MultistartResult(
        problem, best, _outcome_of_searches(jax.tree.map(lambda x: x[:-1], optima), feasible[:-1]), shares
    )


def search_one_by_one(
    problem: Problem,
    noise: Noise,
    points: np.ndarray,
    shares: np.ndarray,
    tell: Callable[[Remark], None],
) -> MultistartResult:
    """Searches from several points as `search_from_starts`, but one after another.

    The noise settles at the optimum of the first point. Then each other point is searched once. If one ends lower, it
    becomes the optimum and the noise settles again.

    Args:
        problem: problem with the initial noise.
        shares: initial noise, relative to the readings.
        tell: callback for progress after every step.
    """
    start_time = time.perf_counter()

    def elapsed_minutes() -> float:
        return (time.perf_counter() - start_time) / 60

    def search_first(problem: Problem, points: np.ndarray) -> tuple[optimizers.Optimum, np.ndarray, np.ndarray]:
        def search_from(z: np.ndarray) -> tuple[optimizers.Optimum, Observation, Observation]:
            return optimizers.search_rollout(
                problem,
                jnp.asarray(z),
                tell=lambda *done: tell(progress_remark("search", *done, elapsed_minutes())),
            )

        optima, start, end = search_from(points[0])
        optima, end = scans.search_lower_minima(problem, (optima, end), lambda z: search_from(z)[::2], tell)
        optima, start, end = jax.tree.map(lambda x: jnp.asarray(x)[None], (optima, start, end))
        return optima, start.status, end.status

    first_point = points[0]
    for _ in range(len(points)):
        z = first_point
        for round_ in range(1, ROUNDS + 1):
            problem, optima, feasible = _search_until_feasible(problem, z[None], search_first)
            z = np.asarray(optima.z[0])
            tell(progress_remark("round", round_, optima.cost[0], optima.steps[0], elapsed_minutes()))
            new_shares = _reestimate_shares(problem, noise, z, shares)
            if new_shares is None:
                break
            shares = new_shares
            problem = with_noise_shares(problem, noise, shares)
        ends, feasibles = [optima], [feasible]
        for k, point in enumerate(points[1:], 2):
            end, status, _ = search_first(problem, point[None])
            ends.append(end)
            feasibles.append(~np.any(problem.unreachable_rows(status), axis=1))
            tell(progress_remark("start", k, len(points), end.cost[0], end.steps[0], elapsed_minutes()))
        optima = jax.tree.map(lambda *x: jnp.concatenate(x), *ends)
        k = int(np.nanargmin(optima.cost))
        if not optima.cost[k] < optima.cost[0] - AGREE * (1 + optima.cost[0]):
            k = 0
            break
        first_point = np.asarray(optima.z[k])
    return MultistartResult(
        problem, _pick_member(optima, k), _outcome_of_searches(optima, np.concatenate(feasibles)), shares
    )


def starts_from_posterior(steady_problem: Problem, z: np.ndarray, rng: np.random.Generator, count: int) -> np.ndarray:
    """Starts of the searches of a rollout, drawn from the posterior of `steady` at its optimum z.

    A draw is kept if no row slides and if no friction law is steeper at rest than that of the base. If there are too
    few, the nearest ones are kept. Draws from the prior would need hundreds of rollouts along the limit of adhesion
    to recover. The starts of `steady` already show if the problem has several optima.
    """
    spread = np.linalg.cholesky(identifiability.analyse_identifiability(steady_problem, jnp.asarray(z)).covariance)
    draws = z + rng.standard_normal((DRAWS, len(z))) @ spread.T

    def steepness(robot: Robot) -> jax.Array:
        laws = [chassis.ground.friction for chassis in robot.configurations.members]
        return jnp.stack([law.static / law.speed_static for law in laws])

    def status_and_steepness(z: jax.Array) -> tuple[jax.Array, jax.Array]:
        return steady_problem.observation(z).status, steepness(steady_problem.robot(z)) > 1.001 * steepness(
            steady_problem.base
        )

    status, steep = jax.jit(jax.vmap(status_and_steepness))(jnp.asarray(draws))
    unreachable_count = steady_problem.unreachable_rows(status).sum(1) + np.asarray(steep).sum(1)
    return draws[np.argsort(unreachable_count, kind="stable")[:count]]


def optimum_of_population(
    problem: Problem,
    noise: Noise,
    shares: np.ndarray,
    searched: PopulationSearch,
    tell: Callable[[Remark], None],
) -> MultistartResult:
    """Result of a population, after a further search by gradients from its best member where gradients are
    reliable.
    """
    z = searched.population.z[searched.best]
    if searched.slope is None:
        optima = search_one_by_one(problem, noise, z[None], shares, tell)
        return dataclasses.replace(optima, searched=searched)
    observation = jax.tree.map(lambda x: jnp.asarray(x[searched.best]), searched.population.observations)
    residual = np.concatenate([np.asarray(problem.whitened(observation)), z - np.asarray(problem.data.centre)])
    penalty_rows = np.zeros((problem.data.measured.shape[0], len(z)))  # of the penalty on adhesion
    jacobian = jnp.asarray(np.concatenate([searched.slope, penalty_rows, np.eye(len(z))]))
    best = optimizers.optimum_at(
        jacobian, jnp.asarray(residual), jnp.asarray(z), problem.data, jnp.asarray(0), jacobian
    )
    has_settled = np.array([searched.population.settled])
    best = dataclasses.replace(best, converged=jnp.asarray(searched.population.settled))
    start_outcomes = StartOutcomes(
        np.array([float(best.cost)]), has_settled, sum(g.failed for g in searched.population.generations)
    )
    return MultistartResult(problem, best, start_outcomes, shares, searched)


def initial_noise_shares(noise: Noise) -> np.ndarray:
    """Initial noise relative to the readings, NaN if the sd is known, shape (channels,)."""
    return np.where(noise.estimated, noise_room.START, np.nan)


def _pick_member(members: T, k: int) -> T:
    return jax.tree.map(lambda x: x[k], members)


def _outcome_of_searches(optima: optimizers.Optimum, feasible: np.ndarray) -> StartOutcomes:
    cost = np.where(np.isfinite(optima.cost), optima.cost, np.inf)
    return StartOutcomes(cost, np.asarray(optima.converged), int(np.sum(~feasible)), np.asarray(optima.z))


def _reestimate_shares(problem: Problem, noise: Noise, z: np.ndarray, shares: np.ndarray) -> np.ndarray | None:
    """Noise of each channel relative to its size, estimated from the misfit at z and corrected for degrees of
    freedom, NaN if known. None if all noise is known, or if the estimate has settled.

    s² = Σ (error / size)² / (readings - Σ leverage). It contains model error as well as noise, so a fit that uses it
    cannot be tested for adequacy.
    """
    if not noise.estimated.any():
        return None
    data = problem.data
    size = noise.sd / noise_room.START  # the reference of an estimated share
    weight = np.asarray(data.weight)
    error = np.asarray(optimizers.observe_at(problem, jnp.asarray(z)).reading - data.measured) / size
    error = np.where(weight > 0, error, 0.0)
    leverage = identifiability.analyse_identifiability(problem, jnp.asarray(z)).leverage
    freedom = np.maximum(weight.sum(0) - leverage.sum(0), 1.0)
    new_shares = np.maximum(np.sqrt(np.sum(error**2, 0) / freedom), series_noise.FLOOR)
    new_shares = np.where(noise.estimated, new_shares, np.nan)
    return None if np.nanmax(np.abs(new_shares / shares - 1)) < SETTLED_SHARE else new_shares


def with_noise_shares(problem: Problem, noise: Noise, shares: np.ndarray) -> Problem:
    """Problem with estimated noise, relative to the readings, shape (channels,)."""
    sd = np.where(noise.estimated, noise.sd / noise_room.START * shares, noise.sd)
    return problem.with_data(sd=jnp.asarray(sd))


def _search_until_feasible(
    problem: Problem, points: np.ndarray, search: Callable[..., Any]
) -> tuple[Problem, optimizers.Optimum, np.ndarray]:
    """Searches from all points. The penalty on adhesion becomes stiffer until no row slides at the best point.

    Returns:
        The problem, the searches, and True for each feasible start.
    """
    for _ in range(TIGHTENINGS + 1):
        optima, status_start, status_end = search(problem, jnp.asarray(points))
        k = int(np.nanargmin(optima.cost))
        if not problem.unreachable_rows(status_end)[k].any():
            break
        problem = problem.with_data(stiffness=problem.data.stiffness / 10)
    return problem, optima, ~np.any(problem.unreachable_rows(status_start), axis=1)
