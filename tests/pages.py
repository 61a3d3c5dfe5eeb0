"""Reading the pages of reports."""

from __future__ import annotations

import re
from html.parser import HTMLParser
from pathlib import Path


class Tables(HTMLParser):
    """Rows of cell texts of every table with an id, and all text outside scripts and styles."""

    def __init__(self, page: str) -> None:
        super().__init__()
        self.tables: dict[str, list[list[str]]] = {}
        self.text = ""
        self._name: str | None = None
        self.feed(page)

    def handle_starttag(self, tag, attrs):
        if tag == "table":
            self._name = dict(attrs).get("id") or "-"
            self.tables[self._name] = []
        elif tag == "tr" and self._name:
            self.tables[self._name].append([])
        elif tag in ("td", "th") and self._name:
            self.tables[self._name][-1].append("")

    def handle_endtag(self, tag):
        if tag == "table":
            self._name = None

    def handle_data(self, data):
        if self.cdata_elem:  # a script or a style
            return
        self.text += data
        if self._name and self.tables[self._name] and self.tables[self._name][-1]:
            self.tables[self._name][-1][-1] += data.strip()


def drawn(page: str) -> set[str]:
    """Names of the figures on a page."""
    return set(re.findall(r'<figure id="([^"]+)">', page))


def outside(folder: Path) -> list[str]:
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
