"""One look for every figure: sizes, colours that colour-blind readers tell apart, labels at the line's end."""

from __future__ import annotations

import html
import io
import json
import re
import textwrap
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import QuadMesh
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib.image import AxesImage
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.text import Text
from matplotlib.ticker import LogFormatter, NullFormatter, ScalarFormatter

from calibration.data import Json
from mmrjax.model.channels import Channel
from sweeps import pages

WIDTH = 10.0  # inches, the width of the page's text
INK, FAINT = "#222222", "#8a8a8a"
# Okabe and Ito (2008), without the yellow that white paper swallows.
BLUE, VERMILION, GREEN, ORANGE, PURPLE, SKY = "#0072B2", "#D55E00", "#009E73", "#E69F00", "#CC79A7", "#56B4E9"
_CYCLE = ((BLUE, "o"), (VERMILION, "s"), (GREEN, "^"), (PURPLE, "D"), (ORANGE, "v"), (SKY, "P"))


def configuration_looks(names: Iterable[str]) -> dict[str, tuple[str, str]]:
    """Colour and marker of each configuration, in the order in which they first come."""
    return {name: _CYCLE[k % len(_CYCLE)] for k, name in enumerate(dict.fromkeys(map(str, names)))}


def axis_label(channel: Channel) -> str:
    """A channel with its unit."""
    return f"{channel.label} [{channel.unit}]"


_RC: dict[Any, Any] = {
    "font.family": "DejaVu Sans",  # comes with matplotlib; browsers without it have Verdana, of the same widths
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
    "svg.fonttype": "none",
    "svg.hashsalt": "mmrjax",
    "figure.facecolor": "white",
}


#: Width of a figure with stacked panels, for phones [inches].
NARROW = 4.3
#: Letters of a line across it, and of a line of the names at its left.
LETTERS, NAMES = 42, 20


@contextmanager
def figure_settings(width: float = WIDTH) -> Iterator[None]:
    """The settings of every figure, for as long as the block lasts; at the width `NARROW` panels are stacked.

    Matplotlib reads a file `matplotlibrc` of the working folder, which could change figures or run LaTeX.
    """
    with matplotlib.rc_context():
        matplotlib.rcdefaults()
        with matplotlib.rc_context(_RC | {"figure.figsize": (width, width)}):
            yield


def is_narrow() -> bool:
    """True within `figure_settings(NARROW)`."""
    return bool(matplotlib.rcParams["figure.figsize"][0] == NARROW)


def new_figure(rows: int, columns: int, height: float, **keywords: Any) -> tuple[Figure, np.ndarray]:
    """A figure of the width of `figure_settings` and its axes, shape (rows, columns)."""
    stacked = is_narrow()
    size = WIDTH, height
    if stacked and columns > 1:
        size = NARROW, max(height / rows, 2.2) * columns * rows
    elif stacked:
        size = NARROW, max(height, 2.8) if rows == 1 else height
    fig = Figure(figsize=size, layout=ConstrainedLayoutEngine(w_pad=0.08, h_pad=0.06))
    FigureCanvasAgg(fig)
    if not stacked or columns == 1:
        grid = fig.subplots(rows, columns, squeeze=False, **keywords)
    else:
        grid = fig.subplots(rows * columns, 1, squeeze=False).reshape(rows, columns)
        for axis in ("x", "y"):
            shared = keywords.get(f"share{axis}", False)
            groups: Any = {"row": grid, "col": grid.T, True: [grid.ravel()], "all": [grid.ravel()]}.get(shared, [])
            for group in groups:
                for other in group[1:]:
                    getattr(other, f"share{axis}")(group[0])
    fig.panels = grid  # type: ignore[attr-defined]
    return fig, grid


