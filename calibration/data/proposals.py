"""Proposed columns for the signals of a file, chosen by unit, then behaviour, then name."""

from __future__ import annotations

import collections
import itertools
import math
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from calibration.data.columns import Layout
from calibration.data.sources.recorded_signals import Signal
from mmrjax.model import channels, quantities

#: Names of signals that are not readings: commands.
COMMAND = re.compile(r"(?:^|[^a-z])(?:cmd|command|target|set_?point|ref|reference|desired|goal|demand)(?:[^a-z]|$|_)")
#: Names of signals that are neither readings nor commands of a drive.
OTHER = re.compile(
    r"status|flag|error|fault|count|index|stamp|air|wind\b|pitot|latit|longit|altit|gps|ambient|_raw|roll|yaw|gyro|accel"
    r"|predict|residual|z_?score|fitted"
)
#: Names of signals whose unit is that of a sensor's output.
SENSOR = re.compile(r"encoder|sensor|photo|shunt|adc|therm|gauge")
#: Quantities that a command may contain, because they are imposed.
IMPOSED = ("supply_voltage", "duty")
#: Larger numbers are time stamps or counters. Largest voltage and current without a unit.
LARGEST, LARGEST_V, LARGEST_A = 1e6, 1000.0, 500.0
#: Smallest relative difference between a supply current and duty times motor current.
POWER = 0.25


#: Quantities and the usual names of their signals. The first match wins.
MEANINGS = tuple((quantity, re.compile(pattern)) for quantity, pattern in (
    ("duty", r"duty|pwm|throttle|motor_?(cmd|command)$"),
    ("supply_voltage", r"(?<![a-z])(bat|bus|supply|input|pack|dc)[^/]*volt|vbat|vbus|u_?bat|\bvin\b"),
    ("motor_voltage", r"(motor|phase|winding|terminal)[^/]*(volt|_v\b)"),
    ("supply_voltage", r"volt|\bu\b|^v$"),
    ("total_current", r"(?<![a-z])(bat|input|supply|bus|total|dc|pack)[^/]*(cur|amp)|ibat|ibus"),
    ("motor_current", r"(motor|phase|winding|axis)[^/]*(cur|amp|\bi\b)|i_?mot|\biq\b|\bq[-_](current|a\b)"),
    ("total_current", r"cur|amps?\b|\bi\b"),
    ("output_speed", r"(wheel|output|joint|load)[^/]*(vel|speed|rpm|omega)"),
    ("motor_speed", r"(?<!e)rpm|omega|vel|speed|drehzahl|^n$|\bn_?mot"),
    ("speed", r"(?<!e)vel|speed"),
    ("output_torque", r"torque|\btau\b|moment|effort"),
    ("output_angle", r"angle|theta|position|\bpos\b"),
    ("position", r"position|\bpos\b|distance|odometer|travel"),
    ("slope", r"slope|incline|grade"),
    ("payload", r"payload"),
    ("winding_temperature", r"winding|wicklung|motor[^/]*temp"),
    ("run_id", r"run_?id|episode|trial"),
))  # fmt: skip
#: Numbers that mean full duty in commands without a unit.
WHOLE = (127, 128, 255, 256, 400, 511, 512, 1000, 1023, 1024, 2047, 4095, 8191, 32767)
#: Largest speed without a unit that is taken as m/s: if the log has no position, and if it has one.
SLOW, LARGEST_M_S = 10.0, 30.0
#: Unit of a position, unit of its rate, and position after one second at a rate of 1.
RATES = (
    ("m", "m_s", 1.0), ("turns", "turns_s", 1.0), ("deg", "deg_s", 1.0), ("rad", "rad_s", 1.0), ("mm", "mm_s", 1.0),
    ("turns", "rpm", 1 / 60), ("deg", "rpm", 6.0), ("rad", "rpm", math.pi / 30), ("deg", "rad_s", 180 / math.pi),
    ("turns", "rad_s", 0.5 / math.pi), ("rad", "turns_s", 2 * math.pi), ("deg", "turns_s", 360.0),
    ("mm", "m_s", 1e3), ("m", "mm_s", 1e-3),
)  # fmt: skip
#: Units that only positions have, and that only rates have.
_POSITION_UNITS, _RATE_UNITS = {"m", "turns"}, {"m_s", "turns_s"}
#: Largest relative error of such a ratio, and of a position that is compared with the integral of its rate.
SAME_RATE, INTEGRAL = 0.03, 0.05
#: Quantities that the only signal in one of their units is taken to be, if its name has no known meaning.
BY_UNIT = ("supply_voltage", "total_current", "motor_speed", "winding_temperature")


