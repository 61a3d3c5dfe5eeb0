"""Estimates from independent replicates of a randomised design, with valid intervals.

Every index is a ratio of means: a numerator over a variance. A bootstrap over the points of a scrambled Sobol
sequence would treat them as independent, but they are correlated by construction. Whole replicates with different
scramblings are independent (Owen, Monte Carlo variance of scrambled net quadrature, SIAM J. Numer. Anal. 34 (1997)).
The spread between replicates is therefore that of the estimate, and Student's t gives the interval.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
from scipy import stats

#: Replicates of a design.
REPLICATES = 32
#: Probability of the intervals.
LEVEL = 0.95


@dataclasses.dataclass(frozen=True)
class IntervalEstimate:
    """Estimates with their 95 % intervals.

    Attributes:
        value: estimates, any shape.
        low, high: ends of the 95 % interval.
    """

    value: np.ndarray
    low: np.ndarray
    high: np.ndarray

    def __getitem__(self, k: Any) -> IntervalEstimate:
        return IntervalEstimate(self.value[k], self.low[k], self.high[k])


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
        nothing = np.full(numerator.shape[1:], np.nan)
        return IntervalEstimate(nothing, nothing, nothing)
    mean_numerator = np.mean(numerator, 0)
    value = mean_numerator / mean_denominator
    error = (numerator - mean_numerator - value * (denominator - mean_denominator).reshape(shape)) / mean_denominator
    sd = np.sqrt(np.sum(error**2, 0) / (count * (count - 1)))
    width = float(stats.t.ppf(0.5 + LEVEL / 2, count - 1)) * sd
    return IntervalEstimate(value, value - width, value + width)
