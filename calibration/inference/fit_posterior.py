"""Posteriors of fits, from their coordinates and covariance."""

from __future__ import annotations

from collections.abc import Collection

import numpy as np

from calibration.data import Names
from calibration.data.posterior_file import LOG, NORMAL, Posterior
from calibration.inference.fit_notes import Pair
from calibration.inference.priors import SOFTNESS, Coordinates

#: Correlation beyond which two parameters are not determined separately.
TOGETHER = 0.95
#: Ratio of two relative sds up to which the combination of two parameters is a ratio or a product.
EVEN = 1.25


def posterior_of_coordinates(coordinates: Coordinates, z: np.ndarray, covariance: np.ndarray) -> Posterior:
    """Posterior of a fit with optimum z and this covariance."""
    size = len(coordinates)
    return Posterior(
        coordinates=coordinates.names,
        units=coordinates.units,
        mean=np.asarray(z, float),
        covariance=np.asarray(covariance, float),
        location=np.asarray(coordinates.location, float),
        spread=np.asarray(coordinates.spread, float),
        low=np.asarray(coordinates.low, float),
        high=np.asarray(coordinates.high, float),
        softness=np.full(size, SOFTNESS),
        kinds=tuple(LOG if scale else NORMAL for scale in coordinates.scale),
        tied=coordinates.tied,
    )


def determined_together(posterior: Posterior, held: Collection[str] = ()) -> tuple[Pair, ...]:
    """Pairs of parameters with a posterior correlation beyond `TOGETHER`, strongest first, and their combination.

    Args:
        held: names of parameters held by their priors. A pair of two of these is omitted. In a pair with one of them,
            the other is known only as well as that prior, and the data determine only their combination.
    """
    sd = np.sqrt(np.diag(posterior.covariance))
    value = posterior.at(posterior.mean)
    log = np.array([kind == LOG for kind in posterior.kinds])
    spread = posterior.spread * sd  # of the parameter, or of its logarithm
    groups = []
    for i, j in zip(*np.triu_indices(len(sd), 1), strict=True):
        one, other = posterior.coordinates[i], posterior.coordinates[j]
        correlation = float(posterior.covariance[i, j] / max(sd[i] * sd[j], 1e-300))
        if not abs(correlation) > TOGETHER or (one in held and other in held):
            continue
        size = spread * np.where(log, value[: len(sd)], 1.0)
        weight = -np.sign(correlation) * abs(size[i] / size[j])
        even = log[i] and log[j] and 1 / EVEN < spread[i] / spread[j] < EVEN
        form = "linear" if not even else "ratio" if correlation > 0 else "product"
        groups.append(Pair(one, other, correlation, form, float(weight)))
    return tuple(sorted(groups, key=lambda pair: -abs(pair.correlation)))


def undetermined_names(held: Collection[str], pairs: Collection[Pair]) -> Names:
    """Names held by priors, without names in a pair with a determined combination."""
    paired = {name for pair in pairs for name in (pair.one, pair.other)}
    return tuple(name for name in held if name not in paired)
