"""Noise without a stated sd, estimated from the scatter of readings along series of conditions or over time.

A series is rows that differ in one condition only. Along it, readings of a model are smooth. They are also smooth
over time, except at jumps of an imposed quantity or of dry friction, which are left out. The difference of a reading
from the line between its neighbours is noise, plus curvature if the steps are wide. So the estimate may be too
large, never too small (second differences: von Neumann, Ann. Math. Stat. 12 (1941). Gasser, Sroka and
Jennen-Steinmetz, Biometrika 73 (1986), for any spacing).
"""

from __future__ import annotations

import dataclasses
from collections.abc import Hashable, Iterable
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy import sparse
from scipy.special import ndtr

from calibration.data.columns import DRIVEN, SUPPLY
from calibration.data.inferred_facts import display_step
from calibration.data.runs import Runs
from mmrjax.model.channels import Channel

#: The axis of the series if it has enough; else the axis with most degrees of freedom is used.
FIRST = "slope_deg"
#: Least sd as a share of its reading [-].
FLOOR = 1e-3
#: The axis of a log.
TIME = "time_s"
#: Fewest degrees of freedom of an estimate.
FEWEST = 4.0
#: Probability of a form below which it is omitted.
NEGLIGIBLE = 0.01
#: Size of a difference with a wrong reading, and of one over time with a jump, in sds; the largest share of such
#: differences; repeats of their exclusion.
WRONG, JUMP, MOST, CUTS = 5.0, 3.0, 0.25, 10
#: Largest range of a voltage that sags with the load, over its largest value [-].
SAG = 0.15
#: Columns that distinguish rows in addition to the axes.
LABELS = ("configuration", "surface", "mode")


@dataclasses.dataclass(frozen=True)
class SeriesNoise:
    """Noise of a channel, estimated along series.

    Attributes:
        channel: the channel.
        floor: constant part of the sd [SI].
        share: part of the sd that is proportional to the reading [-]. Both parts add as squares.
        freedom: degrees of freedom of the estimate.
        axis: column along which the series run.
        count: number of series.
        least: sd of rounding to the resolution of the display [SI].
    """

    channel: Channel
    floor: float
    share: float
    freedom: float
    axis: str
    count: int
    least: float = 0.0

    def sd(self, sizes: Float[np.ndarray, " rows"]) -> Float[np.ndarray, " rows"]:
        """Standard deviation of readings of these sizes [SI]. At least that of rounding, and at least `FLOOR` of the
        reading, the error of an instrument's scale. That of an angle or a position changes the fitted constants and
        is no noise.
        """
        least = np.maximum(self.least, FLOOR * sizes * self.channel.settled)
        return np.maximum(np.hypot(self.floor, self.share * sizes), least)


def estimate_noise(runs: Runs, sizes: Float[np.ndarray, "rows channels"]) -> tuple[SeriesNoise | None, ...]:
    """Noise of each channel, None if too few rows belong to series.

    Args:
        sizes: reference size of each reading for relative noise [SI].
    """
    if runs.sampled:  # of all rows of a thinned log, with sizes that are those of the channels
        runs = runs.whole
        sizes = np.tile(sizes[:1], (len(runs), 1))
        by_axis = {TIME: list(runs.rows_by_run().values())}
    else:
        by_axis = {axis: series_along(runs, axis) for axis in sorted(runs.axes, key=lambda axis: axis != FIRST)}
    measured = runs.measured()
    noises: list[SeriesNoise | None] = []
    for k, channel in enumerate(runs.channels):
        estimates = [
            _noise_of_channel(channel, measured[:, k], sizes[:, k], runs[a], a, series)
            for a, series in by_axis.items()
        ]
        sufficient = [e for e in estimates if e is not None and e.freedom >= FEWEST]
        preferred = next((e for e in sufficient if e.axis == FIRST), None)
        noises.append(preferred or max(sufficient, key=lambda e: e.freedom, default=None))
    return tuple(noises)


def rows_by_key(keys: Iterable[Hashable]) -> dict[Any, np.ndarray]:
    """Rows with each key, from the key of each row."""
    rows_of_key: dict[Any, list[int]] = {}
    for row, key in enumerate(keys):
        rows_of_key.setdefault(key, []).append(row)
    return {key: np.array(rows) for key, rows in rows_of_key.items()}


def series_along(runs: Runs, axis: str) -> list[np.ndarray]:
    """Rows of each series along an axis, at least three. Backward travel is a separate series.

    Voltages that differ only by the sag of the supply are one level.
    """
    other_columns = [c for c in (*LABELS, *runs.axes) if runs.has(c) and c != axis]
    levels = {c: voltage_levels(runs[c]) if c == SUPPLY else runs[c] for c in other_columns}
    driving = [c for c in (*runs.layout.axes[:1], "supply_voltage_V", "duty") if runs.has(c)]
    keys = (
        (*(str(levels[c][row]) for c in other_columns), *(float(np.sign(runs[c][row])) for c in driving))
        for row in range(len(runs))
    )
    groups = list(rows_by_key(keys).values())
    if runs.has("mode"):
        groups = [rows for rows in groups if runs["mode"][rows[0]] == DRIVEN[0]]
    return [rows for rows in groups if len(rows) > 2]


