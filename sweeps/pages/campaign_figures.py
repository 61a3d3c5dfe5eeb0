"""Figures of a sweep into a store: distribution of an output, and its dependence on the varied quantities."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure

from calibration.data import Names
from sweeps.pages.figure_style import (
    BLUE,
    FAINT,
    GREEN,
    INK,
    ORANGE,
    PURPLE,
    SKY,
    VERMILION,
    new_figure,
)
from sweeps.points.climbs import SIZE
from sweeps.points.zarr_store import StoreLayout

#: Bins of a histogram. Most and fewest bins along a quantity, and points per bin required for more than the fewest.
BARS, BINS = 40, 24
LEAST, EACH = 6, 5
#: Colours of verdicts, in the order of their codes.
ENDINGS = (GREEN, VERMILION, ORANGE, SKY, PURPLE, FAINT, INK)


class VariedQuantity(NamedTuple):
    """A quantity that varies: its values at the drawn points, its label with unit, and words for the values if it has
    any.
    """

    values: np.ndarray
    label: str
    words: Names = ()


def varied_names(values: np.ndarray, layout: StoreLayout) -> dict[str, VariedQuantity]:
    """Varied names of a store with their values at some points, shape (points, names)."""
    units = {n: layout.coordinates[n].get("units", "").removeprefix("1") for n in layout.design.names}
    return {
        n: VariedQuantity(values[:, k], f"{n} [{units[n]}]" if units[n] else n, layout.labels.get(n, ()))
        for k, n in enumerate(layout.design.names)
    }


def draw_output(output: np.ndarray, label: str, values: np.ndarray, layout: StoreLayout) -> Figure:
    """Distribution of an output of a store, and its dependence on the varied quantities."""
    return draw_output_spread(output, label, varied_names(values, layout))


def draw_output_spread(output: np.ndarray, label: str, varied: Mapping[str, VariedQuantity]) -> Figure:
    """Histogram of an output, its median against the two quantities that it depends on most, and against both.

    Args:
        output: output of the points that settled.
        label: label with its unit.
        varied: varied quantities by name, at these points.
    """
    names = sorted(varied, key=lambda name: -variance_share(varied[name].values, output))[:2]
    fig, ((histogram, *others),) = new_figure(1, 2 + len(names) if len(names) == 2 else 2, 2.9)
    histogram.hist(output, bins=_number_of_bins(output, BARS), color=BLUE)
    histogram.set(xlabel=label, ylabel="points", title="distribution")
    for axes, name in zip(others, names, strict=False):
        values = varied[name].values
        bin_index, middles = bin_values(values)
        quantiles = np.array([np.quantile(output[bin_index == k], (0.05, 0.5, 0.95)) for k in range(len(middles))])
        axes.fill_between(middles, quantiles[:, 0], quantiles[:, 2], color=BLUE, alpha=0.2, linewidth=0)
        axes.plot(middles, quantiles[:, 1], color=BLUE)
        axes.set(xlabel=varied[name].label, ylabel=label)
        _set_ticks(axes.xaxis, varied[name])
    if len(names) == 2:
        _draw_map(fig, others[2], varied[names[0]], varied[names[1]], output, label)
    return fig


def draw_verdicts(
    codes: np.ndarray, names: Sequence[str], values: np.ndarray, layout: StoreLayout, first: str
) -> Figure:
    """Verdicts of climbs over an axis and the size of the obstacle. Other axes are at their first values.

    Args:
        codes: verdict of each point.
        names: names of the verdicts, by code.
        values: varied quantities, shape (points, names).
        first: name of the horizontal axis.
    """
    design = layout.design
    rest = [k for k, n in enumerate(design.names) if n not in (SIZE, first)]
    at_first = np.all(values[:, rest] == [design.axes[design.names[k]][0] for k in rest], axis=1)
    varied = varied_names(values[at_first], layout)
    return draw_grid_statuses(codes[at_first], names, varied[first], varied[SIZE])


def draw_grid_statuses(codes: np.ndarray, names: Sequence[str], across: VariedQuantity, up: VariedQuantity) -> Figure:
    """Status of the points of a grid over two of its axes.

    Args:
        codes: codes of the points.
        names: names of the codes.
    """
    fig, axes = new_figure(1, 1, 4.2)
    ax = axes[0, 0]
    x, y = np.unique(across.values), np.unique(up.values)
    grid = np.full((len(y), len(x)), np.nan)
    grid[np.searchsorted(y, up.values), np.searchsorted(x, across.values)] = codes
    ax.pcolormesh(
        x, y, grid, cmap=ListedColormap(ENDINGS[: len(names)]), vmin=-0.5, vmax=len(names) - 0.5, shading="nearest",
        rasterized=True,
    )  # fmt: skip
    for k in np.unique(codes):
        ax.plot([], [], "s", color=ENDINGS[k], label=names[k])
    ax.legend(loc="upper left", bbox_to_anchor=(1.01, 1.0))
    ax.set(xlabel=across.label, ylabel=up.label)
    return fig


def _number_of_bins(values: np.ndarray, most: int) -> int:
    """Number of bins for this many values."""
    return min(most, max(LEAST, len(values) // EACH))


def bin_values(values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Bin of each value, and the middles of the bins: the levels if there are few, otherwise bins with equal numbers
    of points.
    """
    levels, number = np.unique(values), _number_of_bins(values, BINS)
    if len(levels) <= number:
        return np.searchsorted(levels, values), levels
    edges = np.unique(np.quantile(values, np.linspace(0, 1, number + 1)))
    return np.clip(np.searchsorted(edges, values, side="right") - 1, 0, len(edges) - 2), (edges[1:] + edges[:-1]) / 2


def variance_share(values: np.ndarray, output: np.ndarray) -> float:
    """Share of an output's variance between the bins of a quantity, approximately its first-order index."""
    bin_index, middles = bin_values(values)
    count = np.bincount(bin_index, minlength=len(middles))
    mean = np.bincount(bin_index, output, minlength=len(middles)) / np.maximum(count, 1)
    total = float(np.var(output))
    return float(np.sum(count * (mean - output.mean()) ** 2) / len(output) / total) if total > 0 else 0.0


def _set_ticks(axis: Axis, varied: VariedQuantity) -> None:
    if varied.words:
        axis.set_ticks(range(len(varied.words)), labels=list(varied.words))


def _draw_map(
    fig: Figure,
    axes: Axes,
    one: VariedQuantity,
    other: VariedQuantity,
    output: np.ndarray,
    label: str,
) -> None:
    (a, across), (b, along) = bin_values(one.values), bin_values(other.values)
    cells = np.full((len(along), len(across)), np.nan)
    cell = b * len(across) + a
    order = np.argsort(cell, kind="stable")
    numbers, first = np.unique(cell[order], return_index=True)
    for number, values in zip(numbers, np.split(output[order], first[1:]), strict=True):
        cells.flat[number] = np.median(values)
    mesh = axes.pcolormesh(across, along, cells, shading="nearest", cmap="viridis", rasterized=True)
    fig.colorbar(mesh, ax=axes, label=f"median {label}")
    axes.set(xlabel=one.label, ylabel=other.label)
    _set_ticks(axes.xaxis, one)
    _set_ticks(axes.yaxis, other)
    axes.grid(False)
