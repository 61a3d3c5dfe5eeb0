"""Search without gradients: generations of a population of robots, simulated in batches.

A rollout has thresholds (contacts that open and close, regimes of vibration), across which gradients are no guide.
Members are drawn by CMA-ES (Hansen and Ostermeier 2001; the library `cmaes`). All results of a member's run are kept.
So the noise can be estimated again without another run, and a regression over the members shows how readings change
near the best one.
"""

from __future__ import annotations

import dataclasses
import functools
import time
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from calibration.data import Json, Names
from calibration.data.writing import entries_of
from calibration.described import describe
from calibration.inference import noise as noise_room
from calibration.inference import series_noise
from calibration.inference.fit_notes import Remark, progress_remark
from calibration.inference.noise import Noise
from calibration.inference.priors import Coordinates
from calibration.inference.problem import MISSING, Observation, Problem
from mmrjax.compile.compiling import compiled
from mmrjax.model.signals import FLAGS, STATUSES

#: Number of members run together: on processors, and on an accelerator.
TOGETHER = (16, 512)
#: Largest number of generations, and number of generations that may pass without a gain of this size [½σ²].
GENERATIONS, PATIENCE, GAIN = 30, 8, 0.5
#: Fewest members of a generation.
LEAST = 4
#: Cost of a row that is not reached [½σ²].
LOST = 1e3
#: Number of members in the local regression per coefficient.
MEMBERS_EACH = 3
#: Distance from the middle of a prior beyond which a search is at its edge [prior sd].
EDGE = 2.5


#: Step of the differences that check derivatives [posterior sd], and largest relative difference between the two.
STEP, APART = 0.2, 0.25


@dataclasses.dataclass(frozen=True)
class Generation:
    """Summary of one generation.

    Attributes:
        members: number of members.
        failed: number of members with a row that failed or left the ground.
        lowest: lowest objective so far [½σ²].
        median: median objective of this generation [½σ²].
    """

    members: int
    failed: int
    lowest: float
    median: float


@dataclasses.dataclass(frozen=True)
class Population:
    """All members of a search by generations.

    Attributes:
        z: coordinates, shape (members, parameters).
        observations: observation of each member, first axis the members.
        cost: objective with the final noise of the search [½σ²], inf if a member has none.
        generations: summary of each generation.
    """

    z: Float[np.ndarray, "members parameters"]
    observations: Observation
    cost: Float[np.ndarray, " members"]
    generations: tuple[Generation, ...]

    @property
    def order(self) -> Int[np.ndarray, " members"]:
        """Indices of the members by their objective, the lowest first."""
        return np.argsort(self.cost, kind="stable")

    @property
    def settled(self) -> bool:
        """True if the last generations brought no relevant gain."""
        lowest = [g.lowest for g in self.generations]
        return len(lowest) > PATIENCE and lowest[-PATIENCE - 1] - lowest[-1] < GAIN

    def outcomes(self) -> dict[str, int]:
        """Number of members with at least one row of each status or flag. Zeros are omitted."""
        counts = {word: int((self.observations.status == k).any(1).sum()) for k, word in enumerate(STATUSES) if k}
        counts["jumps"] = int((self.observations.flags >> FLAGS.index("jumps") & 1).any(1).sum())
        return {word: count for word, count in counts.items() if count}


#: Function of members' coordinates and observations.
Objective = Callable[[np.ndarray, Observation], Float[np.ndarray, " members"]]
#: Function that returns the stored result of a stage by its name, or else computes and stores it.
StoreStage = Callable[[str, Callable[[], Any]], Any]


def compute_without_storing(name: str, make: Callable[[], Any]) -> Any:
    """Computes the result of a stage without storing it."""
    return make()


def simulate_members(
    problem: Problem,
    points: np.ndarray,
    advance: Callable[[int], None] = lambda _: None,
    batch_size: int | None = None,
) -> Observation:
    """Simulates the rows for each point.

    Args:
        advance: callback for the number of simulated members.
        batch_size: number of members in one batch. None: `TOGETHER`.
    """
    batch_size = batch_size or TOGETHER[jax.default_backend() != "cpu"]
    batches = []
    for first in range(0, len(points), batch_size):
        batch = points[first : first + batch_size]
        padded = np.concatenate([batch, np.repeat(batch[-1:], batch_size - len(batch), 0)])
        observed = jax.device_get(_observe_points(problem, jnp.asarray(padded)))
        batches.append(jax.tree.map(lambda x: x[: len(batch)], observed))  # noqa: B023
        advance(first + len(batch))
    return _join_observations(batches)


