"""Common style of all figures: sizes, colours that colour-blind readers can distinguish, labels of lines."""

from __future__ import annotations

import io
import re
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import QuadMesh
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib.image import AxesImage
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.text import Text

from mmrjax.model.channels import Channel

WIDTH = 10.0  # inches, the width of the page's text
INK, FAINT = "#222222", "#8a8a8a"
# Palette of Okabe and Ito (2008) without yellow, which is hard to see on white paper.
BLUE, VERMILION, GREEN, ORANGE, PURPLE, SKY = "#0072B2", "#D55E00", "#009E73", "#E69F00", "#CC79A7", "#56B4E9"
_CYCLE = ((BLUE, "o"), (VERMILION, "s"), (GREEN, "^"), (PURPLE, "D"), (ORANGE, "v"), (SKY, "P"))
#: Number of different styles. More configurations would share them, and a legend could not distinguish them.
LOOKS = len(_CYCLE)


def configuration_looks(names: Iterable[str]) -> dict[str, tuple[str, str]]:
    """Colour and marker of each configuration, in order of first occurrence."""
    return {name: _CYCLE[k % len(_CYCLE)] for k, name in enumerate(dict.fromkeys(map(str, names)))}


def axis_label(channel: Channel) -> str:
    """A channel with its unit."""
    return f"{channel.label} [{channel.unit}]"


_RC: dict[Any, Any] = {
    "font.family": "DejaVu Sans",  # part of matplotlib; browsers without it use Verdana, which has the same widths
    "font.size": 8.5,
    "text.color": INK,
    "axes.titlesize": 10,
    "axes.titleweight": "bold",
    "axes.titlelocation": "left",
    "axes.labelcolor": INK,
    "axes.labelsize": 9.5,
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
    "legend.title_fontsize": 8.5,
    "svg.fonttype": "none",
    "svg.hashsalt": "mmrjax",
    "figure.facecolor": "white",
}


@contextmanager
def figure_settings() -> Iterator[None]:
    """Context with the settings of every figure.

    Matplotlib reads a file `matplotlibrc` of the working folder, which could change figures or run LaTeX.
    """
    with matplotlib.rc_context():
        matplotlib.rcdefaults()
        with matplotlib.rc_context(_RC):
            yield


def new_figure(rows: int, columns: int, height: float, **keywords: Any) -> tuple[Figure, np.ndarray]:
    """Figure with the width of the page's text, and its axes, shape (rows, columns)."""
    fig = Figure(figsize=(WIDTH, height), layout=ConstrainedLayoutEngine(w_pad=0.08, h_pad=0.06))
    FigureCanvasAgg(fig)
    return fig, fig.subplots(rows, columns, squeeze=False, **keywords)


def outer_legend(axes: Axes, place: str) -> None:
    """Legend of axes at a place outside of all panels, such as `upper center`."""
    handles, labels = axes.get_legend_handles_labels()
    placement: Any = f"outside {place}"
    axes.figure.legend(handles, labels, loc=placement, ncols=len(labels))


def has_colour_scale(fig: Figure) -> bool:
    """True if colours of the figure encode numbers. A dark page must not invert them."""
    return bool(fig.findobj(lambda artist: isinstance(artist, AxesImage | QuadMesh)))


#: Smallest text size in a figure [pt]. Smallest contrast of text to white paper (WCAG 2, AA).
LEAST, CONTRAST = 8.5, 4.6


def figure_as_svg(fig: Figure) -> str:
    """The figure as a self-contained SVG document. Its text is stored as text."""
    for written in fig.findobj(lambda artist: isinstance(artist, Text)):
        assert isinstance(written, Text)
        written.set_fontsize(max(written.get_fontsize(), LEAST))
        # colour of a text, darkened until it is readable on white paper; colours near white are for dark backgrounds
        # and stay
        colour = written.get_color()
        channels = np.array(to_rgb(colour))
        while 1.25 < 1.05 / (_luminance(channels) + 0.05) < CONTRAST:
            channels = channels * 0.97
        written.set_color(tuple(channels))
    if (engine := fig.get_layout_engine()) is not None:
        fig.set_dpi(72)  # of SVG
        engine.execute(fig)
        fig.set_layout_engine(None)  # otherwise savefig would draw everything once more for the layout
    buffer = io.StringIO()
    fig.savefig(buffer, format="svg", metadata={"Date": None, "Creator": None, "Format": None, "Type": None})
    text = buffer.getvalue()
    text = re.sub(r"<!DOCTYPE[^>]*>\s*", "", text)
    text = re.sub(r"<metadata>.*?</metadata>\s*", "", text, flags=re.S)
    return text.replace("'DejaVu Sans'", "'DejaVu Sans', Verdana")


def _luminance(channels: np.ndarray) -> float:
    """Relative luminance of sRGB, as WCAG 2 defines it."""
    linear = np.where(channels <= 0.03928, channels / 12.92, ((channels + 0.055) / 1.055) ** 2.4)
    return float(linear @ [0.2126, 0.7152, 0.0722])


def label_line_end(axes: Axes, x: np.ndarray, y: np.ndarray, words: str, colour: str, **keywords: Any) -> None:
    """Writes `words` at the last finite point of a line, in its colour."""
    finite = np.nonzero(np.isfinite(y))[0]
    if finite.size:
        axes.annotate(
            words, (x[finite[-1]], y[finite[-1]]), xytext=keywords.pop("offset", (5, 0)), textcoords="offset points",
            color=colour, va="center", annotation_clip=False, **keywords,
        )  # fmt: skip


def add_corner_note(axes: Axes, words: str, x: float = 0.02, y: float = 0.97, **keywords: Any) -> None:
    """Adds a remark in a corner of the axes. Coordinates are axes fractions."""
    axes.text(x, y, words, transform=axes.transAxes, **{"va": "top", **keywords})
