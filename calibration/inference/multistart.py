"""Searches from many starts, with the noise estimated on the way where nobody states it."""

from __future__ import annotations

import dataclasses
import functools
import time
from collections.abc import Callable
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np

from calibration.described import described
from calibration.inference import identifiability, optimizers, scans, series_noise
from calibration.inference import noise as noise_room
from calibration.inference.fit_notes import Agreement, Step
from calibration.inference.noise import Noise
from calibration.inference.population import Population, Searched, most_probable
from calibration.inference.problem import Data, Observation, Problem
from mmrjax.model.robot import Robot

#: Costs closer than this to the best [½σ²] are the same optimum.
AGREE = 1e-3
#: Rounds of fitting and estimating the noise, and the change of a share at which they end.
ROUNDS, SETTLED_SHARE = 30, 1e-3
#: Draws among which the starts of a rollout's searches are chosen.
DRAWS = 2000
#: Tightenings of the penalty on adhesion, tenfold each.
TIGHTENINGS = 3
T = TypeVar("T")


@dataclasses.dataclass(frozen=True)
class Starts:
    """How searches from many starts ended.

    Attributes:
        cost: objective of each [½σ²], shape (starts,).
        converged: of each.
        infeasible: starts at which some row slides or fails.
        z: where each ended, shape (starts, parameters); None where that is not kept.
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
        """How many converged searches ended at the best optimum."""
        return int(np.sum(self.converged & self._at_best))

    @property
    def agreement(self) -> Agreement:
        """Whether the starts agree."""
        other = self.converged & ~self._at_best
        more = float(self.cost[other].min() - self.cost.min()) if other.any() else 0.0
        return Agreement(len(self.cost), self.agree, int(other.sum()), more, int(np.sum(~self.converged)))

    def statement(self) -> str:
        """Whether the starts agree, as a sentence."""
        return described(self.agreement)


@dataclasses.dataclass(frozen=True)
class Found:
    """What searches found.

    Attributes:
        problem: with the noise (and stiffness) it ended with; best: its optimum.
        starts: how the searches ended.
        shares: estimated sd of each channel as a share of its size, NaN where the sd was known.
        searched: the population that it began from, None without.
    """

    problem: Problem
    best: optimizers.Optimum
    starts: Starts
    shares: np.ndarray
    searched: Searched | None = None


def unreachable(posed: Problem, status: np.ndarray) -> np.ndarray:
    """Whether the model has no operating point for a row that has a reading; shape of `status`, (..., rows)."""
    return posed.observe.unreachable(np.asarray(status)) & (np.asarray(posed.data.weight).max(1) > 0)


def search(posed: Problem, noise: Noise, points: np.ndarray, solver: optimizers.Solver | None = None) -> Found:
    """Search from all points in one batch; where the noise is not known, estimate it and search again until it
    settles.

    The best optimum so far starts beside the points, so that every round is the same compiled batch.

    Args:
        solver: of optimistix; None for ours.
    """
    by = functools.partial(optimizers.searches, solver=solver)
    z = points[0]
    shares = first_shares(noise)
    for _ in range(ROUNDS):
        posed, found, feasible = _tighten(posed, np.concatenate([points, z[None]]), by)
        best = _member(found, int(np.nanargmin(found.cost)))
        z = np.asarray(best.z)
        new = _settling(posed, noise, z, shares)
        if new is None:
            break
        shares = new
        posed = _noisier(posed, noise, shares)
    return Found(posed, best, _ended(jax.tree.map(lambda x: x[:-1], found), feasible[:-1]), shares)


def search_one_by_one(
    posed: Problem,
    noise: Noise,
    points: np.ndarray,
    shares: np.ndarray,
    tell: Callable[[Step], None],
    solver: optimizers.Solver | None = None,
) -> Found:
    """As `search`, one search at a time: the noise settles on the first point's optimum, then the others start once
    each. One that ends lower takes its place, and the noise settles again.

    Args:
        posed: with the noise to begin from; shares: of the reading, that it has.
        tell: is given what was done after every step; solver: of optimistix, None for ours.
    """
    begun = time.perf_counter()

    def minutes() -> float:
        return (time.perf_counter() - begun) / 60

    def step(posed: Problem, points: np.ndarray, data: Data) -> tuple[optimizers.Optimum, np.ndarray, np.ndarray]:
        def one(z: np.ndarray) -> tuple[optimizers.Optimum, Observation, Observation]:
            if solver is not None:
                return _member(optimizers.searches_by(posed, jnp.asarray(z)[None], data, solver), 0)
            return optimizers.search_long(
                posed, jnp.asarray(z), data, tell=lambda *done: tell(Step("search", (*done, minutes())))
            )

        found, start, end = one(points[0])
        found, end = scans.searched_on(posed, (found, end), data, lambda z: one(z)[::2], tell)
        found, start, end = jax.tree.map(lambda x: jnp.asarray(x)[None], (found, start, end))
        return found, start.status, end.status

    first = points[0]
    for _ in range(len(points)):
        z = first
        for round_ in range(1, ROUNDS + 1):
            posed, found, feasible = _tighten(posed, z[None], step)
            z = np.asarray(found.z[0])
            tell(Step("round", (round_, found.cost[0], found.steps[0], minutes())))
            new = _settling(posed, noise, z, shares)
            if new is None:
                break
            shares = new
            posed = _noisier(posed, noise, shares)
        ends, feasibles = [found], [feasible]
        for k, point in enumerate(points[1:], 2):
            end, status, _ = step(posed, point[None], posed.data)
            ends.append(end)
            feasibles.append(~np.any(unreachable(posed, status), axis=1))
            tell(Step("start", (k, len(points), end.cost[0], end.steps[0], minutes())))
        found = jax.tree.map(lambda *x: jnp.concatenate(x), *ends)
        k = int(np.nanargmin(found.cost))
        if not found.cost[k] < found.cost[0] - AGREE * (1 + found.cost[0]):
            k = 0
            break
        first = np.asarray(found.z[k])
    return Found(posed, _member(found, k), _ended(found, np.concatenate(feasibles)), shares)


def nearby(easy: Problem, z: np.ndarray, rng: np.random.Generator, count: int) -> np.ndarray:
    """Draws from the posterior of `steady` at its optimum z, for a rollout's searches to begin at: such at which
    no row slides and no friction law is steeper at rest than the base's, or the nearest to that.

    Draws from the prior would take hundreds of rollouts along the limit of adhesion to come back from; whether
    the problem has several optima is what the many starts of `steady` say.
    """
    spread = np.linalg.cholesky(identifiability.analyse(easy, jnp.asarray(z)).covariance)
    draws = z + rng.standard_normal((DRAWS, len(z))) @ spread.T

    def steepness(robot: Robot) -> jax.Array:
        laws = [chassis.ground.friction for chassis in robot.configurations.members]
        return jnp.stack([law.static / law.speed_static for law in laws])

    def seen(z: jax.Array) -> tuple[jax.Array, jax.Array]:
        return easy.observation(z).status, steepness(easy.robot(z)) > 1.001 * steepness(easy.base)

    status, steep = jax.jit(jax.vmap(seen))(jnp.asarray(draws))
    lost = unreachable(easy, status).sum(1) + np.asarray(steep).sum(1)
    return draws[np.argsort(lost, kind="stable")[:count]]


def at_best(
    posed: Problem,
    noise: Noise,
    shares: np.ndarray,
    searched: Searched,
    tell: Callable[[Step], None],
    solver: optimizers.Solver | None = None,
) -> Found:
    """What a population found, its best member searched on by gradients where those are to be trusted."""
    z = searched.found.z[searched.at]
    if searched.slope is None:
        found = search_one_by_one(posed, noise, z[None], shares, tell, solver)
        return dataclasses.replace(found, searched=searched)
    seen = Observation(*(jnp.asarray(x[searched.at]) for x in (
        searched.found.reading, searched.found.adhesion_used, searched.found.status, searched.found.flags,
    )))  # fmt: skip
    error = np.concatenate([np.asarray(posed.whitened(seen, posed.data)), z - np.asarray(posed.data.centre)])
    rows = np.zeros((posed.data.measured.shape[0], len(z)))  # of the penalty on adhesion
    best = optimizers.optimum(np.concatenate([searched.slope, rows, np.eye(len(z))]), error, z, posed.data)
    settled = np.array([searched.found.settled])
    best = dataclasses.replace(best, converged=jnp.asarray(searched.found.settled))
    ended = Starts(np.array([float(best.cost)]), settled, sum(g.failed for g in searched.found.generations))
    return Found(posed, best, ended, shares, searched)


def reestimate_noise_at(posed: Problem, noise: Noise, searched: Population, at: int) -> tuple[Problem, np.ndarray]:
    """The problem with the noise that is most probable for a member, and the shares that it is of readings."""
    shares = most_probable(posed, noise, searched.reading[at])
    return _noisier(posed, noise, shares), shares


def first_shares(noise: Noise) -> np.ndarray:
    """What the estimated shares begin at, NaN where the sd is known; shape (channels,)."""
    return np.where(noise.estimated, noise_room.START, np.nan)


def _member(found: T, k: int) -> T:
    return jax.tree.map(lambda x: x[k], found)


def _ended(found: optimizers.Optimum, feasible: np.ndarray) -> Starts:
    cost = np.where(np.isfinite(found.cost), found.cost, np.inf)
    return Starts(cost, np.asarray(found.converged), int(np.sum(~feasible)), np.asarray(found.z))


def _settling(posed: Problem, noise: Noise, z: np.ndarray, shares: np.ndarray) -> np.ndarray | None:
    """The shares estimated anew at z, or None where there is nothing to estimate or they have settled."""
    if not noise.estimated.any():
        return None
    new = _shares(posed, noise, z)
    return None if np.nanmax(np.abs(new / shares - 1)) < SETTLED_SHARE else new


def _noisier(posed: Problem, noise: Noise, shares: np.ndarray) -> Problem:
    sd = np.where(noise.estimated, noise.sd / noise_room.START * shares, noise.sd)
    return dataclasses.replace(posed, data=dataclasses.replace(posed.data, sd=jnp.asarray(sd)))


def _tighten(
    posed: Problem, points: np.ndarray, search: Callable[..., Any]
) -> tuple[Problem, optimizers.Optimum, np.ndarray]:
    """Search from all points, with the penalty on adhesion stiffer until no row slides at the best.

    Returns:
        The problem, the searches, and whether each start was feasible.
    """
    for _ in range(TIGHTENINGS + 1):
        found, status_start, status_end = search(posed, jnp.asarray(points), posed.data)
        k = int(np.nanargmin(found.cost))
        if not unreachable(posed, status_end)[k].any():
            break
        data = dataclasses.replace(posed.data, stiffness=posed.data.stiffness / 10)
        posed = dataclasses.replace(posed, data=data)
    return posed, found, ~np.any(unreachable(posed, status_start), axis=1)


def _shares(posed: Problem, noise: Noise, z: np.ndarray) -> np.ndarray:
    """Sd over size of each channel from the misfit, degrees of freedom taken off; NaN where known.

    s² = Σ (error / size)² / (readings - Σ leverage). It holds model error as well as noise, so a fit with it can't
    be tested for adequacy.
    """
    data = posed.data
    size = noise.sd / noise_room.START  # what an estimated share is of
    weight = np.asarray(data.weight)
    error = np.asarray(optimizers.observation(posed, jnp.asarray(z)).reading - data.measured) / size
    error = np.where(weight > 0, error, 0.0)
    leverage = identifiability.analyse(posed, jnp.asarray(z)).leverage
    left = np.maximum(weight.sum(0) - leverage.sum(0), 1.0)
    shares = np.maximum(np.sqrt(np.sum(error**2, 0) / left), series_noise.FLOOR)
    return np.where(noise.estimated, shares, np.nan)
