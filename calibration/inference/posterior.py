"""Posteriors of fits, from their coordinates and the covariance of these."""

from __future__ import annotations

import numpy as np

from calibration.data.posterior import LOG, NORMAL, Posterior
from calibration.inference.priors import SOFTNESS, Coordinates


def of_coordinates(coordinates: Coordinates, z: np.ndarray, covariance: np.ndarray) -> Posterior:
    """The posterior of a fit whose coordinates have this optimum and covariance."""
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
