"""A calibration from table to result: noise, starts, optimum, what is known of it, errors seen and unseen."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np

from calibration import checks, fit, holdout, identifiability, priors, problem
from calibration import noise as noise_room
from calibration.identifiability import Identifiability, Profile
from calibration.noise import Noise
from calibration.problem import Problem
from calibration.records import Runs
from mmrjax.robot import Robot

#: Costs closer than this to the best [½σ²] are the same optimum.
AGREE = 1e-3
#: Rounds of fitting and estimating the noise, and the change of a share at which they end.
ROUNDS, SETTLED_SHARE = 30, 1e-3
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
    starts: int = 64,
    seed: int = 0,
    profiles: bool = True,
    blocks: Sequence[str] = tuple(holdout.BLOCKS),
) -> Calibration:
    """Calibrate `base` to measured runs.

    Args:
        runs: rows of steady runs, or of time histories.
        base: its values are the prior means.
        free, fix: parameter names, see `priors.choose`; stated: priors in place of the fields'.
        noise: as `noise.parse`; None takes the file's sd columns, or estimates.
        model: a fidelity of `problem.FIDELITIES`.
        starts: the prior mean and `starts - 1` draws from the prior.
        profiles: whether to profile every parameter.
        blocks: kinds of blocks to hold out.

    Raises:
        BadData, BadConfiguration: see `checks`, `priors`, `noise`, `problem`.
    """
    problem.fidelity(model)
    names = priors.choose(base, priors.default_names(runs["configuration"], base), free, fix)
    coordinates = priors.coordinates(base, names, stated)
    known_noise = noise_room.of(runs, noise)
    notes = checks.check(runs, names, known_noise)
    posed = problem.build(runs, base, coordinates, known_noise.sd, model)

    rng = np.random.default_rng(seed)
    points = np.concatenate([np.zeros((1, len(names))), rng.standard_normal((max(starts, 1) - 1, len(names)))])
    posed, found, best, shares = _search(posed, known_noise, points)
    z = np.asarray(best.z)
    after, before = fit.read(posed, posed.robot(jnp.asarray(z))), fit.read(posed, base)
    status_after, status_before = np.asarray(after.status), np.asarray(before.status)
    slides = posed.unreachable(status_after)
    if slides.any():
        robot = posed.robot(jnp.asarray(z))
        adhesion = {c: float(getattr(robot, c).ground.friction.static) for c in priors.FRICTION}
        raise checks.infeasible(runs, slides, names, adhesion)

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
        sd = np.where(noise.estimated, noise.sd / noise_room.START * shares, noise.sd)
        data = dataclasses.replace(posed.data, sd=jnp.asarray(sd))
        posed = dataclasses.replace(posed, data=data)
    cost = np.where(np.isfinite(found.cost), found.cost, np.inf)[:-1]
    ended = Starts(np.asarray(found.z)[:-1], cost, np.asarray(found.converged)[:-1], int(np.sum(~feasible[:-1])))
    return posed, ended, best, shares


def _tighten(posed: Problem, points: np.ndarray) -> tuple[Problem, fit.Optimum, np.ndarray]:
    """Search from all points, with the penalty on adhesion stiffer until no row slides at the best.

    Returns:
        The problem, the searches, and whether each start was feasible.
    """
    for _ in range(TIGHTENINGS + 1):
        found, status_start, status_end = fit.searches(posed, jnp.asarray(points), posed.data)
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
    error = np.asarray(fit.read(posed, posed.robot(jnp.asarray(z))).reading - data.measured) / unit
    leverage = identifiability.analyse(posed, jnp.asarray(z)).leverage
    left = np.maximum(len(error) - leverage.sum(0), 1.0)
    shares = np.maximum(np.sqrt(np.sum(error**2, 0) / left), noise_room.FLOOR)
    return np.where(noise.estimated, shares, np.nan)
