"""Tables of columns: pandas, polars, Arrow, xarray and dicts of arrays, and Parquet, Feather and Arrow files."""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from calibration.data import input_files
from calibration.data.input_errors import BadData
from calibration.data.sources import json_records
from calibration.data.sources.recorded_signals import (
    Clock,
    Load,
    Signal,
    array_in_memory,
    refused_signal,
    refused_type,
    signals_of_arrays,
    unit_of_clock,
)

EXPECTED = (
    "a path, a pandas or polars DataFrame, an Arrow table, an xarray Dataset, a dict of arrays, or a list of records"
)

#: Longest list whose elements become signals.
MOST = 64
#: Keys of a column's metadata that hold its unit.
_UNITS = (b"unit", b"units", b"Unit")


def signals_of_object(source: Any) -> tuple[str, tuple[Signal, ...]]:
    """Kind of an object in memory, and its signals.

    Raises:
        BadData: the object is of another kind.
    """
    library, kind = type(source).__module__.partition(".")[0], type(source).__name__
    if (library, kind) == ("pandas", "DataFrame"):
        return "the DataFrame", tuple(_signals_of_frame(source))
    if library == "polars" and kind in ("DataFrame", "LazyFrame"):
        try:
            frame = source.collect() if kind == "LazyFrame" else source
        except Exception as error:  # polars has its own errors
            raise BadData(f"the LazyFrame: polars cannot evaluate it ({' '.join(str(error).split())})") from error
        return "the DataFrame", signals_of_arrow_table(frame.to_arrow())
    if library == "pyarrow" and kind in ("Table", "RecordBatch"):
        import pyarrow as pa

        return "the Arrow table", signals_of_arrow_table(pa.table(source))
    if library == "xarray" and kind in ("Dataset", "DataArray"):
        dataset = source if kind == "Dataset" else source.to_dataset(name=source.name or "values")
        return f"the {kind}", _signals_of_xarray(dataset)
    if isinstance(source, np.ndarray) and source.dtype.names:
        fields = {name: array_in_memory(source[name]) for name in source.dtype.names}
        return "the array", signals_of_arrays("the array", fields)
    if isinstance(source, Mapping):
        return "the dict", json_records.signals_of_json_content(source, "the dict")
    if isinstance(source, list | tuple) and source and all(isinstance(item, Mapping) for item in source):
        return "the records", json_records.signals_of_json_content(list(source), "the records")
    kind = f"{library} {kind}".removeprefix("builtins ")
    raise BadData(f"the source: got {kind}; expected {EXPECTED}")


def _signals_of_frame(frame: Any) -> Iterator[Signal]:
    """Signals of a pandas DataFrame, and of its index if that has a name or times."""
    import pyarrow as pa

    levels = [frame.index.get_level_values(level) for level in range(frame.index.nlevels)]
    index_levels = [
        (level.name or "time", level) for level in levels if level.name is not None or level.dtype.kind in "mM"
    ]
    for title, series in (*index_levels, *((title, frame.iloc[:, j]) for j, title in enumerate(frame.columns))):
        name = ".".join(filter(None, map(str, title if isinstance(title, tuple) else (title,))))
        try:
            yield from signals_of_arrow_table(pa.table([pa.array(series, from_pandas=True)], [name]))
        except pa.ArrowException:  # complex numbers, or objects of several kinds
            yield refused_signal(name, len(frame), refused_type(series.dtype))


def _signals_of_xarray(dataset: Any) -> tuple[Signal, ...]:
    """Signals of a Dataset. If its variables have several dimensions of time, each variable has its own clock."""
    dimensions = {d for v in dataset.data_vars.values() for d in v.dims}
    has_clocks = len({dataset.sizes[d] for d in dimensions if dataset.sizes[d] > 1}) > 1
    signals: list[Signal] = []
    for title, array in {**dataset.coords, **dataset.data_vars}.items():
        if not array.dims:
            continue
        clock, dimension, name = None, str(array.dims[0]), str(title)
        stored_array = (array.shape, array.dtype, _value_loader(array))
        unit = str(array.attrs.get("units", ""))
        if has_clocks and dimension in dataset.coords:
            stamps = dataset.coords[dimension]
            clock = Clock(
                dimension, _value_loader(stamps), str(stamps.attrs.get("units", "")) or unit_of_clock(dimension) or ""
            )
        signals_of_variable = signals_of_arrays("the Dataset", {name: stored_array}, {name: unit})
        signals += [replace(s, clock=clock) for s in signals_of_variable]
    return tuple(signals)


def _value_loader(array: Any) -> Load:
    return lambda: np.asarray(array.values)


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

    open_file = pa.ipc.open_file if input_files.first_bytes(path, name).startswith(b"ARROW1") else pa.ipc.open_stream

    def read_column(k: int) -> Any:
        with pa.OSFile(str(path)) as file:
            return open_file(file, options=pa.ipc.IpcReadOptions(included_fields=[k])).read_all().column(0)

    with pa.OSFile(str(path)) as file:
        schema = open_file(file).schema
    input_files.check_declared(name, len(schema))
    return _signals(schema, len(read_column(0)) if len(schema) else 0, read_column)


def signals_of_arrow_table(table: Any) -> tuple[Signal, ...]:
    """Signals of a `pyarrow.Table`."""
    return _signals(table.schema, table.num_rows, table.column)


def _signals(schema: Any, rows: int, read_column: Callable[[int], Any]) -> tuple[Signal, ...]:
    """Signals of columns. A column of lists has one signal for each element, `name[0]`.

    Args:
        read_column: function that reads a column by its index.
    """
    import pyarrow as pa
    import pyarrow.types as kinds
    from pyarrow import compute

    signals = []
    for k, field in enumerate(schema):
        kind, read_values = field.type, functools.partial(read_column, k)
        if not (kinds.is_list(kind) or kinds.is_large_list(kind) or kinds.is_fixed_size_list(kind)) or not rows:
            signals.append(_signal(field, rows, read_values))
            continue
        lengths = compute.unique(compute.list_value_length(read_values())).to_pylist()
        if len(lengths) != 1 or not lengths[0]:
            why = "holds lists of several lengths; expected one length in every row"
            signals.append(Signal(field.name, rows, read_values, refused=why))
            continue
        for j in range(min(lengths[0], MOST)):
            element = functools.partial(lambda read, j: compute.list_element(read(), j), read_values, j)
            signals.append(_signal(pa.field(f"{field.name}[{j}]", kind.value_type), rows, element))
    return tuple(signals)


def _signal(field: Any, rows: int, read_values: Callable[[], Any]) -> Signal:
    import pyarrow.types as kinds

    kind, metadata = field.type, field.metadata or {}
    unit = next((metadata[key].decode("utf-8", "replace") for key in _UNITS if key in metadata), "")
    if kinds.is_dictionary(kind):
        kind = kind.value_type
    is_text = kinds.is_string(kind) or kinds.is_large_string(kind) or kinds.is_string_view(kind)
    is_number = kinds.is_integer(kind) or kinds.is_floating(kind) or kinds.is_boolean(kind) or kinds.is_decimal(kind)
    is_time = kinds.is_timestamp(kind) or kinds.is_duration(kind)
    refused = (
        "" if is_text or is_number or is_time or kinds.is_null(kind) else f"holds {kind}; expected numbers or words"
    )
    load = lambda: values_of_arrow_column(read_values())  # noqa: E731
    return Signal(field.name, rows, load, unit, words=is_text, refused=refused)


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
