"""Writing of tables and documents: numbers that are not finite become empty cells in CSV and null in JSON."""

from __future__ import annotations

import contextlib
import csv
import inspect
import io
import json
import math
import operator
import re
import shutil
from collections.abc import Iterator, Mapping
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any, TextIO, TypeAlias

import numpy as np

from calibration.data import Columns, Json
from calibration.data.named_arrays import cell_number
from mmrjax.errors import printable
from mmrjax.model.quantities import TABLE, unit_at_end, unit_in_column

#: Types of libraries that are imported only when needed.
PandasFrame: TypeAlias = Any
PolarsFrame: TypeAlias = Any
ArrowTable: TypeAlias = Any
XarrayDataset: TypeAlias = Any


def columns_of(result: Any) -> Columns:
    """Returns the table of a result as a dict of columns, each of shape (rows,).

    Args:
        result: runs, a dict of columns, or the result of a calibration, a loop or a simulation.

    Raises:
        TypeError: `result` has no table.
    """
    if isinstance(result, Mapping):
        content = result
    elif isinstance(getattr(result, "columns", None), Mapping):
        content = result.columns
    else:
        table = next(
            (getattr(result, name) for name in ("rows_table", "rows", "table") if hasattr(result, name)), None
        )
        if table is None:
            raise TypeError(f"expected a result with a table, got {type(result).__name__}")
        content = table() if callable(table) else table
    return {str(name): np.asarray(values) for name, values in content.items()}


def to_arrow(result: Any) -> ArrowTable:
    """Returns the table of a result as a `pyarrow.Table`.

    Args:
        result: runs, a calibration, the result of a loop or of a simulation, or a dict of columns.

    Raises:
        TypeError: `result` has no table.
    """
    import pyarrow as pa

    columns = columns_of(result)
    return pa.table({name: pa.array(v.tolist() if v.dtype.kind in "OU" else v) for name, v in columns.items()})


def to_pandas(result: Any) -> PandasFrame:
    """Returns the table of a result as a pandas DataFrame.

    Args:
        result: runs, a calibration, the result of a loop or of a simulation, or a dict of columns.

    Raises:
        TypeError: `result` has no table.
    """
    import pandas as pd

    return pd.DataFrame(columns_of(result))


def to_polars(result: Any) -> PolarsFrame:
    """Returns the table of a result as a polars DataFrame.

    Args:
        result: runs, a calibration, the result of a loop or of a simulation, or a dict of columns.

    Raises:
        TypeError: `result` has no table.
    """
    import polars as pl

    return pl.DataFrame(to_arrow(result))


def to_xarray(result: Any) -> XarrayDataset:
    """Returns the table of a result as an xarray Dataset with the dimension `row` and the columns' units.

    Args:
        result: runs, a calibration, the result of a loop or of a simulation, or a dict of columns.

    Raises:
        TypeError: `result` has no table.
    """
    import xarray as xr

    units = {unit_in_column(q.unit): q.unit for rows in TABLE.values() for q in rows}
    unit_by_name = {name: unit_at_end(name, units) for name in columns_of(result)}
    return xr.Dataset(
        {
            name: ("row", values, {} if (unit := unit_by_name[name]) is None else {"units": units[unit]})
            for name, values in columns_of(result).items()
        }
    )


@contextlib.contextmanager
def naming_file(path: Path | str) -> Iterator[None]:
    """Adds the file's name to a system error while the file is written, because errors such as a full disk do not
    name it.
    """
    try:
        yield
    except OSError as error:
        if error.filename is None:
            error.filename = str(path)
        raise


