"""Named columns of any source: selection of its signals, and conversion to rows of one table."""

from __future__ import annotations

import hashlib
import itertools
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from calibration.data import Columns, Mapped, Names, delimited, input_files, presets_file
from calibration.data.columns import SPEED, TIME, WHEN, WORDS, Layout
from calibration.data.input_errors import BadData
from calibration.data.named_arrays import NamedArrays, Raw, column_numbers, column_texts
from calibration.data.presets_file import Preset
from calibration.data.sources import one_clock, opening
from calibration.data.sources.recorded_signals import (
    RUN,
    Signal,
    Source,
    find_signal,
    matching_signals,
    suggested_paths,
)
from mmrjax.errors import list_some
from mmrjax.model import channels, quantities

#: Columns of a source, and those that have other names there.
ReadColumns = tuple[NamedArrays, Mapped]
#: Most values of columns that the model does not use, which are read to find correlations with residuals.
EXTRA_VALUES = 20_000_000
#: Ratio of the rms currents along d and q above which the field counts as weakened [-].
WEAKENED = 0.3


def read_columns(
    source: Any, layout: Layout, columns: Preset = presets_file.NONE, between: str = "held"
) -> ReadColumns:
    """Returns the columns of a file or of a table in memory, and those with other names in the source.

    Args:
        source: a path, perhaps with `::` and the path of signals in the file, or a table in memory
            (`columnar.EXPECTED`). A pattern such as `runs/*.csv` names files that are a run each.
        layout: layout of the table's robot.
        columns: names of the source's columns, in addition to those in the robot file, over which they take
            precedence.
        between: `linear` if the imposed quantity is linear between samples, as in `Rig.between_rows`.

    Raises:
        BadData: the file is missing, damaged or in a format that is not read, a signal is missing or of another kind,
            or signals differ in length.
    """
    if not isinstance(source, str | Path):
        return _columns_of_signals(opening.open_object(source), layout, columns, between)
    if group := opening.files_of_group(str(source)):
        return _joined_files([read_columns(file, layout, columns, between) for file in group], str(source))
    path, signal_path = opening.split_source(str(source))
    name = path.name or str(source)
    file_format = opening.format_of(path, name)
    if file_format is not None:
        return _columns_of_signals(
            opening.open_signals(path, signal_path, name, file_format), layout, columns, between
        )
    return _columns_of_table(_with_header(delimited.read_csv_columns(path, name), columns.header), layout, columns)


def _joined_files(readings: Sequence[ReadColumns], name: str) -> ReadColumns:
    """Tables of several files joined into one. Each file is a run, named after the file.

    Raises:
        BadData: the files have different columns or units.
    """
    tables = [table for table, _ in readings]
    first, *others = tables
    for other in others:
        if (other.header, other.units) != (first.header, first.units):
            differing = sorted({*first.header} ^ {*other.header})
            raise BadData(
                f"{name}: {other.name} and {first.name} differ in "
                f"{list_some(differing) if differing else 'the order or units of their columns'}; expected the same "
                "columns in every file"
            )
    values = [
        np.concatenate(parts)
        if all(isinstance(v, np.ndarray) for v in parts)
        else list(itertools.chain(*map(column_texts, parts)))
        for parts in zip(*(table.values for table in tables), strict=True)
    ]
    header, units = first.header, first.units
    if RUN not in header:
        values.append([Path(table.name).stem for table in tables for _ in range(len(table))])
        header, units = (*header, RUN), (*units, "") if units else ()
    digest = hashlib.sha256("".join(table.digest for table in tables).encode()).hexdigest()
    notes = tuple(dict.fromkeys(note for table in tables for note in table.notes))
    return NamedArrays(name, header, tuple(values), units, first.units_from, notes, digest), readings[0][1]


