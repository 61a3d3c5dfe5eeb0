"""Spreadsheets, .xlsx, .xls and .ods: one table in each sheet."""

from __future__ import annotations

import functools
import re
import zipfile
from pathlib import Path
from typing import Any

import numpy as np

from calibration.data import delimited, input_files
from calibration.data.input_errors import BadData
from calibration.data.sources.recorded_signals import Signal

#: Memory of the cells, as a multiple of their text in the file.
OBJECTS = 4
#: Memory of a cell of a sheet's rectangle [bytes].
CELL = 100


def signals_of_workbook(path: Path, name: str) -> tuple[Signal, ...]:
    """Columns of a workbook: by name if only one sheet has data, otherwise `sheet/name`.

    The first row with a cell is the header. A row of units may follow.

    Loading a column of numbers raises `BadData` if a cell has words.
    """
    import pandas as pd

    size = path.stat().st_size
    if zipfile.is_zipfile(path):
        with zipfile.ZipFile(path) as archive:
            unpacked_size = sum(item.file_size for item in archive.infolist())
            input_files.check_declared(name, 1, unpacked_size, size)
            input_files.check_memory(name, OBJECTS * unpacked_size)
            if any(item.startswith("xl/worksheets/") and item.endswith(".bin") for item in archive.namelist()):
                raise BadData(f"{name}: is a binary workbook (.xlsb); save it as .xlsx")
            cells = max(map(_cell_count, map(archive.read, archive.namelist())), default=0)
        input_files.check_memory(name, CELL * cells)
    else:
        input_files.check_memory(name, OBJECTS * size)
    sheets = pd.read_excel(path, sheet_name=None, header=None, engine="calamine")
    tables = {sheet: frame.dropna(how="all") for sheet, frame in sheets.items()}
    tables = {sheet: frame for sheet, frame in tables.items() if len(frame) > 1}
    input_files.check_declared(name, sum(frame.shape[1] for frame in tables.values()))
    signals = []
    for sheet, frame in tables.items():
        header, below = (["" if pd.isna(cell) else str(cell).strip() for cell in frame.iloc[k]] for k in (0, 1))
        units = delimited.row_of_units(header, below)
        body = frame.iloc[2 if units else 1 :]
        for k, (title, unit) in enumerate(zip(header, units or [""] * len(header), strict=True)):
            if title:
                signal_path = title if len(tables) == 1 else f"{sheet}/{title}"
                signals.append(_signal(body.iloc[:, k].infer_objects(), signal_path, f"{sheet}, {title}", unit))
    return tuple(signals)


def _cell_count(content: bytes) -> int:
    """Number of cells in the rectangle that a sheet's XML declares. Calamine allocates all of it."""
    places = re.findall(rb'\br="([A-Z]{1,3})(\d{1,7})"', content)  # of .xlsx
    height = max((int(row) for _, row in places), default=0)
    width = max(
        (functools.reduce(lambda n, c: 26 * n + c - ord("A") + 1, column, 0) for column, _ in places), default=0
    )
    if b"number-columns-repeated" in content or b"number-rows-repeated" in content:  # of .ods
        for row in re.findall(rb"<table:table-row.*?</table:table-row>", content, re.DOTALL):
            cells = [c for c in re.findall(rb"<table:table-cell[^>]*>", row) if b"value" in c]
            if cells:
                rows, columns = (rb'number-%s-repeated="(\d+)"' % word for word in (b"rows", b"columns"))
                height += int((re.findall(rows, row) or [1])[0])
                width = max(width, sum(int((re.findall(columns, cell) or [1])[0]) for cell in cells))
    return width * height


def _signal(cells: Any, path: str, place: str, unit: str) -> Signal:
    """A column of numbers, NaN for empty cells, of dates, or of words."""
    import pandas as pd

    numbers = pd.to_numeric(cells, errors="coerce")
    not_numbers = cells[numbers.isna() & cells.notna()]
    is_text = len(not_numbers) > numbers.notna().sum()

    def load() -> np.ndarray:
        if pd.api.types.is_datetime64_any_dtype(cells.dtype):
            return cells.to_numpy("datetime64[ns]")
        if is_text:
            return cells.fillna("").astype(str).to_numpy(str)
        if len(not_numbers):
            raise BadData(f"{place}: got {str(not_numbers.iloc[0])[:40]!r} among numbers; expected a number")
        return numbers.to_numpy(float)

    return Signal(path, len(cells), load, unit, words=is_text)
