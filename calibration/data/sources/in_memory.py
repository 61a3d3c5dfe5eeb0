"""Tables in memory: pandas, polars, Arrow, xarray, and dicts of arrays."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
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
        signals = []
        for level in range(source.index.nlevels):
            index = source.index.get_level_values(level)
            has_named_index = index.name is not None or index.dtype.kind in "mM"
            if has_named_index:
                signals.append(_of_series(str(index.name or "time"), index, len(source)))
        signals += [
            _of_series(
                ".".join(str(part) for part in column if str(part)) if isinstance(column, tuple) else str(column),
                source.iloc[:, j],
                len(source),
            )
            for j, column in enumerate(source.columns)
        ]
        return "the DataFrame", tuple(signals)
    if library == "polars" and kind in ("DataFrame", "LazyFrame"):
        try:
            frame = source.collect() if kind == "LazyFrame" else source
        except Exception as error:  # polars has its own errors
            raise BadData(f"the LazyFrame: polars cannot evaluate it ({' '.join(str(error).split())})") from error
        return "the DataFrame", columnar.signals_of_arrow_table(frame.to_arrow())
    if library == "pyarrow" and kind in ("Table", "RecordBatch"):
        import pyarrow as pa

        return "the Arrow table", columnar.signals_of_arrow_table(
            source if kind == "Table" else pa.Table.from_batches([source])
        )
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


def _of_series(name: str, series: Any, rows: int) -> Signal:
    dtype = series.dtype
    kind = getattr(dtype, "kind", "O")
    if refused := "" if kind == "O" else refused_type(dtype):
        return Signal(name, rows, lambda: np.empty(0), refused=refused)
    if kind in "mM":  # a time zone does not change elapsed times
        return Signal(name, rows, lambda: np.asarray(series.to_numpy(dtype=f"{kind}8[ns]")))
    words = str(dtype) in ("str", "string", "category") or str(dtype).startswith("string")
    if kind == "O" and not words:
        kinds = {type(value) for value, is_missing in zip(series, series.isna(), strict=True) if not is_missing}
        if kinds and kinds <= {str}:
            words = True
        elif kinds and not kinds <= {int, float, bool, np.float64, np.int64}:
            return Signal(name, rows, lambda: np.empty(0), refused="holds objects; expected numbers or words")
    if words:
        return Signal(name, rows, _words(series), words=True)
    return Signal(name, rows, lambda: np.asarray(series.to_numpy(dtype=float, na_value=np.nan)))


def _words(series: Any) -> Load:
    return lambda: np.array(
        ["" if is_missing else str(value) for value, is_missing in zip(series, series.isna(), strict=True)]
    )


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
