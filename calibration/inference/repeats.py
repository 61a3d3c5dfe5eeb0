"""Noise estimated from rows that repeat the same conditions."""

from __future__ import annotations

import itertools
import math

import numpy as np
from jaxtyping import Int

from calibration.data import Names
from calibration.data.runs import Runs
from calibration.inference.fit_notes import Remark
from calibration.inference.noise import UNSTATED, Noise

#: Fewest differences between repeats for an estimate of the noise: of two readings, one may be wrong.
FEWEST = 3
#: Probability of a median difference this large under the stated noise, below which the noise is enlarged.
IMPROBABLE = 1e-3
#: Median of the magnitude of a standard normal number.
MEDIAN = 0.6745


def rows_of_same_conditions(runs: Runs) -> list[Int[np.ndarray, " rows"]]:
    """Rows of each set of equal conditions. A set may have a single row."""
    columns = [c for c in ("configuration", *runs.axes, "surface") if runs.has(c)]
    alike: dict[Names, list[int]] = {}
    for row, key in enumerate(zip(*(runs[c].astype(str).tolist() for c in columns), strict=True)):
        alike.setdefault(key, []).append(row)
    return [np.array(rows) for rows in alike.values()]


def enlarge_noise(noise: Noise, runs: Runs) -> tuple[Noise, list[Remark]]:
    """Noise that is consistent with the repeats in a table, and a remark for each channel whose sd was enlarged.

    The median difference between neighbouring repeats decides, so that a few wrong readings have no effect. Noise
    estimated along series already includes the repeats.
    """
    if runs.sampled:
        return noise, []
    pairs = [pair for rows in rows_of_same_conditions(runs) for pair in itertools.pairwise(rows)]
    if len(pairs) < FEWEST:
        return noise, []
    first_rows, second_rows = np.array(pairs).T
    difference_in_sds = np.abs(runs.measured()[first_rows] - runs.measured()[second_rows]) / np.hypot(
        noise.sd[first_rows], noise.sd[second_rows]
    )
    factors, notes = dict[str, float](), list[Remark]()
    for k, channel in enumerate(noise.channels):
        deviations = difference_in_sds[np.isfinite(difference_in_sds[:, k]), k]
        if len(deviations) < FEWEST or noise.source[k] in ("series", "estimated", "no readings"):
            continue
        median = float(np.median(deviations))
        if _median_tail(median, len(deviations)) < IMPROBABLE:
            factors[channel.name] = median / MEDIAN
            notes.append(
                Remark(
                    "larger_noise",
                    channel=channel.name,
                    factor=factors[channel.name],
                    pairs=len(deviations),
                    source=UNSTATED.get(noise.source[k], "stated"),
                )
            )
    return noise.scaled(factors), notes


def _median_tail(median: float, count: int) -> float:
    """Probability that the median magnitude of `count` standard normal numbers is at least `median`."""
    tail_probability, needed_count = math.erfc(median / math.sqrt(2)), (count + 1) // 2
    return sum(
        math.comb(count, k) * tail_probability**k * (1 - tail_probability) ** (count - k)
        for k in range(needed_count, count + 1)
    )
