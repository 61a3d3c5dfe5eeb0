"""Information of data and priors on each parameter: covariance, rank and profile likelihoods."""

from __future__ import annotations

import dataclasses
from collections.abc import Collection

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from calibration.data import Names
from calibration.data.posterior_file import LOG, NORMAL, Posterior
from calibration.inference import optimizers
from calibration.inference.fit_notes import DependentPair
from calibration.inference.priors import SOFTNESS, Coordinates
from calibration.inference.problem import Problem
from mmrjax.compile.compiling import compiled

#: Two-sided 95 % of the standard normal distribution.
Z95 = 1.959963984540054
#: Posterior over prior sd above which a parameter is held by its prior [-].
HELD = 0.9
#: Correlations reported.
CORRELATED = 0.9
#: Steps of a profile, in posterior sds from the optimum.
PROFILE_STEPS = (0.1, 0.25, 0.5, 1.0, 1.5, 2.0, 2.5, 3.0, 4.0, 6.0)


def held_by_prior(sd: np.ndarray) -> np.ndarray:
    """True for each parameter that the data do not determine: its posterior sd exceeds `HELD` of its prior sd, or is
    unknown.

    Args:
        sd: posterior sds of coordinates with prior sd 1 (for a log-normal prior, of the logarithm), any shape.
    """
    return ~(np.asarray(sd) <= HELD)


@dataclasses.dataclass(frozen=True)
class Identifiability:
    """Linear analysis at the optimum, in coordinates z with prior sd 1.

    Attributes:
        names: names of the parameters.
        covariance: posterior covariance of z, shape (parameters, parameters).
        sd: posterior sd of z, which is posterior sd over prior sd.
        singular_values: singular values of the whitened Jacobian of the readings without priors: prior sd over data
            sd along each direction, largest first. Above 1 the data are more informative than the prior.
        directions: right singular vectors, one in each row. Those beyond the rank are from `separate_directions`.
        rank: number of singular values above 1e-8 of the largest.
        sensitivity: change of the readings by one prior sd of each parameter, in data sds. 0 if nothing measures the
            parameter.
        leverage: share of each reading's variance that the fit explains, shape (rows, channels).
        jacobian: Jacobian of the whitened readings, row by row, shape (rows · channels, parameters).
    """

    names: Names
    covariance: np.ndarray
    sd: np.ndarray
    singular_values: np.ndarray
    directions: np.ndarray
    rank: int
    sensitivity: np.ndarray
    leverage: np.ndarray
    jacobian: np.ndarray

    @property
    def correlation(self) -> np.ndarray:
        """Posterior correlations of z."""
        return self.covariance / np.outer(self.sd, self.sd)

    @property
    def held_by_prior(self) -> np.ndarray:
        """True for each parameter that the data do not determine, shape (parameters,)."""
        return held_by_prior(self.sd)

    def correlated(self) -> list[tuple[str, str, float]]:
        """Pairs with |correlation| above `CORRELATED`, strongest first."""
        c = self.correlation
        pairs = [
            (self.names[i], self.names[j], float(c[i, j])) for i, j in zip(*np.triu_indices(len(c), 1), strict=True)
        ]
        return sorted((p for p in pairs if abs(p[2]) > CORRELATED), key=lambda p: -abs(p[2]))

    def weak_directions(self) -> list[tuple[float, dict[str, float]]]:
        """Directions in which the prior is more informative than the data: singular value, and main components in
        prior sds.
        """
        weak = []
        for s, v in zip(self.singular_values, self.directions, strict=True):
            if s < 1:
                main = {n: float(x) for n, x in zip(self.names, v, strict=True) if abs(x) > 0.1}
                weak.append((float(s), main))
        return weak


def separate_directions(directions: np.ndarray) -> np.ndarray:
    """Orthonormal basis of a subspace in which each vector is as close as possible to one parameter.

    The parameter with the largest component in the subspace is first. The result does not depend on the given basis,
    and so not on rounding.

    Args:
        directions: orthonormal vectors that span the subspace, shape (directions, parameters).
    """
    projector = directions.T @ directions
    separated = np.zeros_like(directions)
    for row in separated:
        k = int(np.argmax(np.round(np.diag(projector), 6)))
        row[:] = projector[k] / np.sqrt(projector[k, k])
        projector = projector - np.outer(row, row)
    return separated


@compiled
def _jacobians(problem: Problem, z: Array) -> tuple[Array, Array]:
    readings = problem.linearised(problem.robot, z)[1][: problem.data.measured.size]
    return jnp.concatenate([readings, jnp.eye(z.size)]), readings


def analyse_identifiability(problem: Problem, z: Array, slope: np.ndarray | None = None) -> Identifiability:
    """Linear analysis of `problem` at coordinates z, from readings and priors only.

    The limit of adhesion is excluded: it is one-sided, so a profile shows it and a standard error cannot.

    Args:
        slope: Jacobian of the whitened readings, shape (rows · channels, parameters). None: from the model.
    """
    data = problem.data
    if slope is not None:
        all_slopes = np.concatenate([slope, np.eye(len(z))])
        readings = slope
    elif problem.observe.long:
        jacobian = np.asarray(optimizers.linearise(problem, z)[1])
        all_slopes, readings = jacobian[optimizers.informative_residuals(data)], jacobian[: data.measured.size]
    else:
        all_slopes, readings = (np.asarray(j) for j in _jacobians(optimizers.with_solved_rows(problem, z), z))
    _, s, v = np.linalg.svd(all_slopes, full_matrices=False)
    covariance = (v.T / s**2) @ v
    _, singular, directions = np.linalg.svd(readings, full_matrices=False)
    rank = int(np.sum(singular > 1e-8 * singular.max()))
    directions[rank:] = separate_directions(directions[rank:])
    leverage = np.einsum("ij,jk,ik->i", readings, covariance, readings)
    return Identifiability(
        names=problem.coordinates.names,
        covariance=covariance,
        sd=np.sqrt(np.diag(covariance)),
        singular_values=singular,
        directions=directions,
        rank=rank,
        sensitivity=np.linalg.norm(readings, axis=0),
        leverage=leverage.reshape(data.measured.shape),
        jacobian=readings,
    )


