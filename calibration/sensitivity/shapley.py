"""Shapley effects: shares of the variance that add up to one even for correlated inputs.

The share of x_j is the mean reduction of the remaining variance when x_j becomes known, over all orders of the inputs
(Owen, SIAM/ASA J. Uncertain. Quantif. 2 (2014)). It is estimated by random orders, each with its
reverse. The cost E[Var(y | all but J)] is estimated by three draws of x_J for one draw of the rest (Song, Nelson and
Staum, ibid. 4 (2016)). Inputs are normal in their coordinates, so conditional draws are exact.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np
from scipy.special import ndtri
from scipy.stats import qmc

from calibration.sensitivity.replicates import Estimate, ratio_estimate

#: Draws of unknown inputs for each draw of known ones.
INNER = 3
#: Draws for the variance, a power of 2.
DRAWS = 4096


@dataclasses.dataclass(frozen=True)
class Design:
    """Points in coordinates z.

    Attributes:
        orders: pairs of orders of inputs, one the reverse of the other; shape (pairs, 2, inputs).
        points: first DRAWS for the variance, then INNER for each proper prefix of each order; shape (points, inputs).
    """

    orders: np.ndarray
    points: np.ndarray


@dataclasses.dataclass(frozen=True)
class Terms:
    """Parts of the variance whose ratios are the effects [output's unit²].

    Attributes:
        variance: of the output; parts: shape (pairs, inputs), NaN in rows of omitted pairs.
        lost: share of points without a value of the model [-].
    """

    variance: float
    parts: np.ndarray
    lost: float


def pairs_of_orders(evaluations: float, inputs: int) -> int:
    """Number of pairs of orders for at least so many evaluations."""
    return max(int(np.ceil((evaluations - DRAWS) / (2 * INNER * max(inputs - 1, 1)))), 50)


def shapley_design(mean: np.ndarray, covariance: np.ndarray, pairs: int, seed: int) -> Design:
    """Design for jointly normal inputs.

    Args:
        mean, covariance: of z.
        pairs: of orders; seed: random seed.
    """
    rng = np.random.default_rng(seed)
    size = len(mean)
    values, vectors = np.linalg.eigh(covariance)
    root = vectors * np.sqrt(np.maximum(values, 0.0))
    uniform = qmc.Sobol(size, scramble=True, rng=rng.spawn(1)[0]).random(DRAWS)
    whole = mean + ndtri(np.clip(uniform, 1e-9, 1 - 1e-9)) @ root.T
    forward = np.array([rng.permutation(size) for _ in range(pairs)])
    orders = np.stack([forward, forward[:, ::-1]], 1)
    known: dict[bytes, tuple[np.ndarray, np.ndarray]] = {}
    parts = [whole]
    for order in orders.reshape(-1, size):
        outer = mean + rng.standard_normal((size - 1, size)) @ root.T
        inner = rng.standard_normal((size - 1, INNER, size))
        for k in range(1, size):
            drawn = np.sort(order[:k])
            key = drawn.tobytes()
            if key not in known:
                known[key] = _conditional(covariance, drawn)
            pull, half = known[key]
            rest = np.setdiff1d(np.arange(size), drawn, assume_unique=True)
            at = np.tile(outer[k - 1], (INNER, 1))
            centre = mean[drawn] + pull @ (at[0, rest] - mean[rest])
            at[:, drawn] = centre + inner[k - 1][:, :k] @ half.T
            parts.append(at)
    return Design(orders, np.concatenate(parts))


def _conditional(covariance: np.ndarray, drawn: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Matrix of the conditional mean of z_J given the rest, and a root of its conditional covariance."""
    rest = np.setdiff1d(np.arange(len(covariance)), drawn, assume_unique=True)
    across = covariance[np.ix_(drawn, rest)]
    pull = across @ np.linalg.pinv(covariance[np.ix_(rest, rest)], hermitian=True)
    left = covariance[np.ix_(drawn, drawn)] - pull @ across.T
    values, vectors = np.linalg.eigh((left + left.T) / 2)
    return pull, vectors * np.sqrt(np.maximum(values, 0.0))


def shapley_terms(design: Design, values: np.ndarray) -> Terms | None:
    """Parts of an output's variance from its values at the design's points.

    A pair of orders is omitted if the output is not finite at one of its points.

    Returns:
        None if fewer than ten pairs remain.
    """
    pairs, _, size = design.orders.shape
    whole, rest = values[:DRAWS], values[DRAWS:].reshape(pairs, 2, size - 1, INNER)
    finite = np.isfinite(rest).all((1, 2, 3))
    if finite.sum() < 10 or np.isfinite(whole).sum() < DRAWS // 2:
        return None
    variance = float(np.nanvar(whole))
    cost = rest[finite].var(-1, ddof=1)  # (pairs, 2, prefixes)
    edge = (*cost.shape[:2], 1)
    ladder = np.concatenate([np.zeros(edge), cost, np.full(edge, variance)], -1)
    of_orders = np.zeros((len(cost), 2, size))
    np.put_along_axis(of_orders, design.orders[finite], np.diff(ladder, axis=-1), -1)
    parts = np.full((pairs, size), np.nan)
    parts[finite] = of_orders.mean(1)
    return Terms(variance, parts, float(1 - np.isfinite(values).mean()))


def terms_of_vector(found: Sequence[Terms]) -> Terms:
    """Terms of several outputs as of a vector (Gamboa et al., Electron. J. Stat. 8 (2014)), with the same pairs of
    orders, row by row.

    A pair missing in one output is replaced by the mean of that output's other pairs. The other pairs get a larger
    weight, so that the mean over all rows and its variance are the output's own.
    """
    rows = max(len(terms.parts) for terms in found)
    whole = np.zeros((rows, found[0].parts.shape[1]))
    for terms in found:
        finite = np.isfinite(terms.parts).all(1)
        kept = terms.parts[finite]
        middle = kept.mean(0)
        whole += middle
        whole[: len(finite)][finite] += rows / len(kept) * (kept - middle)
    return Terms(sum(t.variance for t in found), whole, max(t.lost for t in found))


def effects_of_terms(terms: Terms) -> Estimate:
    """Shapley effects [-], shape (inputs,)."""
    kept = terms.parts[np.isfinite(terms.parts).all(1)]
    return ratio_estimate(kept, np.full(len(kept), terms.variance))