@dataclass(frozen=True)
class ColumnCandidate:
    """A signal and the quantity that it may show.

    Attributes:
        column: name of the column, with the unit of the signal.
        question: what a person has to check, empty for nothing.
        factor: factor that converts the unit of the signal, if no column has that unit.
    """

    signal: Signal
    quantity: str
    column: str
    question: str = ""
    factor: float = 1.0

    def line(self, question: str) -> str:
        """The candidate as a line of a table `[columns]`."""
        name = f'"{self.signal.path}"'
        value_text = name if self.factor == 1.0 else f"{{column = {name}, factor = {self.factor:g}}}"
        return f"{self.column} = {value_text}{f'  # {question}' if question else ''}"


def propose_columns(
    signals: Sequence[Signal], known_names: set[str], signal_times: Callable[[Signal], np.ndarray | None]
) -> Iterator[tuple[str, str]]:
    """Proposes columns for signals: the path of each signal, and its line in a table `[columns]`.

    Args:
        signals: signals, in order of preference.
        known_names: names that are already columns.
        signal_times: function that returns the times of a signal [s].
    """
    columns = {q.stem or q.name: q.columns() for q in Layout(channels=channels.EVERY).quantities().values()}
    known_stems = {signal.name.rpartition("_")[0] for signal in signals if signal.name in known_names}
    known_units = {unit for units in columns.values() for unit in units.values()}
    known_units -= {"", "s", "ms", "us", "ns", "min", "h"}
    stated_units = {signal.path: _stated_unit(signal, known_units) for signal in signals}
    count = collections.Counter(stated_units[signal.path] for signal in signals)
    candidates = (
        _candidate_of_signal(signal, stated_units[signal.path], count[stated_units[signal.path]] == 1, columns)
        for signal in signals
        if signal.name not in known_names and stated_units[signal.path] in {None, *known_units}
    )
    pool = [candidate for candidate in candidates if candidate is not None]
    groups: dict[str, list[ColumnCandidate]] = {}
    for candidate in _currents_by_duty(_candidates_by_rate(pool, stated_units, columns, signal_times)):
        groups.setdefault(candidate.quantity, []).append(candidate)
    for quantity, group in groups.items():
        if quantity in known_stems:
            continue
        best, *others = sorted(group, key=lambda c: (c.signal.clock is None, bool(c.question)))
        question = best.question
        if others:
            other_paths = ", ".join(c.signal.path for c in others[:3])
            question = f"or {other_paths}: which one is the {quantity.replace('_', ' ')}?"
        if joint := _joint_name(best.signal, signals):
            question = "; ".join(filter(None, (f"joint {joint}", question)))
        yield best.signal.path, best.line(question)


def _joint_name(signal: Signal, signals: Sequence[Signal]) -> str:
    """Name of the joint to which an element of a joint message belongs, empty if none."""
    path, count = re.subn(r"\w+(\[\d+\])$", r"name\1", signal.path)
    names = next((s.load() for s in signals if count and s.path == path and s.words), np.zeros(0))
    return str(names[0]) if len({*names.tolist()}) == 1 else ""


