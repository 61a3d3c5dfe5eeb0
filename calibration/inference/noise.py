"""Standard deviations of the measured channels: from columns of the file, as stated, from repeats, or estimated."""

from __future__ import annotations

import dataclasses
import itertools
import math
import re
from collections.abc import Iterable, Mapping

import numpy as np
from jaxtyping import Float, Int

from calibration.data import Names
from calibration.data.input_errors import BadConfiguration, BadData, allowed_words
from calibration.data.runs import Runs
from calibration.inference import series_noise
from calibration.inference.fit_notes import Remark
from calibration.inference.series_noise import SeriesNoise
from mmrjax.model import channels
from mmrjax.model.channels import Channel

#: Initial estimate of a noise as a share of the reading [-].
START = 0.02
#: Share of a channel's rms below which a reading's sd in per cent no longer decreases: instruments have a zero.
LEAST_SIZE = 0.2
#: Fewest differences between repeats for an estimate of the noise: of two readings, one may be wrong.
REPEATS = 3
#: Probability of a median difference this large under the stated noise, below which the noise is enlarged.
IMPROBABLE = 1e-3
#: Median of the magnitude of a standard normal number.
MEDIAN = 0.6745
#: Sources of sds that nobody states, with their names in messages.
UNSTATED = {"assumed": "assumed", "series": "estimated"}


@dataclasses.dataclass(frozen=True)
class Noise:
    """Standard deviations of the readings and their sources.

    Attributes:
        channels: channels, in the order of the arrays.
        sd: standard deviations [SI], shape (rows, channels). An initial guess if they will be estimated, 1 for
            missing readings.
        estimated: True for channels whose sd is to be estimated from the misfit, shape (channels,).
        source: source of each channel's sd: `columns`, `stated`, `estimated`, `series`, `assumed`, or `no readings`.
        along_series: noise estimates of channels with the source `series`.
    """

    channels: tuple[Channel, ...]
    sd: np.ndarray
    estimated: np.ndarray
    source: Names
    along_series: tuple[SeriesNoise, ...] = ()

    @property
    def word(self) -> str:
        """Source of the sds, as a word for messages."""
        return next((w for source, w in UNSTATED.items() if source in self.source), "stated")

    @property
    def silent(self) -> tuple[Channel, ...]:
        """Channels whose noise is not stated."""
        return tuple(c for c, source in zip(self.channels, self.source, strict=True) if source in UNSTATED)

    @property
    def freedom(self) -> Float[np.ndarray, " channels"]:
        """Degrees of freedom of each channel's sd, infinite if it is stated or assumed."""
        freedoms = {s.channel: s.freedom for s in self.along_series}
        return np.array([freedoms.get(c, np.inf) for c in self.channels])

    def scaled(self, factors: Mapping[str, float]) -> Noise:
        """Noise with the sds of some channels multiplied by a factor. `factors`: by channel name."""
        factor = np.array([factors.get(name, 1.0) for name in channels.channel_names(self.channels)])
        return dataclasses.replace(self, sd=self.sd * factor)


def parse_noise(text: str, measured_channels: tuple[Channel, ...]) -> dict[int, tuple[float, bool]]:
    """Reads noise given as text, such as `current=2%,motor_speed=0.5%,speed=1%` or
    `current=0.05A,motor_speed=30rpm,speed=5mm/s`.

    Args:
        measured_channels: the available channels.

    Returns:
        Position of the channel → (number, True for a share of the reading). Absolute numbers in SI.

    Raises:
        BadConfiguration: an unknown channel, a number that is not positive, or another unit.
    """
    channel_of_short_name = {c.word: k for k, c in enumerate(measured_channels)}
    channel_of_word = channel_of_short_name | {c.name: k for k, c in enumerate(measured_channels)}
    noise_of_channel: dict[int, tuple[float, bool]] = {}
    for part in text.split(","):
        name, _, value = part.strip().partition("=")
        if name not in channel_of_word:
            raise BadConfiguration(
                f"--noise {part.strip()}: no such channel; {allowed_words(name, channel_of_short_name)}"
            )
        k = channel_of_word[name]
        if k in noise_of_channel:
            raise BadConfiguration(f"--noise {part.strip()}: {name} is given twice; expected each channel once")
        channel = measured_channels[k]
        match = re.fullmatch(r"\s*(\+?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?)\s*(%|[^\d\s.]+)\s*", value)
        units = channel.sizes
        expected = (
            f"expected a positive number with % or {' or '.join(units)}, e.g. {name}=2% or {name}=0.1{channel.unit}"
        )
        size = float(match[1]) if match else math.nan
        if match is None or not 0 < size < math.inf or match[2] not in ("%", *units):
            raise BadConfiguration(f"--noise {part.strip()}: {expected}")
        relative = match[2] == "%"
        noise_of_channel[k] = (size / 100 if relative else size * units[match[2]], relative)
    return noise_of_channel


