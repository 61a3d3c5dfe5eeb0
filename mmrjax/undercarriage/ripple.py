"""Effects of the running gear's discreteness on a run: ripple, its period (34), touchdowns, stages I-III.

Computed from a finished run, in NumPy, member by member; not differentiable.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

Series = Float[np.ndarray, " samples"]


class Ripple(NamedTuple):
    """Fluctuation of a signal about its mean.

    Attributes:
        mean: [the signal's unit].
        amplitude: half of peak to peak over the mean [-].
        period: of repetition [s]; NaN: no repetition within half the record.
    """

    mean: float
    amplitude: float
    period: float


def ripple(time: Series, values: Series) -> Ripple:
    """Ripple of evenly sampled `values`, with a linear drift removed.

    Two events per pitch (a grouser lands in front, another lifts at the rear) make a harmonic the strongest
    line of the spectrum. The period is therefore the first lag with an autocorrelation of at least 0.9 of the
    largest. It is refined by a parabola and by counting on to the last such repetition.
    """
    time, values = np.asarray(time, float), np.asarray(values, float)
    rest = values - np.polyval(np.polyfit(time, values, 1), time)
    n = len(rest)
    lags = np.arange(n // 2)
    with np.errstate(invalid="ignore", divide="ignore"):  # for a constant signal
        agreement = np.array([np.corrcoef(rest[: n - k], rest[k:])[0, 1] for k in lags])
    inner = agreement[1:-1]
    peaks = 1 + np.nonzero((inner > agreement[:-2]) & (inner >= agreement[2:]))[0]
    period = float("nan")
    good = peaks[agreement[peaks] >= 0.9 * agreement[peaks].max(initial=0.0)]
    if len(good):
        first = _vertex(agreement, good[0])
        count = np.round(good / first)
        near = np.abs(good / first - count) < 0.2
        last = good[near][-1]
        period = float(_vertex(agreement, last) / np.round(last / first) * (time[1] - time[0]))
    return Ripple(float(values.mean()), float(np.ptp(rest) / 2 / abs(values.mean())), period)


class Fluctuation(NamedTuple):
    """Variation of a signal about its mean, and its strongest frequency.

    Attributes:
        mean: [the signal's unit].
        deviation: standard deviation over the mean [-].
        frequency: of the strongest line of its spectrum [Hz]; NaN: it is constant.
    """

    mean: float
    deviation: float
    frequency: float


def fluctuation(time: Series, values: Series) -> Fluctuation:
    """Fluctuation of evenly sampled `values`, with a linear drift removed and a Hann window for the spectrum."""
    time, values = np.asarray(time, float), np.asarray(values, float)
    mean = float(values.mean())
    if not np.isfinite(values).all() or mean == 0.0:
        return Fluctuation(mean, float("nan"), float("nan"))
    rest = values - np.polyval(np.polyfit(time, values, 1), time)
    deviation = float(rest.std() / abs(mean))
    if deviation < 1e-13:  # rounding
        return Fluctuation(mean, deviation, float("nan"))
    size = 1 << (8 * len(rest) - 1).bit_length()  # zero padding, for a fine grid of frequencies
    power = np.abs(np.fft.rfft(rest * np.hanning(len(rest)), size)) ** 2
    best = int(np.argmax(power[1:-1])) + 1
    return Fluctuation(mean, deviation, float(_vertex(power, best) / (size * (time[1] - time[0]))))


def _vertex(values: Series, k: int) -> float:
    below, here, above = values[k - 1 : k + 2]
    return float(k + (below - above) / (2 * (below - 2 * here + above)))


def period_pitch(pitch: float, speed_wheel: float, radius: float) -> float:
    """T = S / (ω_k r_k) [s], eq. (34), with S_g for tracks, S_t for the tooth mesh; `radius` of the pulley."""
    return pitch / (speed_wheel * radius)


def touchdowns(
    time: Series, grouser: Float[np.ndarray, "samples 24"], place: Float[np.ndarray, "samples 24"]
) -> Series:
    """Times at which a grouser touches down, in order [s]; `place` distinguishes the front arc from the rear one.

    A grouser that lifts and returns in the middle of the run does not count: its place has to be in the second half
    of the path, or just at the start of it.
    """
    bears = np.asarray(grouser) > 0
    lands = ~bears[:-1] & bears[1:]
    length = np.asarray(place).max()
    front = (np.asarray(place)[1:] > length / 2) | (np.asarray(place)[1:] < 0.02 * length)
    return np.sort(np.asarray(time)[1:][np.nonzero(lands & front)[0]])