def _candidate_of_signal(
    signal: Signal, unit: str | None, is_only: bool, columns: Mapping[str, Mapping[str, str]]
) -> ColumnCandidate | None:
    """Quantity that a signal may show. None if its unit, behaviour or name excludes all quantities.

    Args:
        unit: unit of the signal, spelled as in columns. None: it states none.
        is_only: True if no other signal has that unit.
        columns: column names of each quantity, and their units.
    """
    name = _path_words(signal.path)
    if signal.refused or OTHER.search(name):
        return None
    matches = [quantity for quantity, pattern in MEANINGS if pattern.search(name)]
    possible = [q for q in matches if unit is None or unit in columns[q].values()]
    if not matches and unit is not None and is_only and not SENSOR.search(name):
        possible = [q for q in BY_UNIT if unit in columns[q].values()]
    if COMMAND.search(name):
        possible = [q for q in possible if q in IMPOSED]
    if not possible or (signal.words and possible[0] != "run_id"):
        return None
    quantity = possible[0]
    if quantity == "run_id":
        return ColumnCandidate(signal, quantity, quantity)
    values = np.asarray(signal.load(), float)
    values = values[np.isfinite(values)]
    if not _is_reading(values):
        return None
    largest = float(np.abs(values).max())
    if quantity == "duty":
        factor, question = 1.0, ""
        if unit == "percent" or re.search(r"pct|percent|%", name) or 1.0 < largest <= 100.0:
            factor = 0.01
        elif largest > 1.0:
            full_scale = next((w for w in WHOLE if largest <= w <= 1.05 * largest), None)
            if full_scale is None or values.min() > 0.4 * largest:  # pulse widths never become small
                return None
            factor, question = float(f"{1 / full_scale:.8g}"), f"is {full_scale} full duty?"
        return ColumnCandidate(signal, quantity, "duty", question, factor)
    if unit is None and quantity == "motor_speed" and largest < SLOW:
        return ColumnCandidate(signal, "speed", "speed_m_s", f"numbers up to {largest:.3g}: m/s?")
    question = ""
    if unit is None:
        unit, question = next(iter(columns[quantity].values())), "unit not stated: check it"
        if largest > {"V": LARGEST_V, "A": LARGEST_A}.get(unit, np.inf):
            unit, question = f"m{unit}", f"numbers up to {largest:.0f}: m{unit}?"
    elif not matches:
        question = "a guess from its unit only: check it"
    elif "effort" in name:
        question = "effort may be a torque or a current: check it"
    return ColumnCandidate(signal, quantity, _column_in(columns[quantity], unit), question)


def _column_in(units: Mapping[str, str], unit: str) -> str:
    """Column of a quantity in a unit."""
    return next(column for column, u in units.items() if u == unit)


def _path_words(path: str) -> str:
    """Path in lower case. Words that capitals separate get underscores."""
    return re.sub(r"(?<=[a-z])(?=[A-Z])", "_", path).casefold()


def _stated_unit(signal: Signal, known: set[str]) -> str | None:
    """Unit stated by the metadata or the name of a signal, or None."""
    if signal.unit:
        return quantities.unit_in_column(signal.unit.strip("[]()"))
    if brackets := re.search(r"[\[(]([^\])]*[^\])\d][^\])]*)[\])]\s*$", signal.path):
        return quantities.unit_in_column(brackets[1].strip())
    return quantities.unit_at_end(signal.name, known)


def _is_reading(values: np.ndarray) -> bool:
    """False for a constant, a flag, a counter or a time stamp."""
    if not len(values) or np.ptp(values) == 0 or np.abs(values).max() > LARGEST or np.isin(values, (0.0, 1.0)).all():
        return False
    steps = np.diff(values)
    return not (len(steps) > 3 and values.min() >= 0 and (steps == steps[0]).all() and float(steps[0]).is_integer())


def seconds_per_count(signals: Sequence[Signal], count: np.ndarray) -> float:
    """Seconds per count of a clock, from a position and its rate that state their units. NaN if there are no such
    signals.

    Args:
        count: counts of the clock, shape (rows,).
    """
    known_units = {unit for position_unit, rate_unit, _ in RATES for unit in (position_unit, rate_unit)}
    signals_with_units = [
        (signal, _stated_unit(signal, known_units))
        for signal in signals
        if not (signal.refused or signal.words) and signal.length == len(count)
    ]
    pairs = {(position_unit, rate_unit): seconds for position_unit, rate_unit, seconds in RATES}
    for (position, position_unit), (rate_signal, rate_unit) in itertools.permutations(signals_with_units, 2):
        seconds = pairs.get((position_unit or "", rate_unit or ""))
        if seconds is not None:
            factor = _integral_factor(
                count, np.asarray(position.load(), float), np.asarray(rate_signal.load(), float)
            )
            if math.isfinite(factor) and factor > 0:
                return factor / seconds
    return math.nan


