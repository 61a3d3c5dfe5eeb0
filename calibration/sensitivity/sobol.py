"""Variance-based indices of independent inputs: first, total and second order (Sobol' 1993, Homma and Saltelli 1996).

S_i = Var(E[y | x_i]) / Var y is the mean share of the variance that is removed if x_i is known. T_i =
E[Var(y | all but x_i)] / Var y is the share that remains if all but x_i are known. T_i - S_i is due to interactions.
S_ij is the joint effect of x_i and x_j in addition to their single effects. Designs are SALib's (Saltelli's scheme on
a scrambled Sobol sequence), and so are the estimators: Saltelli et al., Comput. Phys. Commun. 181 (2010) for first
order and, after Jansen (1999), for the total. Saltelli, ibid. 145 (2002) for second order, the mean of both orders.
Intervals are from whole replicates.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence

import numpy as np

from calibration.sensitivity.replicates import REPLICATES, Estimate, ratio_estimate

#: Fewest points of a replicate.
FEWEST = 4
#: Numbers of replicates at which convergence is shown.
STAGES = (4, 8, 16, REPLICATES)


@dataclasses.dataclass(frozen=True)
class Design:
    """Points of the unit cube, by replicates.

    Attributes:
        points: shape (replicates · size · blocks, inputs), a block after the other: A, A with the k-th column of B
            for each k, with `second` B with the k-th column of A for each k, B.
        size: base points of a replicate, a power of 2.
        second: True for designs with second-order indices.
    """

    points: np.ndarray
    size: int
    second: bool
    replicates: int = REPLICATES

    @property
    def inputs(self) -> int:
        """Number of inputs."""
        return self.points.shape[1]

    @property
    def blocks(self) -> int:
        """Evaluations for each base point."""
        return (2 * self.inputs if self.second else self.inputs) + 2


def base_points(evaluations: float, inputs: int, second: bool, replicates: int = REPLICATES) -> int:
    """Base points of a replicate for at least so many evaluations in all: the next power of 2."""
    blocks = (2 * inputs if second else inputs) + 2
    return 2 ** max(math.ceil(math.log2(max(evaluations / (replicates * blocks), FEWEST))), 0)


def sobol_design(inputs: int, size: int, seed: int, second: bool = True, replicates: int = REPLICATES) -> Design:
    """Design of independent replicates, each a Sobol sequence with its own scrambling.

    Args:
        size: base points of a replicate, a power of 2.
        seed: random seed.
    """
    from SALib.sample import sobol as sampling

    problem = {
        "num_vars": inputs,
        "names": [str(k) for k in range(inputs)],
        "bounds": [[0.0, 1.0]] * inputs,
    }
    generators = np.random.default_rng(seed).spawn(replicates)
    parts = [sampling.sample(problem, size, calc_second_order=second, seed=rng) for rng in generators]
    return Design(np.concatenate(parts), size, second, replicates)


@dataclasses.dataclass(frozen=True)
class Terms:
    """Parts of the variance of an output, by replicate, whose ratios are the indices [output's unit²].

    Attributes:
        variance: shape (replicates,).
        first, total: shape (replicates, inputs).
        second: of each pair, closed (with the single effects), shape (replicates, inputs, inputs), None without.
        rows: number of included base points.
        lost: number of those with a missing value of the model.
    """

    variance: np.ndarray
    first: np.ndarray
    total: np.ndarray
    second: np.ndarray | None
    rows: int
    lost: int

    def __add__(self, other: Terms) -> Terms:
        """Terms of both outputs together, as of a vector (Gamboa et al., Electron. J. Stat. 8 (2014))."""
        second = None if self.second is None or other.second is None else self.second + other.second
        return Terms(
            self.variance + other.variance,
            self.first + other.first,
            self.total + other.total,
            second,
            self.rows + other.rows,
            self.lost + other.lost,
        )

    def widened(self, places: Sequence[int], inputs: int) -> Terms:
        """Terms for more inputs, with these at `places` and the others inert."""

        first, total = (np.zeros((len(self.variance), inputs)) for _ in range(2))
        first[:, places], total[:, places] = self.first, self.total
        second = None
        columns = np.asarray(places)
        if self.second is not None:
            second = first[:, :, None] + first[:, None, :]  # without interaction
            second[np.ix_(np.arange(len(second)), columns, columns)] = self.second
        return dataclasses.replace(self, first=first, total=total, second=second)


def sobol_terms(design: Design, values: np.ndarray) -> Terms | None:
    """Parts of an output's variance.

    A base point is omitted if the output is not finite in one of its blocks. If that depends on one
    input only (an adhesion that is too small), the indices are exactly those of that input truncated there, otherwise
    approximately.

    Args:
        values: values of the output at the design's points.

    Returns:
        None if fewer than two base points of some replicate remain.
    """
    d = design.inputs
    by = np.reshape(values, (design.replicates, design.size, design.blocks))
    finite = np.asarray(np.isfinite(by).all(-1))
    count = finite.sum(1)
    if count.min() < 2:
        return None
    by = np.where(finite[..., None], by, 0.0)
    a, b = by[..., 0], by[..., -1]
    centre = (a + b)[finite].mean() / 2
    by = np.where(finite[..., None], by - centre, 0.0)
    a, b, ab = by[..., 0], by[..., -1], by[..., 1 : d + 1]
    # A replicate with more rows has a larger weight: sums over the mean number of rows, not means of each.
    weight = 1.0 / count.mean()
    second = None
    if design.second:
        ba = by[..., d + 1 : 2 * d + 1]
        # Var E[y | x_j, x_k]: common to B with A's x_j and A with B's x_k, in both orders.
        mixed = np.einsum("rnj,rnk->rjk", ba, ab)
        alone = np.einsum("rn,rn->r", a, b)[:, None, None]
        closed = weight * (mixed - alone)
        second = (closed + np.swapaxes(closed, 1, 2)) / 2
    return Terms(
        variance=weight * np.sum(a**2 + b**2, 1) / 2,
        first=weight * np.einsum("rn,rnk->rk", b, ab - a[..., None]),
        total=weight * np.sum((a[..., None] - ab) ** 2, 1) / 2,
        second=second,
        rows=int(count.sum()),
        lost=int(finite.size - count.sum()),
    )


@dataclasses.dataclass(frozen=True)
class Indices:
    """Indices of one output, shape (inputs,). `second` has shape (inputs, inputs) or is None. `variance`: [unit²]."""

    first: Estimate
    total: Estimate
    second: Estimate | None
    variance: float


def indices_of_terms(terms: Terms, replicates: int | None = None) -> Indices:
    """Indices from parts of the variance, or from a first number of replicates."""
    kept = slice(replicates)
    variance, first = terms.variance[kept], terms.first[kept]
    second = None
    if terms.second is not None:
        beyond = terms.second[kept] - first[:, :, None] - first[:, None, :]
        second = ratio_estimate(beyond, variance)
    return Indices(
        ratio_estimate(first, variance), ratio_estimate(terms.total[kept], variance), second, float(variance.mean())
    )
