"""Errors of a simulation: relative error of equation (35), its summary by channel, and R² of (A1)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from mmrjax.model.channels import Channel


def relative_error(simulated: np.ndarray, measured: np.ndarray) -> np.ndarray:
    """δCV = (CV - EV) / CV · 100 [%], eq. (35), with CV simulated and EV measured, any shape."""
    return 100.0 * (simulated - measured) / simulated


#: Reference of percent errors of fits. A simulated size would make a model that overshoots look better.
OF_SIZE = "channel's measured root mean square"


def sized_error(simulated: np.ndarray, measured: np.ndarray) -> np.ndarray:
    """Error relative to the measured rms: (CV - EV) / rms(EV) · 100 [%]. Only rows with both values count.

    Args:
        simulated, measured: CV and EV, shape (rows, ...).
    """
    is_compared = np.isfinite(simulated) & np.isfinite(measured)
    with np.errstate(divide="ignore", invalid="ignore"):  # NaN for a channel without readings
        size = np.sqrt(np.sum(np.square(measured), 0, where=is_compared) / is_compared.sum(0))
        return np.asarray(100.0 * (simulated - measured) / size)


def share_of_measured(simulated: np.ndarray, measured: np.ndarray) -> np.ndarray:
    """rms error divided by the measured rms [-], shape (channels,). Only rows with both values count. NaN if there is
    none.

    Args:
        simulated, measured: shape (rows, channels), or shapes that broadcast to it.
    """
    simulated, measured = np.broadcast_arrays(simulated, measured)
    is_compared = np.isfinite(simulated) & np.isfinite(measured)
    error_rms, measured_rms = (
        np.sqrt(np.sum(np.square(x), 0, where=is_compared)) for x in (simulated - measured, measured)
    )
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(error_rms / measured_rms)


def root_mean_square(errors: np.ndarray) -> float:
    """Root mean square of the finite errors, or NaN."""
    finite = errors[np.isfinite(errors)]
    return float(np.sqrt(np.mean(finite**2))) if finite.size else float("nan")


def error_summary(errors: np.ndarray) -> dict[str, float | int]:
    """Root mean square and largest magnitude of the finite errors (35) [%], and their number."""
    finite = errors[np.isfinite(errors)]
    largest = float(np.abs(finite).max()) if finite.size else float("nan")
    return {"rows": int(finite.size), "rms_percent": root_mean_square(finite), "max_percent": largest}


def r_squared(measured: np.ndarray, approximated: np.ndarray) -> float:
    """R² of eq. (A1) [-]: 1 - Σ(y - Y)² / (ΣY² - (ΣY)²/n), Y measured, y the approximation.

    NaN if the measured values do not vary, or if fewer than two rows have both.
    """
    is_compared = np.isfinite(measured) & np.isfinite(approximated)
    y, approximation = measured[is_compared], approximated[is_compared]
    if y.size < 2:
        return float("nan")
    spread = float(np.sum(y**2) - np.sum(y) ** 2 / y.size)
    return float(1 - np.sum((approximation - y) ** 2) / spread) if spread > 0 else float("nan")


def channel_errors(
    channels: Sequence[Channel],
    simulated: np.ndarray,
    measured: np.ndarray,
    sd: np.ndarray,
    percent: np.ndarray | None = None,
) -> dict[str, dict[str, Any]]:
    """Errors of each channel over rows with a simulated and a measured value: in percent, in sds, and as `rms` in its
    unit.

    Args:
        channels: the channels.
        simulated, measured, sd: readings and standard deviations [SI], NaN if missing, shape (rows, channels).
        percent: percentage errors of the same shape. None: `sized_error`.
    """
    percent = sized_error(simulated, measured) if percent is None else percent
    errors = simulated - measured
    return {
        channel.name: {
            **error_summary(percent[:, k]),
            "rms_sigma": root_mean_square(errors[:, k] / sd[:, k]),
            "rms": root_mean_square(errors[:, k]) / channel.factor,
        }
        for k, channel in enumerate(channels)
    }