def legend_columns(labels: Iterable[str]) -> int:
    """Columns of a legend: all labels in one line; in a narrow figure as many as fit into its width."""
    lengths = [len(label) for label in labels]
    if not is_narrow():
        return max(len(lengths), 1)
    return max(1, min(len(lengths), int(72 * NARROW // (0.62 * LEAST_NARROW * max(lengths, default=1) + 40))))


def can_stack(fig: Figure) -> bool:
    """True for a figure that `new_figure` made, which can be drawn for a phone."""
    return pages.FOR_PHONES and hasattr(fig, "panels")


def fit_for_phones(fig: Figure) -> Figure:
    """A narrow figure with wrapped labels and titles; stacked panels have the labels that they shared."""
    grid: Any = vars(fig)["panels"]
    for i, j in np.ndindex(grid.shape):
        axes = grid[i, j]
        if not axes.axison:
            continue
        if grid.shape[1] > 1:
            axes.set_ylabel(axes.get_ylabel() or grid[i, 0].get_ylabel())
            axes.set_xlabel(axes.get_xlabel() or grid[-1, j].get_xlabel())
        axes.set_xlabel("\n".join(textwrap.wrap(axes.get_xlabel(), LETTERS)))
        axes.set_title("\n".join(textwrap.wrap(axes.get_title(loc="left"), LETTERS - 12)))
        names = [tick.get_text() for tick in axes.get_yticklabels()]
        if max(map(len, names), default=0) > NAMES:
            axes.set_yticks(axes.get_yticks(), [textwrap.fill(name, NAMES) for name in names])
    for legend in fig.legends:
        legend.set_ncols(1)
    return fig


def has_colour_scale(fig: Figure) -> bool:
    """True if colours of the figure encode numbers; a dark page must not invert them."""
    return bool(fig.findobj(lambda artist: isinstance(artist, AxesImage | QuadMesh)))


#: Least size of text in a figure [pt], the same in a narrow figure, which is 11 px on a phone of 390 px, and least
#: contrast of a text's colour to white paper (WCAG 2, AA).
LEAST, LEAST_NARROW, CONTRAST = 8.5, 10.0, 4.6


def figure_as_svg(fig: Figure) -> str:
    """The figure as an SVG document that refers to nothing outside itself; its text is text.

    `data-axes` of the document says where its axes are and what they run over, so that a page can show values.
    """
    least = LEAST_NARROW if fig.get_figwidth() == NARROW else LEAST
    for written in fig.findobj(lambda artist: isinstance(artist, Text)):
        assert isinstance(written, Text)
        written.set_fontsize(max(written.get_fontsize(), least))
        # A text's colour, darkened until it can be read on white paper; what is near white is for a dark ground,
        # and stays
        colour = written.get_color()
        channels = np.array(to_rgb(colour))
        while 1.25 < 1.05 / (_luminance(channels) + 0.05) < CONTRAST:
            channels = channels * 0.97
        written.set_color(tuple(channels))
    if (engine := fig.get_layout_engine()) is not None:
        fig.set_dpi(72)  # that of SVG
        engine.execute(fig)
        if least == LEAST_NARROW and _wrap(fig):
            engine.execute(fig)
        fig.set_layout_engine(None)  # or savefig draws everything once more to lay it out
    buffer = io.StringIO()
    fig.savefig(buffer, format="svg", metadata={"Date": None, "Creator": None, "Format": None, "Type": None})
    text = buffer.getvalue()
    text = re.sub(r"<!DOCTYPE[^>]*>\s*", "", text)
    text = re.sub(r"<metadata>.*?</metadata>\s*", "", text, flags=re.S).replace(
        "'DejaVu Sans'", "'DejaVu Sans', Verdana"
    )
    axes = html.escape(json.dumps([_place(fig, a) for a in fig.axes if a.axison and a.get_visible()]))
    return text.replace("<svg ", f'<svg data-axes="{axes}" ', 1)


def _wrap(fig: Figure) -> bool:
    """Break horizontal texts that reach beyond the figure; True if there is any."""
    width, wrapped = 72 * fig.get_figwidth(), False
    for written in fig.findobj(lambda artist: isinstance(artist, Text) and artist.get_visible()):
        assert isinstance(written, Text)
        text, box = written.get_text(), written.get_window_extent()
        beyond = max(box.x1 - width, -box.x0, 0.0)
        if beyond > 0 and " " in text and written.get_rotation() == 0:
            longest = max(map(len, text.split("\n")))
            room = 1 - (2 if written.get_horizontalalignment() == "center" else 1) * beyond / box.width
            written.set_text("\n".join(textwrap.wrap(text, max(12, int(longest * room) - 2))))
            wrapped = True
    return wrapped


def _luminance(channels: np.ndarray) -> float:
    """Relative luminance of sRGB, as WCAG 2 defines it."""
    linear = np.where(channels <= 0.03928, channels / 12.92, ((channels + 0.055) / 1.055) ** 2.4)
    return float(linear @ [0.2126, 0.7152, 0.0722])


def _place(fig: Figure, axes: Axes) -> Json:
    """Position of axes in the drawing [pt from its upper left corner], and their ranges."""
    width, height = 72 * fig.get_size_inches()
    box = axes.get_position(original=False)
    place = [box.x0 * width, (1 - box.y1) * height, box.width * width, box.height * height]
    # an inner axis has its label at the edge of its row or column, or of the figure
    column = [a.xaxis for a in fig.axes if a.get_position().x0 == axes.get_position().x0]
    row = [a.yaxis for a in fig.axes if a.get_position().y0 == axes.get_position().y0]
    both = {}
    for name, axis, beside, whole in (
        ("x", axes.xaxis, column, fig.get_supxlabel()),
        ("y", axes.yaxis, row, fig.get_supylabel()),
    ):
        labels = (axis.get_label_text(), *(other.get_label_text() for other in beside), whole)
        both[name] = {**_run(axis), "label": next(filter(None, labels), "").split("\n")[0]}
    return {"box": [round(v, 1) for v in place], **both}


def _run(axis: Axis) -> Json:
    """The ends of an axis, whether it is logarithmic, and its names where its ticks have any."""
    ends = [float(f"{end:.6g}") for end in axis.get_view_interval()]
    known: Json = {"ends": ends, "log": axis.get_scale() == "log"}
    if not isinstance(axis.get_major_formatter(), ScalarFormatter | LogFormatter | NullFormatter):
        names = [(float(t.get_loc()), t.label1.get_text() or t.label2.get_text()) for t in axis.get_major_ticks()]
        if names and all(name for _, name in names):
            known["names"] = names
    return known


def label_end(axes: Axes, x: np.ndarray, y: np.ndarray, words: str, colour: str, **keywords: Any) -> None:
    """Write `words` at the last finite point of a line, in the line's colour."""
    finite = np.nonzero(np.isfinite(y))[0]
    if finite.size:
        offset = keywords.pop("offset", (5, 0))
        axes.annotate(
            words,
            (x[finite[-1]], y[finite[-1]]),
            xytext=offset,
            textcoords="offset points",
            color=colour,
            va="center",
            fontsize=8.5,
            annotation_clip=False,
            **keywords,
        )


def corner_note(axes: Axes, words: str, x: float = 0.02, y: float = 0.97, **keywords: Any) -> None:
    """A remark in a corner of the axes (axes fractions)."""
    keywords = {"fontsize": 8.5, "color": INK, "va": "top", "ha": "left", **keywords}
    axes.text(x, y, words, transform=axes.transAxes, **keywords)
