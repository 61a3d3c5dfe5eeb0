"""Parquet, Feather and Arrow files."""

from __future__ import annotations

import functools
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from calibration.data import input_files
from calibration.data.sources.recorded_signals import Signal

#: Longest list whose elements become signals.
MOST = 64
#: Keys of a column's metadata that hold its unit.
_UNITS = (b"unit", b"units", b"Unit")


def signals_of_parquet(path: Path, name: str) -> tuple[Signal, ...]:
    """Signals of a Parquet file, read column by column."""
    from pyarrow import parquet

    file = parquet.ParquetFile(path)
    rows, schema = file.metadata.num_rows, file.schema_arrow
    input_files.check_declared(name, len(schema), input_files.VALUE * rows * len(schema), path.stat().st_size)
    return _signals(schema, rows, lambda k: file.read([schema.names[k]], use_threads=True).column(0))


def signals_of_arrow(path: Path, name: str) -> tuple[Signal, ...]:
    """Signals of a Feather or Arrow file, or an Arrow stream, read column by column.

    The file is not mapped into memory: if it were truncated meanwhile, the program would crash.
    """
    import pyarrow as pa

    opened = pa.ipc.open_file if input_files.first_bytes(path, name).startswith(b"ARROW1") else pa.ipc.open_stream

    def column(k: int) -> Any:
        with pa.OSFile(str(path)) as file:
            return opened(file, options=pa.ipc.IpcReadOptions(included_fields=[k])).read_all().column(0)

    with pa.OSFile(str(path)) as file:
        schema = opened(file).schema
    input_files.check_declared(name, len(schema))
    return _signals(schema, len(column(0)) if len(schema) else 0, column)


def signals_of_arrow_table(table: Any) -> tuple[Signal, ...]:
    """Signals of a `pyarrow.Table`."""
    return _signals(table.schema, table.num_rows, table.column)


def _signals(schema: Any, rows: int, column: Callable[[int], Any]) -> tuple[Signal, ...]:
    """Signals of columns. A column of lists has one signal for each element, `name[0]`.

    Args:
        column: function that reads a column by its index.
    """
    import pyarrow as pa
    import pyarrow.types as kinds
    from pyarrow import compute

    signals = []
    for k, field in enumerate(schema):
        kind, whole = field.type, functools.partial(column, k)
        if not (kinds.is_list(kind) or kinds.is_large_list(kind) or kinds.is_fixed_size_list(kind)) or not rows:
            signals.append(_signal(field, rows, whole))
            continue
        lengths = compute.unique(compute.list_value_length(whole())).to_pylist()
        if len(lengths) != 1 or not lengths[0]:
            why = "holds lists of several lengths; expected one length in every row"
            signals.append(Signal(field.name, rows, whole, refused=why))
            continue
        for j in range(min(lengths[0], MOST)):
            element = functools.partial(lambda read, j: compute.list_element(read(), j), whole, j)
            signals.append(_signal(pa.field(f"{field.name}[{j}]", kind.value_type), rows, element))
    return tuple(signals)


def _signal(field: Any, rows: int, column: Callable[[], Any]) -> Signal:
    import pyarrow.types as kinds

    kind, metadata = field.type, field.metadata or {}
    unit = next((metadata[key].decode("utf-8", "replace") for key in _UNITS if key in metadata), "")
    if kinds.is_dictionary(kind):
        kind = kind.value_type
    words = kinds.is_string(kind) or kinds.is_large_string(kind) or kinds.is_string_view(kind)
    number = kinds.is_integer(kind) or kinds.is_floating(kind) or kinds.is_boolean(kind) or kinds.is_decimal(kind)
    timed = kinds.is_timestamp(kind) or kinds.is_duration(kind)
    refused = "" if words or number or timed or kinds.is_null(kind) else f"holds {kind}; expected numbers or words"
    load = lambda: values_of_arrow_column(column())  # noqa: E731
    return Signal(field.name, rows, load, unit, words=words, refused=refused)


def values_of_arrow_column(column: Any) -> np.ndarray:
    """Values of a `pyarrow.ChunkedArray`: numbers, NaN for a missing one, words, or `datetime64`."""
    import pyarrow as pa
    import pyarrow.types as kinds
    from pyarrow import compute

    kind = column.type
    if kinds.is_dictionary(kind):
        column, kind = column.cast(kind.value_type), kind.value_type
    if kinds.is_timestamp(kind):
        return np.asarray(column.cast(pa.timestamp("ns")).to_numpy())
    if kinds.is_duration(kind):
        return np.asarray(column.cast(pa.duration("ns")).to_numpy())
    if kinds.is_string(kind) or kinds.is_large_string(kind) or kinds.is_string_view(kind):
        return np.asarray(compute.fill_null(column, "").to_pylist(), dtype=str)
    if column.null_count:
        column = compute.fill_null(column.cast(pa.float64()), np.nan)
    elif kinds.is_boolean(kind) or kinds.is_decimal(kind):
        column = column.cast(pa.float64())
    return np.asarray(column.to_numpy())
