"""Description of a data file: its signals with unit, rate, range and gaps, and the columns that they may be."""

from __future__ import annotations

import dataclasses
import math
import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from calibration.data import Json, Names, delimited, presets_file, proposals
from calibration.data.columns import Layout
from calibration.data.input_errors import BadData
from calibration.data.named_arrays import NamedArrays, column_numbers
from calibration.data.sources import one_clock, opening
from calibration.data.sources.recorded_signals import UNITS, Clock, Signal, Source, unit_of_clock, values_in_memory
from mmrjax.model import channels

#: Smallest gap between samples, in usual steps.
GAP = 5.0
#: Names of counts of time, and the least share of rows in which such a count rises.
_COUNT, RISING = re.compile(r"time|tick|stamp"), 0.9


@dataclasses.dataclass(frozen=True)
class SignalFacts:
    """Properties of a signal of a file.

    Attributes:
        path: path of the signal.
        unit: unit that the file states.
        samples: number of samples.
        refused: reason why it cannot be read.
        rate: sampling rate [Hz], NaN without a clock.
        gaps: number of steps longer than `GAP` usual ones, NaN without a clock.
        least, greatest: smallest and largest number, or NaN.
        missing: number of missing readings.
        words: some of its values, if they are words.
        clock: name of its clock.
    """

    path: str
    unit: str
    samples: int
    refused: str = ""
    rate: float = np.nan
    gaps: float = np.nan
    least: float = np.nan
    greatest: float = np.nan
    missing: int = 0
    words: Names = ()
    clock: str = ""


@dataclasses.dataclass(frozen=True)
class FileContents:
    """Description of a data file.

    Attributes:
        name, kind: name and kind of the file.
        signals: signals of the file.
        notes: notes on how it was read.
        preset: name of the packaged preset for its columns, empty if there is none.
        proposed: lines of a proposed table `[columns]`, to be checked by a person.
    """

    name: str
    kind: str
    signals: tuple[SignalFacts, ...]
    notes: Names
    preset: str
    proposed: Names

    def to_json(self) -> Json:
        """The contents as JSON-able data."""
        return {"schema": "mmrjax.inspect/1", **dataclasses.asdict(self)}


def inspect_source(source: str | Path | Any) -> FileContents:
    """Describes the contents of a file or of a table in memory.

    Raises:
        BadData: the file does not exist, cannot be read, or has no columns.
    """
    contents_found = _source(source)
    times: dict[int, tuple[np.ndarray, str] | str] = {}
    clocks = {id(s.clock) for s in contents_found.signals if s.clock is not None}
    clock_signals = (
        s for s in contents_found.signals if not (s.words or s.refused) and _unit_of_time(s.name) is not None
    )
    table = None if clocks else next(clock_signals, None)  # the time column of a table
    clock = None if table is None else Clock(table.path, table.load, _unit_of_time(table.name) or "")
    facts = tuple(
        _facts(signal, signal.clock or (None if signal is table else clock), times)
        for signal in contents_found.signals
    )
    notes = list(contents_found.notes)
    for signal in contents_found.signals:
        time = times.get(id(signal.clock)) if signal.clock is not None else None
        if isinstance(time, str) and f"{contents_found.name}: {time}" not in notes:
            notes.append(f"{contents_found.name}: {time}")
    preset = presets_file.recognise_preset([s.path for s in contents_found.signals])
    if len(clocks) > 1:
        notes.append(
            f"{contents_found.name}: signals have {len(clocks)} clocks. Rows are taken at the samples of the "
            "densest channel"
        )
    constant_signals = {fact.path for fact in facts if fact.least == fact.greatest}
    read = (dataclasses.replace(s, refused=f.refused) for s, f in zip(contents_found.signals, facts, strict=True))
    moving = sorted(
        read, key=lambda signal: signal.path in constant_signals
    )  # of several, the first one that changes
    lines = dict(_proposed_columns(moving))
    proposed = tuple(lines[s.path] for s in contents_found.signals if s.path in lines)
    return FileContents(
        contents_found.name, contents_found.kind, facts, tuple(notes), preset, () if preset else proposed
    )


def _source(source: Any) -> Source:
    if not isinstance(source, str | Path):
        return opening.open_object(source)
    if group := opening.files_of_group(str(source)):
        first_source = _source(group[0])
        note = f"{source}: {len(group)} files, each a run; these are the signals of {group[0].name}"
        return dataclasses.replace(first_source, notes=(note, *first_source.notes))
    path, signal_path = opening.split_source(str(source))
    name = path.name or str(source)
    if not path.exists():
        raise BadData(f"{source}: no such file; expected a file of data, or the folder of a ROS 2 bag")
    form = opening.format_of(path, name)
    if form is not None:
        return opening.open_signals(path, signal_path, name, form)
    table = _signals_of_text(delimited.read_csv_columns(path, name))
    if not table.signals:
        raise BadData(f"{name}: the file is empty; expected a header and rows")
    return table.below(signal_path) if signal_path else table


