"""Parquet, Feather and Arrow files."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from calibration.data import input_files
from calibration.data.sources.recorded_signals import Load, Signal

#: Longest list whose elements become signals.
MOST = 64
#: Keys of a column's metadata that hold its unit.
_UNITS = (b"unit", b"units", b"Unit")


def signals_of_parquet(path: Path, name: str) -> tuple[Signal, ...]:
    """Signals of a Parquet file, read column by column."""
    from pyarrow import parquet

    file = parquet.ParquetFile(path)
    rows, schema = file.metadata.num_rows, file.schema_arrow
    size = input_files.VALUE * rows * file.metadata.num_columns
    input_files.check_declared(name, file.metadata.num_columns, size, path.stat().st_size)

    def column(field: str) -> Load:
        return lambda: values_of_arrow_column(file.read([field], use_threads=True).column(0))

    return tuple(s for field in schema for s in _signals(field, rows, column(field.name), file.read))


def signals_of_arrow(path: Path, name: str) -> tuple[Signal, ...]:
    """Signals of a Feather or Arrow file, or an Arrow stream, read column by column.

    The file is not mapped into memory: if it were truncated meanwhile, the program would crash.
    """
    import pyarrow as pa

    def reader(file: Any, **options: Any) -> Any:
        stream = file.read(6) != b"ARROW1"
        file.seek(0)
        return (pa.ipc.open_stream if stream else pa.ipc.open_file)(file, **options)

    def column(k: int) -> Any:
        with pa.OSFile(str(path)) as file:
            return reader(file, options=pa.ipc.IpcReadOptions(included_fields=[k])).read_all()

    with pa.OSFile(str(path)) as file:
        schema = reader(file).schema
    input_files.check_declared(name, len(schema))
    rows = column(0).num_rows if len(schema) else 0

    def values(k: int) -> Load:
        return lambda: values_of_arrow_column(column(k).column(0))

    def whole(k: int) -> Callable[[list[str]], Any]:
        return lambda names: column(k)

    return tuple(s for k, field in enumerate(schema) for s in _signals(field, rows, values(k), whole(k)))


def signals_of_arrow_table(table: Any) -> tuple[Signal, ...]:
    """Signals of a `pyarrow.Table`."""

    def column(field: str) -> Load:
        return lambda: values_of_arrow_column(table.column(field))

    return tuple(
        s for field in table.schema for s in _signals(field, table.num_rows, column(field.name), table.select)
    )


def _signals(field: Any, rows: int, load: Load, read: Callable[[list[str]], Any]) -> list[Signal]:
    """Signals of a column. A column of lists has one signal for each element, `name[0]`."""
    import pyarrow.types as kinds

    kind = field.type
    if not (kinds.is_list(kind) or kinds.is_large_list(kind) or kinds.is_fixed_size_list(kind)) or not rows:
        return [_signal(field, rows, load)]
    import pyarrow as pa
    from pyarrow import compute

    column = read([field.name]).column(0)
    lengths = compute.unique(compute.list_value_length(column)).to_pylist()
    if len(lengths) != 1 or not lengths[0]:
        why = "holds lists of several lengths; expected one length in every row"
        return [Signal(field.name, rows, load, refused=why)]

    def element(k: int) -> Load:
        return lambda: values_of_arrow_column(compute.list_element(column, k))

    return [
        _signal(pa.field(f"{field.name}[{k}]", kind.value_type), rows, element(k))
        for k in range(min(lengths[0], MOST))
    ]


def _signal(field: Any, rows: int, load: Load) -> Signal:
    import pyarrow.types as kinds

    kind, metadata = field.type, field.metadata or {}
    unit = next((metadata[key].decode("utf-8", "replace") for key in _UNITS if key in metadata), "")
    if kinds.is_dictionary(kind):
        kind = kind.value_type
    words = kinds.is_string(kind) or kinds.is_large_string(kind) or kinds.is_string_view(kind)
    number = kinds.is_integer(kind) or kinds.is_floating(kind) or kinds.is_boolean(kind) or kinds.is_decimal(kind)
    timed = kinds.is_timestamp(kind) or kinds.is_duration(kind)
    refused = "" if words or number or timed or kinds.is_null(kind) else f"holds {kind}; expected numbers or words"
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
