"""Texts and tables of a document as parts of a page."""

from __future__ import annotations

import re
import urllib.parse

from markupsafe import Markup, escape

from sweeps.report.document import PAGE_ROWS, Table


def marked_html(text: str) -> Markup:
    """A text as HTML, with its bold words and names."""
    html = re.sub(r"\*\*(.+?)\*\*", r"<b>\1</b>", str(escape(text)))
    return Markup(re.sub(r"`([^`]+)`", r"<code>\1</code>", html))


def download_link(table: Table) -> Markup:
    """A link that saves a table as CSV: the file of the run folder that holds more rows, or the table itself."""
    if len(table.rows) > PAGE_ROWS:
        return Markup('<a class="csv" download href="{0}">all rows as CSV</a>').format(table.file)
    return Markup('<a class="csv" download="{}.csv" href="data:text/csv;charset=utf-8,{}">CSV</a>').format(
        table.name, urllib.parse.quote(table.csv)
    )
