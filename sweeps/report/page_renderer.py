"""Renderer of pages: one HTML file that needs no network, with inline figures and tables as CSV."""

from __future__ import annotations

import dataclasses
from pathlib import Path

from calibration.data import Json
from calibration.data.robot_file import RobotFile
from sweeps.pages.page import FigureAlbum, render_page, robot_section
from sweeps.report.document import Document, Figure


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
