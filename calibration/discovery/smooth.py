"""Smooth curves over a variable in a balance, linearised at a fit. The size and length of their prior maximise the
evidence.
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Callable

import numpy as np
from jaxtyping import Array
from numpy.polynomial import legendre

from calibration.discovery.projection import Projection
from calibration.inference.bases import ORDERS, place_signature, scale_to_unit_range, window_from_name
from calibration.inference.linearization import Linearization
from mmrjax.compile.compiling import compiled
from mmrjax.effects.curve import ORDINATES, ordinate_weights

#: Priors of the ordinates that are tried: correlation lengths [spacings], sizes [σ by an ordinate].
LENGTHS, SIZES = (1.0, 1.5, 2.5, 4.0), tuple(np.geomspace(0.3, 300.0, 25))
#: Terms of each variable of a surface, and the decrease of their prior sd with the degree (in logarithms).
PRODUCT, FALL = 4, 0.35
#: Margin before and after a temporary change, as a share of its duration.
MARGIN = 0.3
#: Width of a condition's level for that margin, as a share of the condition's range.
NARROW = 0.05
#: Prior sd of a curve's level and trend, relative to the prior sd of its shape.
WIDE = 3.0
#: Number of plotted points of a curve.
POINTS = 61


@dataclasses.dataclass(frozen=True)
class SmoothCurve:
    """A smooth curve (or a wave) at the base fit. The size and length of its prior maximise the evidence.

    Attributes:
        effect, variable: name of the curve as an effect, and its variable.
        low, high: range of the variable.
        scale: amplitude of the curve [unit of the balance].
        root: L of the prior covariance L Lᵀ of the ordinates, shape (ordinates, ordinates).
        start: ordinates in prior coordinates, y = L z, shape (ordinates,).
        covariance: their posterior covariance, with the base refitted to first order.
        explained: decrease of χ² [σ²].
        freedom: effective number of parameters.
        evidence: twice the log of the marginal likelihood ratio of curve and no curve [σ²].
    """

    effect: str
    variable: str
    low: float
    high: float
    scale: float
    root: np.ndarray
    start: np.ndarray
    covariance: np.ndarray
    explained: float
    freedom: float
    evidence: float

    @property
    def temporary(self) -> bool:
        """True if it describes a temporary change."""
        return window_from_name(self.variable) is not None

    def basis(self, x: np.ndarray) -> np.ndarray:
        """Weight of each ordinate at x, shape (points, ordinates)."""
        return _basis_functions(self.variable, x, self.low, self.high)

    def drawn(self, z: np.ndarray, covariance: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Values of the variable, and the curve and its sd there, for ordinates in prior coordinates."""
        grid = np.linspace(self.low, self.high, POINTS)
        shape = self.scale * self.basis(grid) @ self.root
        return grid, shape @ z, np.sqrt(np.einsum("ij,jk,ik->i", shape, covariance, shape))


def _basis_functions(variable: str, x: np.ndarray, low: float, high: float) -> np.ndarray:
    if variable in ORDERS:
        return np.stack([np.sin(x), np.cos(x)], 1)
    return np.asarray(_weights(np.asarray(x), np.asarray(low), np.asarray(high)))


_weights: Callable[..., Array] = compiled(ordinate_weights)


