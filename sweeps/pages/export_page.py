"""The page of `export`: an exported drive next to the native model, and what the format loses."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from mmrjax.model import channels
from sweeps.export import export_words as words
from sweeps.export.comparison import DROPPED, HELD, Comparison
from sweeps.export.formats import Export
from sweeps.export.joint import channels_of
from sweeps.pages.figure_style import BLUE, FAINT, INK, VERMILION, figure
from sweeps.pages.page import Album, curves, render

#: Classes of a verdict's cell.
GRADES = {HELD: "good", DROPPED: "bad"}


def write(folder: Path, found: Export) -> Path:
    """Write `report.html` and `figures/` of an export; returns the path of the page."""
    album, compared = Album(folder), found.comparison
    album.add("readings", lambda: readings(compared))
    named = list(compared.errors[0].percent)
    return render(
        folder,
        "export.html.j2",
        album,
        curves=curves(found.joint.robot),
        of_channels=tuple(channels.find(n) for n in named),
        title=f"{found.joint.file.name} for {found.format}",
        statement=words.statement(found),
        remarks=(),
        said=words.remarks(found),
        use=words.USE[found.format]
        .format(name=found.joint.name, at="drive", armature=words.armature(found))
        .replace("`", ""),
        fates=[(f, words.kept(f), GRADES.get(f.verdict, "fair")) for f in compared.fates],
        errors=[(e.label, [e.percent[n] for n in named]) for e in compared.errors],
        errors_title=words.errors_title(found),
        fitted=[(n, compared.translated[n], v) for n, v in compared.refitted.items()],
        constants=found.constants,
        seen=words.conditions_seen(found),
        untested=words.not_tested(found),
        checks=found.checks,
    )


def readings(compared: Comparison) -> Figure:
    """Readings of the exported drive over those of the reference, a panel for each channel."""
    at = compared.situation
    shown = [(k, c) for k, c in enumerate(channels_of(at.joint)) if c.name in compared.errors[0].percent]
    reference = at.measured if at.is_measured else at.native
    fig, grid = figure(1, max(len(shown), 1), 3.4)
    for axes, (k, channel) in zip(grid[0], shown, strict=False):
        size = 1 / channel.factor
        given = reference[:, k] * size
        ends = np.nanmin(given), np.nanmax(given)
        axes.plot(ends, ends, color=FAINT, lw=1)
        if at.is_measured:
            axes.plot(given, at.native[:, k] * size, "o", color=BLUE, ms=5, mfc="none", label="native")
        axes.plot(given, compared.readings[:, k] * size, ".", color=VERMILION, ms=5, label="exported")
        axes.set_xlabel(f"{compared.reference}: {channel.label} [{channel.unit}]", color=INK)
        axes.set_ylabel(f"{channel.label} [{channel.unit}]", color=INK)
        axes.legend(loc="upper left", frameon=False)
    return fig
