"""JSON: records, named arrays, and both within nested objects."""

from __future__ import annotations

import collections
import json
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from calibration.data import Columns, Json, input_files
from calibration.data.input_errors import BadData
from calibration.data.sources.recorded_signals import (
    RUN,
    Signal,
    array_in_memory,
    encodable_text,
    parent_path,
    path_parts,
    signals_of_arrays,
    unit_of_clock,
)

#: Largest JSON file [bytes], because its objects take about ten times as much memory. Deepest nesting.
LARGEST, DEEPEST = 2**28, 16
#: Keys for the sampling of episodes: rates [Hz] and steps [s], with the exponent that converts them to steps.
RATES = {
    **dict.fromkeys(("rate_hz", "sample_rate_hz", "sampling_rate_hz", "frequency_hz", "fps", "fs"), -1),
    **dict.fromkeys(("dt", "dt_s", "step_s", "time_step_s", "sample_time_s"), 1),
}


def signals_of_json(path: Path, name: str) -> tuple[Signal, ...]:
    """Signals of a JSON file, or of a file with one object per line.

    Raises:
        BadData: the text is no JSON, or nested too deeply.
    """
    content = input_files.file_bytes(path, name, largest=LARGEST)
    try:
        text = content.decode("utf-8-sig")
        try:
            parsed = json.loads(text, object_pairs_hook=_object)
        except json.JSONDecodeError:
            lines = [line for line in text.splitlines() if line.strip()]
            if len(lines) < 2 or not lines[0].rstrip().endswith("}"):
                raise
            parsed = [json.loads(line, object_pairs_hook=_object) for line in lines]
    except (ValueError, RecursionError) as error:
        why = "nested too deep" if isinstance(error, RecursionError) else error
        raise BadData(f"{name}: cannot be read as JSON ({why}); it may be cut off; export it again") from error
    return signals_of_json_content(parsed, name)


def _object(pairs: list[tuple[str, Any]]) -> Json:
    """An object of JSON.

    Raises:
        ValueError: a key occurs twice.
    """
    by_key = dict(pairs)
    if len(by_key) < len(pairs):
        twice = next(key for key, count in collections.Counter(key for key, _ in pairs).items() if count > 1)
        raise ValueError(f"an object has the key {encodable_text(twice)} twice")
    return by_key


def signals_of_json_content(content: Any, name: str) -> tuple[Signal, ...]:
    """Signals of lists and dicts of lists, numbers and arrays.

    Raises:
        BadData: the content has no table.
    """
    arrays: Json = {}
    _collect_arrays(content, "", arrays, name, 1)
    arrays = _join_tables({path: values for path, values in arrays.items() if values.size})
    if not arrays:
        raise BadData(
            f"{name}: holds no list of records and no arrays; expected "
            '[{"time_s": 0.0, ...}, ...] or {"time_s": [...], ...}'
        )
    return signals_of_arrays(name, {path: array_in_memory(values) for path, values in arrays.items()})


def _joined_path(path: str, key: Any) -> str:
    return f"{path}.{key}" if path else str(key)


def _check_depth(name: str, path: str, depth: int) -> None:
    if depth > DEEPEST:
        raise BadData(f"{name}, {path}: is nested too deeply; expected at most {DEEPEST} levels")


def _collect_arrays(value: Any, path: str, arrays: Columns, name: str, depth: int) -> None:
    _check_depth(name, path, depth)
    if isinstance(value, Mapping):
        value = _unfold_pandas_dict(value)
    if isinstance(value, Mapping):
        for key, inner in value.items():
            _collect_arrays(inner, _joined_path(path, key), arrays, name, depth + 1)
        _add_time(value, path, arrays)
    elif isinstance(value, Sequence) and not isinstance(value, str | bytes):
        if value and all(isinstance(item, Mapping) for item in value):
            columns = _columns_of_episodes(value) or _columns_of_records(value, name)
            arrays.update({_joined_path(path, key): values for key, values in columns.items()})
        elif value:
            arrays[path or "values"] = _array(value)
    elif hasattr(value, "__array__"):
        arrays[path or "values"] = value if isinstance(value, np.ma.MaskedArray) else np.asarray(value)


def _add_time(value: Mapping[str, Any], path: str, arrays: Columns) -> None:
    """Adds the time of episodes without a clock, if the file states a rate or a step."""
    steps = [
        value[key] ** power
        for key, power in RATES.items()
        if isinstance(value.get(key), int | float) and value[key] > 0
    ]
    for inner in value if steps else ():
        prefix = f"{_joined_path(path, inner)}."
        columns = [name.removeprefix(prefix) for name in arrays if name.startswith(prefix)]
        if RUN in columns and not any(unit_of_clock(column) is not None for column in columns):
            runs, row = arrays[prefix + RUN], np.arange(len(arrays[prefix + RUN]))
            first_row = np.maximum.accumulate(np.where(np.r_[True, runs[1:] != runs[:-1]], row, 0))
            arrays[f"{prefix}time_s"] = (row - first_row) * steps[0]


