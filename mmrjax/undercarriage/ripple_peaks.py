"""Ripple caused by the running gear, its peaks over speed, and the natural frequencies that explain them.

Computed from finished runs, in NumPy, member by member, not differentiable.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.signal import find_peaks, peak_widths

from mmrjax.fidelities.track import TrackTrajectory
from mmrjax.model.robot import Robot
from mmrjax.model.signals import CONVERGED, NOT_SETTLED
from mmrjax.undercarriage.modes import Mode
from mmrjax.undercarriage.running_gear import TEETH_PULLEY, BeltPath

Series = Float[np.ndarray, " samples"]


def measure_ripple(time: Series, values: Series) -> tuple[float, float, float]:
    """Ripple of evenly sampled `values`, with a linear drift removed.

    Two events per pitch (a grouser lands in front, another lifts at the rear) make a harmonic the strongest
    line of the spectrum. The period is therefore the first lag with an autocorrelation of at least 0.9 of the
    largest. It is refined by a parabola and by counting on to the last such repetition.

    Returns:
        Mean [unit of the signal], half of the peak-to-peak value relative to the mean [-], and period of repetition
        [s]. NaN: no repetition within half the record.
    """
    time, values = np.asarray(time, float), np.asarray(values, float)
    detrended = values - np.polyval(np.polyfit(time, values, 1), time)
    n = len(detrended)
    lags = np.arange(n // 2)
    with np.errstate(invalid="ignore", divide="ignore"):  # for a constant signal
        autocorrelation = np.array([np.corrcoef(detrended[: n - k], detrended[k:])[0, 1] for k in lags])
    inside = autocorrelation[1:-1]
    peaks = 1 + np.nonzero((inside > autocorrelation[:-2]) & (inside >= autocorrelation[2:]))[0]
    period = float("nan")
    candidates = peaks[autocorrelation[peaks] >= 0.9 * autocorrelation[peaks].max(initial=0.0)]
    if len(candidates):
        fundamental = _parabola_vertex(autocorrelation, candidates[0])
        period_counts = np.round(candidates / fundamental)
        is_multiple = np.abs(candidates / fundamental - period_counts) < 0.2
        last = candidates[is_multiple][-1]
        period = float(_parabola_vertex(autocorrelation, last) / np.round(last / fundamental) * (time[1] - time[0]))
    return float(values.mean()), float(np.ptp(detrended) / 2 / abs(values.mean())), period


def measure_fluctuation(time: Series, values: Series) -> tuple[float, float, float]:
    """Fluctuation of evenly sampled `values`, with a linear drift removed and a Hann window for the spectrum.

    Returns:
        Mean [unit of the signal], standard deviation relative to the mean [-], and frequency of the strongest line of
        the spectrum [Hz]. NaN: it is constant.
    """
    time, values = np.asarray(time, float), np.asarray(values, float)
    mean = float(values.mean())
    if not np.isfinite(values).all() or mean == 0.0:
        return mean, float("nan"), float("nan")
    detrended = values - np.polyval(np.polyfit(time, values, 1), time)
    deviation = float(detrended.std() / abs(mean))
    if deviation < 1e-13:  # rounding
        return mean, deviation, float("nan")
    size = 1 << (8 * len(detrended) - 1).bit_length()  # zero padding, for a fine grid of frequencies
    power = np.abs(np.fft.rfft(detrended * np.hanning(len(detrended)), size)) ** 2
    best = int(np.argmax(power[1:-1])) + 1
    return mean, deviation, float(_parabola_vertex(power, best) / (size * (time[1] - time[0])))


def _parabola_vertex(values: Series, k: int) -> float:
    value_before, value_at, value_after = values[k - 1 : k + 2]
    return float(k + (value_before - value_after) / (2 * (value_before - 2 * value_at + value_after)))


def period_pitch(pitch: float, speed_wheel: float, radius: float) -> float:
    """T = S / (ω_k r_k) [s], eq. (34), with S_g for tracks, S_t for the tooth mesh. `radius` of the pulley."""
    return pitch / (speed_wheel * radius)


def touchdown_times(
    time: Series, grouser: Float[np.ndarray, "samples 24"], place: Float[np.ndarray, "samples 24"]
) -> Series:
    """Touchdown times of a grouser, in order [s]. Its position `place` tells the front arc from the rear
    one.

    A grouser that lifts and returns in the middle of the run does not count. Its place has to be in the second half
    of the path, or just at the start of it.
    """
    is_loaded = np.asarray(grouser) > 0
    is_landing = ~is_loaded[:-1] & is_loaded[1:]
    length = np.asarray(place).max()
    front = (np.asarray(place)[1:] > length / 2) | (np.asarray(place)[1:] < 0.02 * length)
    return np.sort(np.asarray(time)[1:][np.nonzero(is_landing & front)[0]])


class RippleSignal(NamedTuple):
    """A signal whose ripple is studied: its field, its name in words, its display unit, and the SI value of that
    unit.
    """

    field: str
    label: str
    unit: str
    factor: float


#: By name.
SIGNALS = {
    "reaction": RippleSignal("normal", "ground reaction", "N", 1.0),
    "current": RippleSignal("total_current", "current", "A", 1.0),
    "speed": RippleSignal("speed", "speed", "mm_s", 1e-3),
    "motor_speed": RippleSignal("speed_motor", "motor speed", "rpm", 2 * np.pi / 60),
}
TAIL = 0.5  # share of a run, at its end, that is evaluated
PERIODS = 3  # fewest pitches in it for a valid ripple
#: Least prominence of a peak over speed, as a share of its height, and least height [-].
STANDS_OUT, NOTICEABLE = 0.05, 2e-4
MATTERS = 0.01  # ripple above which a speed should be avoided [-]
MOVES = 0.03  # relative change of a mode with payload that its peaks have to follow
_SAME = 0.2  # of an order: largest distance of the strongest line from a whole order


class PassingParts(NamedTuple):
    """Parts of the running gear that pass the chassis at a regular distance and excite vibrations.

    Attributes:
        name: `grousers` or `teeth`.
        pitch: distance between two of them along the belt [m].
        travel: travel of the robot between two of them, without slip [m].
    """

    name: str
    pitch: float
    travel: float


def passing_parts(robot: Robot, configuration: int) -> PassingParts:
    """Parts that excite vibrations in a configuration: grousers with pitch S_g on tracks, teeth with S_t on
    wheels.
    """
    chassis = robot.configurations.members[configuration]
    pulley_radius = float(robot.radius_pulley)
    if float(chassis.on_tracks) > 0.5:
        pitch = float(BeltPath(robot.radius_pulley, robot.running_gear).pitch)
        return PassingParts("grousers", pitch, pitch)
    pitch = 2 * np.pi * pulley_radius / TEETH_PULLEY
    return PassingParts("teeth", pitch, pitch * float(chassis.radius) / pulley_radius)


@dataclasses.dataclass(frozen=True)
class Vibrations:
    """Ripple in each run of a batch, NaN where it could not be evaluated (`read`).

    Attributes:
        status: codes into `STATUSES`.
        read: True if the ripple is valid: the robot travels, and at least `PERIODS` pitches have passed.
        speed: mean speed [m/s].
        passing: passing frequency of grousers or teeth [Hz].
        mean, deviation, frequency: mean, relative deviation and strongest frequency of each of `SIGNALS`, see
            `measure_fluctuation`.
    """

    status: np.ndarray
    read: np.ndarray
    speed: np.ndarray
    passing: np.ndarray
    mean: dict[str, np.ndarray]
    deviation: dict[str, np.ndarray]
    frequency: dict[str, np.ndarray]

    @property
    def settled(self) -> np.ndarray:
        """True for valid runs in steady travel."""
        return self.read & (self.status == CONVERGED)


def vibrations_of_runs(robot: Robot, runs: TrackTrajectory, pitch: float) -> Vibrations:
    """Ripple at the end of each run of a batch.

    Args:
        runs: simulated runs, fields of shape (runs, samples, ...).
        pitch: pitch of the passing parts [m].
    """
    time = np.asarray(runs.time[0])
    status = np.asarray(runs.result.status)
    tail = time > time[-1] - TAIL * (time[-1] - time[0])
    tail_time = time[tail]
    vibrations = {
        name: np.array(
            [measure_fluctuation(tail_time, x) for x in np.asarray(getattr(runs.signals, signal.field))[:, tail]]
        )
        for name, signal in SIGNALS.items()
    }
    rates = np.asarray(runs.signals.speed_wheel)[:, tail].mean(axis=1) * float(robot.radius_pulley) / pitch
    travels = np.isin(status, (CONVERGED, NOT_SETTLED)) & np.isfinite([x[:, 1] for x in vibrations.values()]).all(
        axis=0
    )
    read = travels & (rates * (tail_time[-1] - tail_time[0]) >= PERIODS)
    column = {name: np.where(read[:, None], x, np.nan).T for name, x in vibrations.items()}
    mean, deviation, frequency = ({name: x[k] for name, x in column.items()} for k in range(3))
    return Vibrations(status, read, mean["speed"], np.where(read, rates, np.nan), mean, deviation, frequency)


class RipplePeak(NamedTuple):
    """A peak of ripple over speed at one payload.

    Attributes:
        signal: signal, one of `SIGNALS`.
        payload: payload [kg].
        speed, low, high: speed, lower limit and upper limit at the maximum, and limits of the range above 70 % of its
            rise [m/s].
        ripple: largest ripple: standard deviation relative to the mean [-].
        rise: rise of the ripple above the higher of the two valleys next to it [-].
        order: strongest multiple of the passing frequency. 0: not a whole multiple.
        frequency: frequency of the strongest line [Hz].
        mode: natural vibration at that frequency, which explains the peak. Empty: there is none.
    """

    signal: str
    payload: float
    speed: float
    low: float
    high: float
    ripple: float
    rise: float
    order: int
    frequency: float
    mode: str


def peaks_over_speed(
    signal: str,
    payload: float,
    speed: Float[np.ndarray, " runs"],
    passing: Float[np.ndarray, " runs"],
    deviation: Float[np.ndarray, " runs"],
    frequency: Float[np.ndarray, " runs"],
    modes: Sequence[Mode],
) -> list[RipplePeak]:
    """Peaks of ripple over speed at one payload, each with its mode.

    A crossing of a harmonic and a natural frequency counts if ripple peaks there and its strongest line is that
    harmonic and within the mode's band. Neither is inferred from the other.

    Args:
        speed, passing, deviation, frequency: values of the valid runs, in order of speed.
        modes: natural vibrations at this payload.
    """
    if len(speed) < 3:
        return []
    maxima, properties = find_peaks(deviation, prominence=1e-12)
    widths = peak_widths(deviation, maxima, rel_height=0.3)
    index = np.arange(len(speed))
    peaks = []
    for k, maximum in enumerate(maxima):
        height = float(deviation[maximum])
        rise = float(properties["prominences"][k])
        if rise < STANDS_OUT * height or height < NOTICEABLE:
            continue
        low, high = (float(np.interp(widths[side][k], index, speed)) for side in (2, 3))
        ratio = frequency[maximum] / passing[maximum]
        curvature, slope, _ = np.polyfit(
            speed[maximum - 1 : maximum + 2] - speed[maximum], deviation[maximum - 1 : maximum + 2], 2
        )
        peak_speed = float(np.clip(speed[maximum] - slope / (2 * curvature), low, high))
        nearest_ratio = round(float(ratio)) if np.isfinite(ratio) else 0
        order = nearest_ratio if nearest_ratio and abs(ratio - nearest_ratio) < _SAME else 0
        modes_in_band = [m for m in modes if order and m.resonant and m.band[0] <= frequency[maximum] <= m.band[1]]
        mode = min(modes_in_band, key=lambda m: abs(m.frequency - frequency[maximum])).name if modes_in_band else ""
        peaks.append(
            RipplePeak(signal, payload, peak_speed, low, high, height, rise, order, float(frequency[maximum]), mode)
        )
    return peaks


def drop_unconfirmed_modes(peaks: Sequence[RipplePeak], modes: Mapping[float, Sequence[Mode]]) -> list[RipplePeak]:
    """Peaks in which a mode is removed if the peak does not follow it over the payloads.

    If a mode's frequency changes with payload by more than `MOVES`, the lines of the peaks of one order have to
    change in the same direction. A peak that moves against it only crosses its band.

    Args:
        modes: natural vibrations by payload [kg].
    """
    confirmed = list(peaks)
    for key in dict.fromkeys((p.mode, p.order, p.signal) for p in peaks if p.mode):
        members = [k for k, p in enumerate(peaks) if (p.mode, p.order, p.signal) == key]
        natural_frequencies = np.array(
            [next(m.frequency for m in modes[peaks[k].payload] if m.name == key[0]) for k in members]
        )
        if np.ptp(natural_frequencies) < MOVES * natural_frequencies.mean():
            continue
        if np.polyfit(natural_frequencies, [peaks[k].frequency for k in members], 1)[0] <= 0:
            for k in members:
                confirmed[k] = peaks[k]._replace(mode="")
    return confirmed


class ModeCrossing(NamedTuple):
    """Speed that makes a harmonic of the passing frequency equal to a natural frequency.

    Attributes:
        mode, order, payload: mode, order and payload of the crossing [kg].
        speed: speed at the mode's mean frequency [m/s].
        signals: signals with a ripple peak there. Empty: the crossing has no visible effect.
    """

    mode: str
    order: int
    payload: float
    speed: float
    signals: tuple[str, ...]


def find_crossings(
    modes: Sequence[Mode], payload: float, travel: float, slowest: float, fastest: float, peaks: Sequence[RipplePeak]
) -> list[ModeCrossing]:
    """Crossings at one payload between two speeds [m/s], and the ripple peaks that confirm them.

    Args:
        travel: travel of the robot from one passing to the next [m].
    """
    crossings = []
    for mode in modes:
        if not mode.resonant:
            continue
        lowest_order = max(int(np.ceil(mode.frequency * travel / fastest)), 1)
        for order in range(lowest_order, int(mode.frequency * travel / slowest) + 1):
            signals = tuple(p.signal for p in peaks if (p.payload, p.mode, p.order) == (payload, mode.name, order))
            crossings.append(ModeCrossing(mode.name, order, payload, mode.frequency * travel / order, signals))
    return crossings


class Resonance(NamedTuple):
    """Peaks of one mode, order and signal over the payloads.

    Attributes:
        mode: natural vibration that explains the peaks. Empty: there is none.
        speeds: lowest and highest speed of the peaks [m/s].
        avoid: range of speeds to avoid, from the widths of the peaks [m/s].
        frequencies: lowest and highest frequency of the peaks [Hz].
        payloads: payloads of its peaks [kg].
        ripple: largest ripple [-].
        rise: largest rise above the surroundings [-].
    """

    mode: str
    order: int
    signal: str
    speeds: tuple[float, float]
    avoid: tuple[float, float]
    frequencies: tuple[float, float]
    payloads: tuple[float, ...]
    ripple: float
    rise: float


def group_resonances(peaks: Sequence[RipplePeak]) -> list[Resonance]:
    """Peaks grouped by mode, order and signal. Signals are in the order of `SIGNALS`, and those with the largest
    ripple come first.
    """
    keys = dict.fromkeys((p.mode, p.order, p.signal) for p in peaks)
    resonances = []
    for key in keys:
        members = [p for p in peaks if (p.mode, p.order, p.signal) == key]
        speeds, frequencies = [p.speed for p in members], [p.frequency for p in members]
        avoid = min(p.low for p in members), max(p.high for p in members)
        ranges = (min(speeds), max(speeds)), avoid, (min(frequencies), max(frequencies))
        resonances.append(
            Resonance(
                *key,
                *ranges,
                tuple(p.payload for p in members),
                max(p.ripple for p in members),
                max(p.rise for p in members),
            )
        )
    return sorted(resonances, key=lambda r: (list(SIGNALS).index(r.signal), -r.ripple))


def strongest_resonances(resonances: Sequence[Resonance]) -> list[Resonance]:
    """Resonances to avoid: for each signal, all whose ripple is at least 1 % and whose rise is at least half of the
    largest."""
    largest = {signal: max((r.rise for r in resonances if r.signal == signal), default=0.0) for signal in SIGNALS}
    return [r for r in resonances if r.rise >= largest[r.signal] / 2 and r.ripple >= MATTERS]
