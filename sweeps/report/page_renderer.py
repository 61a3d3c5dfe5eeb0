"""Renderer of pages: one HTML file that needs no network, with inline figures and tables as CSV."""

from __future__ import annotations

import dataclasses
import re
import urllib.parse
from collections.abc import Callable
from importlib import resources
from pathlib import Path
from typing import Any

import jinja2
from markupsafe import Markup, escape

from calibration.data.robot_file import RobotFile
from calibration.data.writing import write_text
from mmrjax import __version__
from mmrjax.errors import printable
from sweeps import capabilities
from sweeps.pages import words
from sweeps.pages.comparison_figures import TimeOverlay
from sweeps.pages.figure_style import (
    figure_as_svg,
    figure_settings,
    has_colour_scale,
)
from sweeps.report import catalogue, run_tables
from sweeps.report.document import PAGE_ROWS as ROWS
from sweeps.report.document import SIDE_BY_SIDE, Document, Figure, Note, Section, Table, cell_tone, columns


def write_report_page(folder: Path, document: Document, file: RobotFile | None = None) -> Path:
    """Writes `report.html` and `figures/` of a document. Returns the path of the page.

    Adds the parts of every page: contents after the answer, and files of the folder.

    Args:
        file: robot file of the page, whose parameters are the last section.
    """
    album = FigureAlbum(folder)
    document = dataclasses.replace(document, sections=(*document.page_sections(), *document.sections))
    for block in document.every_block:
        if isinstance(block, Figure):
            album.add(block.name, block.draw)
    templates = resources.files("sweeps.pages") / "templates"
    environment = jinja2.Environment(
        loader=jinja2.FunctionLoader(lambda n: (templates / n).read_text("utf-8")),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters |= {"marked": marked_html, "download": download_link, "tone": cell_tone}
    environment.globals |= {"page_rows": ROWS, "side_by_side": SIDE_BY_SIDE, "version": __version__}
    page = environment.get_template("document.html.j2").render(
        document=document, pictures=album.pictures, overlays=album.overlays, files=_files_of_folder(Path(folder)),
        warnings=() if file is None else robot_warnings(file),
        about_robot=None if file is None else _parameter_section(file),
    )  # fmt: skip
    path = Path(folder) / "report.html"
    write_text(path, printable(page))
    return path


class FigureAlbum:
    """Draws figures into `folder/figures` and keeps them for the page."""

    def __init__(self, folder: Path) -> None:
        self.folder = Path(folder) / "figures"
        self.folder.mkdir(parents=True, exist_ok=True)
        self.pictures: dict[str, Markup] = {}
        self.overlays = False

    def add(self, name: str, draw: Callable[[], Any]) -> None:
        """Draws a figure. An overlay over time becomes a static figure with the data of an interactive one.

        Args:
            draw: function that returns the figure, or an overlay over time.
        """
        with figure_settings():
            drawing = draw()
            figure = drawing.draw() if isinstance(drawing, TimeOverlay) else drawing
            svg = figure_as_svg(figure)
        write_text(self.folder / f"{name}.svg", printable(svg))
        # An SVG document as an element of a page, with the class `looks` and unique ids
        css_class = "scale" if has_colour_scale(figure) else ""
        element = re.sub(r' xmlns(?::\w+)?="[^"]*"', "", svg[svg.index("<svg") :])
        element = element.replace("<svg ", f'<svg class="{css_class}" ', 1)
        used_ids = set(re.findall(r'(?:href="|url\()#([^")]+)', element))
        element = re.sub(r' id="([^"]+)"', lambda m: f' id="{name}-{m[1]}"' if m[1] in used_ids else "", element)
        self.pictures[name] = Markup(re.sub(r'((?:href="|url\()#)(?=[^")]+)', rf"\g<1>{name}-", element))
        if isinstance(drawing, TimeOverlay):
            self.overlays = True
            data = f'<script type="application/json" data-overlay="{name}">{drawing.to_json()}</script>'
            self.pictures[name] += Markup(data)


def robot_warnings(file: RobotFile) -> tuple[Note, ...]:
    """Warnings of unnamed curves and remarks on a robot."""
    remarks = (Note(". ".join(file.remarks), "warn", "robot-warning"),) if file.remarks else ()
    return (*run_tables.curve_warning(file.robot), *remarks)


def _parameter_section(file: RobotFile) -> Section:
    """Parameters of a rig, or those in which a robot differs from the nominal one."""
    from mmrjax.model.paper_robots import ROBOTS

    name = "own"
    values = ["value | .6g"]
    rows = capabilities.rig_parameters(file)
    if file.robot.rig.inherits:
        name = "changed"
        values = ["this robot | .6g", "nominal | .6g"]
        rows = capabilities.changed_parameters(file.robot, ROBOTS["nominal"]())
    heads = columns("parameter", *values, "unit", "meaning")
    table = Table(name, heads, [(f"`{parameter}`", *rest) for parameter, *rest in rows])
    return Section("The robot", (catalogue.note(f"run.{name if rows else 'nominal'}"), table), "robot")


def _files_of_folder(folder: Path) -> dict[str, str]:
    """Files of a run folder, including those still to be written, with their descriptions. Known files come first."""
    files = {p.name + "/" * p.is_dir() for p in folder.iterdir()} | {"manifest.json"}
    described = {name: meaning for name, meaning in words.FILES.items() if name in files}
    others = sorted(name for name in files - described.keys() if "." in name and name != "report.html")
    return described | dict.fromkeys(others, "")  # no locks, no chunks


def marked_html(text: str) -> Markup:
    """Text as HTML, with bold words and names."""
    html = re.sub(r"\*\*(.+?)\*\*", r"<b>\1</b>", str(escape(text)))
    return Markup(re.sub(r"`([^`]+)`", r"<code>\1</code>", html))


def download_link(table: Table) -> Markup:
    """Link that saves a table as CSV: the file in the run folder if it has more rows, otherwise the table itself."""
    if len(table.rows) > ROWS:
        return Markup('<a class="csv" download href="{0}">all rows as CSV</a>').format(table.file)
    return Markup('<a class="csv" download="{}.csv" href="data:text/csv;charset=utf-8,{}">CSV</a>').format(
        table.name, urllib.parse.quote(table.csv)
    )
