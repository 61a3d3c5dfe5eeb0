"""Linear algebra at a fit: columns projected against the free parameters, and the defect of a balance by row."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import numpy as np

from calibration.inference.bases import place_signature
from calibration.inference.linearization import Linearization


class Projection:
    """Projection of columns on the complement of the free parameters, as if these were fitted again.

    Args:
        linear: at the base fit of settled rows. Its prior rows are those of the free parameters.
    """

    def __init__(self, linear: Linearization) -> None:
        jacobian, residual = np.asarray(linear.jacobian), np.asarray(linear.residual)
        self.readings = linear.readings
        half = np.linalg.solve(np.linalg.cholesky(jacobian.T @ jacobian), jacobian.T)
        self.half = half[:, : self.readings]
        self.left = (residual - half.T @ (half @ residual))[: self.readings]

    def __call__(self, columns: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """A = Cᵀ (I - P) C and b = -Cᵀ (I - P) e: coefficients a explain 2 bᵀa - aᵀA a of χ².

        Args:
            columns: whitened change of the readings per unit, shape (readings, columns).
        """
        inside = self.half @ columns
        return columns.T @ columns - inside.T @ inside, -columns.T @ self.left


@dataclasses.dataclass(frozen=True)
class Defect:
    """Error of a balance or channel in each row, after the free parameters have absorbed their part.

    Attributes:
        value, sd: [unit of the place], shape (rows,), NaN if the readings do not show it.
    """

    value: np.ndarray
    sd: np.ndarray


def defect_by_row(linear: Linearization, place: str) -> Defect:
    """Error of one balance equation in each row, by least squares that also refits the free parameters.

    δ_i = -(r_i·e) / ‖r_i‖² with the sd 1/‖r_i‖ and r_i = (I - P) g_i. The residuals are e. All readings change by g_i
    per unit error of the equation in row i. In time histories the error is largest at that instant and falls to zero
    at the neighbouring knots. Rows between knots are NaN.
    """
    places = linear.places()
    shapes = np.zeros((linear.rows, len(places)))
    shapes[places, np.arange(len(places))] = 1.0
    columns = place_signature(linear, place, shapes)
    a, b = Projection(linear)(columns)
    norm2, total_norm = np.diag(a), np.sum(columns**2, 0)
    is_visible = norm2 > 1e-6 * np.maximum(total_norm, 1e-300)
    norm2 = np.where(is_visible, norm2, np.nan)
    value, sd = np.full(linear.rows, np.nan), np.full(linear.rows, np.nan)
    value[places], sd[places] = b / norm2, 1 / np.sqrt(norm2)
    return Defect(value, sd)


def explained_by(jacobian: np.ndarray, residual: np.ndarray) -> Callable[[np.ndarray], tuple[float, float]]:
    """Function of columns over the readings: decrease of χ² and remaining sensitivity of all columns [σ²]."""
    half = np.linalg.solve(np.linalg.cholesky(jacobian.T @ jacobian), jacobian.T)
    projected_residual = residual - half.T @ (half @ residual)

    def of(columns: np.ndarray) -> tuple[float, float]:
        inside = half[:, : len(columns)] @ columns
        inner, told = columns.T @ columns - inside.T @ inside, columns.T @ projected_residual[: len(columns)]
        return float(told @ np.linalg.lstsq(inner, told, rcond=1e-9)[0]), float(np.trace(inner))

    return of