def _join_observations(parts: list[Observation]) -> Observation:
    return jax.tree.map(lambda *x: np.concatenate(x), *parts)


@compiled
def _observe_points(problem: Problem, points: Float[Array, "points parameters"]) -> Observation:
    return jax.vmap(problem.observation)(points)


def most_probable_noise(
    problem: Problem, noise: Noise, reading: Float[np.ndarray, "... rows channels"]
) -> Float[np.ndarray, "... channels"]:
    """Most probable noise of each channel given these readings, relative to the size of the channel. NaN if it is
    known.
    """
    weight = np.asarray(problem.data.weight)
    size = noise.sd / noise_room.START
    error = np.where(weight > 0, (reading - np.asarray(problem.data.measured)) / size, 0.0)
    share = np.sqrt(np.sum(weight * error**2, -2) / np.maximum(weight.sum(0), 1.0))
    return np.where(noise.estimated, np.hypot(share, series_noise.FLOOR), np.nan)


def member_objective(problem: Problem, noise: Noise) -> Objective:
    """Function that returns the objective of members: half the sum of squared residuals of readings and priors.

    If the sd of a channel is unknown, the most probable one for each member is used: n ln s replaces the squares,
    where s is the relative rms error. A measured row that a member does not reach costs `LOST`. A member with an
    included reading that could not be computed costs inf.
    """
    data = problem.data
    weight, measured, sd = np.asarray(data.weight), np.asarray(data.measured), np.asarray(data.sd)

    def objective(z: np.ndarray, observation: Observation) -> Float[np.ndarray, " members"]:
        error = np.where(weight > 0, observation.reading - measured, 0.0)
        squares = np.sum((z - np.asarray(data.centre)) ** 2, -1)
        shares = most_probable_noise(problem, noise, np.asarray(observation.reading))
        for k, estimated in enumerate(noise.estimated):
            count = weight[:, k].sum()
            if estimated and count:
                squares += 2 * count * np.log(shares[..., k])
            else:
                squares += np.sum(weight[:, k] * (error[..., k] / sd[:, k]) ** 2, -1)
        cost = 0.5 * squares + LOST * problem.unreachable_rows(observation.status).sum(-1)
        return np.where(np.isfinite(cost), cost, np.inf)

    return objective


def run_evolution(
    problem: Problem,
    objective: Objective,
    centre: np.ndarray,
    covariance: np.ndarray,
    *,
    size: int,
    seed: int,
    generations: int,
    further_points: np.ndarray,
    tell: Callable[[Remark], None],
    keep: StoreStage,
) -> Population:
    """Searches by generations: each is drawn around the best members of the generations before.

    Args:
        problem: the problem.
        objective: objective of members.
        centre, covariance: centre and covariance of the first generation, in coordinates z.
        size: number of members in a generation.
        seed: random seed.
        generations: largest number of generations.
        further_points: further points to simulate with the first generation.
        tell: callback for progress after every batch.
        keep: storage of the generations, so that a search can resume.
    """
    from cmaes import CMA

    start_time = time.perf_counter()
    sampler = CMA(np.asarray(centre, float), 1.0, population_size=size, seed=seed, cov=np.array(covariance, float))
    z = np.empty((0, len(centre)))
    cost = np.empty(0)
    observations = list[Observation]()
    progress = list[Generation]()
    for number in range(1, generations + 1):
        sample = np.array([sampler.ask() for _ in range(size)])
        points = sample if number > 1 else np.concatenate([further_points, sample])

        def advance(done: int) -> None:
            minutes = (time.perf_counter() - start_time) / 60
            tell(progress_remark("members", number, done, len(points), minutes))  # noqa: B023

        simulate = functools.partial(simulate_members, problem, points, advance)
        generation: Observation = keep(f"generation {number}", simulate)
        z = np.concatenate([z, points])
        observations.append(generation)
        cost = np.concatenate([cost, objective(points, generation)])
        sample_cost = cost[-size:]
        finite_cost = np.where(np.isfinite(sample_cost), sample_cost, MISSING**2)
        sampler.tell(list(zip(sample, finite_cost.tolist(), strict=True)))
        failed = int(np.sum(problem.unreachable_rows(generation.status).any(-1)))
        progress.append(Generation(len(points), failed, float(cost.min()), float(np.median(sample_cost))))
        tell(progress_remark("generation", number, cost.min(), np.median(sample_cost), failed))
        population = Population(z, _join_observations(observations), cost, tuple(progress))
        if population.settled:
            break
    return population