@contextlib.contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Context manager: temporary path that replaces a file when the block ends.

    After an error, such as a full disk, the file is unchanged.
    """
    path = path.resolve()  # target of a link
    if path.exists() and not path.is_file():  # a device or a pipe
        with naming_file(path):
            yield path
        return
    temporary = path.with_name(f".{path.stem[:100]}.writing{path.suffix}")
    try:
        with naming_file(path):
            yield temporary
            if path.exists():
                shutil.copymode(path, temporary)
            temporary.replace(path)
    except OSError as error:
        if error.filename == str(temporary):
            error.filename = str(path)
        raise
    finally:
        temporary.unlink(missing_ok=True)


def write_text(path: Path, text: str) -> None:
    """Writes a text file."""
    with replacing(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def write_json(path: Path, content: Mapping[str, Any]) -> None:
    """Writes `json_text` to a file."""
    write_text(path, json_text(content) + "\n")


def json_text(content: Mapping[str, Any]) -> str:
    """Data as JSON. Numbers that are not finite become null, and characters that are not `printable` are escaped."""
    text = json.dumps(json_value(content), indent=2, ensure_ascii=False)
    printed = printable(text)
    pairs = zip(text, printed, strict=True)
    return text if printed == text else "".join(a if a == b else json.dumps(a)[1:-1] for a, b in pairs)


def toml_value(value: Any) -> str:
    """A value as TOML. Characters that are not `printable` are escaped."""
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, str):
        text = json.dumps(value.encode("utf-8", "replace").decode(), ensure_ascii=False)
        return "".join(c if c.isprintable() else f"\\U{ord(c):08x}" for c in text)
    if isinstance(value, tuple | list):
        return "[" + ", ".join(map(toml_value, value)) + "]"
    if isinstance(value, dict):
        return "{" + ", ".join(f"{toml_value(name)} = {toml_value(v)}" for name, v in value.items()) + "}"
    return repr(value)


def write_table(path: Path, columns: Columns, tables: str = "csv") -> None:
    """Writes a table as CSV. Numbers that are not finite become empty cells.

    Args:
        tables: `parquet` to also write the columns in that format, with all digits.
    """
    if tables == "parquet":
        from pyarrow import parquet

        with replacing(path.with_suffix(".parquet")) as temporary:
            parquet.write_table(to_arrow(columns), temporary)
    with replacing(path) as temporary, temporary.open("w", newline="", encoding="utf-8") as stream:
        _write_rows(stream, columns)


def table_text(columns: Columns) -> str:
    """Text of the CSV file that `write_table` writes."""
    stream = io.StringIO()
    _write_rows(stream, columns)
    return stream.getvalue()


def _write_rows(stream: TextIO, columns: Columns) -> None:
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerow(map(cell_text, columns))
    writer.writerows(zip(*(map(cell_text, column) for column in columns.values()), strict=True))


#: Words that a spreadsheet would run as formulas, and words that already have our mark.
_FORMULA = re.compile(r"'*[=+\-@\t\r]")


def cell_text(value: Any) -> str:
    """A cell of a table. A word that a spreadsheet would run as a formula gets an apostrophe (`cell_word`)."""
    if isinstance(value, float | np.floating):
        return f"{value:.9g}" if math.isfinite(value) else ""
    text = printable(str(value)).replace("\n", " ")
    return f"'{text}" if isinstance(value, str) and _FORMULA.match(text) and math.isnan(cell_number(text)) else text


def cell_word(text: str) -> str:
    """A cell as it was before `cell_text` marked it."""
    return text[1:] if text.startswith("'") and _FORMULA.match(text) else text


def entries_of(value: Any, *entries: str) -> Json:
    """Entries of an object for a list of `key` or `key=attribute.of.attribute`. Methods are called."""
    pairs = (entry.partition("=") for entry in entries)
    values = {key: operator.attrgetter(attribute or key)(value) for key, _, attribute in pairs}
    return {key: x() if inspect.ismethod(x) else x for key, x in values.items()}


def json_value(value: Any) -> Any:
    """Data for JSON, with null in place of numbers that are not finite.

    An object becomes the entries that its class lists in `JSON` (`entries_of`), otherwise its `to_json()` or the
    fields of its dataclass.
    """
    json_fields = getattr(value, "JSON", None)
    if json_fields is None and hasattr(value, "to_json"):
        return json_value(value.to_json())
    if json_fields is None and is_dataclass(value):
        json_fields = [field.name for field in fields(value)]
    if json_fields is not None:
        return json_value(entries_of(value, *json_fields))
    if isinstance(value, Mapping):
        return {key: json_value(v) for key, v in value.items()}
    if isinstance(value, list | tuple):
        return [json_value(v) for v in value]
    if isinstance(value, np.ndarray):
        return json_value(value.tolist())
    if isinstance(value, np.generic):
        value = value.item()
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value
