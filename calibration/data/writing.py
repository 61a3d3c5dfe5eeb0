"""Tables and documents as files: numbers that are not finite are empty cells in CSV and null in JSON."""

from __future__ import annotations

import contextlib
import csv
import io
import json
import math
import shutil
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, TextIO

import numpy as np

from calibration.data import frames


@contextlib.contextmanager
def naming_file(path: Path | str) -> Iterator[None]:
    """Adds the file's name to an error of the system while the file is written, as a full disk does not name it."""
    try:
        yield
    except OSError as error:
        if error.filename is None:
            error.filename = str(path)
        raise


@contextlib.contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Path next to a file, which replaces the file when the block ends.

    After an error the file is as it was. A full disk is an example: writing into the file would have emptied it.
    """
    path = path.resolve()  # the file that a link names
    if path.exists() and not path.is_file():  # a device or a pipe
        with naming_file(path):
            yield path
        return
    aside = path.with_name(f".{path.stem[:100]}.writing{path.suffix}")
    try:
        with naming_file(path):
            yield aside
            if path.exists():
                shutil.copymode(path, aside)
            aside.replace(path)
    except OSError as error:
        if error.filename == str(aside):
            error.filename = str(path)
        raise
    finally:
        aside.unlink(missing_ok=True)


def write_text(path: Path, text: str) -> None:
    """Write a text file."""
    with replacing(path) as aside:
        aside.write_text(text, encoding="utf-8")


def write_json(path: Path, content: Mapping[str, Any]) -> None:
    """Write a JSON file; numbers that are not finite become null."""
    write_text(path, json.dumps(finite_or_null(content), indent=2, ensure_ascii=False) + "\n")


def write_table(path: Path, columns: Mapping[str, np.ndarray], tables: str = "csv") -> None:
    """Write a table as CSV; numbers that are not finite become empty cells.

    Args:
        tables: `parquet` to write the same columns into a file of that format too, with all their digits.
    """
    if tables == "parquet":
        from pyarrow import parquet

        with replacing(path.with_suffix(".parquet")) as aside:
            parquet.write_table(frames.to_arrow(columns), aside)
    with replacing(path) as aside, aside.open("w", newline="", encoding="utf-8") as stream:
        _write_rows(stream, columns)


def table_text(columns: Mapping[str, np.ndarray]) -> str:
    """A table as the text of a CSV file, as `write_table` writes it."""
    stream = io.StringIO()
    _write_rows(stream, columns)
    return stream.getvalue()


def _write_rows(stream: TextIO, columns: Mapping[str, np.ndarray]) -> None:
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerow(columns)
    writer.writerows(zip(*(map(cell_text, column) for column in columns.values()), strict=True))


def cell_text(value: Any) -> str:
    """A cell of a table."""
    if isinstance(value, float | np.floating):
        return f"{value:.9g}" if math.isfinite(value) else ""
    return str(value)


def finite_or_null(value: Any) -> Any:
    """JSON-able data with null in place of numbers that are not finite."""
    if isinstance(value, Mapping):
        return {key: finite_or_null(v) for key, v in value.items()}
    if isinstance(value, list | tuple):
        return [finite_or_null(v) for v in value]
    if isinstance(value, np.ndarray):
        return finite_or_null(value.tolist())
    if isinstance(value, np.generic):
        value = value.item()
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value
