"""Check that a model describes the runs at all. If it does not, no effect is named."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from calibration.data import Names
from calibration.data.runs import Runs
from calibration.discovery.active_set import CandidateSpace
from calibration.discovery.loop_notes import MissedChannel
from calibration.discovery.prediction import HeldOutScore
from calibration.inference import checks as unused_room
from calibration.inference.lack_of_fit import EXPLAINED, UNDESCRIBED
from calibration.inference.linearization import Linearization
from calibration.inference.noise import UNSTATED, Noise

#: Least share of the refit's error on unseen runs that effects have to remove where the refit misses a channel.
REMOVED = 0.5


def missed_channels(
    space: CandidateSpace, runs: Runs, noise: Noise, refit: Linearization
) -> tuple[MissedChannel, ...]:
    """Channels with a refit error above `UNDESCRIBED` of their measured rms, or with an estimated noise above it.

    If the stated noise of a channel is that large, residuals up to `EXPLAINED` times the noise are accepted.

    Args:
        refit: linearization of the fit without effects.
    """
    if not space.bare.observe.reads:
        return ()
    has_stated_sd = np.array([source not in UNSTATED for source in noise.source])
    share, sigma = _error_shares(space, runs, noise, refit)
    large = (share > UNDESCRIBED) & ~(has_stated_sd & (sigma <= EXPLAINED))
    counts = space.weight[: len(runs)] > 0
    measured_values = np.where(counts, runs.measured(), np.nan)
    with np.errstate(invalid="ignore"):
        noisy = np.sqrt(np.nansum(np.where(counts, noise.sd, 0.0) ** 2, 0) / np.nansum(measured_values**2, 0))
    noisy = np.where(has_stated_sd, 0.0, noisy)
    return tuple(
        MissedChannel(c.name, float(share[k]), float(noisy[k]))
        for k, c in enumerate(runs.channels)
        if large[k] or noisy[k] > UNDESCRIBED
    )


def remaining_errors(
    space: CandidateSpace, runs: Runs, missed: Sequence[MissedChannel], refit: HeldOutScore, found: HeldOutScore
) -> tuple[MissedChannel, ...]:
    """Hold-out errors of the missed channels after effects were added.

    None if the effects do not describe the runs either. This is so if more than `UNDESCRIBED` of a channel's rms
    remains, less than `REMOVED` of the refit's error has gone, or the noise itself is estimated to be that large.

    Args:
        missed: channels from `missed_channels`.
        refit, found: hold-out predictions without and with the effects.
    """
    before, after = _hold_out_error_shares(space, runs, refit, found)
    index = {c.name: k for k, c in enumerate(runs.channels)}
    remaining = [m._replace(error=float(after[index[m.channel]])) for m in missed]
    described = all(
        m.noise <= UNDESCRIBED and m.error <= min(UNDESCRIBED, (1 - REMOVED) * before[index[m.channel]])
        for m in remaining
    )
    return tuple(remaining) if described else ()


def _hold_out_error_shares(space: CandidateSpace, runs: Runs, *scores: HeldOutScore) -> np.ndarray:
    """Hold-out rms error of each fit, divided by the measured rms of the channel [-]. Only readings that all fits
    predict count. NaN if there is none. Shape (fits, channels).
    """
    measured_values = runs.measured()
    counts = space.weight[: len(runs)] > 0
    off = [[np.where(counts, reading - measured_values, np.nan) for reading in s.reading.values()] for s in scores]
    errors: np.ndarray = np.array(off).reshape(len(scores), -1, measured_values.shape[1])
    errors = np.where(np.isfinite(errors).all(0), errors, np.nan)
    with np.errstate(invalid="ignore"):
        size = np.nansum(np.where(counts, measured_values, np.nan) ** 2, 0) / counts.sum(0)
        return np.sqrt(np.nansum(errors**2, 1) / np.isfinite(errors).sum(1) / size)


def _error_shares(
    space: CandidateSpace, runs: Runs, noise: Noise, fit: Linearization
) -> tuple[np.ndarray, np.ndarray]:
    """rms error and noise of each channel, both divided by its measured rms [-]. Only included readings count. 0 if
    there is none.
    """
    rows = len(runs)
    counts = space.weight[:rows] > 0
    off = np.where(counts, np.asarray(fit.by_row())[:rows], 0.0)
    size = np.sqrt(np.sum(np.where(counts, runs.measured(), 0.0) ** 2, 0))
    error = np.sqrt(np.sum((off * np.where(counts, noise.sd, 0.0)) ** 2, 0))
    return error / np.maximum(size, 1e-300), np.sqrt(np.sum(off**2, 0) / np.maximum(counts.sum(0), 1))


def unused_inputs(runs: Runs) -> Names:
    """Numeric columns that vary but have no role, and an output torque that may be imposed by a brake."""
    torques = (f"{note.theirs} as a condition" for note in unused_room.unexplained_torque_notes(runs))
    return (*unused_room.unused_columns(runs), *torques)
