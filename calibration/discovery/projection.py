"""Linear algebra at a fit: projection orthogonal to the free parameters, and the error of a balance in each row."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import numpy as np

from calibration.inference.bases import place_signature
from calibration.inference.linearization import Linearization


def projection_factor(jacobian: np.ndarray) -> np.ndarray:
    """H = L⁻¹ Jᵀ with L Lᵀ = JᵀJ, so that HᵀH projects onto the columns of J, shape (columns, rows)."""
    return np.linalg.solve(np.linalg.cholesky(jacobian.T @ jacobian), jacobian.T)


class Projection:
    """Projects columns orthogonally to the free parameters, as if these were fitted again.

    Args:
        linear: linearization of the base fit of settled rows. Its prior rows belong to the free parameters.
    """

    def __init__(self, linear: Linearization) -> None:
        jacobian, residual = np.asarray(linear.jacobian), np.asarray(linear.residual)
        self.readings = linear.readings
        half = projection_factor(jacobian)
        self.half = half[:, : self.readings]
        self.left = (residual - half.T @ (half @ residual))[: self.readings]

    def __call__(self, columns: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """A = Cᵀ (I - P) C and b = -Cᵀ (I - P) e. Coefficients a of the columns C reduce χ² by 2 bᵀa - aᵀA a.

        Args:
            columns: whitened change of the readings per unit, shape (readings, columns).
        """
        inside = self.half @ columns
        return columns.T @ columns - inside.T @ inside, -columns.T @ self.left


@dataclasses.dataclass(frozen=True)
class BalanceError:
    """Error of a balance or channel in each row that the free parameters cannot absorb.

    Attributes:
        value, sd: error and its standard deviation [unit of the balance or channel], shape (rows,). NaN if the
            readings do not show it.
    """

    value: np.ndarray
    sd: np.ndarray


def balance_error_by_row(linear: Linearization, place: str) -> BalanceError:
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
    return BalanceError(value, sd)


def explained_function(jacobian: np.ndarray, residual: np.ndarray) -> Callable[[np.ndarray], tuple[float, float]]:
    """Function that returns how much columns over the readings explain of a fit's residuals.

    Its results are the decrease of χ² by all columns, and their sensitivity that the free parameters leave [σ²].
    """
    half = projection_factor(jacobian)
    projected_residual = residual - half.T @ (half @ residual)

    def explained(columns: np.ndarray) -> tuple[float, float]:
        inside = half[:, : len(columns)] @ columns
        inner, told = columns.T @ columns - inside.T @ inside, columns.T @ projected_residual[: len(columns)]
        return float(told @ np.linalg.lstsq(inner, told, rcond=1e-9)[0]), float(np.trace(inner))

    return explained
