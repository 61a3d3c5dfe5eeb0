"""Renderer for the terminal: answer, tables and notes of a document."""

from __future__ import annotations

from typing import Literal

import rich.table
from rich.text import Text

from sweeps.console import print_output
from sweeps.report.document import SIDE_BY_SIDE, TERMINAL_ROWS, Document, Note, Table, cell_tone, plain_text

#: Longest text in columns that are never wrapped.
SHORT = 12
#: Styles of cells by tone.
TONES = {"bad": "red"}


def print_document(document: Document, brief: bool = False) -> None:
    """Prints a document: the answer, then its blocks for the terminal or its `brief` lines."""
    print_output(plain_text(document.answer))
    if brief:
        print_output("\n".join(map(plain_text, document.brief)))
        return
    for block in document.every_block:
        if isinstance(block, Note) and block.terminal:
            items = (block.text,) if isinstance(block.text, str) else tuple(f"- {item}" for item in block.text)
            for item in items:
                print_output(plain_text(item))
        elif isinstance(block, Table) and block.terminal and block.rows:
            print_table(block)


def print_table(table: Table) -> None:
    """Prints a table without the columns and rows that only the page shows."""
    turned = table.turned
    rows = turned.rows if turned.brief is None else [turned.rows[k] for k in turned.brief]
    if table.file and len(rows) > TERMINAL_ROWS:
        print_output(f"{len(rows):,} rows: see {table.file}")
        return
    printed = rich.table.Table(title=table.title or None, title_justify="left", box=None, pad_edge=False)
    cells: list[list[Text]] = []
    for k, column in enumerate(turned.columns):
        if column.terminal:
            texts = [Text(plain_text(column.text(row[k])), TONES.get(cell_tone(row[k]), "")) for row in rows]
            short = bool(column.form) or max(map(len, texts)) <= SHORT
            justify: Literal["right", "left"] = "right" if column.form else "left"
            printed.add_column(plain_text(column.full_title), justify=justify, no_wrap=short, overflow="fold")
            cells.append(texts)
    for row in zip(*cells, strict=True):
        printed.add_row(*row)
    print_output(printed)
    if table.sideways and len(table.rows) > SIDE_BY_SIDE:
        print_output(f"... and {len(table.rows) - SIDE_BY_SIDE} more in {table.file}")
