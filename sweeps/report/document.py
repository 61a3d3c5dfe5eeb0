"""A report as data. `page_renderer` turns it into a page, `terminal_renderer` into terminal output.

Texts may contain `**bold**` words and names in backticks. A command builds its document once, in `x_report.py`.
"""

from __future__ import annotations

import csv
import dataclasses
import io
import math
import re
from collections.abc import Callable, Iterable, Sequence
from typing import Any

import numpy as np

from calibration.data import Names
from calibration.data.writing import cell_text

#: Most rows of a table on a page, and on the terminal.
PAGE_ROWS, TERMINAL_ROWS = 200, 60
#: Table entry for a missing number.
DASH = "–"
#: Most rows that are shown side by side.
SIDE_BY_SIDE = 6


@dataclasses.dataclass(frozen=True)
class Note:
    """A paragraph, or a list of items.

    Attributes:
        text: the paragraph, or a tuple of items.
        kind: its style on the page: "", `lead`, `key`, or `warn`.
        name: name of the element on the page.
        terminal: True if the terminal prints it too.
    """

    text: str | Names
    kind: str = ""
    name: str = ""
    terminal: bool = False


@dataclasses.dataclass(frozen=True)
class Column:
    """One column of a table.

    Attributes:
        heading: text of the heading.
        unit: unit of its numbers.
        group: common heading above columns of the same group.
        form: format of its numbers, "" for a column of text.
        terminal: True if the terminal shows it too.
    """

    heading: str
    unit: str = ""
    form: str = ""
    group: str = ""
    terminal: bool = True

    @property
    def title(self) -> str:
        """Heading with its unit, as in `mass [kg]`."""
        return f"{self.heading} [{self.unit}]" if self.unit else self.heading

    @property
    def full_title(self) -> str:
        """Heading with its group, for a terminal or a CSV file."""
        return f"{self.group}: {self.title}" if self.group and self.heading else self.group or self.title

    def text(self, cell: Any) -> str:
        """Text of a cell, for page and terminal. A missing number is a dash."""
        value = cell_value(cell)
        if is_missing(value):
            return DASH
        if self.form and isinstance(value, int | float | np.number):
            return re.sub(r"^-(?=0\.?0*$)", "", self.form.format(value))
        return str(value)


def columns(*titles: str) -> tuple[Column, ...]:
    """Columns from titles such as `speed > error [%] | +.1f`: heading in a group, unit, and format of numbers.

    A column without ` |` has text. A column with nothing after ` |` has numbers as text. `~` marks a column that only
    the page shows.
    """
    columns_so_far = []
    for title in titles:
        name, bar, form = title.removeprefix("~").partition(" |")
        group, _, heading = name.rpartition(" > ")
        heading, _, unit = heading.removesuffix("]").partition(" [")
        form = form.strip()
        form = form if "{" in form or not bar else f"{{:{form}}}"
        columns_so_far.append(Column(heading, unit, form, group, not title.startswith("~")))
    return tuple(columns_so_far)


@dataclasses.dataclass(frozen=True)
class Cell:
    """A value with a tone, shown as a colour on the page: `good`, `fair`, `bad`, `slides` or `none`.

    A number with the tone `bar` or `over` is a share [%], shown as a bar.
    """

    value: Any
    tone: str = ""


