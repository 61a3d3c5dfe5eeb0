"""Tables of results as objects of pandas, polars, Arrow and xarray."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, TypeAlias

import numpy as np

from calibration.data import Columns

#: Types of libraries that are imported where they are needed.
PandasFrame: TypeAlias = Any
PolarsFrame: TypeAlias = Any
ArrowTable: TypeAlias = Any
XarrayDataset: TypeAlias = Any


def columns_of(result: Any) -> Columns:
    """Returns the table of a result, by column: of shape (rows,) each.

    Args:
        result: runs, a calibration, the result of a loop or of a simulation, or a dict of columns.

    Raises:
        TypeError: something without a table.
    """
    if isinstance(result, Mapping):
        found = result
    elif isinstance(getattr(result, "columns", None), Mapping):
        found = result.columns
    else:
        table = next(
            (getattr(result, name) for name in ("rows_table", "rows", "table") if hasattr(result, name)), None
        )
        if table is None:
            raise TypeError(f"expected a result with a table, got {type(result).__name__}")
        found = table() if callable(table) else table
    return {str(name): np.asarray(values) for name, values in found.items()}


def to_arrow(result: Any) -> ArrowTable:
    """Returns the table of a result as a `pyarrow.Table`.

    Args:
        result: runs, a calibration, the result of a loop or of a simulation, or a dict of columns.

    Raises:
        TypeError: something without a table.
    """
    import pyarrow as pa

    columns = columns_of(result)
    return pa.table({name: pa.array(v.tolist() if v.dtype.kind in "OU" else v) for name, v in columns.items()})


def to_pandas(result: Any) -> PandasFrame:
    """Returns the table of a result as a pandas DataFrame.

    Args:
        result: runs, a calibration, the result of a loop or of a simulation, or a dict of columns.

    Raises:
        TypeError: something without a table.
    """
    import pandas as pd

    return pd.DataFrame(columns_of(result))


def to_polars(result: Any) -> PolarsFrame:
    """Returns the table of a result as a polars DataFrame.

    Args:
        result: runs, a calibration, the result of a loop or of a simulation, or a dict of columns.

    Raises:
        TypeError: something without a table.
    """
    import polars as pl

    return pl.DataFrame(to_arrow(result))


def to_xarray(result: Any) -> XarrayDataset:
    """Returns the table of a result as an xarray Dataset with the dimension `row`.

    Args:
        result: runs, a calibration, the result of a loop or of a simulation, or a dict of columns.

    Raises:
        TypeError: something without a table.
    """
    import xarray as xr

    return xr.Dataset({name: ("row", values) for name, values in columns_of(result).items()})
