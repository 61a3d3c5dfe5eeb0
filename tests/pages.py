"""Reading the pages of reports, and texts that are recorded."""

from __future__ import annotations

import os
import re
from html.parser import HTMLParser
from pathlib import Path

from sweeps.report.document import Figure, Note, Section

#: Texts of documents and sentences as they are; `MMRJAX_RECORD=1 pytest FILE` writes those of a file anew.
RECORD = Path(__file__).parent / "record/pages"


def recorded(name, text):
    """The recorded text of this name, after writing it where that is asked for."""
    path = RECORD / f"{name}.txt"
    if os.environ.get("MMRJAX_RECORD"):
        path.write_text(text, encoding="utf-8")
    return path.read_text(encoding="utf-8")


def as_text(document):
    """A document as lines of text: headings, notes, alternative texts of figures, and tables with their headings."""
    lines = [f"# {document.title}", document.answer]
    for section in (Section("", document.blocks), *document.sections):
        lines += [f"## {section.heading}"] * bool(section.heading)
        for block in section.blocks:
            if isinstance(block, Note):
                lines += [block.text] if isinstance(block.text, str) else [f"- {item}" for item in block.text]
            elif isinstance(block, Figure):
                lines += [f"[{block.name}] {block.alternative}", block.caption]
            elif block.rows:
                lines.append(f"{block.name}: " + " | ".join(c.full_title for c in block.columns))
                lines += [
                    " | ".join(c.text(v) for c, v in zip(block.columns, row, strict=True)) for row in block.rows
                ]
    return "\n".join(lines) + "\n"


def tokens(text):
    """Words of a text with # for each number, and the numbers."""
    number = r"\d+(?:\.\d+)?(?:e[+-]?\d+)?"
    return re.sub(number, "#", text).split(), [float(x) for x in re.findall(number, text)]


class Tables(HTMLParser):
    """Rows of cell texts of every table with an id, and all text outside scripts and styles.

    What stands small below a name, its meaning, is the last cell of its row.
    """

    def __init__(self, page):
        super().__init__()
        self.tables: dict[str, list[list[str]]] = {}
        self.text = ""
        self._name: str | None = None
        self._small, self._meaning = False, ""
        self.feed(page)

    def handle_starttag(self, tag, attrs):
        if tag == "table":
            self._name = dict(attrs).get("id") or "-"
            self.tables[self._name] = []
        elif tag == "tr" and self._name:
            self.tables[self._name].append([])
        elif tag in ("td", "th") and self._name:
            self.tables[self._name][-1].append("")
        elif tag == "small":
            self._small, self._meaning = True, ""

    def handle_endtag(self, tag):
        if tag == "table":
            self._name = None
        elif tag == "small":
            self._small = False
        elif tag == "tr" and self._name and self._meaning:
            self.tables[self._name][-1].append(self._meaning)
            self._meaning = ""

    def handle_data(self, data):
        if self.cdata_elem:  # a script or a style
            return
        self.text += data
        if self._small:
            self._meaning += data.strip()
        elif self._name and self.tables[self._name] and self.tables[self._name][-1]:
            self.tables[self._name][-1][-1] += data.strip()


def drawn(page):
    """Names of the figures on a page."""
    return set(re.findall(r'<figure id="([^"]+)">', page))


def outside(folder):
    """What a page and its figures refer to that is not in them."""
    found = []
    for document in ((folder / "report.html").read_text(), *(p.read_text() for p in (folder / "figures").iterdir())):
        links = re.findall(r'(?:src|href|xlink:href)="([^"]*)"', document)
        beside = [link for link in links if not link.startswith(("#", "data:"))]
        found += [
            link for link in beside if link != "manifest.json" and not (folder / link).exists()
        ]  # it comes last
        found += re.findall(r"url\(http|@import|<script[^>]*\ssrc|fetch\(|XMLHttp", document)
    return found + re.findall(r"https?://", (folder / "report.html").read_text())
