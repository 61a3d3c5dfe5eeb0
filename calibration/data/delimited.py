"""Tables as text: encoding, separators and decimal marks."""

from __future__ import annotations

import codecs
import contextlib
import csv
import functools
import hashlib
import itertools
import math
import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from calibration.data import Names, input_files
from calibration.data.columns import WORDS
from calibration.data.input_errors import BadData
from calibration.data.named_arrays import MISSING, NamedArrays, Raw, cell_number
from calibration.data.writing import cell_word
from mmrjax.errors import count_noun
from mmrjax.model import channels, quantities

#: File size above which plain tables are read as whole arrays [bytes].
LONG = 2_000_000
#: Memory of a cell that is read as text [bytes].
CELL = 80
#: Separators of cells other than a comma, and a word for each.
SEPARATORS = {";": "semicolons", "\t": "tabs"}
_SEPARATOR = re.compile(r"[,;\t]")
#: First characters of lines of comments.
COMMENTS = ("#", "%")
#: Bytes that do not occur in text.
_CONTROLS = re.compile(rb"[\0-\x08\x0e-\x1f]")
_COMMA, _POINT = (re.compile(rf"[+-]?\d*{mark}\d+(?:[eE][+-]?\d+)?") for mark in (",", r"\."))
#: Numbers whose mark may separate thousands, and numbers below a thousand.
_THOUSANDS, _BELOW = re.compile(r"[+-]?[1-9]\d{0,2}[,.]\d{3}"), re.compile(r"[+-]?[1-9]\d{0,2}")


def read_csv_columns(path: Path, name: str) -> NamedArrays:
    """Columns of a CSV file, as texts or, for a plain table, as numbers.

    Args:
        name: name of the file, for messages.

    Raises:
        BadData: for the same reasons as `input_files.csv_bytes`, `decode_text` and `split_cells`, or a row and the
            header differ in length.
    """
    content = input_files.csv_bytes(path, name)
    if len(content) >= LONG and (plain := _read_plain_table(name, content)) is not None:
        return plain
    text, encoding_notes = decode_text(name, content)
    input_files.check_memory(name, CELL * sum(text.count(mark) for mark in (",", *SEPARATORS)))
    rows, notes = split_cells(name, drop_comments([line for line in text.splitlines() if line.strip()]))
    header, *body = rows or [[]]
    input_files.check_declared(name, len(header))
    units = row_of_units(header, body[0]) if body else ()
    if units:
        body = body[1:]
        notes = (*notes, f"{name}: the row below the header contains units. Row numbers start below it")
    check_row_lengths(name, header, body)
    return NamedArrays(
        name,
        tuple(column or f"column {k}" for k, column in enumerate(header, 1)),
        tuple(map(list, zip(*body, strict=True))) or tuple([] for _ in header),
        units,
        notes=(*encoding_notes, *notes),
        digest=hashlib.sha256(content).hexdigest(),
    )


def check_row_lengths(name: str, header: Sequence[str], body: Sequence[Sequence[str]]) -> None:
    """Rejects rows that have not one cell for each column."""
    for k, row in enumerate(body, 1):
        if len(row) != len(header):
            raise BadData(
                f"{name} row {k}: got {count_noun(len(row), 'cell')}; "
                f"the header has {count_noun(len(header), 'column')}"
            )


def _read_plain_table(name: str, content: bytes) -> NamedArrays | None:
    """Columns of a plain table with numbers as arrays. None for other tables, which `split_cells` reads and checks.

    A plain table is in UTF-8 with commas, without comments, quotes and units.
    """
    header_end = content.find(b"\n")
    if (
        content.startswith((b"#", b"%", codecs.BOM_UTF8, b"\xff\xfe", b"\xfe\xff"))
        or b'"' in content
        or header_end < 0
    ):
        return None
    try:
        first_lines = content[: content.find(b"\n", header_end + 1)].decode().splitlines()
    except UnicodeDecodeError:
        return None
    input_files.check_declared(name, first_lines[0].count(",") + 1)
    header, row = ([cell_word(cell.strip()) for cell in line.split(",")] for line in (*first_lines, "", "")[:2])
    if len(header) < 2 or not all(header) or len(header) != len(row) or row_of_units(header, row):
        return None
    import pyarrow as pa
    from pyarrow import compute
    from pyarrow import csv as reader

    names = [str(k) for k in range(len(header))]
    conversion = reader.ConvertOptions(column_types=dict.fromkeys(names, pa.string()), strings_can_be_null=False)
    try:
        table = reader.read_csv(
            pa.BufferReader(pa.py_buffer(content)),
            reader.ReadOptions(column_names=names, skip_rows=1),
            reader.ParseOptions(quote_char=False),
            conversion,
        )
    except pa.ArrowInvalid:  # a row of different length, or bytes that are not UTF-8
        return None
    is_blank = [compute.equal(column, "") for column in table.columns]
    if compute.any(functools.reduce(compute.and_, is_blank)).as_py():  # rows with only separators
        return None
    values: list[Raw] = []
    for column in table.columns:
        try:
            numbers = column.cast(pa.float64()).to_numpy()
        except pa.ArrowInvalid:  # some cell states no number
            numbers = np.full(1, np.nan)
        is_plain = not np.isnan(numbers).any()
        values.append(numbers if is_plain else [cell_word(cell.strip()) for cell in column.to_pylist()])
    return NamedArrays(name, tuple(header), tuple(values), digest=hashlib.sha256(content).hexdigest())


