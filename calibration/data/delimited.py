"""Cells of a table as text: what separates them, and the decimal mark of their numbers."""

from __future__ import annotations

import csv
import re
from collections.abc import Sequence

from calibration.data.errors import BadData

#: What may separate cells beside a comma, and how it is called.
SEPARATORS = {";": "semicolons", "\t": "tabs"}
_COMMA, _POINT = (re.compile(rf"[+-]?\d*{mark}\d+(?:[eE][+-]?\d+)?") for mark in (",", r"\."))


def cells(name: str, lines: Sequence[str]) -> tuple[list[list[str]], tuple[str, ...]]:
    """Rows of cells without blanks around them, numbers with points; and sentences on what was read otherwise.

    Semicolons or tabs separate cells where the header has no comma; numbers may have decimal commas then.

    Args:
        name: of the file, for messages; lines: of the file, its header first.

    Raises:
        BadData: a column that has decimal commas and points.
    """
    header = lines[0] if lines else ""
    mark = next((m for m in SEPARATORS if m in header and "," not in header), ",")
    rows = [[cell.strip() for cell in row] for row in csv.reader(lines, delimiter=mark)]
    rows = [row for row in rows if any(row)]
    if mark == ",":
        return rows, ()
    said = f"{name}: columns are separated by {SEPARATORS[mark]}"
    comma: dict[int, str] = {}
    point: dict[int, str] = {}
    for row in rows[1:]:
        for j, cell in enumerate(row):
            if _COMMA.fullmatch(cell):
                comma.setdefault(j, cell)
                row[j] = cell.replace(",", ".")
            elif _POINT.fullmatch(cell):
                point.setdefault(j, cell)
    for j in comma.keys() & point.keys():
        column = rows[0][j] if j < len(rows[0]) else "a column"
        raise BadData(
            f"{name}, {column}: got {comma[j]} and {point[j]}; expected decimal commas or points, one of them in a "
            "column, and nothing between thousands"
        )
    return rows, (f"{said}, and numbers have decimal commas; read so" if comma else f"{said}; read so",)
