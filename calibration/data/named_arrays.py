"""Raw columns of a source, by name, before they have a meaning. Every reader of a format returns them."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace

import numpy as np

from calibration.data import Names
from calibration.data.input_errors import BadData, parse_number

#: Raw values of a column: a list of texts as written, or an array of numbers with NaN for a missing reading.
Raw = list[str] | np.ndarray
#: Entries that programs write for a missing reading.
MISSING = frozenset({"", "nan", "na", "n/a", "#n/a", "<na>", "none", "null"})
#: A check of rows: column, True for each wrong row, and the end of the message, or a function that returns it by row.
Check = tuple[str, np.ndarray, str | Callable[[int], str]]


@dataclass(frozen=True)
class NamedArrays:
    """Named columns of one source. `runs.runs_of_arrays` checks them and converts them to `Runs`.

    Messages count rows from 1. A reader that omits rows reports this in `notes`.

    Attributes:
        name: name of the source, with which every message begins.
        header: names of the columns, as in the source.
        values: values of each column, all equally long.
        units: unit of each column, spelled as by `quantities.unit_in_column`, empty if unknown. May be empty
            altogether.
        units_from: where the source states the units, for messages.
        notes: sentences on the reading of the source.
        digest: SHA-256 of the source, empty if it has none.
    """

    name: str
    header: Names
    values: tuple[Raw, ...]
    units: Names = ()
    units_from: str = "the row of units below the header"
    notes: Names = ()
    digest: str = ""

    def __len__(self) -> int:
        return len(self.values[0]) if self.values else 0

    def rows(self, kept: np.ndarray, note: str) -> NamedArrays:
        """Copy with some of the rows, and a note on the omitted ones.

        Args:
            kept: True for each row that is kept, shape (rows,).
        """
        index = np.flatnonzero(kept)
        values = tuple(v[index] if isinstance(v, np.ndarray) else [v[k] for k in index] for v in self.values)
        return replace(self, values=values, notes=(*self.notes, f"{self.name}: {note}"))

    def with_columns(self, columns: Mapping[str, np.ndarray]) -> NamedArrays:
        """Copy with additional columns of numbers, which replace columns of the same name."""
        columns_left = [k for k, column in enumerate(self.header) if column not in columns]
        return replace(
            self,
            header=(*(self.header[k] for k in columns_left), *columns),
            values=(*(self.values[k] for k in columns_left), *columns.values()),
            units=(*(self.units[k] for k in columns_left), *[""] * len(columns)) if self.units else (),
        )

    def row(self, index: int) -> str:
        """Label of a row in messages, by its index from 0."""
        return f"{self.name} row {index + 1}"


def column_texts(raw: Raw) -> list[str]:
    """Values of a column as texts. Whole numbers have no decimal point."""
    if isinstance(raw, list):
        return raw
    return [f"{x:.15g}" if isinstance(x, float) else str(x) for x in raw.tolist()]


def cell_number(cell: str) -> float:
    """Number in a cell, NaN if it has none."""
    try:
        return parse_number(cell)
    except ValueError:
        return math.nan


def column_numbers(raw: Raw) -> np.ndarray:
    """Numbers in the cells of a column, NaN for a cell without a number."""
    if isinstance(raw, np.ndarray):
        return raw.astype(float)
    try:
        if "_" not in (joined := "".join(raw)) and joined.isascii():
            return np.array(list(map(float, raw)))
    except ValueError:
        pass  # a cell without a number
    return np.array([cell_number(cell) for cell in raw])


def missing_readings(raw: Raw, rows: np.ndarray) -> np.ndarray:
    """True for each row without a reading, shape (rows,)."""
    if isinstance(raw, np.ndarray):
        return np.isnan(raw[rows].astype(float))
    return np.array([raw[row].lower() in MISSING for row in rows.tolist()], bool)


def check_rows(name: str, columns: Mapping[str, np.ndarray], checks: Iterable[Check]) -> None:
    """Runs checks in their order, and rejects a table at the first wrong row of the first check that finds one.

    Args:
        name: name of the source, with which the message begins.
        columns: values of the columns, shape (rows,).
    """
    for column, wrong, why in checks:
        for row in np.flatnonzero(wrong)[:1].tolist():
            value = columns[column][row]
            cell = "an empty cell" if np.isnan(value) else f"{value:g}"
            end = why if isinstance(why, str) else why(row)
            raise BadData(f"{name} row {row + 1}, {column}: got {cell}{end}")