def read_whole_table(path: Path, signal_path: str = "") -> NamedArrays:
    """All columns of a table in a file, unchanged.

    Raises:
        BadData: for the same reasons as `read_columns`. Signals with separate clocks, which do not form one table.
    """
    name = path.name or str(path)
    file_format = opening.format_of(path, name)
    if file_format is None:
        return delimited.read_csv_columns(path, name)
    source = opening.open_signals(path, signal_path, name, file_format)
    signals = {s.path if len(matching_signals(source.signals, s.name)) > 1 else s.name: s for s in source.signals}
    for signal in signals.values():
        if signal.refused or signal.clock is not None:
            raise BadData(f"{name}, {signal.path}: {signal.refused or 'has its own clock; expected one table'}")
    input_files.check_memory(name, input_files.VALUE * sum(s.length for s in signals.values()))
    return _arrays(source, _in_rows(source, signals), signals)


def _arrays(source: Source, values: Columns, signals: Mapping[str, Signal], notes: Names = ()) -> NamedArrays:
    """Values with the units of their signals."""
    units = tuple(quantities.unit_in_column(signals[c].unit if c in signals else "") for c in values)
    raw = tuple(map(_raw_values, values.values()))
    return NamedArrays(source.name, tuple(values), raw, units, "the source", notes, source.digest)


def _with_header(arrays: NamedArrays, header: Names) -> NamedArrays:
    """Table without a header, with column names from a preset."""
    if len(arrays.header) != len(header) or not np.isfinite(column_numbers(list(arrays.header))).all():
        return arrays
    values = tuple([first, *rest] for first, rest in zip(arrays.header, arrays.values, strict=True))
    note = f"{arrays.name}: has no header. Its columns are read as {', '.join(header)}"
    return replace(arrays, header=header, values=values, notes=(*arrays.notes, note))


def _columns_of_table(arrays: NamedArrays, layout: Layout, columns: Preset) -> ReadColumns:
    by_name = dict(zip(arrays.header, arrays.values, strict=True))

    def has_readings(name: str) -> bool:
        return any(cell not in ("", "0") for cell in by_name[name])

    mapped, notes = columns.mapped(lambda name: name if name in by_name else None, has_readings)
    if arrays.header:
        _check_any_found(arrays.name, columns, any(pattern in by_name for _, pattern, _ in mapped), arrays.header)
    columns.check_needed(mapped, layout.imposed_column, arrays.name)
    notes = (*arrays.notes, *notes, *weakened_field_notes(columns, by_name))
    values = tuple(map(_decode_raw_numbers, map(columns.column_of, arrays.header), arrays.values))
    mapped = presets_file.merge_columns(mapped, layout.mapped)
    return replace(arrays, values=values, notes=notes), mapped


def weakened_field_notes(preset: Preset, values: Mapping[str, Raw]) -> Names:
    """A note on each current of a preset with a large d component, so that no DC motor is equivalent.

    Args:
        values: cells of the file's columns, by name.
    """
    notes = []
    for column in preset.columns:
        name = next((name for name in column.source_columns if name in values), None)
        if name is not None and column.across in values:
            q, d = (np.sqrt(np.nanmean(column_numbers(values[c]) ** 2)) for c in (name, column.across))
            if d > WEAKENED * q:
                notes.append(
                    f"{preset.name}: {column.across} is {d / q:.0%} of {name}. The motor runs with field weakening "
                    "there, which a DC motor model does not cover. Leave those rows out"
                )
    return tuple(notes)


def _check_any_found(name: str, columns: Preset, is_found: bool, header: Sequence[str]) -> None:
    """Rejects a source without any column of a preset."""
    if columns.columns and not is_found:
        patterns, present = (list_some(x, 120) for x in ([c.source_columns[0] for c in columns.columns], header))
        raise BadData(
            f"{name}: has none of the columns of {columns.name} ({patterns}), but {present}; correct the names, or "
            "choose another preset"
        )


