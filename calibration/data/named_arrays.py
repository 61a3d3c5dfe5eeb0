"""Columns of a source by name with raw values, before they have a meaning. Every reader of a format makes them."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping

import numpy as np

from calibration.data import Names
from calibration.data.input_errors import parse_number

#: Raw values of a column: a list of texts as written, or an array of numbers with NaN for a missing reading.
Raw = list[str] | np.ndarray
#: Entries of programs for a missing reading.
MISSING = frozenset({"", "nan", "na", "n/a", "#n/a", "<na>", "none", "null"})


@dataclasses.dataclass(frozen=True)
class NamedArrays:
    """Named columns of one source. `runs.of_arrays` checks them and makes `Runs` of them.

    Messages count rows from 1. A reader that leaves out rows says so in `notes`.

    Attributes:
        name: name of the source, which opens every message.
        header: names of the columns, as the source states them.
        values: one for each column, all of one length.
        units: one for each column, spelled by `quantities.unit_in_column`, empty if unknown, or no units at all.
        units_from: place where the source states them, for messages.
        notes: sentences on reading.
        digest: SHA-256 of the source's bytes, empty if it has none.
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
        """Copy with some of the rows, and a note on the others.

        Args:
            kept: True for each row that is kept, shape (rows,).
        """
        index = np.flatnonzero(kept)
        values = tuple(v[index] if isinstance(v, np.ndarray) else [v[k] for k in index] for v in self.values)
        return dataclasses.replace(self, values=values, notes=(*self.notes, f"{self.name}: {note}"))

    def with_columns(self, columns: Mapping[str, np.ndarray]) -> NamedArrays:
        """Copy with columns of numbers in addition to its own, or in place of those with the same name."""
        kept = [k for k, column in enumerate(self.header) if column not in columns]
        return dataclasses.replace(
            self,
            header=(*(self.header[k] for k in kept), *columns),
            values=(*(self.values[k] for k in kept), *columns.values()),
            units=(*(self.units[k] for k in kept), *[""] * len(columns)) if self.units else (),
        )

    def row(self, index: int) -> str:
        """Name of a row in messages, by its index from 0."""
        return f"{self.name} row {index + 1}"


def column_texts(raw: Raw) -> list[str]:
    """Returns the values of a column as texts, whole numbers without a point."""
    if isinstance(raw, list):
        return raw
    return [f"{x:.15g}" if isinstance(x, float) else str(x) for x in raw.tolist()]


def cell_number(cell: str) -> float:
    """Returns a cell's number, NaN if it contains none."""
    try:
        return parse_number(cell)
    except ValueError:
        return math.nan


def column_numbers(raw: Raw) -> np.ndarray:
    """Returns the numbers in a column's cells, NaN for a cell without a number."""
    if isinstance(raw, np.ndarray):
        return raw.astype(float)
    try:
        if "_" not in (joined := "".join(raw)) and joined.isascii():
            return np.array(list(map(float, raw)))
    except ValueError:
        pass  # some cell states no number
    return np.array([cell_number(cell) for cell in raw])


def missing_readings(raw: Raw, rows: np.ndarray) -> np.ndarray:
    """Returns True for each row without a reading, shape (rows,)."""
    if isinstance(raw, np.ndarray):
        return np.isnan(raw[rows].astype(float))
    return np.array([raw[row].lower() in MISSING for row in rows.tolist()], bool)
