"""Bounds of variance-based indices from exact gradients.

In scores, inputs are standard normal or uniform whatever their distribution. Poincaré's inequality bounds the total
index from above, T_i ≤ C_i E[(∂y/∂s_i)²] / Var y. C is 1 for a standard normal score and 1/π² for a uniform one
in 0..1 (Sobol' and Kucherenko, Math. Comput. Simul. 79 (2009). Lamboni et al., ibid. 87 (2013). Roustant et
al., Electron. J. Stat. 11 (2017)). The linear term of the output's expansion bounds the first-order index from below:
E[y s_i]² / Var y, and E[y s_i] = E[∂y/∂s_i] for a normal score (Stein). For a uniform one √12 E[y (s - 1/2)] =
√3 E[s (1 - s) ∂y/∂s]. If both bounds agree, the output is linear in that input and the index is known exactly.
"""

from __future__ import annotations

import dataclasses

import numpy as np
from scipy.stats import qmc

from calibration.sensitivity.replicates import REPLICATES, Estimate, ratio_estimate


@dataclasses.dataclass(frozen=True)
class Terms:
    """Parts of the variance, by replicate, whose ratios are the bounds [output's unit²].

    Attributes:
        variance: shape (replicates,).
        lower, upper: shape (replicates, inputs).
        rows: number of included points.
        lost: number of points without a value of the model.
    """

    variance: np.ndarray
    lower: np.ndarray
    upper: np.ndarray
    rows: int
    lost: int

    def __add__(self, other: Terms) -> Terms:
        return Terms(
            self.variance + other.variance,
            self.lower + other.lower,
            self.upper + other.upper,
            self.rows + other.rows,
            self.lost + other.lost,
        )


@dataclasses.dataclass(frozen=True)
class Bounds:
    """Bounds of one output: first-order indices are at least `lower`, total ones at most `upper`, shape (inputs,)."""

    lower: Estimate
    upper: Estimate
    variance: float


def derivative_design(inputs: int, size: int, seed: int, replicates: int = REPLICATES) -> np.ndarray:
    """Points of the unit cube, shape (replicates · size, inputs), each replicate with an independent scrambling.

    Args:
        size: points of a replicate, a power of 2.
    """
    generators = np.random.default_rng(seed).spawn(replicates)
    return np.concatenate([qmc.Sobol(inputs, scramble=True, rng=rng).random(size) for rng in generators])


def derivative_terms(
    scores: np.ndarray, values: np.ndarray, gradients: np.ndarray, normal: np.ndarray, replicates: int = REPLICATES
) -> Terms | None:
    """Parts of an output's variance and of its bounds.

    Args:
        scores: of the design, shape (points, inputs).
        values, gradients: of the output there, by the scores.
        normal: True for standard normal scores, False for uniform ones in 0..1, shape (inputs,).

    Returns:
        None if some replicate has no finite value.
    """
    y = values.reshape(replicates, -1)
    finite = np.isfinite(y)
    count = finite.sum(1)
    if count.min() < 1 or count.sum() < 2 * replicates:
        return None
    weight = 1.0 / count.mean()
    centre = y[finite].mean()
    y = np.where(finite, y - centre, 0.0)
    g = np.where(finite[..., None], gradients.reshape(*y.shape, -1), 0.0)
    s = scores.reshape(g.shape)
    flat = np.where(normal, 1.0, np.sqrt(3.0) * s * (1 - s))
    mean = weight * np.sum(flat * g, 1)
    middle = mean.mean(0)
    return Terms(
        variance=weight * np.sum(y**2, 1),
        lower=middle**2 + 2 * middle * (mean - middle),  # the square of a mean, linearised
        upper=weight * np.sum(g**2, 1) * np.where(normal, 1.0, 1 / np.pi**2),
        rows=int(count.sum()),
        lost=int(finite.size - count.sum()),
    )


def index_bounds(terms: Terms) -> Bounds:
    """Bounds from parts of the variance."""
    lower, upper = ratio_estimate(terms.lower, terms.variance), ratio_estimate(terms.upper, terms.variance)
    return Bounds(lower, upper, float(terms.variance.mean()))
