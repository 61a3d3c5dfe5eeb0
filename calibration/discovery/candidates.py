"""Candidates: sets of effects, fitted together with the base."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from calibration.data import Names
from calibration.data.input_errors import BadData
from calibration.data.runs import Runs
from calibration.discovery.active_set import CandidateSpace
from calibration.discovery.score_tests import ScoreTable
from calibration.discovery.settings import Settings
from calibration.inference import scans
from calibration.inference.blocks import fit_from_each_start
from calibration.inference.lack_of_fit import Residuals
from calibration.inference.linearization import Linearization, amplitude_of
from calibration.inference.observers import Observer
from calibration.inference.optimizers import Optimum, observe_at
from calibration.inference.problem import Observation
from mmrjax.compile.compiling import SELDOM, compiled
from mmrjax.model.energy import sink_powers
from mmrjax.model.robot import Robot
from mmrjax.model.signals import SLIDES

# --- power balance of a fit: an effect may be negative if its whole balance dissipates ------------


#: The sink of `energy.SINKS` that contains the whole power of a balance.
SINK = {
    "supply": "driver", "electrical": "winding", "motor": "motor", "gearbox": "gearbox", "track": "track",
    "ground": "rolling", "slip": "sliding",
}  # fmt: skip
#: Rounding error of a power, as a share of the largest in its balance.
ROUNDING = 1e-9


def supplying_effects(space: CandidateSpace, active: Sequence[str], amplitude: np.ndarray, z: np.ndarray) -> Names:
    """Names of dissipative effects with a negative amplitude for which a balance would supply power in an included
    row.

    A negative amplitude only corrects the law of its balance, as long as the balance as a whole dissipates. Time
    histories and turns have no operating point for each row, so there the sign of the term decides.

    Args:
        active: name of the effect in each slot.
        amplitude: amplitude in each slot.
        z: coordinates of the fit.
    """
    negative = [n for n, a in zip(active, amplitude, strict=True) if n and a <= 0 and space.library[n].dissipative]
    if not negative or space.bare.observe.long:
        return tuple(negative)
    power = _dissipated_power(space.bare.observe, space.problem(active).robot(jnp.asarray(z)))
    by_balance = {} if power is None else dict(zip(SINK, np.asarray(power)[:, space.included], strict=True))
    known_power = {b: x[np.isfinite(x)] for b, x in by_balance.items() if np.isfinite(x).any()}
    dissipates = {b for b, x in known_power.items() if x.min() >= -ROUNDING * np.abs(x).max()}
    return tuple(n for n in negative if space.library[n].balance not in dissipates)


@functools.partial(compiled, options=SELDOM)
def _dissipated_power(observe: Observer, robot: Robot) -> Float[Array, "balances rows"] | None:
    """Power that each balance of `SINK` dissipates in each row [W], None if rows have no operating point."""
    signals = observe.operating_points(robot)
    if signals is None:
        return None
    power = jax.vmap(lambda run, point: sink_powers(robot, run, point))(observe.conditions, signals)
    return jnp.stack([jnp.asarray(power[name], float) for name in SINK.values()])


# --- candidates -----------------------------------------------------------------------------------


#: Prior sds above its mean up to which an adhesion is plausible.
ADHESION = 2.5
#: Fewest rows for a fit of the base.
FEWEST = 4
#: Difference of the objective between searches that end in the same place [½σ²].
ALIKE = 1e-9
#: Distance of a regression from the prior above which a search begins at the prior mean too [prior sd].
UNLIKELY = 4.0
#: Rise of the objective above which a fit with more effects is worse than without [½σ²].
STUCK = 0.1


@dataclasses.dataclass(frozen=True)
class Candidate:
    """Fit of the base together with a set of effects.

    Attributes:
        active: name of the effect in each slot, "" if empty.
        z: coordinates of the fit, see `ActiveSet`.
        sd: posterior standard deviation of each coordinate.
        cost: objective of the fit [½σ²].
        amplitude: amplitude in prior sds of each slot's effect (0 if empty).
        size: amplitude of each slot, relative to the largest plausible one of its sign [-]. 0 if the slot is empty.
        plausible: True if each amplitude has a plausible size, is not at a bound, and has a physically possible sign.
        nearly: True if it would be plausible with `settings.stretched` times larger amplitudes.
        converged: True if the fit is an optimum.
        supplying: effects that would make a balance supply power.
        simulated: True for a fit of the model, False for a regression (`screening`).
    """

    active: Names
    z: np.ndarray
    sd: np.ndarray
    cost: float
    amplitude: np.ndarray
    size: np.ndarray
    plausible: bool
    nearly: bool
    converged: bool
    supplying: Names = ()
    simulated: bool = True

    @property
    def effects(self) -> Names:
        """Names of the effects in its slots."""
        return tuple(name for name in self.active if name)

    @property
    def key(self) -> frozenset[str]:
        """Set of its effects, which identifies the candidate."""
        return frozenset(self.effects)

    def with_effect(self, replaced: str, effect: str) -> Names:
        """Its slots with one effect, or the first empty slot (""), replaced by another effect."""
        k = self.active.index(replaced)
        return (*self.active[:k], effect, *self.active[k + 1 :])


def fill_slots(effects: Sequence[str], settings: Settings) -> Names:
    """Slots with these effects first, and empty slots ("") after them."""
    return (*effects, *("",) * (settings.slots - len(effects)))


def candidate_of_fit(space: CandidateSpace, active: Names, best: Optimum) -> Candidate:
    """Candidate with the result of a fit and the plausibility of its amplitudes."""
    settings, filled = space.settings, np.array([bool(name) for name in active])
    amplitude, spread = (
        np.where(filled, settings.width * np.asarray(space.coordinates.parts(x)[1]), 0.0) for x in (best.z, best.sd)
    )

    def relative_to_plausible(name: str, amplitude: float) -> float:
        """Amplitude [prior sds] relative to the largest plausible one of its sign. 0 for an empty slot."""
        if not name:
            return 0.0
        spec = amplitude_of(space.library[name]).spec
        bound = max(spec.bounds[1] if amplitude > 0 else -spec.bounds[0], 0.0) / spec.prior_sd(0.0)
        return abs(amplitude) / max(min(settings.plausible, bound), 1e-9)

    size, relative_sd = (np.array(list(map(relative_to_plausible, active, x))) for x in (amplitude, spread))
    cost = float(best.cost) if np.isfinite(best.cost) else np.inf
    z, sd = np.asarray(best.z), np.asarray(best.sd)
    supplies = supplying_effects(space, active, amplitude, z) if np.isfinite(cost) else ()
    # The bound determines an amplitude within an sd of it, unless the sd is a quarter of the plausible range or more.
    plausible = bool(np.all(size + np.where(relative_sd < 0.25, relative_sd, 0.0) < 1.0)) and not supplies
    nearly = bool(np.all(size < settings.stretched)) and not supplies
    return Candidate(active, z, sd, cost, amplitude, size, plausible, nearly, bool(best.converged), supplies)


@dataclasses.dataclass(frozen=True)
class BaseFit:
    """Fit of the base without any effects.

    Attributes:
        candidate: candidate without effects.
        reading: simulated reading of each row [SI], shape (rows, channels).
        space: candidate space without the rows in `unusable`.
        unusable: indices of rows that the robot cannot reach at any plausible parameters.
    """

    candidate: Candidate
    reading: np.ndarray
    space: CandidateSpace
    unusable: tuple[int, ...]


def with_slots(best: Optimum, space: CandidateSpace) -> Optimum:
    """Optimum of the base with the coordinates of empty slots."""
    empty = np.zeros(2 * space.settings.slots)
    z, sd = np.append(best.z[: space.free], empty), np.append(best.sd[: space.free], empty + 1)
    fit: dict[str, Any] = {"z": z, "sd": sd}
    return dataclasses.replace(best, **fit)


def fit_base(space: CandidateSpace, source: str, near: Candidate | None = None) -> BaseFit:
    """Fits the base without effects, from its prior mean and from random draws of its prior.

    If the robot cannot reach some rows at all, they are excluded and the fit is repeated.

    Args:
        source: first words of the error message.
        near: fit of the same runs with other weights, or by regression. For long runs it is the only start,
            unless a regression ends `UNLIKELY` far from its prior.

    Raises:
        BadData: too few rows remain.
    """
    unusable_rows = _beyond_adhesion(space)
    unusable = tuple(map(int, np.flatnonzero(unusable_rows)))
    space = space.without(unusable_rows) if unusable else space
    while True:
        optima, observations = _best_starts(space, near)
        # The first of those that end in one place, because rounding decides which of them is the lowest.
        cost = np.where(np.isfinite(optima.cost), optima.cost, np.inf)
        k = int(np.argmax(cost <= np.min(cost) + ALIKE))
        unusable_rows = space.bare.observe.unreachable(np.asarray(observations.status[k])) & space.included
        if not unusable_rows.any():
            best = jax.tree.map(lambda x: x[k], optima)  # noqa: B023
            fit = candidate_of_fit(space, fill_slots((), space.settings), with_slots(best, space))
            return BaseFit(fit, np.asarray(observations.reading[k]), space, unusable)
        unusable = tuple(sorted({*unusable, *map(int, np.flatnonzero(unusable_rows))}))
        space = space.without(unusable_rows)
        if space.included.sum() < FEWEST:
            rows = ", ".join(str(r + 1) for r in unusable[:12])
            raise BadData(f"{source}: too few rows for a search, since the model has no result in rows {rows}")


def _beyond_adhesion(space: CandidateSpace) -> np.ndarray:
    """True for rows in which the robot slides even at the largest plausible adhesion, shape (rows,).

    If they stayed, the fit would raise the adhesion, and distort all other parameters, until the robot grips in them.
    """
    problem = space.bare
    if problem.observe.over_time:
        return np.zeros(len(space.included), bool)
    ground = [name.endswith("ground.friction.static") for name in problem.coordinates.names]
    observation = observe_at(problem, jnp.where(jnp.asarray(ground), ADHESION, 0.0))
    return (np.asarray(observation.status) == SLIDES) & space.included


def _best_starts(space: CandidateSpace, near: Candidate | None) -> tuple[Optimum, Observation]:
    """Best fit of the base from several starts that the data suggest, and the simulated observation there.

    A search from a regression that does not converge is repeated from the prior mean.
    """
    observe, bare, regression = space.bare.observe, space.bare, False
    if near is not None and observe.long:
        starts, regression = near.z[None, : space.free], not near.simulated
        if regression:
            mean = [np.zeros(space.free)] * bool(np.abs(starts).max() > UNLIKELY)
            starts = scans.place_at_minimum(bare, np.stack([*starts, *mean]))
    else:
        starts = observe.starts(bare, np.random.default_rng(space.settings.seed), observe.policy.searches)
    rivals = regression or near is None or not observe.long  # a fit of the same runs has scanned them

    def search(starts: np.ndarray) -> tuple[Optimum, Observation]:
        weights = jnp.asarray(np.repeat(space.weight[None], len(starts), 0))
        return jax.device_get(observe.search(bare, jnp.asarray(starts), weights, rivals=rivals))

    optima = search(starts)
    if regression and len(starts) == 1 and not np.all(optima[0].converged):
        from_mean = search(scans.place_at_minimum(bare, np.zeros((1, space.free))))
        optima = jax.tree.map(lambda *x: np.concatenate(x), optima, from_mean)
    return optima


Proposal = tuple[Names, np.ndarray]


def fit_candidates(space: CandidateSpace, proposals: Sequence[Proposal]) -> list[Candidate]:
    """Fits each set of effects from its start."""
    if not proposals:
        return []
    problem, active = space.problem_for_sets(names for names, _ in proposals)
    optima, _ = fit_from_each_start(problem, [z for _, z in proposals], [space.weight] * len(proposals), active)
    return [
        candidate_of_fit(space, names, jax.tree.map(lambda x: x[k], optima))  # noqa: B023
        for k, (names, _) in enumerate(proposals)
    ]


def fit_in_addition(
    space: CandidateSpace, extensions: Sequence[tuple[Names, Candidate, ScoreTable]]
) -> list[Candidate]:
    """Fits effects in addition to those of a previous fit. Their scores give the start.

    A result that is worse than the previous fit started where no solution exists. It is repeated from the previous
    fit. The best result is also fitted from the prior mean, because without the effect the search may have gone
    astray.

    Args:
        extensions: (active effects, previous fit, scores of its residuals). The active effects include those of the
            previous fit.
    """
    fits = fit_candidates(
        space, [(active, start_of_fit(space, base_fit, active, scores)) for active, base_fit, scores in extensions]
    )
    stuck = [k for k, (_, base_fit, _) in enumerate(extensions) if not fits[k].cost <= base_fit.cost + STUCK]
    restarts = [(k, start_of_fit(space, extensions[k][1], extensions[k][0])) for k in stuck]
    for k in sorted(range(len(fits)), key=lambda k: fits[k].cost)[:1]:
        restarts.append((k, np.where(np.arange(len(fits[k].z)) < space.free, 0.0, fits[k].z)))
    refits = fit_candidates(space, [(extensions[k][0], z) for k, z in restarts])
    for (k, _), refit in zip(restarts, refits, strict=True):
        fits[k] = refit if refit.cost < fits[k].cost - STUCK else fits[k]
    return fits


def start_of_fit(
    space: CandidateSpace,
    previous: Candidate,
    active: Names,
    scores: ScoreTable | None = None,
) -> np.ndarray:
    """Start of a fit of `active`: coordinates of another fit, with each new effect at the amplitude that its score
    estimates.
    """
    p, s = space.free, space.settings.slots
    z = np.zeros(p + 2 * s)
    z[:p] = previous.z[:p]
    for slot, name in enumerate(active):
        if name and name in previous.active:
            old_slot = previous.active.index(name)
            z[p + slot], z[p + s + slot] = previous.z[p + old_slot], previous.z[p + s + old_slot]
        elif name and scores is not None:
            instance = space.library.best_instance(name, np.asarray(scores.single))
            z[p + slot] = np.clip(float(scores.amplitude[instance]) / space.settings.width, -1.5, 1.5)
            z[p + s + slot] = space.library.at[instance]
    return z


def residuals_by_channel(
    space: CandidateSpace, runs: Runs, linear: Linearization, reading: np.ndarray, z: np.ndarray
) -> Residuals:
    """Residuals of a fit, with their statistics, by channel.

    Args:
        linear: linearization of the fit at z.
        reading: simulated reading of each row [SI], shape (rows or more, channels).
    """
    rows, count = len(runs), len(runs.channels)
    counts = (space.weight[:rows] > 0) & np.isfinite(reading[:rows])
    jacobian = np.asarray(linear.jacobian)[: rows * count, : len(z)]
    whitened = np.where(counts, np.asarray(linear.by_row())[:rows], 0.0)
    return Residuals(
        type(space.bare.observe), runs, reading[:rows], whitened, counts, jacobian, z[: jacobian.shape[1]]
    )


def excess_misfit(space: CandidateSpace, base: Candidate) -> float:
    """χ² of the base fit, including priors, minus its expectation from noise (`Observer.noise_misfit`) [σ²]."""
    counts = np.asarray(space.weight > 0)

    def whitened() -> np.ndarray:  # residuals divided by their sds, 0 for excluded readings
        data = space.equipped.data
        errors = (simulated_reading(space, base) - np.asarray(data.measured)) / np.asarray(data.sd)
        return np.where(counts, np.nan_to_num(errors), 0.0)

    return 2 * base.cost - space.bare.observe.noise_misfit(whitened, counts)


def share_of_excess(excess: float, explained: float) -> float:
    """Share of the excess misfit that is explained, at most 1 [-].

    If the stated noise is too large, the excess is smaller than the decrease of χ².

    Args:
        excess: excess misfit, see `excess_misfit` [σ²].
        explained: decrease of χ² [σ²].
    """
    return float(explained / max(excess, explained, 1e-300))


def simulated_reading(space: CandidateSpace, candidate: Candidate) -> np.ndarray:
    """Readings of a candidate [SI], shape (rows, channels)."""
    problem, z, active = space.fit_of(candidate.active, candidate.z)
    return np.asarray(problem.observe.observation_at(problem, z, active).reading)