def _columns_of_signals(source: Source, layout: Layout, columns: Preset, between: str) -> ReadColumns:
    """Columns of the signals with a meaning, and of some others."""
    signals = source.signals

    def present_path(name: str) -> str | None:
        matches = matching_signals(signals, name)
        return matches[0].path if "*" in name and len(matches) == 1 else name if matches else None

    mapped, notes = columns.mapped(present_path)
    is_found = any(present_path(pattern) for _, pattern, _ in mapped)
    _check_any_found(source.name, columns, is_found, [s.path for s in signals])
    columns.check_needed(mapped, layout.imposed_column, source.name)
    mapped = presets_file.merge_columns(mapped, layout.mapped)
    signals_by_column, clock, missing = _chosen_signals(source, mapped, layout)
    for column, signal in signals_by_column.items():
        if signal.refused:
            read_as = "" if column == signal.path else f" (read as {column})"
            raise BadData(f"{source.name}, {signal.path}: {signal.refused}{read_as}")
    has_clocks = any(s.clock is not None for s in signals_by_column.values())
    extras = {} if has_clocks else _extra_columns(source, signals_by_column)
    size = input_files.VALUE * sum(s.length for s in (*signals_by_column.values(), *extras.values()))
    input_files.check_memory(source.name, size)
    signals_by_column = {
        name: _decoded_signal(columns.column_of(name), signal) for name, signal in signals_by_column.items()
    }
    if has_clocks:
        values, further_notes = _on_a_grid(source, signals_by_column, layout, between, clock, mapped)
    else:
        values, further_notes = _in_rows(source, signals_by_column), ()
        values |= _in_rows(source, extras, len(next(iter(values.values()), [])))
    notes = (*source.notes, *further_notes, *notes, *weakened_field_notes(columns, values), *missing)
    return _arrays(source, values, signals_by_column, notes), mapped


def _chosen_signals(source: Source, mapped: Mapped, layout: Layout) -> tuple[dict[str, Signal], str, Names]:
    """Signals by the name of their column, the clock stated as the grid, and notes on missing signals.

    A signal has a column if a table of columns names it, or if the last part of its path is a column name.
    """
    signals_by_column: dict[str, Signal] = {}
    clock, missing = "", []
    clocks = {s.clock.name for s in source.signals if s.clock is not None}
    for column, pattern, _ in mapped:
        matches = {s.path for s in matching_signals(source.signals, pattern)}
        if pattern in clocks or (matches and matches <= clocks):  # several clocks: each signal has its own
            clock = pattern if pattern in clocks else matches.pop() if len(matches) == 1 else ""
        elif matches:
            signals_by_column[pattern] = find_signal(source.signals, pattern, source.name)
        else:
            near = suggested_paths(pattern, [s.path for s in source.signals])
            missing.append(f"{source.name}: no signal {pattern}, from which {column} is read; {near}")
    spellings = replace(layout, channels=channels.EVERY, mapped=()).spellings()
    spelled = {name.casefold() for name in spellings}
    used_signals = {id(signal) for signal in signals_by_column.values()}
    for signal in source.signals:
        # The mode in a topic has another meaning.
        is_vague = signal.clock is not None and signal.name in (*WORDS, *WHEN)
        if signal.name.casefold() in spelled and id(signal) not in used_signals and not is_vague:
            signals_by_column.setdefault(signal.name, signal)
    return signals_by_column, clock, tuple(missing)


def _decode_raw_numbers(column: presets_file.PresetColumn, raw: Raw) -> Raw:
    """Raw numbers converted to signed numbers around zero. Cells without a number are unchanged."""
    if not (column.sign_bit or column.zero):
        return raw
    numbers, sign_value = column_numbers(raw), 2.0**column.sign_bit
    decoded = np.where(bool(column.sign_bit) & (numbers >= sign_value), sign_value - numbers, numbers) - column.zero
    if isinstance(raw, np.ndarray):
        return decoded
    return [cell if np.isnan(x) else repr(x) for cell, x in zip(raw, decoded.tolist(), strict=True)]