def _candidates_by_rate(
    pool: Sequence[ColumnCandidate],
    stated: Mapping[str, str | None],
    columns: Mapping[str, Mapping[str, str]],
    signal_times: Callable[[Signal], np.ndarray | None],
) -> Iterator[ColumnCandidate]:
    """Candidates for position and speed with consistent units.

    Args:
        stated: unit of each signal, by its path.
        columns: as in `_candidate_of_signal`.
    """
    agreed: dict[str, ColumnCandidate] = {}
    positions = [c.signal for c in pool if _POSITION_UNITS & {*columns[c.quantity].values()}]
    rates = [
        c.signal
        for c in pool
        if _RATE_UNITS & {*columns[c.quantity].values()} and "motor" not in c.signal.path.casefold()
    ]
    for position, rate in itertools.product(positions, rates):
        time = signal_times(rate) if position.length == rate.length and position.path not in agreed else None
        if time is None or len(time) != rate.length:
            continue
        stated_units = stated[position.path], stated[rate.path]
        units = _units_of_position_and_rate(time, position, rate, stated_units)
        if not units:
            continue
        units_text, *other_texts = (f"{p} and {v.replace('_', '/')}" for p, v in units[:4])
        either = f"; or {' or '.join(other_texts)}?" if other_texts else ""
        quantities_of_both = ("position", "speed") if units[0][0] in ("m", "mm") else ("output_angle", "output_speed")
        for signal, other, quantity, unit in zip(
            (position, rate), (rate, position), quantities_of_both, units[0], strict=True
        ):
            question = f"by {other.path}, in {units_text}{either}" if None in stated_units else ""
            agreed[signal.path] = ColumnCandidate(signal, quantity, _column_in(columns[quantity], unit), question)
    yield from (agreed.get(c.signal.path, c) for c in pool)


def _units_of_position_and_rate(
    time: np.ndarray, position: Signal, rate: Signal, stated: Sequence[str | None]
) -> list[tuple[str, str]]:
    """Units in which a position is the integral of its rate, empty if it is not.

    Args:
        time: time of both signals [s].
        stated: unit of each, None if it states none.
    """
    rate_values = np.asarray(rate.load(), float)
    factor = _integral_factor(time, np.asarray(position.load(), float), rate_values)
    is_rotation = re.search(r"angle|theta|omega|rpm", _path_words(f"{position.path} {rate.path}"))
    is_no_length = not any(stated) and (bool(is_rotation) or float(np.nanmax(np.abs(rate_values))) > LARGEST_M_S)
    return [
        (position_unit, rate_unit)
        for position_unit, rate_unit, seconds in RATES
        if abs(factor / seconds - 1) < SAME_RATE
        and stated[0] in (None, position_unit)
        and stated[1] in (None, rate_unit)
        and not (is_no_length and position_unit in ("m", "mm"))
    ]


def _integral_factor(time: np.ndarray, position: np.ndarray, rate: np.ndarray) -> float:
    """Ratio of a position to the integral of a rate, NaN if the position is not that integral."""
    step = np.diff(time)
    is_usable = np.isfinite(step) & (step > 0) & np.isfinite(np.diff(position)) & np.isfinite(rate[1:] + rate[:-1])
    if is_usable.sum() < 3:
        return math.nan
    is_usable &= step <= 5 * np.median(step[is_usable])
    distance = np.cumsum(np.where(is_usable, np.diff(position), 0.0))
    integral = np.cumsum(np.where(is_usable, 0.5 * (rate[1:] + rate[:-1]) * step, 0.0))
    if not np.any(integral):
        return math.nan
    factor = float(distance @ integral / (integral @ integral))
    relative_error = np.abs(distance - factor * integral).max() / max(float(np.abs(distance).max()), 1e-300)
    return factor if relative_error < INTEGRAL else math.nan


def _currents_by_duty(candidates: Iterable[ColumnCandidate]) -> Iterator[ColumnCandidate]:
    """Candidates for two currents that are logged with a duty: the supply current is the motor current times the
    duty.
    """
    pool = [*candidates]
    duties = [c for c in pool if c.quantity == "duty"][:1]
    currents = [c for c in pool if c.quantity in ("total_current", "motor_current")]
    quantity_by_id = {id(c): c.quantity for c in currents}
    for (supply, motor), duty in itertools.product(itertools.permutations(currents, 2), duties):
        if supply.signal.length == motor.signal.length == duty.signal.length:
            supply_current, motor_current, share = (
                np.abs(np.asarray(c.signal.load(), float) * c.factor) for c in (supply, motor, duty)
            )
            if np.nanmedian(np.abs(supply_current - share * motor_current)) < POWER * np.nanmedian(supply_current):
                quantity_by_id |= {id(supply): "total_current", id(motor): "motor_current"}
    for candidate in pool:
        quantity = quantity_by_id.get(id(candidate), candidate.quantity)
        column = candidate.column.replace(candidate.quantity, quantity)
        yield replace(candidate, quantity=quantity, column=column)