def row_of_units(header: Sequence[str], first: Sequence[str]) -> Names:
    """Units in the first row below a header. A unit is empty if the row states none for that column.

    () for a row of data: a cell is a number, or no cell above numbers is a unit.
    """
    if len(first) != len(header) or any(math.isfinite(cell_number(cell)) for cell in first):
        return ()
    units = tuple(quantities.unit_in_column(cell.strip("[]()")).strip("-") for cell in first)
    known_units = {
        unit for quantity in (*quantities.SET, *channels.EVERY) for unit in quantity.columns().values()
    } - {""}
    has_units = any(unit in known_units for column, unit in zip(header, units, strict=True) if column not in WORDS)
    return units if has_units else ()


def decode_text(name: str, content: bytes) -> tuple[str, Names]:
    """Text of a file, and a note if it is not in UTF-8. Other encodings are UTF-16 with a byte order mark, and
    Windows-1252.

    Raises:
        BadData: the bytes are no text.
    """
    try:
        if content.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
            return content.decode("utf-16"), (f"{name}: is read as UTF-16",)
        return content.decode("utf-8-sig"), ()
    except UnicodeDecodeError as error:
        with contextlib.suppress(UnicodeDecodeError):
            if not _CONTROLS.search(content):
                return content.decode("cp1252"), (f"{name}: is not in UTF-8, so it is read as Windows-1252",)
        raise BadData(f"{name}: cannot be read as a text file ({error}); save it as CSV in UTF-8") from error


def drop_comments(lines: Sequence[str]) -> list[str]:
    """Lines of a table from its header on, without the comments (# or %) above it.

    If numbers follow the comments, the last comment with as many cells is the header. A row of units may follow it.
    """
    header_row = next((k for k, line in enumerate(lines) if not line.startswith(COMMENTS)), len(lines))
    lines_below = list(lines[header_row:])
    if not header_row or not lines_below:
        return lines_below
    if all(line.endswith(";") for line in lines_below) and "," in lines_below[0]:  # the end of a row in MATLAB
        lines_below = [line[:-1] for line in lines_below]
    cells = re.split(_SEPARATOR, lines_below[0])
    if not any(math.isfinite(cell_number(cell)) or cell.strip().lower() in MISSING for cell in cells):
        return lines_below
    comments = [line.lstrip("#% ") for line in lines[:header_row]]
    alike = [line for line in comments if len(re.split(_SEPARATOR, line)) == len(cells)] or comments[-1:]
    split = [[cell.strip() for cell in re.split(_SEPARATOR, line)] for line in alike[-2:]]
    has_units = len(split) == 2 and bool(row_of_units(*split))
    return [*alike[-1 - has_units :], *lines_below]


def split_cells(name: str, lines: Sequence[str]) -> tuple[list[list[str]], Names]:
    """Rows of cells without surrounding blanks, numbers with decimal points, and notes on separators and decimal
    marks.

    Semicolons or tabs separate cells if the header has no comma. Numbers may then have decimal commas.

    Args:
        name: name of the file, for messages.
        lines: lines of the file, header first.

    Raises:
        BadData: the text is no CSV, a column has both decimal commas and points, or a mark may separate thousands.
    """
    header = lines[0] if lines else ""
    separator = next((m for m in SEPARATORS if m in header and "," not in header), ",")
    try:
        rows = [[cell_word(cell.strip()) for cell in row] for row in csv.reader(lines, delimiter=separator)]
    except csv.Error as error:
        raise BadData(
            f"{name}: cannot be read as CSV ({error}); look for a quotation mark that is not closed, or a cell of "
            f"more than {csv.field_size_limit():,} characters"
        ) from error
    rows = [row for row in rows if any(row)]
    header_width = max((j + 1 for j, cell in enumerate(rows[0]) if cell), default=0) if rows else 0
    if not any(any(row[header_width:]) for row in rows):  # separators at the ends of lines
        rows = [row[:header_width] for row in rows]
    if separator == ",":
        return rows, ()
    note = f"{name}: columns are separated by {SEPARATORS[separator]}"
    columns = list(itertools.zip_longest(*rows[1:], fillvalue=""))
    titles = [*rows[0], *["a column"] * len(columns)]
    commas, points, small_numbers = (
        [[*filter(x.fullmatch, column)] for column in columns] for x in (_COMMA, _POINT, _BELOW)
    )
    expectation = "expected decimal commas or decimal points, without thousands separators"
    for title, comma, point in zip(titles, commas, points, strict=False):
        if comma and point:
            raise BadData(f"{name}, {title}: got {comma[0]} and {point[0]}; {expectation}")
    for marked, other in ((points, commas), (commas, points)):
        elsewhere = next((f"{cells[0]} in {title}" for title, cells in zip(titles, other, strict=False) if cells), "")
        for title, written, numbers_below in zip(titles, marked, small_numbers, strict=False):
            if written and (elsewhere or numbers_below) and all(map(_THOUSANDS.fullmatch, written)):
                raise BadData(
                    f"{name}, {title}: got {written[0]} next to {elsewhere or 'whole numbers below a thousand'}; "
                    f"{expectation}"
                )
    if not any(commas):
        return rows, (f"{note}; read so",)
    body = ([cell.replace(",", ".") if _COMMA.fullmatch(cell) else cell for cell in row] for row in rows[1:])
    return [rows[0], *body], (f"{note}, and numbers have decimal commas",)
