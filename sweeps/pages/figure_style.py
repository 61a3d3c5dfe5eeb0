"""Common style of all figures: sizes, colours that colour-blind readers can distinguish, labels of lines."""

from __future__ import annotations

import html
import io
import itertools
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
from matplotlib.cm import ScalarMappable
from matplotlib.collections import QuadMesh
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib.image import AxesImage
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.legend import Legend
from matplotlib.text import Annotation, Text
from matplotlib.ticker import LogFormatter, NullFormatter, ScalarFormatter
from matplotlib.transforms import Affine2D, Bbox

from calibration.data import Json
from mmrjax.model.channels import Channel

WIDTH = 10.0  # inches, the width of the page's text
INK, FAINT = "#222222", "#8a8a8a"
# Okabe and Ito (2008), without yellow, which is hard to see on white paper.
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
#: Letters in a line across the figure, and in a line of names at its left.
LETTERS, NAMES = 42, 20
#: Most layout passes of a narrow figure, and height that each adds [inches].
LAYOUTS, TALLER = 5, 4.0
#: Height of a legend line [inches].
LINE = 0.2


@contextmanager
def figure_settings(width: float = WIDTH) -> Iterator[None]:
    """Context with the settings of every figure. At the width `NARROW` panels are stacked.

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
    """Figure with the width of `figure_settings`, and its axes, shape (rows, columns)."""
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


def legend_columns(labels: Iterable[str], most: int = 99) -> int:
    """Columns of a legend: all labels in one line, or `most`. In a narrow figure as many as fit into its width."""
    lengths = [len(label) for label in labels]
    if not is_narrow():
        return max(min(len(lengths), most), 1)
    return max(1, min(len(lengths), most, int(72 * NARROW // (0.62 * LEAST_NARROW * max(lengths, default=1) + 40))))


def outer_legend(axes: Axes, place: str) -> None:
    """Legend of axes at a place outside of all panels, such as `upper center`."""
    handles, labels = axes.get_legend_handles_labels()
    placement: Any = f"outside {place}"
    axes.figure.legend(handles, labels, loc=placement, ncols=legend_columns(labels))


def colour_bar(fig: Any, drawn: ScalarMappable, axes: Any, **keywords: Any) -> Any:
    """Colour bar next to the axes, or below them in a narrow figure."""
    return fig.colorbar(drawn, ax=axes, location="bottom" if is_narrow() else "right", **keywords)


def fit_for_phones(fig: Figure) -> Figure:
    """Adapts a narrow figure: wraps labels and titles, repeats shared labels on stacked panels, and moves legends
    above their axes.
    """
    grid: Any = vars(fig)["panels"]
    for i, j in np.ndindex(grid.shape):
        axes = grid[i, j]
        if not axes.axison:
            continue
        if grid.shape[1] > 1:
            axes.set_ylabel(axes.get_ylabel() or grid[i, 0].get_ylabel())
            axes.set_xlabel(axes.get_xlabel() or grid[-1, j].get_xlabel())
        axes.set_xlabel("\n".join(textwrap.wrap(axes.get_xlabel(), LETTERS)))
        title = axes.get_title(loc="left")
        for text in axes.get_children():
            if title and isinstance(text, Text) and text.get_text() == title:
                text.set_text("\n".join(textwrap.wrap(title, LETTERS - 12)))  # `set_title` would reset its pad
        names = [tick.get_text() for tick in axes.get_yticklabels()]
        if _has_names(axes.yaxis) and max(map(len, names), default=0) > NAMES:
            axes.set_yticks(axes.get_yticks(), [_break_name(name) for name in names])
    legends: Any = fig.findobj(lambda artist: isinstance(artist, Legend))
    for legend in legends:
        if legend.axes is not None and legend.get_bbox_to_anchor().x0 > legend.axes.bbox.x1:
            legend.set_loc("lower left")
            legend.set_bbox_to_anchor((0.0, 1.05 + 0.15 * bool(legend.axes.child_axes)))
            fig.set_figheight(fig.get_figheight() + LINE * len(legend.get_texts()))
    return fig


def _break_name(name: str) -> str:
    """Name broken into lines of at most `NAMES` letters, at spaces, dots and underscores."""
    lines = [""]
    for part in re.findall(r"[^ ._\n]*[ ._\n]*", name):  # panels that share an axis break its names again
        if lines[-1] and len(lines[-1] + part.rstrip()) > NAMES:
            lines.append("")
        lines[-1] += part
    return "\n".join(line.rstrip() for line in lines)


def has_colour_scale(fig: Figure) -> bool:
    """True if colours of the figure encode numbers. A dark page must not invert them."""
    return bool(fig.findobj(lambda artist: isinstance(artist, AxesImage | QuadMesh)))


#: Smallest text size in a figure [pt], and in a narrow figure, where it is 11 px on a phone of 390 px. Smallest
#: contrast of text to white paper (WCAG 2, AA).
LEAST, LEAST_NARROW, CONTRAST = 8.5, 10.0, 4.6


def figure_as_svg(fig: Figure) -> str:
    """The figure as a self-contained SVG document. Its text is stored as text.

    `data-axes` of the document has the positions and ranges of its axes, so that a page can show values.
    """
    smallest_font = LEAST_NARROW if fig.get_figwidth() == NARROW else LEAST
    for written in fig.findobj(lambda artist: isinstance(artist, Text)):
        assert isinstance(written, Text)
        written.set_fontsize(max(written.get_fontsize(), smallest_font))
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
        if smallest_font == LEAST_NARROW:
            for _ in range(LAYOUTS):
                if not _wrap_texts(fig) | _make_room_for_names(fig):
                    break
                engine.execute(fig)
        _separate_texts(fig, move=smallest_font == LEAST_NARROW)
        fig.set_layout_engine(None)  # otherwise savefig would draw everything once more for the layout
    buffer = io.StringIO()
    fig.savefig(buffer, format="svg", metadata={"Date": None, "Creator": None, "Format": None, "Type": None})
    text = buffer.getvalue()
    text = re.sub(r"<!DOCTYPE[^>]*>\s*", "", text)
    text = re.sub(r"<metadata>.*?</metadata>\s*", "", text, flags=re.S).replace(
        "'DejaVu Sans'", "'DejaVu Sans', Verdana"
    )
    axes = html.escape(json.dumps([_axes_geometry(fig, a) for a in fig.axes if a.axison and a.get_visible()]))
    return text.replace("<svg ", f'<svg data-axes="{axes}" ', 1)


def _wrap_texts(fig: Figure) -> bool:
    """Breaks horizontal texts that extend beyond the figure. Returns True if there are any."""
    width, wrapped = 72 * fig.get_figwidth(), False
    for written in fig.findobj(lambda artist: isinstance(artist, Text) and artist.get_visible()):
        assert isinstance(written, Text)
        text, box = written.get_text(), Text.get_window_extent(written)  # without an arrow
        excess_width = max(box.x1 - width, -box.x0, 0.0)
        if excess_width > 0 and " " in text and written.get_rotation() == 0:
            longest = max(map(len, text.split("\n")))
            room = 1 - (2 if written.get_horizontalalignment() == "center" else 1) * excess_width / box.width
            written.set_text("\n".join(textwrap.wrap(text, max(12, int(longest * room) - 2))))
            wrapped = True
    return wrapped


def _make_room_for_names(fig: Figure) -> bool:
    """Enlarges the figure to separate names at y axes, and turns names at x axes upright. Returns True if anything
    changed.
    """
    more, has_rotated = 0.0, False
    for axes in filter(Axes.get_visible, fig.axes):
        for axis, low, high in ((axes.xaxis, "x0", "x1"), (axes.yaxis, "y0", "y1")):
            names = [t for t in axis.get_ticklabels() if t.get_text() and t.get_visible()]
            if len(names) < 2 or not _has_names(axis):
                continue
            boxes = sorted((t.get_window_extent() for t in names), key=lambda box: getattr(box, low))
            pairs = [(getattr(a, high) - getattr(b, low), a, b) for a, b in itertools.pairwise(boxes)]
            if axis is axes.yaxis:
                share = max(1 + lap / (abs(b.y0 + b.y1 - a.y0 - a.y1) / 2 + 1e-9) for lap, a, b in pairs)
                more += max(share - 1, 0.0) * axes.bbox.height / 72
            elif names[0].get_rotation() != 90 and (names[0].get_rotation() or max(lap for lap, *_ in pairs) > 0):
                axis.set_tick_params(rotation=90)
                for name in names:
                    name.set_horizontalalignment("center")
                has_rotated = True
    if more > 0.05:
        fig.set_figheight(fig.get_figheight() + min(more, TALLER))
    return more > 0.05 or has_rotated


def _separate_texts(fig: Figure, move: bool) -> None:
    """Separates overlapping texts inside axes: numbers are hidden, words are moved.

    A map shows all its numbers or none. Without `move` only maps are changed.
    """
    texts: Any = fig.findobj(lambda a: isinstance(a, Text) and a.get_visible() and a.get_text().strip() != "")
    boxes = {text: Text.get_window_extent(text) for text in texts if text.get_rotation() == 0}

    def is_free(text: Text, box: Bbox) -> bool:
        return not any(
            min(box.x1, b.x1) - max(box.x0, b.x0) > 0 and min(box.y1, b.y1) - max(box.y0, b.y0) > 2
            for other, b in boxes.items()
            if other is not text
        )

    inside: list[Any] = [text for axes in fig.axes for text in axes.texts if text in boxes]
    crowded = {text.axes for text in inside if text.axes.images and not is_free(text, boxes[text])}
    movable = inside if move else [text for text in inside if text.axes in crowded and _is_number(text)]
    for text in sorted(movable, key=lambda text: not _is_number(text)):
        box, panel, line = boxes[text], text.axes.bbox, text.get_fontsize() / 2
        if _is_number(text) and (text.axes in crowded or not is_free(text, box)):
            text.set_visible(False)
            del boxes[text]
        if text not in boxes or is_free(text, box):
            continue
        aside = max(panel.x0 + 2 - box.x0, 0.0)
        for lines, along in itertools.product(sorted(range(-12, 13), key=abs), dict.fromkeys((0.0, aside))):
            shifted_box = box.translated(along, lines * line)
            if panel.y0 < shifted_box.y0 and shifted_box.y1 < panel.y1 and is_free(text, shifted_box):
                if isinstance(text, Annotation) and isinstance(text.anncoords, str):
                    text.xyann = tuple(np.add(text.xyann, (along, lines * line)))
                else:
                    text.set_transform(text.get_transform() + Affine2D().translate(along, lines * line))
                boxes[text] = shifted_box
                break


def _is_number(text: Text) -> bool:
    """True for a number in a cell or a bar, which is also in a table."""
    return re.fullmatch(r"[-−+.\d ]+%?", text.get_text()) is not None


def _luminance(channels: np.ndarray) -> float:
    """Relative luminance of sRGB, as WCAG 2 defines it."""
    linear = np.where(channels <= 0.03928, channels / 12.92, ((channels + 0.055) / 1.055) ** 2.4)
    return float(linear @ [0.2126, 0.7152, 0.0722])


def _axes_geometry(fig: Figure, axes: Axes) -> Json:
    """Position of axes in the drawing [pt from its upper left corner], and their ranges."""
    width, height = 72 * fig.get_size_inches()
    box = axes.get_position(original=False)
    axes_box = [box.x0 * width, (1 - box.y1) * height, box.width * width, box.height * height]
    # an inner axis has its label at the edge of its row or column, or of the figure
    column = [a.xaxis for a in fig.axes if a.get_position().x0 == axes.get_position().x0]
    row = [a.yaxis for a in fig.axes if a.get_position().y0 == axes.get_position().y0]
    positions = {}
    for name, axis, beside, whole in (
        ("x", axes.xaxis, column, fig.get_supxlabel()),
        ("y", axes.yaxis, row, fig.get_supylabel()),
    ):
        labels = (axis.get_label_text(), *(other.get_label_text() for other in beside), whole)
        ends = [float(f"{end:.6g}") for end in axis.get_view_interval()]
        axis_facts: Json = {"ends": ends, "log": axis.get_scale() == "log"}
        if _has_names(axis):
            names = [(float(t.get_loc()), t.label1.get_text() or t.label2.get_text()) for t in axis.get_major_ticks()]
            if names and all(name for _, name in names):
                axis_facts["names"] = names
        positions[name] = {**axis_facts, "label": next(filter(None, labels), "").split("\n")[0]}
    return {"box": [round(v, 1) for v in axes_box], **positions}


def _has_names(axis: Axis) -> bool:
    """True if the ticks of an axis have names, not numbers."""
    return not isinstance(axis.get_major_formatter(), ScalarFormatter | LogFormatter | NullFormatter)


def label_line_end(axes: Axes, x: np.ndarray, y: np.ndarray, words: str, colour: str, **keywords: Any) -> None:
    """Writes `words` at the last finite point of a line, in its colour."""
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


def add_corner_note(axes: Axes, words: str, x: float = 0.02, y: float = 0.97, **keywords: Any) -> None:
    """Adds a remark in a corner of the axes. Coordinates are axes fractions."""
    keywords = {"fontsize": 8.5, "color": INK, "va": "top", "ha": "left", **keywords}
    axes.text(x, y, words, transform=axes.transAxes, **keywords)