def _unfold_pandas_dict(value: Mapping[str, Any]) -> Mapping[str, Any] | list[Any]:
    """A dict from pandas as named arrays: each column by row number, or names and rows apart."""
    cells = [inner for inner in value.values() if isinstance(inner, str) or not isinstance(inner, Mapping | Sequence)]
    if value and len(cells) == len(value) and all(isinstance(key, str) and key.isdigit() for key in value):
        return cells
    names, rows = value.get("columns"), value.get("data")
    if not (isinstance(names, list) and isinstance(rows, list) and rows):
        return value
    if not all(isinstance(row, list) and len(row) == len(names) for row in rows):
        return value
    return dict(zip(map(str, names), map(list, zip(*rows, strict=True)), strict=True))


def _columns_of_records(records: Sequence[Mapping[str, Any]], name: str) -> Columns:
    """Columns of records. A missing entry is a missing reading."""
    columns: dict[str, list[Any]] = {}
    for k, record in enumerate(records):
        for key, value in _leaves(record, "", name, 1):
            if key not in columns:
                input_files.check_declared(name, len(columns))
                input_files.check_memory(name, input_files.VALUE * (len(columns) + 1) * len(records))
                columns[key] = [None] * len(records)
            columns[key][k] = value
    return {key: _array(values) for key, values in columns.items()}


def _columns_of_episodes(records: Sequence[Mapping[str, Any]]) -> Columns:
    """Columns of records whose values are equally long lists of numbers. Each record is a run. Empty for other
    records.

    A text that differs in every record is the name of the run, otherwise its number is.
    """
    episodes = [{key: v for key, v in record.items() if isinstance(v, list) and v} for record in records]
    rows: list[int] = []
    for episode in episodes:
        lengths = {len(v) for v in episode.values()}
        is_nested = any(isinstance(v[0], list | Mapping) for v in episode.values())
        if is_nested or len(lengths) != 1 or lengths == {1} or episode.keys() != episodes[0].keys():
            return {}
        rows += lengths
    columns = {key: _array([x for episode in episodes for x in episode[key]]) for key in episodes[0]}
    scalar_keys = [key for key in records[0] if all(isinstance(r.get(key), str | int | float) for r in records)]
    texts = ([str(record[key]) for record in records] for key in scalar_keys if isinstance(records[0][key], str))
    names = next((v for v in texts if len({*v}) == len(v)), [str(k) for k in range(1, len(records) + 1)])
    columns |= {key: _array([record[key] for record in records]).repeat(rows) for key in scalar_keys}
    return columns | {RUN: np.repeat(names, rows)}


def _leaves(record: Mapping[str, Any], path: str, name: str, depth: int) -> Iterable[tuple[str, Any]]:
    _check_depth(name, path, depth)
    for key, value in record.items():
        if isinstance(value, Mapping):
            yield from _leaves(value, _joined_path(path, key), name, depth + 1)
        else:
            yield _joined_path(path, key), value


def _array(values: Sequence[Any]) -> np.ndarray:
    """Array of numbers (NaN if missing), of words, or of objects."""
    kinds = {type(value) for value in values}
    if kinds <= {int, float, bool, type(None)}:
        return np.array([np.nan if value is None else value for value in values], dtype=float)
    if kinds <= {str, type(None)}:
        return np.array(["" if value is None else value for value in values])
    try:
        array = np.array([[np.nan if x is None else x for x in v] if isinstance(v, list) else v for v in values])
    except (ValueError, TypeError):  # lists of different lengths
        array = np.empty(len(values), object)
    return array if array.dtype.kind in "biufUS" else array.astype(object)


def _join_tables(arrays: Columns) -> Columns:
    """Joins tables with the same columns into one table, with the key of each table as `RUN`.

    Files of WPILib SysId have such tables: «slow-forward», «fast-backward», ... are lists of rows.
    """
    matrices = {path: v for path, v in arrays.items() if v.ndim == 2 and v.dtype.kind in "iuf" and v.shape[1] > 1}
    widths = {v.shape[1] for v in matrices.values()}
    groups = {parent_path(path) for path in matrices}
    if len(matrices) < 2 or len(widths) > 1 or len(groups) > 1:
        return arrays
    (above,) = groups
    other_arrays = {path: v for path, v in arrays.items() if path not in matrices}
    runs = np.concatenate([np.full(len(v), path_parts(path)[-1]) for path, v in matrices.items()])
    return other_arrays | {f"{above}rows": np.concatenate(list(matrices.values())), f"{above}{RUN}": runs}