def fit_smooth_curve(linear: Linearization, balance: str, variable: str, included: np.ndarray) -> SmoothCurve:
    """Smooth curve over a variable in a balance, fitted at the linearised base fit.

    The ordinates are a Gaussian process with covariance s² exp(-½ (Δ/l)²) at distance Δ. A level and a trend, WIDE
    times as large, are added because base parameters can absorb them. Size s and length l maximise the evidence
    (Rasmussen and Williams 2006, eqs. (2.39), (5.8)). A wave has independent sine and cosine.

    Args:
        included: True for included rows, shape (rows,).
    """
    window = window_from_name(variable)
    axis = variable if window is None else window.axis
    (x, way), included = linear.curve_variable(balance, axis), linear.at_points(included)
    low, high = (0.0, 2 * np.pi) if variable in ORDERS else (float(x[included].min()), float(x[included].max()))
    if window is not None:
        margin = MARGIN * max(window.high - window.low, NARROW * (high - low))
        low, high = window.low - margin, window.high + margin
    if not high - low > 1e-9 * max(abs(high), abs(low), 1e-9):
        high = low + max(abs(low), 1.0)  # a constant variable shows only an offset
    basis = _basis_functions(variable, x, low, high)
    a, b = Projection.of(linear)(place_signature(linear, balance, way[:, None] * basis))
    size = 1 / np.sqrt(max(np.diag(a).max(), 1e-300))
    roots = [np.eye(2)] if variable in ORDERS else [_prior_root(length, window is not None) for length in LENGTHS]
    best: tuple[float, tuple] = (-np.inf, ())
    for root, sigmas in itertools.product(roots, SIZES):
        scale = sigmas * size
        prior_information, pull = scale**2 * root.T @ a @ root, scale * root.T @ b
        information = np.eye(len(root)) + prior_information
        z = np.linalg.solve(information, pull)
        evidence = 0.5 * pull @ z - 0.5 * np.linalg.slogdet(information)[1]
        if evidence > best[0]:
            covariance = np.linalg.inv(information)
            explained = float(2 * pull @ z - z @ prior_information @ z)
            freedom = float(np.trace(covariance @ prior_information))
            best = evidence, (scale, root, z, covariance, explained, freedom, 2 * float(evidence))
    return SmoothCurve(f"curve_{balance}_{axis}", variable, low, high, *best[1])


def _prior_root(length: float, is_temporary: bool) -> np.ndarray:
    """L of the prior covariance L Lᵀ of the ordinates for one correlation length [spacings of the ordinates]. A
    temporary change is zero at its ends.
    """
    across = np.linspace(-1.0, 1.0, len(ORDINATES))
    distance = np.subtract.outer(np.arange(len(ORDINATES)), np.arange(len(ORDINATES)))
    covariance = np.exp(-0.5 * (distance / length) ** 2) + 1e-6 * np.eye(len(ORDINATES))
    if not is_temporary:
        covariance += WIDE**2 * (1 + np.outer(across, across))
    root = np.linalg.cholesky(covariance)
    if is_temporary:
        root[[0, -1]] = 0.0
    return root


def fit_smooth_surface(
    linear: Linearization, balance: str, variables: tuple[str, str], included: np.ndarray, project: Projection
) -> tuple[float, np.ndarray]:
    """Smooth discrepancy over two variables, as a sum of products of Legendre polynomials.

    The prior sd of a term decreases with its degree. The common size of all terms maximises the evidence.

    Args:
        included: True for included rows, shape (rows,).

    Returns:
        Evidence as in `SmoothCurve`, and the sensitivity of the readings to each term, scaled by its prior sd, shape
        (readings, terms).
    """
    weight = linear.at_points(included).astype(float)
    bases, ways = zip(*(linear.curve_variable(balance, v) for v in variables), strict=True)
    polynomials = [
        legendre.legvander(scale_to_unit_range(x, weight), PRODUCT - 1) * np.exp(-FALL * np.arange(PRODUCT))
        for x in bases
    ]
    shapes = ways[0][:, None] * (polynomials[0][:, :, None] * polynomials[1][:, None, :]).reshape(linear.points, -1)
    columns = place_signature(linear, balance, shapes)
    a, b = project(columns)
    size = 1 / np.sqrt(max(np.diag(a).max(), 1e-300))
    best = -np.inf, 0.0
    for sigmas in SIZES:
        scale = sigmas * size
        information = np.eye(len(b)) + scale**2 * a
        z = np.linalg.solve(information, scale * b)
        evidence = scale * b @ z - np.linalg.slogdet(information)[1]
        best = max(best, (float(evidence), scale))
    return best[0], best[1] * columns
