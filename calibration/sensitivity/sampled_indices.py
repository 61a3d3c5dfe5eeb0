"""Sobol' indices (Sobol' 1993, Homma and Saltelli 1996) and elementary effects (Morris 1991), from replicates.

S_i = Var(E[y | x_i]) / Var y is the mean share of the variance that vanishes if x_i is known. T_i = E[Var(y | all but
x_i)] / Var y is the share that remains if all but x_i are known. T_i - S_i is due to interactions. S_ij is the joint
effect of x_i and x_j in addition to their single effects. Designs (Saltelli's scheme on a scrambled Sobol sequence)
and estimators are those of SALib: Saltelli et al., Comput. Phys. Commun. 181 (2010) for first order and, after Jansen
(1999), for the total, and Saltelli, ibid. 145 (2002) for second order, as the mean of both orders.

Every index is a ratio of means: a numerator over a variance. A bootstrap over the points of a scrambled Sobol
sequence would treat them as independent, but they are correlated by construction. Whole replicates with different
scramblings are independent (Owen, Monte Carlo variance of scrambled net quadrature, SIAM J. Numer. Anal. 34 (1997)).
The spread between replicates is therefore that of the estimate, and Student's t gives the interval.

μ* is the mean magnitude of the change per whole range of the input (Campolongo et al., Environ. Model. Softw. 22
(2007)). σ is the standard deviation of the change between places, due to nonlinearity or interactions.
"""

from __future__ import annotations

import dataclasses
import math
import operator
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy import stats

#: Replicates of a design.
REPLICATES = 32
#: Probability of the intervals.
LEVEL = 0.95


class IntervalEstimate(NamedTuple):
    """Estimates with their 95 % intervals.

    Attributes:
        value: estimates, any shape.
        low, high: ends of the 95 % interval.
    """

    value: np.ndarray
    low: np.ndarray
    high: np.ndarray


def ratio_estimate(numerator: np.ndarray, denominator: np.ndarray) -> IntervalEstimate:
    """Ratio of the means of two quantities over replicates, with its interval.

    Its variance is that of the linearised ratio, e = (numerator - ratio · denominator) / mean denominator (Cochran,
    Sampling Techniques (1977), eq. 6.9). The bias of the ratio decreases with the total number of points, not with
    the number in a replicate.

    Args:
        numerator: shape (replicates, ...).
        denominator: shape (replicates,), not negative.

    Returns:
        NaN if the denominator is 0: without variance there are no shares.
    """
    count = len(numerator)
    mean_denominator = float(np.mean(denominator))
    shape = (-1,) + (1,) * (numerator.ndim - 1)
    if not mean_denominator > 0:
        undefined = np.full(numerator.shape[1:], np.nan)
        return IntervalEstimate(undefined, undefined, undefined)
    mean_numerator = np.mean(numerator, 0)
    value = mean_numerator / mean_denominator
    error = (numerator - mean_numerator - value * (denominator - mean_denominator).reshape(shape)) / mean_denominator
    sd = np.sqrt(np.sum(error**2, 0) / (count * (count - 1)))
    width = float(stats.t.ppf(0.5 + LEVEL / 2, count - 1)) * sd
    return IntervalEstimate(value, value - width, value + width)


#: Fewest points of a replicate.
FEWEST = 4


def base_point_count(evaluations: float, inputs: int) -> int:
    """Number of base points of a replicate for at least this many evaluations: a power of 2."""
    blocks = 2 * inputs + 2
    return 2 ** max(math.ceil(math.log2(max(evaluations / (REPLICATES * blocks), FEWEST))), 0)


def sobol_design(inputs: int, size: int, seed: int) -> np.ndarray:
    """Points of the unit cube in independent replicates, each a Sobol sequence with its own scrambling.

    They have the shape (`REPLICATES` · size · blocks, inputs). Blocks follow one another: A, then A with the k-th
    column of B for each k, then B with the k-th column of A for each k, then B.

    Args:
        size: base points of a replicate, a power of 2.
        seed: random seed.
    """
    from SALib.sample import sobol as sampling

    generators = np.random.default_rng(seed).spawn(REPLICATES)
    return np.concatenate([sampling.sample(_problem(inputs), size, seed=rng) for rng in generators])


@dataclasses.dataclass(frozen=True)
class VarianceTerms:
    """Parts of an output's variance in each replicate [unit² of the output]. Their ratios are the indices.

    Attributes:
        variance: total variance, shape (replicates,).
        first, total: parts for the first-order and total indices, shape (replicates, inputs).
        second: part of each pair including its single effects, shape (replicates, inputs, inputs).
        lost: number of base points omitted because the model has no value.
    """

    variance: np.ndarray
    first: np.ndarray
    total: np.ndarray
    second: np.ndarray
    lost: int

    def __add__(self, other: VarianceTerms) -> VarianceTerms:
        """Terms of both outputs together, as for a vector of outputs (Gamboa et al., Electron. J. Stat. 8 (2014))."""
        return VarianceTerms(*map(operator.add, dataclasses.astuple(self), dataclasses.astuple(other)))

    def widened(self, indices: Sequence[int], inputs: int) -> VarianceTerms:
        """Terms for more inputs: these terms at `indices`, the others without influence."""
        first, total = np.zeros((2, len(self.variance), inputs))
        first[:, indices], total[:, indices] = self.first, self.total
        second = first[:, :, None] + first[:, None, :]  # without interaction
        second[:, np.array(indices)[:, None], indices] = self.second
        return dataclasses.replace(self, first=first, total=total, second=second)