def profile_intervals(
    problem: Problem, z: Array, cost: float, analysis: Identifiability
) -> tuple[Float[np.ndarray, "parameters 2"], Bool[np.ndarray, "parameters 2"]]:
    """95 % interval of each parameter [SI] from its profile likelihood: the objective, minimised over all others.

    Also True for an end that lies beyond the last point of the profile, so that the interval is at least that wide.
    All points of all profiles are refitted in one batch.

    Each refit starts where the linear analysis expects the other parameters. The ends of an interval are interpolated
    on the signed square root of the rise, which is straight for a linear model.
    """
    centre = np.asarray(z)
    size = len(analysis.names)
    steps = np.concatenate([-np.asarray(PROFILE_STEPS[::-1]), PROFILE_STEPS])
    points = centre[:, None] + analysis.sd[:, None] * steps  # (parameters, points)
    direction_of = analysis.covariance / np.diag(analysis.covariance)[:, None]  # row k: how all move with k
    starts = centre + direction_of[:, None, :] * (points - centre[:, None])[..., None]
    held = np.broadcast_to(np.eye(size, dtype=bool)[:, None, :], starts.shape)
    refits = optimizers.fit_with_held(
        problem, jnp.asarray(starts.reshape(-1, size)), jnp.asarray(held.reshape(-1, size))
    )
    cost_of_held = 0.5 * (points - np.asarray(problem.data.centre)[:, None]) ** 2
    rise = 2 * (np.asarray(refits.cost).reshape(points.shape) + cost_of_held - cost)
    root = np.sign(steps) * np.sqrt(np.maximum(rise, 0.0))
    middle = len(PROFILE_STEPS)
    points_with_optimum = np.insert(points, middle, centre, axis=1)
    root_with_optimum = np.insert(root, middle, 0.0, axis=1)
    # Where the signed root reaches ∓Z95, or the end points if it does not.
    rising = np.maximum.accumulate(root_with_optimum, 1)
    ends = np.array([np.interp([-Z95, Z95], r, a) for a, r in zip(points_with_optimum, rising, strict=True)])
    interval = np.asarray(jax.vmap(problem.coordinates.value)(jnp.asarray(ends.T))).T
    return interval, np.stack([root_with_optimum[:, 0] > -Z95, root_with_optimum[:, -1] < Z95], 1)


# --- posteriors of fits ---------------------------------------------------------------------------


#: Correlation beyond which two parameters are not determined separately.
TOGETHER = 0.95
#: Ratio of two relative sds up to which the combination of two parameters is a ratio or a product.
EVEN = 1.25


def posterior_of_coordinates(coordinates: Coordinates, z: np.ndarray, covariance: np.ndarray) -> Posterior:
    """Posterior distribution of a fit with optimum z and this covariance."""
    size = len(coordinates)
    return Posterior(
        coordinates=coordinates.names,
        units=coordinates.units,
        mean=np.asarray(z, float),
        covariance=np.asarray(covariance, float),
        **{name: np.asarray(getattr(coordinates, name), float) for name in ("location", "spread", "low", "high")},
        softness=np.full(size, SOFTNESS),
        kinds=tuple(LOG if scale else NORMAL for scale in coordinates.scale),
        tied=coordinates.tied,
    )


def determined_together(posterior: Posterior, held_names: Collection[str] = ()) -> tuple[DependentPair, ...]:
    """Pairs of parameters whose posterior correlation exceeds `TOGETHER`, strongest first, with the combination that
    is known.

    Args:
        held_names: names of parameters that only their priors determine. A pair of two such parameters is omitted.
            In a pair with one of them, the other is known only as well as that prior, and the data determine only
            their combination.
    """
    sd = np.sqrt(np.diag(posterior.covariance))
    value = posterior.at(posterior.mean)
    log = np.array([kind == LOG for kind in posterior.kinds])
    spread = posterior.spread * sd  # of the parameter, or of its logarithm
    pairs = []
    for i, j in zip(*np.triu_indices(len(sd), 1), strict=True):
        one, other = posterior.coordinates[i], posterior.coordinates[j]
        correlation = float(posterior.covariance[i, j] / max(sd[i] * sd[j], 1e-300))
        if not abs(correlation) > TOGETHER or (one in held_names and other in held_names):
            continue
        size = spread * np.where(log, value[: len(sd)], 1.0)
        weight = -np.sign(correlation) * abs(size[i] / size[j])
        is_ratio_or_product = log[i] and log[j] and 1 / EVEN < spread[i] / spread[j] < EVEN
        form = "linear" if not is_ratio_or_product else "ratio" if correlation > 0 else "product"
        pairs.append(DependentPair(one, other, correlation, form, float(weight)))
    return tuple(sorted(pairs, key=lambda pair: -abs(pair.correlation)))


def undetermined_names(held_names: Collection[str], pairs: Collection[DependentPair]) -> Names:
    """Names of parameters that only their priors determine, except those in a pair whose combination the data
    determine.
    """
    paired = {name for pair in pairs for name in (pair.one, pair.other)}
    return tuple(name for name in held_names if name not in paired)