@dataclasses.dataclass(frozen=True)
class Table:
    """A table. The page offers it as a CSV file.

    Attributes:
        name: name of the element and its CSV file.
        columns: its columns.
        rows: values or `Cell`s, one for each column.
        title: title for the terminal.
        file: file in the run folder with all rows, named if the table is cut.
        wide: True for small print on the page.
        terminal: True if the terminal shows it too.
        brief: indices of the rows that the terminal shows. None: all.
        sideways: True to show a few rows side by side, each under the text of its first cell.
    """

    name: str
    columns: tuple[Column, ...]
    rows: Sequence[Sequence[Any]]
    title: str = ""
    file: str = ""
    wide: bool = False
    terminal: bool = True
    brief: Sequence[int] | None = None
    sideways: bool = False

    @property
    def turned(self) -> Table:
        """Table with the first rows side by side if it is `sideways`, otherwise the table itself."""
        if not self.sideways:
            return self
        first, *others = self.columns
        rows = self.rows[:SIDE_BY_SIDE]
        heads = (Column(""), *(Column(first.text(row[0]), form="{}") for row in rows))
        turned_rows = [
            (column.title, *(Cell(column.text(row[k]), cell_tone(row[k])) for row in rows))
            for k, column in enumerate(others, 1)
        ]
        return dataclasses.replace(self, columns=heads, rows=turned_rows, sideways=False)

    @property
    def groups(self) -> list[tuple[str, int]]:
        """Headings above the columns, each with its number of columns. All empty for a table without groups."""
        group_widths: list[tuple[str, int]] = []
        for column in self.columns:
            if group_widths and column.group and group_widths[-1][0] == column.group:
                group_widths[-1] = column.group, group_widths[-1][1] + 1
            else:
                group_widths.append((column.group, 1))
        return group_widths

    @property
    def csv(self) -> str:
        """The table as CSV with all digits. Missing numbers are empty cells."""
        stream = io.StringIO()
        writer = csv.writer(stream, lineterminator="\n")
        for row in ([column.full_title for column in self.columns], *self.rows):
            values = map(cell_value, row)
            writer.writerow(
                cell_text(plain_text(v)) if isinstance(v, str) else "" if is_missing(v) else v for v in values
            )
        return stream.getvalue()


def table_from_cells(name: str, cells: Iterable[tuple[Column, Iterable[Any]]], **fields: Any) -> Table:
    """Table from its columns, each with its cells."""
    heads, values = zip(*cells, strict=True)
    return Table(name, heads, list(zip(*values, strict=True)), **fields)


@dataclasses.dataclass(frozen=True)
class Figure:
    """A figure of the page.

    Attributes:
        name: name of its element and file.
        alternative: its finding in words, for readers who cannot see it.
        caption: explanation of the figure.
        draw: function that returns the matplotlib figure.
    """

    name: str
    alternative: str
    caption: str
    draw: Callable[[], Any]


Block = Note | Table | Figure


@dataclasses.dataclass(frozen=True)
class Section:
    """Blocks under a heading. `name`: name of the heading's element. `level`: level of the heading. `folded`: text of
    the line that unfolds the blocks. Empty: they are not folded.
    """

    heading: str
    blocks: tuple[Block, ...]
    name: str = ""
    level: int = 2
    folded: str = ""

    @property
    def anchor(self) -> str:
        """Name of the heading's element, by default from its words."""
        return self.name or "section-" + re.sub(r"\W+", "-", self.heading.lower()).strip("-")


@dataclasses.dataclass(frozen=True)
class Document:
    """The report of a command.

    Attributes:
        title: title of the page.
        answer: the result in one or two sentences.
        blocks: blocks between the answer and the first heading.
        sections: sections, in order.
        page_sections: function that returns the first sections of the page, which the terminal lacks.
        brief: lines for a brief terminal output. Empty: the output is always complete.
    """

    title: str
    answer: str
    blocks: tuple[Block, ...]
    sections: tuple[Section, ...] = ()
    page_sections: Callable[[], Iterable[Section]] = tuple
    brief: Names = ()

    @property
    def every_block(self) -> list[Block]:
        """All blocks in order, without those of `page_sections`."""
        return [*self.blocks, *(block for section in self.sections for block in section.blocks)]


def cell_tone(cell: Any) -> str:
    """Tone of a cell, "" for a plain value."""
    return cell.tone if isinstance(cell, Cell) else ""


def cell_value(cell: Any) -> Any:
    """Value of a cell, with or without a tone."""
    return cell.value if isinstance(cell, Cell) else cell


def is_missing(value: Any) -> bool:
    """True for None and for numbers that are not finite."""
    return value is None or (isinstance(value, float | np.floating) and not math.isfinite(value))


def remarks(texts: Iterable[str], name: str = "notes") -> tuple[Note, ...]:
    """Note with remarks for page and terminal, if there are any."""
    items = tuple(texts)
    return (Note(items, name=name, terminal=True),) if items else ()


def plain_text(text: str) -> str:
    """Text without the marks of bold words and names."""
    return re.sub(r"\*\*(.+?)\*\*|`([^`]+)`", lambda m: m[1] or m[2], text)
