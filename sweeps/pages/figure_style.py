"""One look for every figure: sizes, colours that colour-blind readers tell apart, labels at the line's end."""

from __future__ import annotations

import io
import re
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine

from mmrjax.channels import Channel

if TYPE_CHECKING:
    from matplotlib.typing import RcKeyType

WIDTH = 10.0  # inches, the width of the page's text
INK, FAINT = "#222222", "#8a8a8a"
# Okabe and Ito (2008), without the yellow that white paper swallows.
BLUE, VERMILION, GREEN, ORANGE, PURPLE, SKY = "#0072B2", "#D55E00", "#009E73", "#E69F00", "#CC79A7", "#56B4E9"
_CYCLE = ((BLUE, "o"), (VERMILION, "s"), (GREEN, "^"), (PURPLE, "D"), (ORANGE, "v"), (SKY, "P"))


def looks(names: Iterable[str]) -> dict[str, tuple[str, str]]:
    """Colour and marker of each configuration, in the order in which they first come."""
    return {name: _CYCLE[k % len(_CYCLE)] for k, name in enumerate(dict.fromkeys(map(str, names)))}


def axis_label(channel: Channel) -> str:
    """A channel with its unit."""
    return f"{channel.label} [{channel.unit}]"


_RC: dict[RcKeyType, Any] = {
    "font.family": "DejaVu Sans",  # comes with matplotlib
    "font.size": 9.5,
    "axes.titlesize": 10,
    "axes.titleweight": "bold",
    "axes.titlelocation": "left",
    "axes.labelcolor": INK,
    "axes.edgecolor": "#666666",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": "#e4e4e4",
    "grid.linewidth": 0.7,
    "lines.linewidth": 1.8,
    "legend.frameon": False,
    "legend.fontsize": 8.5,
    "hatch.color": "#9a9a9a",
    "hatch.linewidth": 0.7,
    "svg.fonttype": "path",
    "svg.hashsalt": "mmrjax",
    "figure.facecolor": "white",
}


@contextmanager
def style() -> Iterator[None]:
    """The settings of every figure, for as long as the block lasts."""
    with matplotlib.rc_context(_RC):
        yield


def figure(rows: int, columns: int, height: float, **keywords: Any) -> tuple[Figure, np.ndarray]:
    """A figure of the page's width and its axes, shape (rows, columns)."""
    fig = Figure(figsize=(WIDTH, height), layout=ConstrainedLayoutEngine(w_pad=0.08, h_pad=0.06))
    FigureCanvasAgg(fig)
    return fig, fig.subplots(rows, columns, squeeze=False, **keywords)


def svg(fig: Figure) -> str:
    """The figure as an SVG document that refers to nothing outside itself."""
    buffer = io.StringIO()
    fig.savefig(buffer, format="svg", metadata={"Date": None, "Creator": None, "Format": None, "Type": None})
    text = buffer.getvalue()
    text = re.sub(r"<!DOCTYPE[^>]*>\s*", "", text)
    return re.sub(r"<metadata>.*?</metadata>\s*", "", text, flags=re.S)


def label_end(axes: Axes, x: np.ndarray, y: np.ndarray, words: str, colour: str, **keywords: Any) -> None:
    """Write `words` at the last finite point of a line, in the line's colour."""
    there = np.nonzero(np.isfinite(y))[0]
    if there.size:
        offset = keywords.pop("offset", (5, 0))
        axes.annotate(
            words,
            (x[there[-1]], y[there[-1]]),
            xytext=offset,
            textcoords="offset points",
            color=colour,
            va="center",
            fontsize=8.5,
            annotation_clip=False,
            **keywords,
        )


def note(axes: Axes, words: str, x: float = 0.02, y: float = 0.97, **keywords: Any) -> None:
    """A remark in a corner of the axes (axes fractions)."""
    keywords = {"fontsize": 8.5, "color": INK, "va": "top", "ha": "left", **keywords}
    axes.text(x, y, words, transform=axes.transAxes, **keywords)


def colours_of(configurations: np.ndarray) -> dict[str, str]:
    """A colour for each configuration of a table, in the order of their first rows."""
    palette = (BLUE, VERMILION, GREEN, PURPLE, ORANGE, SKY)
    names = dict.fromkeys(map(str, configurations))
    return {name: palette[k % len(palette)] for k, name in enumerate(names)}


def short(name: str) -> str:
    """A parameter's name without the words that every such name has."""
    return name.replace("ground.friction.", "").replace("ground.", "").replace("track.", "").replace("effects.", "")