def noise_from_table(runs: Runs, sizes: np.ndarray, stated: str | None = None) -> Noise:
    """Noise of a table: as stated, otherwise from the sd columns of the file, otherwise to be estimated.

    Known sds include the quantisation error of the instrument, `Instrument.variance`.

    Args:
        sizes: reference size of each reading [SI] for noise stated as a share, see `Observer.sizes`, shape (rows,
            channels).
        stated: text for `parse_noise`.

    Raises:
        BadConfiguration: for the same reasons as `parse_noise`.
        BadData: a channel reads zero everywhere and has no stated sd.
    """
    shares = parse_noise(stated, runs.channels) if stated else {}
    measured = runs.measured()
    sd_columns = runs.deviations()
    rms = np.sqrt(np.nanmean(np.where(np.isfinite(measured).any(0), measured, 0.0) ** 2, 0))
    sizes = np.maximum(sizes, LEAST_SIZE * rms)
    sd = np.ones_like(measured)
    source = []
    for k, channel in enumerate(runs.channels):
        finite = np.isfinite(measured[:, k])
        if not finite.any():
            source.append("no readings")
            continue
        if k not in shares and runs.has(channel.sd_column):
            sd[:, k] = np.where(finite, sd_columns[:, k], 1.0)
            source.append("columns")
            continue
        sd_or_share, is_share = shares.get(k, (START, True))
        if is_share and not np.any(measured[finite, k] != 0):
            raise BadData(
                f"{runs.source}: {channel.name} reads 0 in every "
                f"row{', so nothing moves' * channel.zero_at_rest}; log it while it changes, or give its noise "
                f"in {channel.unit} with --noise"
            )
        sd[:, k] = np.where(finite, sd_or_share * sizes[:, k] if is_share else sd_or_share, 1.0)
        source.append("stated" if k in shares else "estimated")
    quantum = np.array([runs.layout.variance(name) for name in channels.channel_names(runs.channels)])
    is_stated = np.array([s in ("columns", "stated") for s in source])  # an estimate already includes it
    if (is_stated & (quantum > 0)).any():
        sd = np.where(is_stated & np.isfinite(measured), np.sqrt(sd**2 + quantum), sd)
    return Noise(runs.channels, sd, np.array([s == "estimated" for s in source]), tuple(source))


def default_noise(measured_channels: Iterable[Channel]) -> str:
    """Default noise of the loop, used if neither the file nor the user states any.

    They are for averages of at least three repeats, printed to 0.05 A, 10 rpm and 10 mm/s, as in Tables A1 and A2.
    """
    return ",".join(f"{c.word}={100 * c.sd_share:g}%" for c in measured_channels)


def infer_noise(runs: Runs, sizes: np.ndarray, stated: str | None = None) -> Noise:
    """Noise of a table, as in `noise_from_table`, but known before any fit.

    Noise that is not stated is the scatter along series or over time (`series_noise`) or, without series,
    `default_noise`.

    Raises:
        BadConfiguration, BadData: for the same reasons as `noise_from_table`.
    """
    table_noise = noise_from_table(runs, sizes, stated)
    if not table_noise.estimated.any():
        return table_noise
    sd = table_noise.sd.copy()
    sources = list(table_noise.source)
    series = []
    assumed = noise_from_table(runs, sizes, default_noise(runs.channels))
    from_series = series_noise.estimate_noise(runs, sizes)
    for k in np.flatnonzero(table_noise.estimated):
        estimate = from_series[k]
        if estimate is None:
            sd[:, k], sources[k] = assumed.sd[:, k], "assumed"
        else:
            sd[:, k] = np.where(np.isfinite(runs.measured()[:, k]), estimate.sd(sizes[:, k]), 1.0)
            sources[k] = "series"
            series.append(estimate)
    return Noise(runs.channels, sd, np.zeros(len(sources), bool), tuple(sources), tuple(series))


# --- repeats --------------------------------------------------------------------------------------------


def rows_of_same_conditions(runs: Runs) -> list[Int[np.ndarray, " rows"]]:
    """Rows of each set of equal conditions. A set may have a single row."""
    columns = [c for c in ("configuration", *runs.axes, "surface") if runs.has(c)]
    keys = zip(*(runs[c].astype(str).tolist() for c in columns), strict=True)
    return list(series_noise.rows_by_key(keys).values())


def enlarge_noise(noise: Noise, runs: Runs) -> tuple[Noise, list[Remark]]:
    """Noise that is consistent with the repeats in a table, and a remark for each channel whose sd was enlarged.

    The median difference between neighbouring repeats decides, so that a few wrong readings have no effect. Noise
    estimated along series already includes the repeats.
    """
    if runs.sampled:
        return noise, []
    pairs = [pair for rows in rows_of_same_conditions(runs) for pair in itertools.pairwise(rows)]
    if len(pairs) < REPEATS:
        return noise, []
    first_rows, second_rows = np.array(pairs).T
    difference_in_sds = np.abs(runs.measured()[first_rows] - runs.measured()[second_rows]) / np.hypot(
        noise.sd[first_rows], noise.sd[second_rows]
    )
    factors = dict[str, float]()
    remarks = list[Remark]()
    for k, channel in enumerate(noise.channels):
        deviations = difference_in_sds[np.isfinite(difference_in_sds[:, k]), k]
        if len(deviations) < REPEATS or noise.source[k] in ("series", "estimated", "no readings"):
            continue
        median = float(np.median(deviations))
        if _median_tail(median, len(deviations)) < IMPROBABLE:
            factors[channel.name] = median / MEDIAN
            remarks.append(
                Remark(
                    "larger_noise",
                    channel=channel.name,
                    factor=factors[channel.name],
                    pairs=len(deviations),
                    source=UNSTATED.get(noise.source[k], "stated"),
                )
            )
    return noise.scaled(factors), remarks


def _median_tail(median: float, count: int) -> float:
    """Probability that the median magnitude of `count` standard normal numbers is at least `median`."""
    tail_probability = math.erfc(median / math.sqrt(2))
    needed_count = (count + 1) // 2
    return sum(
        math.comb(count, k) * tail_probability**k * (1 - tail_probability) ** (count - k)
        for k in range(needed_count, count + 1)
    )