def _signals_of_text(arrays: NamedArrays) -> Source:
    """Table of texts as signals: a column is numeric if most of its cells are numbers."""
    signals = []
    for k, (name, raw) in enumerate(zip(arrays.header, arrays.values, strict=True)):
        values = column_numbers(raw)
        words = not np.isfinite(values).any() and any(str(cell).strip() for cell in raw)
        loaded = np.array(raw) if words else values
        unit = arrays.units[k] if arrays.units else ""
        signals.append(Signal(name, len(values), values_in_memory(loaded), unit, words=words))
    return Source(arrays.name, "a text file", tuple(signals), arrays.digest, arrays.notes)


def _unit_of_time(name: str) -> str | None:
    """Unit of a clock according to its name, as loggers spell it. None if the name is not that of a clock."""
    plain_name = name.casefold().replace("time (", "time_").rstrip(")")
    return "ms" if plain_name == "ms_today" else unit_of_clock(plain_name)


def _facts(signal: Signal, clock: Clock | None, times: dict[int, tuple[np.ndarray, str] | str]) -> SignalFacts:
    facts = SignalFacts(
        signal.path, signal.unit, signal.length, signal.refused, clock="" if clock is None else clock.name
    )
    if signal.refused or not signal.length:
        return facts
    try:
        values = signal.load()
    except BadData as error:
        return dataclasses.replace(facts, refused=str(error).partition(f"{signal.path}: ")[2] or str(error))
    if values.dtype.kind in "US":
        return dataclasses.replace(facts, words=tuple(map(str, dict.fromkeys(values[:10_000].tolist())))[:5])
    if values.dtype.kind in "mM":
        values = values.astype(np.int64)
    values = np.asarray(values, float)
    finite = np.isfinite(values)
    ends = (float(values[finite].min()), float(values[finite].max())) if finite.any() else (np.nan, np.nan)
    facts = dataclasses.replace(facts, least=ends[0], greatest=ends[1], missing=int((~finite).sum()))
    if clock is None:
        return facts
    if id(clock) not in times:
        times[id(clock)] = _seconds(clock)
    time = times[id(clock)]
    if isinstance(time, str) or len(time[0]) != len(values):
        return facts
    steps = np.diff(time[0])
    usual = float(np.median(steps[steps > 0])) if (steps > 0).any() else np.nan
    return dataclasses.replace(facts, rate=1 / usual, gaps=float((steps > GAP * usual).sum()))


def _seconds(clock: Clock) -> tuple[np.ndarray, str] | str:
    try:
        time, _, unit, _ = one_clock.clock_seconds(clock)
    except BadData as error:
        return str(error)
    rows_of_falls = np.flatnonzero(np.diff(time) < 0)
    if rows_of_falls.size:
        return f"{clock.name} goes back at sample {rows_of_falls[0] + 2}"
    return time, unit


def _proposed_columns(signals: Sequence[Signal]) -> Iterator[tuple[str, str]]:
    """Paths of signals that may be columns, each with its line of a table `[columns]`: the time, then the others."""
    spelled = set(Layout(channels=channels.EVERY).spellings())
    row_signals = [s for s in signals if s.clock is None and not s.refused]
    time_signal = next((s for s in row_signals if _unit_of_time(s.name) is not None), None)
    clock = time_signal or next((s for s in row_signals if _is_rising_count(s)), None)
    other_signals = [s for s in signals if _unit_of_time(s.name) is None and s is not clock]
    elapsed = None
    if clock is not None:
        unit = _unit_of_time(clock.name) or ("s" if clock.words else one_clock.guessed_unit(clock.load()))
        elapsed = None if clock.words else np.asarray(clock.load(), float) * UNITS[unit]
        line = f'time_{unit} = "{clock.path}"'
        if time_signal is None and elapsed is not None:
            seconds_per_unit = proposals.seconds_per_count(other_signals, np.asarray(clock.load(), float))
            question = f"compared with a position, it counts {1 / seconds_per_unit:.3g} per second"
            if math.isnan(seconds_per_unit):
                seconds_per_unit, question = UNITS[unit], "unit of the counts? give the seconds per count"
            seconds_per_unit = float(f"{seconds_per_unit:.3g}")
            elapsed = np.asarray(clock.load(), float) * seconds_per_unit
            line = f'time_s = {{column = "{clock.path}", factor = {seconds_per_unit:g}}}  # {question}'
        elif not _unit_of_time(clock.name) and elapsed is not None and unit != "s":
            step = np.diff(elapsed)
            usual = float(np.median(step[step > 0])) if (step > 0).any() else np.nan
            line += f"  # unit not stated: in {unit}, rows are {usual:.3g} s apart. Check it"
        if not (clock.name in spelled and clock.name.startswith("time_")):
            yield clock.path, line

    def seconds(signal: Signal) -> np.ndarray | None:
        if signal.clock is None:
            return elapsed
        clock_seconds = _seconds(signal.clock)
        return None if isinstance(clock_seconds, str) else clock_seconds[0]

    yield from proposals.propose_columns(other_signals, spelled, seconds)


def _is_rising_count(signal: Signal) -> bool:
    """True if a signal is named like a time counter and rises in nearly every row."""
    if signal.words or not _COUNT.search(signal.name.casefold()):
        return False
    step = np.diff(np.asarray(signal.load(), float))
    step = step[np.isfinite(step)]
    return len(step) > 1 and float(np.mean(step > 0)) > RISING
