"""Stated values that may be wrong: base parameters with a shift that explains the data as well as an effect.

A prior is an earlier measurement, and may be wrong like any reading. The score of a shift of one prior's mean is
that of a column that is 1 in its residual. If it is large, the fit is repeated without that prior.
"""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np

from calibration.discovery.active_set import CandidateSpace
from calibration.discovery.candidates import Candidate, candidate_of_fit
from calibration.discovery.settings import Settings
from calibration.inference.held_out import search_each
from calibration.inference.linearization import Linearization

#: Refits with a prior's mean at the end of the last one, until its pull is small [prior sds].
ROUNDS, PULL = 3, 0.3


@dataclasses.dataclass(frozen=True)
class Shift:
    """A base parameter without its prior, instead of an effect.

    Attributes:
        name: dotted, of the parameter.
        index: of its coordinate.
        fit: of all other parameters. Its cost excludes the prior.
    """

    name: str
    index: int
    fit: Candidate


def prior_shift_scores(jacobian: np.ndarray, residual: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Score of a shift of the mean of each coordinate's prior [σ²], and the linear estimate of each coordinate
    without its prior [prior sds].

    Args:
        jacobian, residual: of a fit, the priors' residuals last.
    """
    half = np.linalg.solve(np.linalg.cholesky(jacobian.T @ jacobian), jacobian.T)
    prior_rows = np.arange(len(residual) - jacobian.shape[1], len(residual))
    leverage = np.sum(half[:, prior_rows] ** 2, 0)
    projected_residual = residual[prior_rows] - half[:, prior_rows].T @ (half @ residual)
    free = np.maximum(1 - leverage, 1e-9)
    is_visible = leverage < 1 - 1e-6
    return np.where(is_visible, projected_residual**2 / free, 0.0), np.where(
        is_visible, residual[prior_rows] / free, 0.0
    )


def find_prior_shifts(
    space: CandidateSpace, at: Candidate, needed: float, settings: Settings, linear: Linearization | None = None
) -> list[Shift]:
    """Base parameters that, without their prior, would explain at least `needed` σ² of a fit's discrepancy.

    Args:
        at: the fit. Its effects stay.
        linear: the same, linearised, if known.
    """
    if linear is None:
        problem, (active,) = space.fitted_by([at.active])
        residual, jacobian, _ = problem.observe.at(problem, at.z, active)
    else:
        residual, jacobian = linear.residual, linear.jacobian
    explained, values = prior_shift_scores(np.asarray(jacobian), np.asarray(residual))
    shifts = []
    for k in np.argsort(-explained[: space.free]):
        if explained[k] < needed:
            break
        fit = _without_prior(space, at, int(k), float(values[k]), settings)
        if fit is not None:
            shifts.append(Shift(space.coordinates.base.names[k], int(k), fit))
    return shifts


def _without_prior(
    space: CandidateSpace, at: Candidate, k: int, value: float, settings: Settings
) -> Candidate | None:
    """Fit without the prior of coordinate k: the prior's mean is moved to the data's estimate.

    None if that is beyond the parameter's bounds, or without an optimum.
    """
    p, mean, start = space.free, value, np.array(at.z)
    equipped, (indices,) = space.fitted_by([at.active])
    for _ in range(ROUNDS):
        centre = np.zeros(len(start))
        centre[k] = mean
        start[k] = mean
        data = dataclasses.replace(equipped.data, centre=jnp.asarray(centre))
        problem = dataclasses.replace(equipped, data=data)
        optima, _ = search_each(problem, [start], [space.weight], [indices])
        best = jax.tree.map(lambda x: x[0], optima)
        z = np.asarray(best.z)
        if not np.isfinite(best.cost):
            return None
        if abs(z[k] - mean) < PULL:
            break
        mean, start = float(z[k]), z.copy()
    if space.coordinates.base.beyond(z[:p])[k]:
        return None
    return candidate_of_fit(space, at.active, best, settings)
