"""Description of a data file: its signals with unit, rate, range and gaps, and the columns that they may be."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
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


@dataclass(frozen=True)
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


@dataclass(frozen=True)
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
        return {"schema": "mmrjax.inspect/1", **asdict(self)}


def inspect_source(source: str | Path | Any) -> FileContents:
    """Describes the contents of a file or of a table in memory.

    Raises:
        BadData: the file does not exist, cannot be read, or has no columns.
    """
    contents = _open_source(source)
    name, signals, notes = contents.name, contents.signals, [*contents.notes]
    clock_ids = {id(s.clock) for s in signals if s.clock is not None}
    time_signal = clock = None  # of a table
    if not clock_ids:
        time_signal = next(
            (s for s in signals if not (s.words or s.refused) and _unit_of_time(s.name) is not None), None
        )
    if time_signal is not None:
        clock = Clock(time_signal.path, time_signal.load, _unit_of_time(time_signal.name) or "")
    times: dict[int, np.ndarray | str] = {}
    facts = tuple(_signal_facts(s, s.clock or (None if s is time_signal else clock), times) for s in signals)
    faults = (times.get(id(s.clock)) for s in signals if s.clock is not None)
    notes += dict.fromkeys(f"{name}: {fault}" for fault in faults if isinstance(fault, str))
    preset = presets_file.recognise_preset([s.path for s in signals])
    if len(clock_ids) > 1:
        notes.append(
            f"{name}: signals have {len(clock_ids)} clocks. Rows are taken at the samples of the densest channel"
        )
    checked_signals = [replace(s, refused=f.refused) for s, f in zip(signals, facts, strict=True)]
    constant = {fact.path for fact in facts if fact.least == fact.greatest}
    # Of several signals for a column, one that changes is proposed.
    line_by_path = dict(_proposed_columns(sorted(checked_signals, key=lambda s: s.path in constant)))
    proposed = () if preset else tuple(line_by_path[s.path] for s in signals if s.path in line_by_path)
    return FileContents(name, contents.kind, facts, tuple(notes), preset, proposed)


def _open_source(source: Any) -> Source:
    if not isinstance(source, str | Path):
        return opening.open_object(source)
    if group := opening.files_of_group(str(source)):
        first_source = _open_source(group[0])
        note = f"{source}: {len(group)} files, each a run; these are the signals of {group[0].name}"
        return replace(first_source, notes=(note, *first_source.notes))
    path, signal_path = opening.split_source(str(source))
    name = path.name or str(source)
    if not path.exists():
        raise BadData(f"{source}: no such file; expected a file of data, or the folder of a ROS 2 bag")
    file_format = opening.format_of(path, name)
    if file_format is not None:
        return opening.open_signals(path, signal_path, name, file_format)
    table = _source_of_text(delimited.read_csv_columns(path, name))
    if not table.signals:
        raise BadData(f"{name}: the file is empty; expected a header and rows")
    return table.below(signal_path) if signal_path else table


def _source_of_text(arrays: NamedArrays) -> Source:
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


def _signal_facts(signal: Signal, clock: Clock | None, times: dict[int, np.ndarray | str]) -> SignalFacts:
    clock_name = "" if clock is None else clock.name
    facts = SignalFacts(signal.path, signal.unit, signal.length, signal.refused, clock=clock_name)
    if signal.refused or not signal.length:
        return facts
    try:
        values = signal.load()
    except BadData as error:
        return replace(facts, refused=str(error).partition(f"{signal.path}: ")[2] or str(error))
    if values.dtype.kind in "US":
        return replace(facts, words=tuple(map(str, dict.fromkeys(values[:10_000].tolist())))[:5])
    values = np.asarray(values.astype(np.int64) if values.dtype.kind in "mM" else values, float)
    finite = values[np.isfinite(values)]
    if len(finite):
        facts = replace(facts, least=float(finite.min()), greatest=float(finite.max()))
    rate = gaps = np.nan
    if clock is not None:
        time = times[id(clock)] = times[id(clock)] if id(clock) in times else _clock_times(clock)
        if not isinstance(time, str) and len(time) == len(values):
            step, usual = np.diff(time), one_clock.usual_step(time)
            rate, gaps = 1 / usual, float((step > GAP * usual).sum())
    return replace(facts, missing=len(values) - len(finite), rate=rate, gaps=gaps)


def _clock_times(clock: Clock) -> np.ndarray | str:
    """Times of a clock [s], or the reason why they cannot be used."""
    try:
        time, *_ = one_clock.clock_seconds(clock)
    except BadData as error:
        return str(error)
    rows_of_falls = np.flatnonzero(np.diff(time) < 0)
    return f"{clock.name} goes back at sample {rows_of_falls[0] + 2}" if rows_of_falls.size else time


def _proposed_columns(signals: Sequence[Signal]) -> Iterator[tuple[str, str]]:
    """Paths of signals that may be columns, each with its line of a table `[columns]`: the time, then the others."""
    known_names = set(Layout(channels=channels.EVERY).spellings())
    row_signals = [s for s in signals if s.clock is None and not s.refused]
    time_signal = next((s for s in row_signals if _unit_of_time(s.name) is not None), None)
    clock = time_signal or next((s for s in row_signals if _is_rising_count(s)), None)
    other_signals = [s for s in signals if _unit_of_time(s.name) is None and s is not clock]
    elapsed = None
    if clock is not None:
        counts = None if clock.words else np.asarray(clock.load(), float)
        stated_unit = _unit_of_time(clock.name)
        unit = stated_unit or ("s" if counts is None else one_clock.guessed_unit(counts))
        line = f'time_{unit} = "{clock.path}"'
        if counts is not None:
            elapsed = counts * UNITS[unit]
        if time_signal is None and counts is not None:
            per_count = proposals.seconds_per_count(other_signals, counts)
            question = f"compared with a position, it counts {1 / per_count:.3g} per second"
            if math.isnan(per_count):
                per_count, question = UNITS[unit], "unit of the counts? give the seconds per count"
            per_count = float(f"{per_count:.3g}")
            elapsed = counts * per_count
            line = f'time_s = {{column = "{clock.path}", factor = {per_count:g}}}  # {question}'
        elif not stated_unit and elapsed is not None and unit != "s":
            step = one_clock.usual_step(elapsed)
            line += f"  # unit not stated: in {unit}, rows are {step:.3g} s apart. Check it"
        if not (clock.name in known_names and clock.name.startswith("time_")):
            yield clock.path, line

    def signal_times(signal: Signal) -> np.ndarray | None:
        time = elapsed if signal.clock is None else _clock_times(signal.clock)
        return None if isinstance(time, str) else time

    yield from proposals.propose_columns(other_signals, known_names, signal_times)


def _is_rising_count(signal: Signal) -> bool:
    """True if a signal is named like a time counter and rises in nearly every row."""
    if signal.words or not _COUNT.search(signal.name.casefold()):
        return False
    steps = np.diff(np.asarray(signal.load(), float))
    steps = steps[np.isfinite(steps)]
    return len(steps) > 1 and float(np.mean(steps > 0)) > RISING
