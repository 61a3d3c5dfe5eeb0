"""Proposed columns for the signals of a file: by their units, then their behaviour, then their names."""

from __future__ import annotations

import collections
import dataclasses
import itertools
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from calibration.data.columns import Layout
from calibration.data.sources.recorded_signals import Signal
from mmrjax.model import channels, quantities

#: Names of signals that are not readings: commands.
COMMAND = re.compile(r"(?:^|[^a-z])(?:cmd|command|target|set_?point|ref|reference|desired|goal|demand)(?:[^a-z]|$|_)")
#: Names of signals that are neither readings nor commands of a drive.
OTHER = re.compile(
    r"status|flag|error|fault|count|index|stamp|air|wind\b|pitot|latit|longit|altit|gps|ambient|_raw|roll|yaw|gyro|accel"
)
#: Quantities that a command may state, because they are imposed.
IMPOSED = ("supply_voltage", "duty")
#: Largest number of a signal that is no time stamp and no counter, and of a voltage and a current without a unit.
LARGEST, LARGEST_V, LARGEST_A = 1e6, 1000.0, 500.0
#: Smallest share of its readings that a current of the supply differs from duty times current of the motor.
POWER = 0.25


class Meaning(NamedTuple):
    """A quantity, and names of signals that show it."""

    quantity: str
    pattern: re.Pattern[str]


#: The first match wins.
MEANINGS = tuple(Meaning(quantity, re.compile(pattern)) for quantity, pattern in (
    ("duty", r"duty|pwm"),
    ("supply_voltage", r"(bat|bus|supply|input|pack|dc)[^/]*volt|vbat|vbus|u_?bat|\bvin\b"),
    ("motor_voltage", r"(motor|phase|winding|terminal)[^/]*(volt|_v\b)"),
    ("supply_voltage", r"volt|\bu\b|^v$"),
    ("total_current", r"(bat|input|supply|bus|total|dc|pack)[^/]*(cur|amp)|ibat|ibus"),
    ("motor_current", r"(motor|phase|winding|axis)[^/]*(cur|amp|\bi\b)|i_?mot|\biq\b|\bq[-_](current|a\b)"),
    ("total_current", r"cur|amps?\b|\bi\b"),
    ("output_speed", r"(wheel|output|joint|load)[^/]*(vel|speed|rpm|omega)"),
    ("motor_speed", r"(?<!e)rpm|omega|vel|speed|drehzahl|^n$|\bn_?mot"),
    ("output_torque", r"torque|\btau\b|moment|effort"),
    ("output_angle", r"angle|theta|position|\bpos\b"),
    ("slope", r"slope|incline|grade"),
    ("payload", r"payload"),
    ("winding_temperature", r"winding|wicklung|motor[^/]*temp"),
    ("run_id", r"run_?id|episode|trial"),
))  # fmt: skip
#: Quantities of which the only signal in one of their units is taken if its name has no meaning.
BY_UNIT = ("supply_voltage", "total_current", "motor_speed", "winding_temperature")


@dataclasses.dataclass(frozen=True)
class Candidate:
    """A signal and the quantity that it may show.

    Attributes:
        column: name of the column with the signal's unit; question: empty, or what a person has to check.
        factor: from the signal's unit, if no column has it.
    """

    signal: Signal
    quantity: str
    column: str
    question: str = ""
    factor: float = 1.0

    def line(self, question: str) -> str:
        """Line of a table `[columns]`."""
        name = f'"{self.signal.path}"'
        stated = name if self.factor == 1.0 else f"{{column = {name}, factor = {self.factor:g}}}"
        return f"{self.column} = {stated}{f'  # {question}' if question else ''}"


def propose_columns(signals: Sequence[Signal], spelled: set[str]) -> Iterator[tuple[str, str]]:
    """Paths of signals that may be columns, each with its line of a table `[columns]`.

    Args:
        signals: those that change first; spelled: names that already are columns.
    """
    columns = {q.stem or q.name: q.columns() for q in Layout(channels=channels.EVERY).quantities().values()}
    taken = {signal.name.rpartition("_")[0] for signal in signals if signal.name in spelled}
    known = {unit for units in columns.values() for unit in units.values()} - {"", "s", "ms", "us", "ns", "min", "h"}
    units = [_unit(signal, known) for signal in signals]
    count = collections.Counter(units)
    pool = [
        candidate
        for signal, unit in zip(signals, units, strict=True)
        if signal.name not in spelled
        and (unit is None or unit in known)
        and (candidate := _candidate(signal, unit, count[unit] == 1, columns)) is not None
    ]
    groups: dict[str, list[Candidate]] = {}
    for candidate in _by_power(pool):
        groups.setdefault(candidate.quantity, []).append(candidate)
    for quantity, group in groups.items():
        if quantity in taken:
            continue
        best, *others = sorted(group, key=lambda c: (c.signal.clock is None, bool(c.question)))
        question = best.question
        if others:
            rest = ", ".join(c.signal.path for c in others[:3])
            question = f"or {rest}: which one is the {quantity.replace('_', ' ')}?"
        if joint := _joint(best.signal, signals):
            question = f"joint {joint}{'; ' * bool(question)}{question}"
        yield best.signal.path, best.line(question)


