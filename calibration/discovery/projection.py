"""Linear algebra at a fit: projection orthogonal to the free parameters, and the error of a balance in each row."""

from __future__ import annotations

import functools

import numpy as np

from calibration.inference.bases import place_signature
from calibration.inference.linearization import Linearization

#: Share of a signature's norm below which the free parameters absorb it completely.
ABSORBED = 1e-3


class Projection:
    """Projects columns orthogonally to the free parameters of a fit, as if these were fitted again.

    Columns are whitened changes of the readings per unit, shape (readings, columns). Prior rows belong to the free
    parameters.

    Args:
        jacobian, residual: Jacobian J and residuals e of the fit, those of the readings first.
    """

    def __init__(self, jacobian: np.ndarray, residual: np.ndarray) -> None:
        self.jacobian, self.residual = jacobian, residual

    @classmethod
    def of(cls, linear: Linearization) -> Projection:
        """Projection at a linearized fit."""
        return cls(np.asarray(linear.jacobian), np.asarray(linear.residual))

    @functools.cached_property
    def half(self) -> np.ndarray:
        """H = L⁻¹ Jᵀ with L Lᵀ = JᵀJ, so that HᵀH projects onto the columns of J, shape (coordinates, rows)."""
        return np.linalg.solve(np.linalg.cholesky(self.jacobian.T @ self.jacobian), self.jacobian.T)

    @functools.cached_property
    def left(self) -> np.ndarray:
        """Projected residuals (I - P) e."""
        return self.residual - self.half.T @ (self.half @ self.residual)

    def __call__(self, columns: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """A = Cᵀ (I - P) C and b = -Cᵀ (I - P) e. Coefficients a of the columns C reduce χ² by 2 bᵀa - aᵀA a."""
        absorbed = self.half[:, : len(columns)] @ columns
        return columns.T @ columns - absorbed.T @ absorbed, -columns.T @ self.left[: len(columns)]

    def explained(self, columns: np.ndarray) -> tuple[float, float]:
        """Decrease of χ² by all columns, and their sensitivity that the free parameters leave [σ²]."""
        a, b = self(columns)
        return float(b @ np.linalg.lstsq(a, b, rcond=1e-9)[0]), float(np.trace(a))

    def norms(self, columns: np.ndarray, rows: np.ndarray | slice | None = None) -> tuple[np.ndarray, np.ndarray]:
        """Squared norm of each projected column, and its product with the residuals.

        Args:
            rows: readings of the columns. None: the first ones.
        """
        rows = slice(len(columns)) if rows is None else rows
        absorbed = self.half[:, rows] @ columns
        return np.sum(columns**2, 0) - np.sum(absorbed**2, 0), columns.T @ self.left[rows]

    def roots(self, columns: np.ndarray, rows: np.ndarray | slice | None = None) -> np.ndarray:
        """Square root of the score of each column [σ]. 0 for columns that the free parameters can imitate."""
        norms, scores = self.norms(columns, rows)
        is_visible = norms > ABSORBED**2 * np.sum(columns**2, 0)
        return np.where(is_visible, np.abs(scores) / np.sqrt(np.maximum(norms, 1e-12)), 0.0)

    def only(self, kept: np.ndarray) -> Projection:
        """Projection of the same fit with some of the readings. Residuals of priors remain.

        Args:
            kept: True for readings that remain, shape (readings,).
        """
        rows = np.append(kept, np.ones(len(self.residual) - len(kept), bool))
        return Projection(self.jacobian[rows], self.residual[rows])


def balance_error_by_row(linear: Linearization, place: str) -> tuple[np.ndarray, np.ndarray]:
    """Error of one balance equation in each row, by least squares that also refits the free parameters, and its
    standard deviation [unit of the balance or channel]. NaN if the readings do not show it.

    δ_i = -(r_i·e) / ‖r_i‖² with the sd 1/‖r_i‖ and r_i = (I - P) g_i. The residuals are e. All readings change by g_i
    per unit error of the equation in row i. In time histories the error is largest at that instant and falls to zero
    at the neighbouring knots. Rows between knots are NaN.
    """
    places = linear.revealing_rows()
    shapes = np.zeros((linear.rows, len(places)))
    shapes[places, np.arange(len(places))] = 1.0
    columns = place_signature(linear, place, shapes)
    norm2, products = Projection.of(linear).norms(columns)
    norm2 = np.where(norm2 > 1e-6 * np.maximum(np.sum(columns**2, 0), 1e-300), norm2, np.nan)
    value, sd = np.full((2, linear.rows), np.nan)
    value[places], sd[places] = -products / norm2, 1 / np.sqrt(norm2)
    return value, sd
