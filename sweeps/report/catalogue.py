"""Figures, tables and notes of reports with texts from `pages/templates/catalogue.toml`, by report and name."""

from __future__ import annotations

import functools
import importlib
from collections.abc import Callable, Iterable, Sequence
from importlib import resources
from typing import Any

from calibration.data import Json
from calibration.data.input_files import toml_content
from sweeps.report.document import Column, Figure, Note, Table, columns


@functools.cache
def _content() -> Json:
    source = (resources.files("sweeps.pages") / "templates" / "catalogue.toml").read_text("utf-8")
    return toml_content(source, "catalogue.toml")


def _entry(name: str) -> Json:
    """Texts of a figure, table or note, by its name `report.name` in the catalogue."""
    report, _, key = name.partition(".")
    entry: Json = _content()[report][key]
    return entry


def text(name: str, *words: Any) -> str:
    """Text of the catalogue with values filled in."""
    sentence: str = _entry(name).get("text", "")
    return sentence.format(*words) if words else sentence


def figure(
    name: str,
    *arguments: Any,
    finding: str = "",
    words: Sequence[Any] = (),
    more: str = "",
    suffix: str = "",
    values: Callable[[], Iterable[Any]] = tuple,
) -> Figure:
    """Figure of the catalogue. Its drawing function is imported late, because importing matplotlib takes half a
    second.

    Args:
        name: name in the catalogue, `report.name`.
        arguments: arguments of the function that draws it.
        finding: finding in words if it depends on the result.
        words: values to fill into the caption.
        more: text to append to the caption.
        suffix: name of the drawn quantity, if there are several figures with this name.
        values: function that computes further arguments when the page is written.
    """
    entry = _entry(name)
    module, _, function = entry["draws"].rpartition(".")
    module = f"sweeps.{module}" if "." in module else f"sweeps.pages.{module}"

    def draw() -> Any:
        return getattr(importlib.import_module(module), function)(*arguments, *values())

    return Figure(
        name.partition(".")[2] + f"_{suffix}" * bool(suffix),
        finding or entry["finding"],
        text(name, *words) + more,
        draw,
    )


def table(name: str, rows: Sequence[Sequence[Any]], *inserted: Column | str, **fields: Any) -> Table:
    """Table of the catalogue.

    Args:
        name: name in the catalogue, `report.name`.
        inserted: columns, or their titles, that replace "..." in the catalogue.
    """
    entry = _entry(name)
    heads: list[Column] = []
    for title in entry["columns"]:
        columns_here = (
            (c if isinstance(c, Column) else columns(c)[0] for c in inserted) if title == "..." else columns(title)
        )
        heads += columns_here
    fixed = {key: entry[key] for key in ("title", "file", "wide", "terminal", "sideways") if key in entry}
    return Table(name.partition(".")[2], tuple(heads), rows, **(fixed | fields))


def note(name: str, *words: Any) -> Note:
    """Note of the catalogue with values filled in."""
    entry = _entry(name)
    return Note(text(name, *words), entry.get("kind", ""), entry.get("name", ""), entry.get("terminal", False))