def _joint(signal: Signal, signals: Sequence[Signal]) -> str:
    """Name of the joint that an element of a message of joints belongs to; empty if there is none."""
    element = re.search(r"\w+(\[\d+\])$", signal.path)
    if element is None:
        return ""
    path = f"{signal.path[: element.start()]}name{element[1]}"
    names = next((s.load() for s in signals if s.path == path and s.words), np.zeros(0))
    return str(names[0]) if len({*names.tolist()}) == 1 else ""


def _candidate(
    signal: Signal, unit: str | None, alone: bool, columns: Mapping[str, Mapping[str, str]]
) -> Candidate | None:
    """Quantity that a signal may show; None if its unit, its behaviour or its name excludes every one.

    Args:
        unit: that it states, a column's; None: it states none. alone: True if no other signal states it.
        columns: names of the columns of each quantity, and their units.
    """
    if signal.refused:
        return None
    name = _words(signal.path)
    matches = [m.quantity for m in MEANINGS if m.pattern.search(name)]
    fitting = [q for q in matches if unit is None or unit in columns[q].values()]
    if not matches and unit is not None and alone:
        fitting = [q for q in BY_UNIT if unit in columns[q].values()]
    command = bool(COMMAND.search(name))
    fitting = [q for q in fitting if not OTHER.search(name) and (not command or q in IMPOSED)]
    if not fitting or (signal.words and fitting[0] != "run_id"):
        return None
    quantity, question = fitting[0], ""
    units = columns[quantity]
    if quantity == "run_id":
        return Candidate(signal, quantity, quantity)
    values = np.asarray(signal.load(), float)
    values = values[np.isfinite(values)]
    if not _is_reading(values):
        return None
    largest = float(np.abs(values).max())
    if quantity == "duty":
        if unit == "percent" or re.search(r"pct|percent|%", name) or 1.0 < largest <= 100.0:
            return Candidate(signal, quantity, "duty", "", 0.01)
        return Candidate(signal, quantity, "duty") if largest <= 1.0 else None
    if unit is None:
        unit, question = next(iter(units.values())), "unit not stated: check it"
        if largest > {"V": LARGEST_V, "A": LARGEST_A}.get(unit, np.inf):
            unit, question = f"m{unit}", f"numbers up to {largest:.0f}: m{unit}?"
    elif not matches:
        question = "by its unit alone: check it"
    elif "effort" in name:
        question = "effort may be a torque or a current: check it"
    column = next(c for c, u in units.items() if u == unit)
    return Candidate(signal, quantity, column, question)


def _words(path: str) -> str:
    """A path in lower case, with underscores between words that capitals separate."""
    return re.sub(r"(?<=[a-z])(?=[A-Z])", "_", path).casefold()


def _unit(signal: Signal, known: set[str]) -> str | None:
    """Unit that a signal's metadata or its name states; None if it states none."""
    if signal.unit:
        return quantities.unit_in_column(signal.unit.strip("[]()"))
    if brackets := re.search(r"[\[(]([^\])]*[^\])\d][^\])]*)[\])]\s*$", signal.path):
        return quantities.unit_in_column(brackets[1].strip())
    return quantities.unit_at_end(signal.name, known)


def _is_reading(values: np.ndarray) -> bool:
    """False for a constant, a flag, a counter or a time stamp."""
    if not len(values) or np.ptp(values) == 0 or np.abs(values).max() > LARGEST:
        return False
    if np.isin(values, (0.0, 1.0)).all():
        return False
    steps = np.diff(values)
    return not (len(steps) > 3 and (steps == steps[0]).all() and float(steps[0]).is_integer())


def _by_power(pool: Sequence[Candidate]) -> Iterator[Candidate]:
    """Candidates; of two currents next to a duty, that of the supply is the motor's times the duty."""
    duty = next((c for c in pool if c.quantity == "duty"), None)
    currents = [c for c in pool if c.quantity in ("total_current", "motor_current")]
    load: Callable[[Candidate], np.ndarray] = lambda c: np.abs(np.asarray(c.signal.load(), float) * c.factor)  # noqa: E731
    meant = {id(c): c.quantity for c in currents}
    for supply, motor in itertools.permutations(currents, 2) if duty is not None else ():
        if duty is None or not supply.signal.length == motor.signal.length == duty.signal.length:
            continue
        difference = load(supply) - load(duty) * load(motor)
        if np.nanmedian(np.abs(difference)) < POWER * np.nanmedian(load(supply)):
            meant |= {id(supply): "total_current", id(motor): "motor_current"}
    for candidate in pool:
        quantity = meant.get(id(candidate), candidate.quantity)
        column = candidate.column.replace(candidate.quantity, quantity)
        yield dataclasses.replace(candidate, quantity=quantity, column=column)
