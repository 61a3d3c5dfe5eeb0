"""A document as text for a terminal: its answer, tables and notes."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import rich.table
from rich.text import Text

from sweeps.console import print_output
from sweeps.report.document import TERMINAL_ROWS, Document, Note, Table, cell_tone, plain_text

#: Styles of cells by tone.
TONES = {"bad": "red"}


def print_document(document: Document) -> None:
    """Print a document: the answer first, then what its blocks show on a terminal."""
    print_output(plain_text(document.answer))
    for block in document.every_block:
        if isinstance(block, Note) and block.terminal:
            items = (block.text,) if isinstance(block.text, str) else tuple(f"- {item}" for item in block.text)
            for item in items:
                print_output(plain_text(item))
        elif isinstance(block, Table) and block.terminal and block.rows:
            rows = block.rows if block.brief is None else [block.rows[k] for k in block.brief]
            print_output(
                as_rich(block, rows) if len(rows) <= TERMINAL_ROWS else f"{len(rows):,} rows: see {block.file}"
            )


def as_rich(table: Table, rows: Sequence[Sequence[Any]]) -> rich.table.Table:
    """Some rows of a table for rich, without the columns that only the page has room for."""
    shown = rich.table.Table(title=table.title or None, title_justify="left", box=None, pad_edge=False)
    kept = [k for k, column in enumerate(table.columns) if column.terminal]
    for k in kept:
        column = table.columns[k]
        shown.add_column(plain_text(column.full_title), justify="right" if column.form else "left")
    for row in rows:
        shown.add_row(
            *(Text(plain_text(table.columns[k].text(row[k])), TONES.get(cell_tone(row[k]), "")) for k in kept)
        )
    return shown
