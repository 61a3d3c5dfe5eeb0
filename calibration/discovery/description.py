"""Check that a model describes the runs at all; otherwise no effect is named."""

from __future__ import annotations

import numpy as np

from calibration.data.runs import Runs
from calibration.discovery.active_set import CandidateSpace
from calibration.discovery.loop_notes import Missed
from calibration.inference import unused as unused_room
from calibration.inference.lack_of_fit import EXPLAINED, UNDESCRIBED
from calibration.inference.linearization import Linearization
from calibration.inference.noise import UNSTATED, Noise

#: Largest error, as a share of a channel's measured rms, of a fit with effects that describes runs which the refit
#: misses by more than `UNDESCRIBED`: the effects are then the missing part.
MENDED = 0.05


def undescribed_channels(
    space: CandidateSpace, runs: Runs, noise: Noise, refit: Linearization, found: Linearization | None = None
) -> tuple[Missed, ...]:
    """Channels that the refit misses by more than `UNDESCRIBED` of their rms, or with estimated noise that large.

    None if the effects found bring all errors below `MENDED`. A channel with stated noise that large is described by
    residuals up to `EXPLAINED` times its sds.

    Args:
        refit, found: the fits without and with effects, linearised; None without effects.
    """
    stated = np.array([source not in UNSTATED for source in noise.source])
    share, sigma = _error_shares(space, runs, noise, refit)
    large = (share > UNDESCRIBED) & ~(stated & (sigma <= EXPLAINED))
    if large.any() and found is not None and np.nanmax(_error_shares(space, runs, noise, found)[0]) < MENDED:
        large[:] = False
    counts = space.weight[: len(runs)] > 0
    measured = np.where(counts, runs.measured(), np.nan)
    with np.errstate(invalid="ignore"):
        noisy = np.sqrt(np.nansum(np.where(counts, noise.sd, 0.0) ** 2, 0) / np.nansum(measured**2, 0))
    noisy = np.where(stated, 0.0, noisy)
    return tuple(
        Missed(c.name, float(share[k]), float(noisy[k]))
        for k, c in enumerate(runs.channels)
        if large[k] or noisy[k] > UNDESCRIBED
    )


def _error_shares(
    space: CandidateSpace, runs: Runs, noise: Noise, fit: Linearization
) -> tuple[np.ndarray, np.ndarray]:
    """rms error of each channel over its measured rms [-], and in sds [σ], over included readings; 0 without any."""
    rows = len(runs)
    counts = space.weight[:rows] > 0
    off = np.where(counts, np.asarray(fit.by_row())[:rows], 0.0)
    size = np.sqrt(np.sum(np.where(counts, runs.measured(), 0.0) ** 2, 0))
    error = np.sqrt(np.sum((off * np.where(counts, noise.sd, 0.0)) ** 2, 0))
    return error / np.maximum(size, 1e-300), np.sqrt(np.sum(off**2, 0) / np.maximum(counts.sum(0), 1))


def unused_inputs(runs: Runs) -> tuple[str, ...]:
    """Columns of numbers that vary and have no role, and an output torque that a brake may impose."""
    torques = (f"{note.theirs} as a condition" for note in unused_room.unexplained_torque_notes(runs))
    return (*unused_room.unused_columns(runs), *torques)
