"""Entries of a calibration's result: parameters, noise and errors at the optimum."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from calibration.data import Columns
from calibration.data.columns import DRIVING
from calibration.data.runs import Runs
from calibration.inference import result, simulation_errors
from calibration.inference.blocks import HeldOutFits
from calibration.inference.identifiability import Z95, Identifiability
from calibration.inference.noise import Noise
from calibration.inference.observers import Observer
from calibration.inference.problem import Problem
from calibration.inference.result import ChannelNoise, ChannelReadings, ChiSquare, Errors, Estimate, HeldOutErrors
from calibration.inference.scans import Scan
from calibration.inference.simulation_errors import sized_error
from mmrjax.model import channels, params
from mmrjax.model.channels import Channel
from mmrjax.model.robot import Robot

#: Least change of the readings by one prior sd of a parameter for the data to determine it at all [data sd].
SENSITIVE = 1e-6

#: Bound that a coordinate reached, by its side.
SIDE_OF_BOUND = {-1: "lower", 0: None, 1: "upper"}


def parameter_estimates(
    problem: Problem,
    base: Robot,
    z: np.ndarray,
    analysis: Identifiability,
    profile: tuple[np.ndarray, np.ndarray] | None,
    steady_optimum: np.ndarray | None,
    sources: dict[str, str],
    scans: Mapping[int, Scan],
) -> dict[str, Estimate]:
    """Estimate of each free parameter, by name.

    Args:
        problem, base: the problem, and the robot at the prior means.
        z: coordinates of the optimum.
        analysis, profile: linear analysis at the optimum, and intervals of `profile_intervals`, if any.
        steady_optimum: optimum of the same problem with `steady`, or None.
        sources: source of each prior that is not from a field.
        scans: scans of coordinates. Their intervals replace those of the profiles.
    """
    coordinates = problem.coordinates
    point, sd = np.asarray(z), np.asarray(analysis.sd)
    value = coordinates.value(point)
    slope = np.asarray(coordinates.slope(point))
    stated_values = coordinates.stated
    linear_interval = np.stack([coordinates.value(point + side * Z95 * sd) for side in (-1, 1)], 1)
    prior_interval = np.stack([coordinates.value(np.full_like(point, side * Z95)) for side in (-1, 1)], 1)
    steady: list[result.SteadyEstimate | None] = [None] * len(point)
    if steady_optimum is not None:
        with_steady = zip(
            coordinates.value(steady_optimum).tolist(), ((z - steady_optimum) / analysis.sd).tolist(), strict=True
        )
        steady = [result.SteadyEstimate(x, distance) for x, distance in with_steady]
    bound = coordinates.beyond(z)
    fields = params.parameters_by_name(base)
    estimates = {}
    for k, name in enumerate(coordinates.names):
        interval = linear_interval[k]
        is_open = (False, False)
        if profile is not None:
            interval = profile[0][k]
            is_open = tuple(profile[1][k].tolist())
        if k in scans:
            is_open = scans[k].open()
            ends = [np.where(np.arange(len(z)) == k, x, point) for x in scans[k].interval()]
            interval = np.array([coordinates.value(end)[k] for end in ends])
        estimates[name] = Estimate(
            value=float(value[k]),
            sd=float(analysis.sd[k] * slope[k]),
            interval=_float_pair(interval),
            interval_linear=_float_pair(linear_interval[k]),
            interval_open=is_open,
            unit=coordinates.units[k],
            meaning=fields[name].spec.meaning,
            prior=result.PriorSummary(
                "log-normal" if coordinates.scale[k] else "normal",
                float(stated_values[k]),
                _float_pair(prior_interval[k]),
                sources.get(name, fields[name].spec.source),
            ),
            shift=float(z[k]),
            variance_ratio=float(analysis.sd[k] ** 2),
            held_by_prior=bool(analysis.held_by_prior[k]),
            at_bound=SIDE_OF_BOUND[int(bound[k])],
            measured_by_data=bool(analysis.sensitivity[k] > SENSITIVE),
            profiled=profile is not None,
            with_steady=steady[k],
        )
    return estimates


def _float_pair(ends: np.ndarray) -> tuple[float, float]:
    return float(ends[0]), float(ends[1])


def channel_noise(
    problem: Problem, noise: Noise, shares: np.ndarray, measured: np.ndarray
) -> dict[str, ChannelNoise]:
    """Source and size of the noise of each channel."""
    share = np.where(np.isfinite(measured), np.asarray(problem.data.sd) / np.maximum(np.abs(measured), 1e-12), np.nan)
    return {
        name: ChannelNoise(
            noise.source[k],
            100 * float(np.nanmedian(share[:, k])) if np.isfinite(share[:, k]).any() else np.nan,
            100 * float(shares[k]) if noise.estimated[k] else None,
        )
        for k, name in enumerate(channels.channel_names(problem.channels))
    }


def errors_by_channel(
    measured_channels: Sequence[Channel],
    simulated: np.ndarray,
    measured: np.ndarray,
    sd: np.ndarray,
    percent: np.ndarray | None = None,
) -> Errors:
    """Errors of each channel. Arguments as in `simulation_errors.channel_errors`."""
    errors = simulation_errors.channel_errors(measured_channels, simulated, measured, sd, percent)
    return {name: result.ChannelErrors(**e) for name, e in errors.items()}


def hold_out_errors(
    problem: Problem, held_out_fits: HeldOutFits, measured: np.ndarray, sd: np.ndarray
) -> HeldOutErrors:
    """Hold-out errors of all rows together and of each block."""
    percent = sized_error(held_out_fits.reading, measured)
    unreachable = problem.observe.unreachable(held_out_fits.status)
    blocks = {}
    for k, label in enumerate(held_out_fits.labels):
        is_in_block = held_out_fits.block == k
        of_block, percent_of_block = (
            np.where(is_in_block[:, None], x, np.nan) for x in (held_out_fits.reading, percent)
        )
        blocks[label] = result.BlockErrors(
            errors_by_channel(problem.channels, of_block, measured, sd, percent_of_block),
            row_numbers(is_in_block & unreachable),
            bool(held_out_fits.converged[k]),
        )
    reading = dict(zip(channels.channel_names(problem.channels), held_out_fits.reading.T, strict=True))
    return HeldOutErrors(
        errors_by_channel(problem.channels, held_out_fits.reading, measured, sd, percent),
        row_numbers(unreachable),
        blocks,
        reading,
    )


def row_numbers(rows: np.ndarray) -> tuple[int, ...]:
    """Row numbers of a mask, counted from 1."""
    return tuple((np.flatnonzero(rows) + 1).tolist())


def readings_by_channel(
    measured_channels: Sequence[Channel],
    measured: np.ndarray,
    sd: np.ndarray,
    before: np.ndarray,
    after: np.ndarray,
) -> dict[str, ChannelReadings]:
    """Measured and simulated readings of each channel. Arguments have shape (rows, channels), NaN for missing
    readings.
    """
    percent = sized_error(after, measured)
    sigma = (after - measured) / sd
    return {
        name: ChannelReadings(*(x[:, k] for x in (measured, sd, before, after, percent, sigma)))
        for k, name in enumerate(channels.channel_names(measured_channels))
    }


def chi_square(
    after: np.ndarray, measured: np.ndarray, sd: np.ndarray, analysis: Identifiability, noise: Noise
) -> ChiSquare:
    """χ² of the finite readings, and the degrees of freedom that the fit leaves."""
    finite = np.isfinite(measured)
    misfit = np.where(finite, (after - measured) / sd, 0.0)
    freedom = float(finite.sum() - analysis.leverage.sum())
    return ChiSquare(float(np.sum(misfit**2)), freedom, not bool(noise.estimated.any()))


def condition_columns(observe: type[Observer], runs: Runs) -> Columns:
    """Columns that identify the rows: run, conditions, surface."""
    other_axes = (axis for axis in observe.axes_of(runs) if axis not in runs.axes)
    columns = ("run_id", *other_axes, "configuration", *runs.axes, *DRIVING, "surface")
    return {column: runs[column] for column in columns if runs.has(column)}
