"""Spreadsheets, .xlsx, .xls and .ods: one table in each sheet."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np

from calibration.data import delimited
from calibration.data.input_errors import BadData
from calibration.data.sources.recorded_signals import Signal


def of_workbook(path: Path, name: str) -> tuple[Signal, ...]:
    """Columns of a workbook: by their names if one sheet has data, else `sheet/name`.

    The first row with a cell is the header; a row of units may follow.

    Columns of numbers with a cell of words raise `BadData` when they are loaded.
    """
    import pandas as pd

    sheets = pd.read_excel(path, sheet_name=None, header=None, engine="calamine")
    tables = {sheet: frame.dropna(how="all") for sheet, frame in sheets.items()}
    tables = {sheet: frame for sheet, frame in tables.items() if len(frame) > 1}
    found = []
    for sheet, frame in tables.items():
        header = ["" if pd.isna(cell) else str(cell).strip() for cell in frame.iloc[0]]
        units = delimited.row_of_units(header, ["" if pd.isna(c) else str(c).strip() for c in frame.iloc[1]])
        body = frame.iloc[2 if units else 1 :]
        for k, title in enumerate(header):
            if title:
                found.append(_signal(body.iloc[:, k].infer_objects(), title, sheet, units[k] if units else ""))
    alone = len(tables) == 1
    return tuple(
        dataclasses.replace(s, path=s.path.removeprefix(f"{next(iter(tables))}/")) if alone else s for s in found
    )


def _signal(cells: Any, title: str, sheet: str, unit: str) -> Signal:
    """A column of numbers, NaN for empty cells, of dates, or of words."""
    import pandas as pd

    numbers = pd.to_numeric(cells, errors="coerce")
    wrong = cells[numbers.isna() & cells.notna()]
    words = len(wrong) > numbers.notna().sum()

    def load() -> np.ndarray:
        if pd.api.types.is_datetime64_any_dtype(cells.dtype):
            return cells.to_numpy("datetime64[ns]")
        if words:
            return cells.fillna("").astype(str).to_numpy(str)
        if len(wrong):
            raise BadData(f"{sheet}, {title}: got {str(wrong.iloc[0])[:40]!r} among numbers; expected a number")
        return numbers.to_numpy(float)

    return Signal(f"{sheet}/{title}", len(cells), load, unit, words=words)