def _decoded_signal(column: presets_file.PresetColumn, signal: Signal) -> Signal:
    """Signal whose values are decoded before they are interpolated."""
    return replace(signal, load=lambda: np.asarray(_decode_raw_numbers(column, signal.load())))


def _extra_columns(source: Source, chosen: Mapping[str, Signal]) -> dict[str, Signal]:
    """Further columns of a table with the length of the chosen ones, unless they have too many values."""
    used_signals = {id(signal) for signal in chosen.values()}
    lengths = {s.length for s in chosen.values() if s.length > 1}
    lengths = lengths or {max((s.length for s in source.signals), default=0)}
    others = [s for s in source.signals if id(s) not in used_signals and not s.refused and s.length in lengths]
    return {s.path: s for s in others} if sum(s.length for s in others) <= EXTRA_VALUES else {}


def _in_rows(source: Source, signals: Mapping[str, Signal], rows: int = 0) -> Columns:
    """Values of a table's columns. A single value applies to every row."""
    lengths = {column: s.length for column, s in signals.items()}
    rows = rows or max(lengths.values(), default=0)
    for column, length in lengths.items():
        if length not in (1, rows):
            longest = next((signals[c].path for c, n in lengths.items() if n == rows), "the time of the others")
            raise BadData(
                f"{source.name}, {signals[column].path}: has {length} values, and {longest} has {rows}; "
                "expected equal lengths, or its own time stamps, as an array named time in the same group"
            )
    columns = {}
    for column, signal in signals.items():
        values = signal.load()
        columns[column] = values if len(values) == rows else np.repeat(values, rows)
    return columns


def _on_a_grid(
    source: Source, chosen: Mapping[str, Signal], layout: Layout, between: str, clock: str, mapped: Mapped
) -> tuple[Columns, Names]:
    """Values of signals with separate clocks, on one grid."""
    meanings = replace(layout, mapped=mapped).meanings(source.name, list(chosen))
    column_of = {c: "" if m is None else m.column for c, m in zip(chosen, meanings, strict=True)}
    signals = {c: s for c, s in chosen.items() if column_of[c] not in TIME}
    clocked = {c: s for c, s in signals.items() if s.clock is not None}
    if not clocked:
        paths = [s.path for s in source.signals]
        raise BadData(
            f"{source.name}: no signal has the name of a column; {suggested_paths('', paths)}; give their columns in "
            f'the robot\'s file, for example [columns] supply_voltage_V = "{paths[0]}" (mmrjax inspect proposes the '
            "lines)"
        )
    measured = {c for c in chosen if column_of[c] in (*layout.measured_columns, *layout.deviation_columns)}
    stepwise = chosen.keys() - measured
    if between == "linear" or layout.imposed_column == SPEED:
        stepwise -= {c for c in chosen if column_of[c] == layout.imposed_column}
    time, values, notes = one_clock.signals_on_one_grid(source.name, clocked, stepwise, measured, clock)
    unclocked = {c: s for c, s in signals.items() if s.clock is None}
    return {"time_s": time, **values, **_in_rows(source, unclocked, len(time))}, notes


def _raw_values(values: np.ndarray) -> Raw:
    """Values as the checks of a table expect them: numbers as an array, words and dates as a list."""
    if values.dtype.kind in "US":
        return [str(value).strip() for value in values.tolist()]
    if values.dtype.kind == "M":  # dates are read as text, times count from the first one
        ticks, is_missing = values.astype("datetime64[ns]").astype(np.int64), np.isnat(values)
        first_tick = ticks[~is_missing].min() if not is_missing.all() else 0
        return np.where(is_missing, np.nan, (ticks - first_tick) * 1e-9)
    if values.dtype.kind == "m":
        return np.where(np.isnat(values), np.nan, values.astype("timedelta64[ns]").astype(np.int64) * 1e-9)
    return values
