"""A calibration from table to result: noise, starts, optimum, what is known of it, errors seen and unseen."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from calibration.data.runs import Runs
from calibration.inference import blocks as holdout
from calibration.inference import checks, identifiability, priors, problem
from calibration.inference import noise as noise_room
from calibration.inference import optimizers as fit
from calibration.inference.identifiability import Identifiability, Profile
from calibration.inference.noise import Noise
from calibration.inference.problem import Data, Problem
from mmrjax.robot import Robot

#: Costs closer than this to the best [½σ²] are the same optimum.
AGREE = 1e-3
#: Rounds of fitting and estimating the noise, and the change of a share at which they end.
ROUNDS, SETTLED_SHARE = 30, 1e-3


class Effort(NamedTuple):
    """What a calibration does where it is not told: searches, profiles, and fits without each block."""

    starts: int
    profiles: bool
    blocks: bool


#: By fidelity. A profile is some twenty refits a parameter, and blocks are a dozen: seconds with `steady`, many
#: minutes of rollouts.
EFFORT = {"steady": Effort(64, True, True), "drive": Effort(1, False, False), "track": Effort(1, False, False)}
#: Searches for histories, which have no optimum of `steady` to begin from.
STARTS_SERIES = 8
#: Draws among which the starts of a rollout's searches are chosen.
DRAWS = 2000
#: Tightenings of the penalty on adhesion, tenfold each.
TIGHTENINGS = 3


@dataclasses.dataclass(frozen=True)
class Starts:
    """Where searches from many points ended.

    Attributes:
        z, cost: of each search, shapes (starts, parameters), (starts,).
        converged: of each.
        infeasible: starts at which some row slides or fails.
    """

    z: np.ndarray
    cost: np.ndarray
    converged: np.ndarray
    infeasible: int

    @property
    def agree(self) -> int:
        """How many converged searches ended at the best optimum."""
        return int(np.sum(self.converged & (self.cost < self.cost.min() + AGREE * (1 + self.cost.min()))))

    def statement(self) -> str:
        """Whether the starts agree, as a sentence."""
        n = len(self.cost)
        if n == 1:
            return "one search" if self.converged[0] else "one search, which did not converge"
        if self.agree == n:
            return f"all {n} starts end at the same optimum"
        other = self.converged & (self.cost >= self.cost.min() + AGREE * (1 + self.cost.min()))
        parts = [f"{self.agree} of {n} starts end at the best optimum"]
        if other.any():
            best = self.cost[other].min()
            parts.append(f"{other.sum()} at others (the next costs {best - self.cost.min():.3g} more)")
        if not self.converged.all():
            parts.append(f"{np.sum(~self.converged)} did not converge")
        return ", ".join(parts)


@dataclasses.dataclass(frozen=True)
class Calibration:
    """All that a calibration found.

    Attributes:
        runs, base, model, seed: what it was asked to fit.
        problem: with the noise it ended with.
        noise: where the sds come from; shares: sd over reading of each estimated channel, else NaN.
        z: the optimum; cost: its objective; converged: whether it is one.
        starts, identifiability, profile: see there; profile is None if not asked for.
        before, after: readings of `base` and of the fitted robot, NaN where it does not reach a row.
        status_before, status_after: of each row; adhesion_used: of the fitted robot, by row.
        held_out: by kind of block.
        notes: sentences worth saying.
        beside: optimum of the same problem with `steady`, where the search began there; else None.
    """

    runs: Runs
    base: Robot
    model: str
    seed: int
    problem: Problem
    noise: Noise
    shares: np.ndarray
    z: np.ndarray
    cost: float
    converged: bool
    starts: Starts
    identifiability: Identifiability
    profile: Profile | None
    before: np.ndarray
    after: np.ndarray
    status_before: np.ndarray
    status_after: np.ndarray
    adhesion_used: np.ndarray
    held_out: dict[str, holdout.HeldOut]
    notes: tuple[str, ...]
    beside: np.ndarray | None = None

    @property
    def robot(self) -> Robot:
        """The calibrated robot."""
        return self.problem.robot(jnp.asarray(self.z))

    @property
    def sd(self) -> np.ndarray:
        """Sd of each reading [A, rad/s, m/s], shape (rows, 3)."""
        return np.asarray(self.problem.data.sd)


def calibrate(
    runs: Runs,
    base: Robot,
    *,
    free: Sequence[str] = (),
    fix: Sequence[str] = (),
    stated: dict[str, tuple[float, float]] | None = None,
    noise: str | None = None,
    model: str = "steady",
    starts: int | None = None,
    seed: int = 0,
    profiles: bool | None = None,
    blocks: Sequence[str] | None = None,
    tell: Callable[[str], None] = lambda sentence: None,
) -> Calibration:
    """Calibrate `base` to measured runs.

    Args:
        runs: rows of steady runs, or of time histories.
        base: its values are the prior means.
        free, fix: parameter names, see `priors.choose`; stated: priors in place of the fields'.
        noise: as `noise.parse`; None takes the file's sd columns, or estimates.
        model: a fidelity of `problem.FIDELITIES`.
        starts: the prior mean and `starts - 1` draws from the prior; for steady rows with `drive` or `track` the
            optimum of `steady` and draws from its posterior.
        profiles: whether to profile every parameter.
        blocks: kinds of blocks to hold out. These three by default as `EFFORT` says.
        tell: is given a sentence now and then while a long calibration goes on.

    Raises:
        BadData, BadConfiguration: see `checks`, `priors`, `noise`, `problem`.
    """
    problem.fidelity(model)
    effort = EFFORT[model]
    if starts is None:
        starts = STARTS_SERIES if problem.is_series(runs) else effort.starts
    profiles = effort.profiles if profiles is None else profiles
    blocks = tuple(holdout.BLOCKS if effort.blocks else ()) if blocks is None else blocks
    names = priors.choose(base, priors.default_names(runs["configuration"], base, model), free, fix)
    known: dict[str, tuple[float, float]] = {}
    if model == "track" and "6T2A" in runs["configuration"]:
        base, known = priors.guided(base)
    known = {name: prior for name, prior in known.items() if name in names and name not in (stated or {})}
    coordinates = priors.coordinates(base, names, {**known, **(stated or {})})
    coordinates = dataclasses.replace(coordinates, stated=tuple(stated or ()))
    known_noise = noise_room.of(runs, noise)
    notes = checks.check(runs, names, known_noise)
    notes += [
        f"{name}: its prior, {mean:.3g} ± {sd:.2g}, is that of its product with the share of the guides in the other "
        f"fidelities; the track model puts {priors.GUIDED:.0%} of the weight on them"
        for name, (mean, sd) in known.items()
    ]
    posed = problem.build(runs, base, coordinates, known_noise.sd, model)

    rng = np.random.default_rng(seed)
    points = np.concatenate([np.zeros((1, len(names))), rng.standard_normal((max(starts, 1) - 1, len(names)))])
    beside, shares = None, np.where(known_noise.estimated, noise_room.START, np.nan)
    if posed.long and not problem.is_series(runs):
        tell("the same with steady first, to begin from its optimum")
        draws = rng.standard_normal((EFFORT["steady"].starts, len(names)))
        draws[0] = 0.0
        easy, _, optimum, shares = _search(problem.build(runs, base, coordinates, known_noise.sd), known_noise, draws)
        points[0] = beside = np.asarray(optimum.z)
        points[1:] = _nearby(easy, beside, rng, len(points) - 1)
        posed = dataclasses.replace(posed, data=easy.data)
    if posed.long:
        posed, found, best, shares = _search_long(posed, known_noise, points, shares, tell)
    else:
        posed, found, best, shares = _search(posed, known_noise, points)
    z = np.asarray(best.z)
    after, before = fit.observation(posed, jnp.asarray(z)), fit.read(posed, posed.base)
    status_after, status_before = np.asarray(after.status), np.asarray(before.status)
    slides = posed.unreachable(status_after)
    if slides.any():
        robot = posed.robot(jnp.asarray(z))
        adhesion = {c: float(getattr(robot, c).ground.friction.static) for c in priors.FRICTION}
        raise checks.infeasible(runs, slides, names, adhesion)

    if posed.long:
        doing = ["the linear analysis", *["profiles"] * profiles, *["blocks held out"] * bool(blocks)]
        tell(f"optimum found; now {', '.join(doing)}")
    if model == "track":
        notes += checks.too_stiff(runs, posed.robot(jnp.asarray(z)))
    if model == "drive" and not problem.is_series(runs):
        notes += checks.from_standstill(runs, posed.robot(jnp.asarray(z)))
    about = identifiability.analyse(posed, jnp.asarray(z))
    profile = identifiability.profile(posed, jnp.asarray(z), float(best.cost), about) if profiles else None
    masks = {kind: holdout.blocks(runs, kind) for kind in blocks}
    return Calibration(
        runs=runs,
        base=base,
        model=model,
        seed=seed,
        problem=posed,
        noise=known_noise,
        shares=shares,
        z=z,
        cost=float(best.cost),
        converged=bool(best.converged),
        starts=found,
        identifiability=about,
        profile=profile,
        before=np.where(posed.unreachable(status_before)[:, None], np.nan, before.reading),
        after=np.asarray(after.reading),
        status_before=status_before,
        status_after=status_after,
        adhesion_used=np.asarray(after.adhesion_used),
        held_out=holdout.held_out(posed, jnp.asarray(z), masks),
        notes=(*notes, *checks.unmeasured(names, about.sensitivity).values()),
        beside=beside,
    )


def _search(posed: Problem, noise: Noise, points: np.ndarray) -> tuple[Problem, Starts, fit.Optimum, np.ndarray]:
    """Search from all points; where the noise is not known, estimate it and search again until it settles.

    The best optimum so far starts beside the points, so that every round is the same compiled batch.

    Returns:
        The problem with the noise (and stiffness) it ended with, the searches, the best of them, and each
        channel's estimated share of the reading (NaN where the sd was known).
    """
    z = points[0]
    shares = np.where(noise.estimated, noise_room.START, np.nan)
    for _ in range(ROUNDS):
        posed, found, feasible = _tighten(posed, np.concatenate([points, z[None]]))
        best = jax.tree.map(lambda x: x[int(np.nanargmin(found.cost))], found)  # noqa: B023
        z = np.asarray(best.z)
        if not noise.estimated.any():
            break
        new = _shares(posed, noise, z)
        change = np.nanmax(np.abs(new / shares - 1))
        if change < SETTLED_SHARE:
            break
        shares = new
        posed = _noisier(posed, noise, shares)
    return posed, _ended(jax.tree.map(lambda x: x[:-1], found), feasible[:-1]), best, shares


def _nearby(easy: Problem, z: np.ndarray, rng: np.random.Generator, count: int) -> np.ndarray:
    """Draws from the posterior of `steady` at its optimum z, for a rollout's searches to begin at: such at which
    no row slides and no friction law is steeper at rest than the base's, or the nearest to that.

    Draws from the prior would take hundreds of rollouts along the limit of adhesion to come back from; whether
    the problem has several optima is what the many starts of `steady` say.
    """
    spread = np.linalg.cholesky(identifiability.analyse(easy, jnp.asarray(z)).covariance)
    draws = z + rng.standard_normal((DRAWS, len(z))) @ spread.T

    def steepness(robot: Robot) -> jax.Array:
        laws = [chassis.ground.friction for chassis in (robot.configurations["6T2A"], robot.configurations["4W2T"])]
        return jnp.stack([law.static / law.speed_static for law in laws])

    def seen(z: jax.Array) -> tuple[jax.Array, jax.Array]:
        return easy.observation(z).status, steepness(easy.robot(z)) > 1.001 * steepness(easy.base)

    status, steep = jax.jit(jax.vmap(seen))(jnp.asarray(draws))
    lost = easy.unreachable(np.asarray(status)).sum(1) + np.asarray(steep).sum(1)
    return draws[np.argsort(lost, kind="stable")[:count]]


def _ended(found: fit.Optimum, feasible: np.ndarray) -> Starts:
    cost = np.where(np.isfinite(found.cost), found.cost, np.inf)
    return Starts(np.asarray(found.z), cost, np.asarray(found.converged), int(np.sum(~feasible)))


def _search_long(
    posed: Problem, noise: Noise, points: np.ndarray, shares: np.ndarray, tell: Callable[[str], None]
) -> tuple[Problem, Starts, fit.Optimum, np.ndarray]:
    """As `_search`, one search at a time: the noise settles on the first point's optimum, then the others
    start once each. One that ends lower takes its place, and the noise settles again.

    Args:
        posed: with the noise to begin from; shares: of the reading, that it has.
    """
    begun = time.perf_counter()

    def clock() -> str:
        return f"{(time.perf_counter() - begun) / 60:.1f} min"

    def search(posed: Problem, points: np.ndarray, data: Data) -> tuple[fit.Optimum, np.ndarray, np.ndarray]:
        whole = fit.search_long(posed, jnp.asarray(points[0]), data, tell=lambda said: tell(f"  {said}, {clock()}"))
        found, start, end = jax.tree.map(lambda x: jnp.asarray(x)[None], whole)
        return found, start.status, end.status

    first = points[0]
    for _ in range(len(points)):
        z = first
        for round_ in range(1, ROUNDS + 1):
            posed, found, feasible = _tighten(posed, z[None], search)
            z = np.asarray(found.z[0])
            tell(f"round {round_}: objective {found.cost[0]:.4f} after {found.steps[0]} steps, {clock()}")
            if not noise.estimated.any():
                break
            new = _shares(posed, noise, z)
            change = np.nanmax(np.abs(new / shares - 1))
            if change < SETTLED_SHARE:
                break
            shares = new
            posed = _noisier(posed, noise, shares)
        ends, feasibles = [found], [feasible]
        for k, point in enumerate(points[1:], 2):
            end, status, _ = search(posed, point[None], posed.data)
            ends.append(end)
            feasibles.append(~posed.unreachable(np.asarray(status)).any(1))
            tell(f"start {k} of {len(points)}: objective {end.cost[0]:.4f} after {end.steps[0]} steps, {clock()}")
        found = jax.tree.map(lambda *x: jnp.concatenate(x), *ends)
        k = int(np.nanargmin(found.cost))
        if not found.cost[k] < found.cost[0] - AGREE * (1 + found.cost[0]):
            k = 0
            break
        first = np.asarray(found.z[k])
    best = jax.tree.map(lambda x: x[k], found)
    return posed, _ended(found, np.concatenate(feasibles)), best, shares


def _noisier(posed: Problem, noise: Noise, shares: np.ndarray) -> Problem:
    sd = np.where(noise.estimated, noise.sd / noise_room.START * shares, noise.sd)
    return dataclasses.replace(posed, data=dataclasses.replace(posed.data, sd=jnp.asarray(sd)))


def _tighten(
    posed: Problem, points: np.ndarray, search: Callable[..., Any] = fit.searches
) -> tuple[Problem, fit.Optimum, np.ndarray]:
    """Search from all points, with the penalty on adhesion stiffer until no row slides at the best.

    Returns:
        The problem, the searches, and whether each start was feasible.
    """
    for _ in range(TIGHTENINGS + 1):
        found, status_start, status_end = search(posed, jnp.asarray(points), posed.data)
        k = int(np.nanargmin(found.cost))
        if not posed.unreachable(np.asarray(status_end)[k]).any():
            break
        data = dataclasses.replace(posed.data, stiffness=posed.data.stiffness / 10)
        posed = dataclasses.replace(posed, data=data)
    return posed, found, ~posed.unreachable(np.asarray(status_start)).any(1)


def _shares(posed: Problem, noise: Noise, z: np.ndarray) -> np.ndarray:
    """Sd over reading of each channel from the misfit, degrees of freedom taken off; NaN where known.

    s² = Σ (error / reading)² / (rows - Σ leverage). It holds model error as well as noise, so a fit with
    it can't be tested for adequacy.
    """
    data = posed.data
    unit = noise.sd / noise_room.START  # the reading that an estimated share is of
    error = np.asarray(fit.observation(posed, jnp.asarray(z)).reading - data.measured) / unit
    leverage = identifiability.analyse(posed, jnp.asarray(z)).leverage
    left = np.maximum(len(error) - leverage.sum(0), 1.0)
    shares = np.maximum(np.sqrt(np.sum(error**2, 0) / left), noise_room.FLOOR)
    return np.where(noise.estimated, shares, np.nan)
