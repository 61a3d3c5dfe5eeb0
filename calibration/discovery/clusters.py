"""Whether outliers cluster: rows that lie off together, in time, angle, order or condition, are a finding.

An outlier is a reading that went wrong by itself. Where several lie closer together than chance puts them, something
happened there, and a clean-up would hide it.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping

import numpy as np
from scipy.special import ndtr

#: Fewest outliers that can be a cluster.
FEWEST = 3
#: Shares of a range over which they are counted.
WINDOWS = (1 / 16, 1 / 8, 1 / 4)
#: Permutations that give the chance of a count.
PERMUTATIONS = 1000
#: Columns whose levels are looked at.
LEVELS = ("configuration", "supply_voltage_V", "slope_deg", "payload_kg", "run_id", "surface", "duty", "mode")


@dataclasses.dataclass(frozen=True)
class Cluster:
    """Outliers that lie together.

    Attributes:
        axis: column, or angle, in which they do; low, high: the stretch; level: of a column of words or levels.
        inside, of: how many outliers lie there, of how many; p: chance of that.
    """

    axis: str
    low: float
    high: float
    level: str
    inside: int
    of: int
    p: float


def cluster(
    outliers: np.ndarray,
    included: np.ndarray,
    axes: Mapping[str, np.ndarray],
    levels: Mapping[str, np.ndarray],
    error: float,
    seed: int,
) -> Cluster | None:
    """The most improbable cluster of outliers, None where chance could put them so.

    Args:
        outliers, included: whether a row is one, or counts otherwise; shape (rows,).
        axes: places of rows along something that goes on; levels: columns of conditions.
        error: family-wise error; seed: of the permutations.
    """
    pool = np.flatnonzero(outliers | included)
    mine = np.flatnonzero(outliers)
    if len(mine) < FEWEST:
        return None
    found = [_along(name, np.asarray(x, float), mine, pool, seed) for name, x in axes.items()]
    found += [c for name, x in levels.items() for c in _at_levels(name, np.asarray(x), mine, pool)]
    if not found:
        return None
    best = min(found, key=lambda c: c.p)
    p = min(1.0, best.p * (len(axes) + len(levels)))
    return dataclasses.replace(best, p=p) if p < error else None


def _along(name: str, x: np.ndarray, mine: np.ndarray, pool: np.ndarray, seed: int) -> Cluster:
    """The fullest stretch of an axis, against as many rows drawn from all."""
    low, high = x[pool].min(), x[pool].max()
    random = np.random.default_rng(seed)
    drawn = np.stack([random.choice(pool, len(mine), replace=False) for _ in range(PERMUTATIONS)])
    found: list[Cluster] = []
    for share in WINDOWS:
        width = share * (high - low)
        count, first = _fullest(x[mine][None], width)
        null, _ = _fullest(x[drawn], width)
        p = (1 + int(np.sum(null >= count[0]))) / (1 + PERMUTATIONS)
        if p == 1 / (1 + PERMUTATIONS):  # beyond what permutations tell: as of a normal count
            p = min(p, float(ndtr((null.mean() - count[0]) / max(null.std(), 0.3))))
        inside = x[mine][(x[mine] >= first[0]) & (x[mine] <= first[0] + width)]
        found.append(Cluster(name, float(inside.min()), float(inside.max()), "", int(count[0]), len(mine), p))
    best = min(found, key=lambda c: c.p)
    return dataclasses.replace(best, p=min(1.0, best.p * len(WINDOWS)))


def _fullest(x: np.ndarray, width: float) -> tuple[np.ndarray, np.ndarray]:
    """How many of each set of places lie in its fullest stretch of a width, and where that begins."""
    x = np.sort(x, 1)
    inside = np.stack([np.searchsorted(row, row + width, side="right") - np.arange(len(row)) for row in x])
    return inside.max(1), x[np.arange(len(x)), inside.argmax(1)]


def _at_levels(name: str, x: np.ndarray, mine: np.ndarray, pool: np.ndarray) -> list[Cluster]:
    """Each level of a column, by the hypergeometric chance of so many outliers at it."""
    values = np.unique(x[pool])
    if not 1 < len(values) <= 0.5 * len(pool):
        return []
    from scipy.stats import hypergeom  # a second to import, and seldom needed

    answers = []
    for value in values:
        inside, size = int(np.sum(x[mine] == value)), int(np.sum(x[pool] == value))
        p = float(hypergeom.sf(inside - 1, len(pool), size, len(mine)))
        answers.append(Cluster(name, np.nan, np.nan, str(value), inside, len(mine), min(1.0, p * len(values))))
    return answers
