"""Tables in memory: pandas, polars, Arrow, xarray, and dicts of arrays."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from calibration.data.input_errors import BadData
from calibration.data.sources import columnar, json_records
from calibration.data.sources.recorded_signals import (
    Clock,
    Load,
    Signal,
    refused_type,
    signals_of_arrays,
    unit_of_clock,
    values_in_memory,
)

EXPECTED = (
    "a path, a pandas or polars DataFrame, an Arrow table, an xarray Dataset, a dict of arrays, or a list of records"
)


def signals_of_object(source: Any) -> tuple[str, tuple[Signal, ...]]:
    """Kind of an object in memory, and its signals.

    Raises:
        BadData: the object is of another kind.
    """
    library = type(source).__module__.partition(".")[0]
    kind = type(source).__name__
    if library == "pandas" and kind == "DataFrame":
        return "the DataFrame", tuple(_of_frame(source))
    if library == "polars" and kind in ("DataFrame", "LazyFrame"):
        try:
            frame = source.collect() if kind == "LazyFrame" else source
        except Exception as error:  # polars has its own errors
            raise BadData(f"the LazyFrame: polars cannot evaluate it ({' '.join(str(error).split())})") from error
        return "the DataFrame", columnar.signals_of_arrow_table(frame.to_arrow())
    if library == "pyarrow" and kind in ("Table", "RecordBatch"):
        import pyarrow as pa

        return "the Arrow table", columnar.signals_of_arrow_table(pa.table(source))
    if library == "xarray" and kind in ("Dataset", "DataArray"):
        return f"the {kind}", _of_xarray(
            source if kind == "Dataset" else source.to_dataset(name=source.name or "values")
        )
    if isinstance(source, np.ndarray) and source.dtype.names:
        return "the array", signals_of_arrays(
            "the array", {n: (source.shape, source.dtype[n], values_in_memory(source[n])) for n in source.dtype.names}
        )
    if isinstance(source, Mapping):
        return "the dict", json_records.signals_of_json_content(source, "the dict")
    if isinstance(source, list | tuple) and source and all(isinstance(item, Mapping) for item in source):
        return "the records", json_records.signals_of_json_content(list(source), "the records")
    library = type(source).__module__.partition(".")[0]
    kind = f"{library} {type(source).__name__}".removeprefix("builtins ")
    raise BadData(f"the source: got {kind}; expected {EXPECTED}")


def _of_frame(frame: Any) -> Iterator[Signal]:
    """Signals of a pandas DataFrame, and of its index if that has a name or times."""
    import pyarrow as pa

    levels = [frame.index.get_level_values(level) for level in range(frame.index.nlevels)]
    named = [(level.name or "time", level) for level in levels if level.name is not None or level.dtype.kind in "mM"]
    for title, series in (*named, *((title, frame.iloc[:, j]) for j, title in enumerate(frame.columns))):
        name = ".".join(filter(None, map(str, title if isinstance(title, tuple) else (title,))))
        try:
            yield from columnar.signals_of_arrow_table(pa.table([pa.array(series, from_pandas=True)], [name]))
        except pa.ArrowException:  # complex numbers, or objects of several kinds
            yield Signal(name, len(frame), lambda: np.empty(0), refused=refused_type(series.dtype))


def _of_xarray(dataset: Any) -> tuple[Signal, ...]:
    """Signals of a Dataset. If its variables have several dimensions of time, each variable has its own clock."""
    dimensions = {d for v in dataset.data_vars.values() for d in v.dims}
    several = len({dataset.sizes[d] for d in dimensions if dataset.sizes[d] > 1}) > 1 and len(dimensions) > 1
    signals_found: list[Signal] = []
    for name, array in {**dataset.coords, **dataset.data_vars}.items():
        if not array.dims:
            continue
        clock = None
        time = array.dims[0]
        if several and time in dataset.coords:
            unit = str(dataset.coords[time].attrs.get("units", "")) or unit_of_clock(str(time)) or ""
            clock = Clock(str(time), _values(dataset.coords[time]), unit)
        shape, dtype = array.shape, array.dtype
        signals = signals_of_arrays(
            "the Dataset", {str(name): (shape, dtype, _values(array))}, {str(name): str(array.attrs.get("units", ""))}
        )
        signals_found += [dataclasses.replace(s, clock=clock) for s in signals]
    return tuple(signals_found)


def _values(array: Any) -> Load:
    return lambda: np.asarray(array.values)