def local_regression(
    problem: Problem, population: Population, member: int
) -> tuple[Float[np.ndarray, "readings parameters"], float]:
    """Derivative of the whitened readings with respect to z near a member, by least squares over its nearest members.

    Contacts that open or close change a run abruptly. The derivative of a run excludes these events, the regression
    includes them over the distance of the members.

    Returns:
        The derivative, shape (rows · channels, parameters), and the rms of the residuals [σ].
    """
    finite = np.isfinite(population.cost)
    z, reading = population.z[finite], population.observations.reading[finite]
    number = min(len(z), MEMBERS_EACH * (z.shape[1] + 1))
    spread = np.linalg.pinv(np.cov(z.T).reshape(z.shape[1], -1))
    offsets = z - population.z[member]
    nearest = np.argsort(np.einsum("ij,jk,ik->i", offsets, spread, offsets), kind="stable")[:number]
    scale = np.asarray(problem.data.weight / problem.data.sd)
    reading_changes = np.where(
        scale > 0, (reading[nearest] - population.observations.reading[member]) * scale, 0.0
    ).reshape(number, -1)
    design = np.column_stack([np.ones(number), offsets[nearest]])
    # A ridge of one prior sd: parameters that the members do not determine get slope zero.
    ridge = np.diag([0.0, *np.full(z.shape[1], 1e-3 * number * np.var(offsets[nearest]) + 1e-12)])
    slope = np.linalg.solve(design.T @ design + ridge, design.T @ reading_changes)
    unexplained = reading_changes - design @ slope
    return slope[1:].T, float(np.sqrt(np.mean(unexplained**2)))


def unreliable_derivatives(
    problem: Problem, z: np.ndarray, jacobian: np.ndarray, sd: np.ndarray
) -> Bool[np.ndarray, " parameters"]:
    """True for parameters whose derivatives of a run disagree with finite differences, shape (parameters,).

    Differences are central, with `STEP` of the posterior sd to either side. A derivative disagrees if the difference
    exceeds both `APART` of its size and one data sd per posterior sd.
    """
    steps = STEP * np.diag(sd)
    observation = simulate_members(problem, np.concatenate([z + steps, z - steps]))
    scale = np.asarray(problem.data.weight / problem.data.sd)
    ahead, behind = np.split(np.where(scale > 0, observation.reading * scale, 0.0), 2)
    differences = ((ahead - behind) / (2 * STEP)).reshape(len(z), -1)  # per posterior sd
    derivatives = jacobian.T * sd[:, None]
    error_norms = np.linalg.norm(derivatives - differences, axis=1)
    size = np.maximum(np.linalg.norm(differences, axis=1), np.linalg.norm(derivatives, axis=1))
    return ~np.isfinite(error_norms) | ((error_norms > APART * size) & (error_norms > 1.0))


def parameters_at_edge(coordinates: Coordinates, z: np.ndarray) -> dict[str, Remark]:
    """Parameters at a bound, or further than `EDGE` from the middle of their prior, with that distance, by name."""
    bounds = [{-1: "lower", 0: "", 1: "upper"}[int(side)] for side in coordinates.beyond(z)]
    return {
        name: Remark("edge", bound=bound, sds=float(shift))
        for name, shift, bound in zip(coordinates.names, z, bounds, strict=True)
        if bound or abs(shift) > EDGE
    }


@dataclasses.dataclass(frozen=True)
class PopulationSearch:
    """Result of a search by generations.

    Attributes:
        population: all members.
        best: index of the best member.
        unreliable: names of parameters whose derivatives of a run disagree with finite differences.
        slope: derivative of the whitened readings by regression over members, if those of a run are unreliable,
            otherwise None.
        regression_rms: rms residual of that regression [σ], NaN without one.
        edge: parameters of the best member at the edge of their range, see `parameters_at_edge`.
    """

    population: Population
    best: int
    unreliable: Names
    slope: np.ndarray | None
    regression_rms: float
    edge: dict[str, Remark] = dataclasses.field(default_factory=dict)

    def to_json(self) -> Json:
        """Entries of result.json."""
        return {
            "members": len(self.population.z),
            **entries_of(
                self,
                "settled=population.settled",
                "generations=population.generations",
                "outcomes=population.outcomes",
            ),
            "at_edge": {name: describe(position) for name, position in self.edge.items()},
            **entries_of(self, "derivatives_apart=unreliable", "regression_rms_sd=regression_rms"),
        }

    def remarks(self) -> list[Remark]:
        """Remarks on the search."""
        members, generations = len(self.population.z), len(self.population.generations)
        summary = Remark("generations", members=members, generations=generations, settled=self.population.settled)
        return [summary, *[Remark("ended_at_edge", edge=self.edge)] * bool(self.edge)]