def sobol_terms(points: np.ndarray, values: np.ndarray) -> VarianceTerms | None:
    """Parts of the variance of an output.

    A base point is omitted if the output is not finite in one of its blocks. If this depends on a single input (such
    as too small an adhesion), the indices are exact for the distribution of that input truncated there. Otherwise
    they are approximate.

    Args:
        points: points of `sobol_design`.
        values: values of the output there.

    Returns:
        None if some replicate has fewer than two base points left.
    """
    d = points.shape[1]
    values_by_block = np.reshape(values, (REPLICATES, -1, 2 * d + 2))
    finite = np.asarray(np.isfinite(values_by_block).all(-1))
    count = finite.sum(1)
    if count.min() < 2:
        return None
    centre = (values_by_block[..., 0] + values_by_block[..., -1])[finite].mean() / 2
    values_by_block = np.where(finite[..., None], values_by_block - centre, 0.0)
    a, b = values_by_block[..., 0], values_by_block[..., -1]
    ab, ba = values_by_block[..., 1 : d + 1], values_by_block[..., d + 1 : -1]
    # A replicate with more rows has a larger weight: sums are divided by the mean number of rows.
    weight = 1.0 / count.mean()
    # Var E[y | x_j, x_k]: common to B with A's x_j and A with B's x_k, in both orders.
    mixed = np.einsum("rnj,rnk->rjk", ba, ab)
    closed = weight * (mixed - np.einsum("rn,rn->r", a, b)[:, None, None])
    return VarianceTerms(
        variance=weight * np.sum(a**2 + b**2, 1) / 2,
        first=weight * np.einsum("rn,rnk->rk", b, ab - a[..., None]),
        total=weight * np.sum((a[..., None] - ab) ** 2, 1) / 2,
        second=(closed + np.swapaxes(closed, 1, 2)) / 2,
        lost=int(np.sum(~finite)),
    )


def sobol_indices(terms: VarianceTerms) -> dict[str, IntervalEstimate]:
    """Sobol indices by order: `first` and `total`, shape (inputs,), and `second`, shape (inputs, inputs)."""
    together = terms.second - terms.first[:, :, None] - terms.first[:, None, :]
    parts = {"first": terms.first, "total": terms.total, "second": together}
    return {order: ratio_estimate(part, terms.variance) for order, part in parts.items()}


#: Levels of the grid of the trajectories.
LEVELS = 4


def morris_design(inputs: int, trajectories: int, seed: int) -> np.ndarray:
    """Trajectories in the unit cube, shape (trajectories · (inputs + 1), inputs)."""
    from SALib.sample import morris as sampling

    # The sampler uses NumPy's global generator despite its seed argument, so the state is restored.
    state = np.random.get_state()  # noqa: NPY002
    try:
        return sampling.sample(_problem(inputs), trajectories, num_levels=LEVELS, seed=seed)
    finally:
        np.random.set_state(state)  # noqa: NPY002


def elementary_effects(points: np.ndarray, values: np.ndarray) -> tuple[dict[str, IntervalEstimate], int] | None:
    """Statistics of the elementary effects of each input on one output, and the number of omitted trajectories.

    The statistics are μ* with its interval, μ and σ, each of shape (inputs,) [unit of the output per range of the
    input]. A trajectory is omitted if the model has no value at one of its points.

    Args:
        points: points from `morris_design`.
        values: values of the output there.

    Returns:
        None if fewer than two trajectories have values at all points.
    """
    inputs = points.shape[1]
    paths = points.reshape(-1, inputs + 1, inputs)
    values_by_path = values.reshape(-1, inputs + 1)
    finite = np.isfinite(values_by_path).all(1)
    if finite.sum() < 2:
        return None
    steps = np.diff(paths[finite], axis=1)
    moved_index = np.abs(steps).argmax(-1)[..., None]
    changes = np.diff(values_by_path[finite], axis=1)[..., None] / np.take_along_axis(steps, moved_index, -1)
    effects = np.zeros((len(changes), inputs))
    np.put_along_axis(effects, moved_index[..., 0], changes[..., 0], 1)
    mean_magnitude = np.abs(effects).mean(0)
    mean = effects.mean(0)
    sd = effects.std(0, ddof=1)
    width = float(stats.t.ppf(0.5 + LEVEL / 2, len(effects) - 1)) / np.sqrt(len(effects))
    error = width * np.abs(effects).std(0, ddof=1)
    return {
        "mean_absolute_effect": IntervalEstimate(mean_magnitude, mean_magnitude - error, mean_magnitude + error),
        "mean_effect": IntervalEstimate(mean, mean, mean),
        "sd_effect": IntervalEstimate(sd, sd, sd),
    }, int(np.sum(~finite))


def _problem(inputs: int) -> dict[str, object]:
    return {
        "num_vars": inputs,
        "names": [str(k) for k in range(inputs)],
        "bounds": [[0.0, 1.0]] * inputs,
        "groups": None,
    }