def voltage_levels(voltage: np.ndarray) -> np.ndarray:
    """Level of each voltage: the largest voltage of its group.

    A group is narrower than `SAG` and narrower than a third of the distance to the next group. Without such groups,
    each voltage is its own level.
    """
    levels = np.unique(voltage)
    gaps = np.diff(levels)
    for smallest_gap in (np.inf, *np.unique(gaps)[::-1]):  # from one group to many
        groups = np.split(levels, np.flatnonzero(gaps >= smallest_gap) + 1)
        if all(np.ptp(g) <= min(SAG * np.abs(g).max(), smallest_gap / 3) for g in groups):
            ends = np.array([g[-1] for g in groups])
            return ends[np.searchsorted(ends, voltage)]
    return voltage


def _noise_of_channel(
    channel: Channel, measured: np.ndarray, sizes: np.ndarray, x: np.ndarray, axis: str, series: list[np.ndarray]
) -> SeriesNoise | None:
    """Noise of a channel as a likelihood-weighted mixture of two forms: a constant sd, and a share of the reading.

    A few series do not decide between the forms, and a pure share would give the smallest readings far too large a
    weight. With four series of five readings, its smallest sd is too small by a factor of 3.7 in one table of twenty,
    that of the mixture by 2.2. Instruments of motors at rest show 0 without noise, so such readings do not count.
    """
    measured = np.where(channel.zero_at_rest & (measured == 0), np.nan, measured)
    weights, series_count = _differences_from_neighbours(measured, x, series)
    if not series_count:
        return None
    difference = weights @ np.nan_to_num(measured)
    rounding_sd = float(display_step(measured, channel) / np.sqrt(12))
    forms = []
    for in_share in (False, True) if np.ptp(sizes) else (False,):
        scale = weights.multiply(sizes[None]) if in_share else weights
        spread = np.sqrt(scale.power(2).sum(1))
        standardised = difference / spread
        scale = sparse.csr_array(scale.multiply(1 / spread[:, None]))
        is_valid, sd = _sound_differences(standardised, JUMP if axis == TIME else WRONG)
        scale = scale[is_valid]
        count = int(is_valid.sum())
        correlations = scale @ scale.T
        freedom = count**2 / float(correlations.power(2).sum())
        log_likelihood = -freedom * float(np.mean(np.log(np.maximum(sd * spread[is_valid], np.finfo(float).tiny))))
        forms.append((log_likelihood, sd, freedom))
    log_likelihood, sd, freedom = np.array(forms).T
    probability = np.exp(log_likelihood - log_likelihood.max()) / np.exp(log_likelihood - log_likelihood.max()).sum()
    floor, *share = (np.sqrt(probability) * sd * (probability > NEGLIGIBLE)).tolist()
    return SeriesNoise(channel, floor, sum(share, 0.0), float(probability @ freedom), axis, series_count, rounding_sd)


def _differences_from_neighbours(
    measured: np.ndarray, x: np.ndarray, series: list[np.ndarray]
) -> tuple[sparse.csr_array, int]:
    """Difference of each reading from the line between its neighbours, as weights of the readings, and the number of
    series.

    The weights have the shape (differences, rows). Only series with at least one difference are counted.
    """
    differences = []
    series_count = 0
    for rows in series:
        rows = rows[np.isfinite(measured[rows])]
        rows = rows[np.argsort(x[rows], kind="stable")]
        before, middle, after = rows[:-2], rows[1:-1], rows[2:]
        span = x[after] - x[before]
        share = np.where(span > 0, (x[after] - x[middle]) / np.where(span > 0, span, 1.0), 0.5)
        k = np.tile(np.arange(len(middle)), 3)
        weights = np.concatenate([-share, np.ones(len(middle)), share - 1.0])
        coordinates = k, np.concatenate([before, middle, after])
        differences.append(sparse.csr_array((weights, coordinates), (len(middle), len(measured))))
        series_count += bool(len(middle))
    return sparse.csr_array(sparse.vstack(differences)) if differences else sparse.csr_array(
        (0, len(measured))
    ), series_count


def _sound_differences(standardised: np.ndarray, limit: float) -> tuple[np.ndarray, float]:
    """True for differences within so many of their sds, and this sd, that of a normal distribution so truncated.

    All differences if too many would lie beyond.
    """
    density = np.exp(-(limit**2) / 2) / np.sqrt(2 * np.pi)
    share = np.sqrt(1 - 2 * limit * density / (2 * ndtr(limit) - 1))
    sd = 1.4826 * float(np.median(np.abs(standardised)))
    for _ in range(CUTS):
        is_valid = np.abs(standardised) <= limit * sd
        if np.mean(~is_valid) > MOST:
            return np.ones(len(standardised), bool), float(np.sqrt(np.mean(standardised**2)))
        sd = float(np.sqrt(np.mean(standardised[is_valid] ** 2)) / share)
    return is_valid, sd
