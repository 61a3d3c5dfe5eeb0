"""Test of whether outliers cluster in time, angle, order or condition.

A single outlier is a wrong reading. If several are closer together than by chance, they have a common cause, and
their removal would hide it.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping

import numpy as np
from scipy.special import ndtr

#: Fewest outliers in a cluster.
FEWEST = 3
#: Widths of the windows in which they are counted, as shares of the range.
WINDOWS = (1 / 16, 1 / 8, 1 / 4)
#: Permutations that give the p-value of a count.
PERMUTATIONS = 1000
#: Columns whose levels are tested.
LEVELS = ("configuration", "supply_voltage_V", "slope_deg", "payload_kg", "run_id", "surface", "duty", "mode")


@dataclasses.dataclass(frozen=True)
class Cluster:
    """Outliers that are close together.

    Attributes:
        axis: column, or angle, of the cluster.
        low, high: its ends.
        level: of a column of words or levels.
        inside, of: number of outliers in it, and of all.
        p: p-value.
    """

    axis: str
    low: float
    high: float
    level: str
    inside: int
    of: int
    p: float


def find_cluster(
    outliers: np.ndarray,
    included: np.ndarray,
    axes: Mapping[str, np.ndarray],
    levels: Mapping[str, np.ndarray],
    error: float,
    seed: int,
) -> Cluster | None:
    """Most significant cluster of outliers, None if it is consistent with chance.

    Args:
        outliers, included: True for outliers, and for other included rows, shape (rows,).
        axes: positions of rows along continuous variables.
        levels: columns of conditions.
        error: family-wise error.
        seed: random seed of the permutations.
    """
    pool = np.flatnonzero(outliers | included)
    outlier_rows = np.flatnonzero(outliers)
    if len(outlier_rows) < FEWEST:
        return None
    clusters = [_cluster_along_axis(name, np.asarray(x, float), outlier_rows, pool, seed) for name, x in axes.items()]
    clusters += [c for name, x in levels.items() for c in _at_levels(name, np.asarray(x), outlier_rows, pool)]
    if not clusters:
        return None
    best = min(clusters, key=lambda c: c.p)
    p = min(1.0, best.p * (len(axes) + len(levels)))
    return dataclasses.replace(best, p=p) if p < error else None


def _cluster_along_axis(name: str, x: np.ndarray, mine: np.ndarray, pool: np.ndarray, seed: int) -> Cluster:
    """The fullest window of an axis, compared with random draws of as many rows."""
    low, high = x[pool].min(), x[pool].max()
    random = np.random.default_rng(seed)
    permutations = np.stack([random.choice(pool, len(mine), replace=False) for _ in range(PERMUTATIONS)])
    clusters: list[Cluster] = []
    for share in WINDOWS:
        width = share * (high - low)
        count, first = _fullest_window(x[mine][None], width)
        null, _ = _fullest_window(x[permutations], width)
        p = (1 + int(np.sum(null >= count[0]))) / (1 + PERMUTATIONS)
        if p == 1 / (1 + PERMUTATIONS):  # beyond the resolution of permutations: a normal approximation
            p = min(p, float(ndtr((null.mean() - count[0]) / max(null.std(), 0.3))))
        inside = x[mine][(x[mine] >= first[0]) & (x[mine] <= first[0] + width)]
        clusters.append(Cluster(name, float(inside.min()), float(inside.max()), "", int(count[0]), len(mine), p))
    best = min(clusters, key=lambda c: c.p)
    return dataclasses.replace(best, p=min(1.0, best.p * len(WINDOWS)))


def _fullest_window(x: np.ndarray, width: float) -> tuple[np.ndarray, np.ndarray]:
    """Largest number of places within a window of a width, for each set, and the start of that window."""
    x = np.sort(x, 1)
    inside = np.stack([np.searchsorted(row, row + width, side="right") - np.arange(len(row)) for row in x])
    return inside.max(1), x[np.arange(len(x)), inside.argmax(1)]


def _at_levels(name: str, x: np.ndarray, mine: np.ndarray, pool: np.ndarray) -> list[Cluster]:
    """Each level of a column, with the hypergeometric p-value of its number of outliers."""
    values = np.unique(x[pool])
    if not 1 < len(values) <= 0.5 * len(pool):
        return []
    from scipy.stats import hypergeom  # takes a second to import, and is rarely needed

    answers = []
    for value in values:
        inside, size = int(np.sum(x[mine] == value)), int(np.sum(x[pool] == value))
        p = float(hypergeom.sf(inside - 1, len(pool), size, len(mine)))
        answers.append(Cluster(name, np.nan, np.nan, str(value), inside, len(mine), min(1.0, p * len(values))))
    return answers
