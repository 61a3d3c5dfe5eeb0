"""Estimates from independent replicates of a randomised design, with intervals that hold what they say.

Every index here is a ratio of means: of a numerator over a variance. A bootstrap over the points of a scrambled Sobol
sequence would take them for independent, which they are not: their whole point is that they are not. Whole replicates
are, each of them scrambled anew (Owen, Monte Carlo variance of scrambled net quadrature, SIAM J. Numer. Anal. 34
(1997)), so their spread is that of the estimate, and Student's t of their number gives the interval.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
from scipy import stats

#: Replicates of a design.
REPLICATES = 32
#: What intervals hold.
LEVEL = 0.95


@dataclasses.dataclass(frozen=True)
class Estimate:
    """Indices with their intervals.

    Attributes:
        value: shape (...); low, high: ends of the 95 % interval.
    """

    value: np.ndarray
    low: np.ndarray
    high: np.ndarray

    def __getitem__(self, k: Any) -> Estimate:
        return Estimate(self.value[k], self.low[k], self.high[k])


def ratio(numerator: np.ndarray, denominator: np.ndarray) -> Estimate:
    """Ratio of the means of two quantities over replicates, and its interval.

    Its variance is that of the linearised ratio, e = (numerator - ratio · denominator) / mean denominator (Cochran,
    Sampling Techniques (1977), eq. 6.9): the bias of a ratio falls with all points, not with those of a replicate.

    Args:
        numerator: shape (replicates, ...); denominator: shape (replicates,), not negative.

    Returns:
        NaN where the denominator is 0: nothing varies, and nothing has a share in it.
    """
    count = len(numerator)
    below = float(np.mean(denominator))
    shape = (-1,) + (1,) * (numerator.ndim - 1)
    if not below > 0:
        nothing = np.full(numerator.shape[1:], np.nan)
        return Estimate(nothing, nothing, nothing)
    above = np.mean(numerator, 0)
    value = above / below
    error = (numerator - above - value * (denominator - below).reshape(shape)) / below
    sd = np.sqrt(np.sum(error**2, 0) / (count * (count - 1)))
    width = float(stats.t.ppf(0.5 + LEVEL / 2, count - 1)) * sd
    return Estimate(value, value - width, value + width)
