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

from calibration.data import Json
from calibration.data.robot_file import RobotFile
from calibration.data.writing import write_text
from mmrjax import __version__
from mmrjax.errors import printable
from mmrjax.model.robot import Robot
from sweeps import capabilities
from sweeps.pages import words
from sweeps.pages.comparison_figures import TimeOverlay
from sweeps.pages.figure_style import (
    figure_as_svg,
    figure_settings,
    has_colour_scale,
)
from sweeps.report import run_tables
from sweeps.report.document import PAGE_ROWS as ROWS
from sweeps.report.document import SIDE_BY_SIDE, Column, Document, Figure, Note, Section, Table, cell_tone


def write_report_page(folder: Path, document: Document, file: RobotFile | None = None) -> Path:
    """Writes `report.html` and `figures/` of a document. Returns the path of the page.

    Args:
        file: robot file of the page, whose parameters are the last section.
    """
    album = FigureAlbum(folder)
    document = dataclasses.replace(document, sections=(*document.page_sections(), *document.sections))
    for block in document.every_block:
        if isinstance(block, Figure):
            album.add(block.name, block.draw)
    about: Json = {"warnings": (), "about_robot": None} if file is None else robot_section(file)
    return render_page(folder, album, title=document.title, document=document, **about)


class FigureAlbum:
    """Draws figures into `folder/figures` and keeps them for the page."""

    def __init__(self, folder: Path) -> None:
        self.folder = Path(folder) / "figures"
        self.folder.mkdir(parents=True, exist_ok=True)
        self.pictures: dict[str, Markup] = {}
        self.overlays = False

    def add(self, name: str, draw: Callable[[], Any]) -> None:
        """Draws a figure.

        Args:
            draw: function that returns the figure, or an overlay over time.
        """
        with figure_settings():
            figure = draw()
            if isinstance(figure, TimeOverlay):
                self.add_overlay(name, figure)
                return
            text = figure_as_svg(figure)
        write_text(self.folder / f"{name}.svg", printable(text))
        # An SVG document as an element of a page, with the class `looks` and unique ids
        looks = "scale" if has_colour_scale(figure) else ""
        element = re.sub(r' xmlns(?::\w+)?="[^"]*"', "", text[text.index("<svg") :])
        element = element.replace("<svg ", f'<svg class="{looks}" ', 1)
        used_ids = set(re.findall(r'(?:href="|url\()#([^")]+)', element))
        element = re.sub(r' id="([^"]+)"', lambda m: f' id="{name}-{m[1]}"' if m[1] in used_ids else "", element)
        self.pictures[name] = Markup(re.sub(r'((?:href="|url\()#)(?=[^")]+)', rf"\g<1>{name}-", element))

    def add_overlay(self, name: str, overlay: TimeOverlay) -> None:
        """Draws readings over time, as a static figure with the data of an interactive one."""
        self.add(name, overlay.draw)
        self.overlays = True
        self.pictures[name] += Markup(
            f'<script type="application/json" data-overlay="{name}">{overlay.to_json()}</script>'
        )


def robot_section(file: RobotFile) -> Json:
    """The `robot`'s name, its section of a page (`about_robot`), and `warnings` of remarks and unnamed curves.

    A packaged robot with other parameters is marked as changed.
    """
    from mmrjax.model.paper_robots import ROBOTS

    remarks = [Note(". ".join(file.remarks), "warn", "robot-warning")] if file.remarks else []
    return {
        "robot": capabilities.displayed_name(file), "about_robot": _parameter_section(file, ROBOTS["nominal"]()),
        "warnings": (*run_tables.curve_warning(file.robot), *remarks),
    }  # fmt: skip


def _parameter_section(file: RobotFile, nominal: Robot) -> Section:
    """Parameters of a rig, or those in which a robot differs from the nominal one."""
    end = (Column("unit"), Column("meaning"))
    name_column, value = Column("parameter"), "{:.6g}"
    if not file.robot.rig.inherits:
        columns = (name_column, Column("value", form=value), *end, Column("source"))
        text = "Its parameters (SI units), without losses and limits that its file lacks."
        rows, table = capabilities.rig_parameters(file), "own"
    else:
        columns = (name_column, Column("this robot", form=value), Column("nominal", form=value), *end)
        text = "Parameters that differ from the nominal robot's (SI units):"
        rows, table = capabilities.changed_parameters(file.robot, nominal), "changed"
    if not rows:
        text = "Every parameter is the nominal robot's (Tables 1-7 of the paper and data sheets)."
    return Section(
        "The robot", (Note(text), Table(table, columns, [(f"`{name}`", *rest) for name, *rest in rows])), "robot"
    )


def render_page(folder: Path, album: FigureAlbum, **known: Any) -> Path:
    """Writes `report.html` from the album's pictures and the values of `document.html.j2`.

    Adds the parts of every page: contents after the answer, files of the folder (`files`: unusual meanings), tables
    that scroll.
    """
    templates = resources.files("sweeps.pages") / "templates"
    environment = jinja2.Environment(
        loader=jinja2.FunctionLoader(lambda n: (templates / n).read_text("utf-8")),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters |= {"marked": marked_html, "download": download_link, "tone": cell_tone}
    environment.globals |= {
        "page_rows": ROWS,
        "side_by_side": SIDE_BY_SIDE,
        "version": __version__,
    }
    known["files"] = _files_of_folder(Path(folder), words.FILES | known.get("files", {}))
    template = environment.get_template("document.html.j2")
    page = template.render(pictures=album.pictures, overlays=album.overlays, **known)
    page = page.replace("<table", '<div class="scroll" tabindex="0"><table').replace("</table>", "</table></div>")
    # Adds links to the headings before the first heading
    links = []

    def with_id(found: re.Match[str]) -> str:
        text = re.sub("<.*?>", "", found[2])
        name = found[1] or "section-" + re.sub(r"\W+", "-", text.lower()).strip("-")
        links.append(f'<a href="#{name}">{text}</a>')
        return f'<h2 id="{name}">{found[2]}</h2>'

    page = _HEADING.sub(with_id, page)
    begin = page.index("<h2")
    page = f'{page[:begin]}<nav id="contents" aria-label="contents">{" ".join(links)}</nav>\n{page[begin:]}'
    path = Path(folder) / "report.html"
    write_text(path, printable(page))
    return path


def _files_of_folder(folder: Path, meanings: dict[str, str]) -> dict[str, str]:
    """Files of a run folder, including those still to be written, with their descriptions. Known files come first."""
    files = {p.name + "/" * p.is_dir() for p in folder.iterdir()} | {"manifest.json"}
    files = {name for name in files if name in meanings or "." in name} - {"report.html"}  # no locks, no chunks
    return {
        name: meanings.get(name, "")
        for name in [*(n for n in meanings if n in files), *sorted(files - set(meanings))]
    }


_HEADING = re.compile(r"<h2(?: id=\"([^\"]+)\")?>(.*?)</h2>", re.S)


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
