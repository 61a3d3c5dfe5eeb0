"""The one simulation of a log whose verdict comes from its windows: its base model and its chosen model."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Sequence
from statistics import NormalDist
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from calibration.discovery.active_set import CandidateSpace
from calibration.discovery.adequacy import Diagnosis
from calibration.discovery.candidates import Candidate, candidate_of_fit
from calibration.inference.blocks import fit_from_each_start
from calibration.inference.lack_of_fit import variance_of_sums
from calibration.inference.observers.time_histories import HistoriesLinearization
from mmrjax.compile.compiling import SELDOM, compiled
from mmrjax.model import channels

#: Most Gauss-Newton steps of a simulated model from its regression.
STEPS = 5
#: Share of what the windows promised that a simulation has to gain for the claim to stay.
CONFIRMED = 0.5


@dataclasses.dataclass(frozen=True)
class LogSimulation:
    """Simulated fits of a log without and with the effects of its verdict.

    Attributes:
        space: candidate space of the log.
        base, best: the fits. Equal without effects.
        disturbed: True if the misfit of the best fit counts as noise, see `with_misfit`.
        promised, gained: share of the misfit that the effects explain in the windows, and in the simulation.
    """

    space: CandidateSpace
    base: Candidate
    best: Candidate
    disturbed: bool
    promised: float
    gained: float

    @property
    def contradicts(self) -> bool:
        """True if the simulation gains too little of what the windows promised."""
        return not self.gained >= CONFIRMED * self.promised

    def diagnosis(self, fit: Candidate, windows: Diagnosis) -> Diagnosis:
        """Diagnosis with the residuals of a simulated fit, and scores of the windows.

        The memory of noise is a normal deviate.
        """
        problem, z, active = self.space.fit_of(fit.active, fit.z)
        observe: Any = problem.observe
        residual, jacobian, _ = observe.at(problem, z, active)
        rows, count = problem.data.weight.shape
        no_signals: Any = None
        linear = HistoriesLinearization(
            jnp.asarray(residual), jnp.asarray(jacobian), jnp.zeros((rows * count, 0)), jnp.zeros(0),
            problem.data.weight / problem.data.sd, no_signals, observe.rows_of, observe.knots, observe.time,
            jnp.zeros(rows), balances=(), channels=channels.channel_names(problem.channels),
            magnitudes=problem.base.rig.magnitudes,
        )  # fmt: skip
        test, count = windows.test, len(windows.test.null.single)
        chance = jnp.array([NormalDist().inv_cdf((k + 0.5) / count) for k in range(count)])
        null = dataclasses.replace(test.null, white=chance)
        strongest = dataclasses.replace(test.found, white=_memory(linear))
        shares = {**test.settings.shares, "white": min(test.settings.shares.values())}
        settings = dataclasses.replace(test.settings, shares=shares)
        return Diagnosis(
            linear, windows.scores, dataclasses.replace(test, found=strongest, null=null, settings=settings)
        )


def with_misfit(space: CandidateSpace, fit: Candidate) -> CandidateSpace:
    """Space whose noise includes the misfit of a simulated fit, as far as this exceeds the noise of the readings.

    An unknown disturbance of a drive is integrated, so such a misfit changes slowly. As noise of each reading it has
    the variance of sums of residuals. Otherwise the parameters would follow it, far from their priors.
    """
    problem, z, active = space.fit_of(fit.active, fit.z)
    observe: Any = problem.observe
    residual = np.asarray(observe.at(problem, z, active)[0])
    sd, weight = np.asarray(problem.data.sd), np.asarray(problem.data.weight) > 0
    by_row = residual[: sd.size].reshape(sd.shape)
    runs = [rows[rows >= 0] for rows in np.asarray(observe.rows_of)]
    variance = [
        variance_of_sums([x[rows][counts[rows]] for rows in runs])
        for x, counts in zip(by_row.T, weight.T, strict=True)
    ]
    return space if max(variance) == 1 else space.with_noise(sd * np.sqrt(variance), space.weight)


_memory = functools.partial(compiled, options=SELDOM)(HistoriesLinearization.autocorrelation)


def refine_by_simulation(space: CandidateSpace, fitted: Candidate, starts: Sequence[np.ndarray]) -> Candidate:
    """Best of the simulated fits of a set of effects from these starts, each after a few steps."""
    problem, _, active = space.fit_of(fitted.active, fitted.z)
    size, fits = len(problem.coordinates), list[Candidate]()
    for z in starts:
        sets = None if active is None else [active]
        optima, _ = fit_from_each_start(problem, [z[:size]], [space.weight], sets, STEPS)
        optimum = jax.tree.map(lambda x: x[0], optima)
        missing = len(fitted.z) - size
        z, sd = np.pad(optimum.z, (0, missing)), np.pad(optimum.sd, (0, missing), constant_values=1.0)
        fits.append(candidate_of_fit(space, fitted.active, dataclasses.replace(optimum, z=z, sd=sd)))
    return min(fits, key=lambda x: x.cost)


def simulate_models(
    space: CandidateSpace,
    base: Candidate,
    best: Candidate,
    simulated_base: Candidate | None = None,
    disturbed: bool = False,
) -> LogSimulation:
    """Simulates the base fit and the best fit of a log's linear rows, each refined by a few steps.

    Args:
        simulated_base: simulated fit of the base. Its refinement starts there too.
        disturbed: True if the misfit of the best fit may count as noise.
    """
    space = space.with_room([*space.room, *best.effects])
    starts = [] if simulated_base is None else [simulated_base.z]
    best_fit = refine_by_simulation(space, best, [best.z, *(starts if best is base else [])])
    noisy_space = with_misfit(space, best_fit) if disturbed else space
    disturbed = noisy_space is not space
    if disturbed:
        space, best_fit = noisy_space, refine_by_simulation(noisy_space, best_fit, [best_fit.z])
    without_effects = np.where(np.arange(len(best_fit.z)) < space.free, best_fit.z, 0.0)
    base_fit = best_fit if best is base else refine_by_simulation(space, base, [base.z, without_effects, *starts])
    return LogSimulation(
        space, base_fit, best_fit, disturbed, 1 - best.cost / base.cost, 1 - best_fit.cost / base_fit.cost
    )
