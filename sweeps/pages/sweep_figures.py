"""Figures of sweeps: maps and lines over a grid, outputs and verdicts of the points of a store."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from matplotlib import colormaps, colors
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from calibration.data import Columns, Json, Names
from mmrjax.model.channels import Channel
from sweeps.pages import words
from sweeps.pages.figure_style import (
    BLUE,
    FAINT,
    GREEN,
    INK,
    ORANGE,
    PURPLE,
    SKY,
    VERMILION,
    add_corner_note,
    axis_label,
    new_figure,
)
from sweeps.points.tasks import SIZE
from sweeps.points.zarr_store import StoreLayout
from sweeps.report.run_tables import UNITS, imposed_column, reading_text

_PANELS = 3  # most voltages drawn for a configuration
_CELLS = 12  # most cells along an axis for which cells are labelled
#: Settings of text in a cell, which does not affect the layout of the figure.
_INSIDE: Json = {"ha": "center", "va": "center", "in_layout": False}


def on_ground(runs: Columns) -> bool:
    """True for runs of a vehicle, which have slope and payload."""
    return "slope_deg" in runs and "payload_kg" in runs


def panels_by_imposed(voltages: np.ndarray, column: str) -> list[tuple[str, np.ndarray]]:
    """Panels of a figure by imposed quantity: a title and a mask for each of at most three panels.

    Up to three voltages each have a panel. A grid with more has panels for the lowest, a middle and the highest.
    """
    if np.isnan(voltages).all():
        return [("battery", np.ones(len(voltages), bool))]
    levels, unit = np.unique(voltages), UNITS[column]
    if levels.size > _PANELS:
        levels = levels[[0, levels.size // 2, -1]]
    return [(f"{v:.4g} {unit}", voltages == v) for v in levels]


def runs_with_number(runs: Columns, channel: Channel) -> np.ndarray:
    """Mask of runs with a settled number. `drive` also leaves instantaneous numbers with other statuses."""
    return np.isin(runs["status"], words.SETTLED) & np.isfinite(runs[channel.column])


def draw_sweep(runs: Columns, channel: Channel) -> Figure:
    """One channel over slope and payload, a panel for each voltage and configuration.

    With a single slope or payload the panels are lines over the other. A cell that did not settle is grey and
    names the reason.
    """
    kinds = list(dict.fromkeys(map(str, runs["configuration"])))
    volts = panels_by_imposed(runs[imposed_column(runs)], imposed_column(runs))
    if not (on_ground(runs) and np.unique(runs["slope_deg"]).size > 1 and np.unique(runs["payload_kg"]).size > 1):
        return _draw_lines(runs, channel, kinds)
    readings = runs[channel.column][runs_with_number(runs, channel)]
    low, high = (float(readings.min()), float(readings.max())) if readings.size else (0.0, 1.0)
    norm = colors.Normalize(low, high if high > low else low + 1.0)
    payloads = np.unique(runs["payload_kg"])
    tall = min(0.3 * payloads.size, 2.2) + 1.0
    fig, grid = new_figure(len(kinds), len(volts), max(2.0, tall) * len(kinds) + 0.5)
    for row, kind in zip(grid, kinds, strict=True):
        for axes, (volt, mask) in zip(row, volts, strict=True):
            _draw_map(axes, runs, np.nonzero((runs["configuration"] == kind) & mask)[0], channel, norm)
            axes.set_title(f"{kind}, {volt}")
            axes.set(xlabel="slope [°]", ylabel="payload [kg]")
    from matplotlib.cm import ScalarMappable

    bar = fig.colorbar(ScalarMappable(norm, "viridis"), ax=grid, shrink=0.8, pad=0.01)
    bar.set_label(axis_label(channel))
    return fig


def _draw_map(axes: Axes, runs: Columns, index: np.ndarray, channel: Channel, norm: Any) -> None:
    axes.grid(False)
    if not index.size:
        add_corner_note(axes, "no runs")
        return
    slopes, at_slope = np.unique(runs["slope_deg"][index], return_inverse=True)
    payloads, at_payload = np.unique(runs["payload_kg"][index], return_inverse=True)
    has_number = runs_with_number(runs, channel)[index]
    image = np.full((payloads.size, slopes.size), np.nan)
    image[at_payload[has_number], at_slope[has_number]] = runs[channel.column][index][has_number]
    places = zip(at_slope[~has_number].tolist(), at_payload[~has_number].tolist(), strict=True)
    missing = dict(zip(places, runs["status"][index][~has_number], strict=True))
    axes.imshow(image, origin="lower", aspect="auto", cmap="viridis", norm=norm, interpolation="nearest")
    labelled = slopes.size <= _CELLS and payloads.size <= _CELLS
    if labelled:
        for j, i in zip(*np.nonzero(np.isfinite(image)), strict=True):
            shade = colormaps["viridis"](norm(image[j, i]))
            ink = "white" if 0.299 * shade[0] + 0.587 * shade[1] + 0.114 * shade[2] < 0.52 else INK
            axes.text(i, j, reading_text(image[j, i], channel), color=ink, fontsize=7.5, **_INSIDE)
    axes.set_facecolor("#d9d9d9")  # behind cells without a number
    _name_missing_cells(axes, missing, labelled)
    _set_ticks(axes.set_xticks, slopes)
    _set_ticks(axes.set_yticks, payloads)


def _name_missing_cells(axes: Axes, missing: dict[tuple[int, int], str], each: bool) -> None:
    box = {"fc": "white", "ec": "none", "pad": 0.6, "alpha": 0.85}
    if each:
        for (i, j), status in missing.items():
            axes.text(i, j, words.short_status(str(status)), fontsize=6.8, bbox=box, **_INSIDE)
        return
    for status in sorted(set(missing.values())):
        places = np.array([p for p, s in missing.items() if s == status], float)
        i, j = places[np.argmin(((places - places.mean(0)) ** 2).sum(1))]
        edge = axes.get_xlim()[1]
        side = "right" if i > 0.88 * edge else "left" if i < 0.12 * edge else "center"
        axes.text(i, j, words.short_status(str(status)), ha=side, va="center", fontsize=8.5, bbox=box)


def _set_ticks(setter: Any, levels: np.ndarray) -> None:
    """Sets ticks at every level, or at round numbers if there are many levels."""
    if levels.size <= 8:
        setter(range(levels.size), [f"{v:.3g}" for v in levels])
        return
    low, high = float(levels[0]), float(levels[-1])
    values = np.asarray(MaxNLocator(6, steps=[1, 2, 5, 10]).tick_values(low, high))
    values = values[(values >= low - 1e-9 * (high - low)) & (values <= high + 1e-9 * (high - low))]
    setter(np.interp(values, levels, np.arange(levels.size)), [f"{v:g}" for v in values])


def _draw_lines(runs: Columns, channel: Channel, kinds: list[str]) -> Figure:
    column, settles = channel.column, runs_with_number(runs, channel)
    variable = own_column = imposed_column(runs)
    if on_ground(runs):
        variable = "payload_kg" if np.unique(runs["payload_kg"]).size > 1 else "slope_deg"
        if np.unique(runs[variable]).size == 1 and np.unique(runs[own_column]).size > 1:
            variable = own_column
    label = {
        "payload_kg": "payload [kg]", "slope_deg": "slope [°]", "supply_voltage_V": "supply voltage [V]",
        "motor_speed_rpm": "motor speed [rpm]",
    }[variable]  # fmt: skip
    fig, grid = new_figure(1, len(kinds), 3.2, sharey=True)
    for axes, kind in zip(grid[0], kinds, strict=True):
        of_kind = runs["configuration"] == kind
        volts = [("", of_kind)] if variable == own_column else panels_by_imposed(runs[own_column], own_column)
        for k, (volt, mask) in enumerate(volts):
            pick = np.nonzero(of_kind & mask)[0]
            pick = pick[np.argsort(runs[variable][pick], kind="stable")]
            shade = colormaps["viridis"](0.15 + 0.7 * k / max(1, len(volts) - 1))
            line = np.where(settles[pick], runs[column][pick], np.nan)
            axes.plot(
                runs[variable][pick],
                line,
                "o-" if pick.size <= 60 else "-",
                ms=4,
                color=shade,
                label=volt or None,
            )
            missing_rows = pick[~np.isfinite(line)]
            for status in np.unique(runs["status"][missing_rows]):
                rows_of_status = missing_rows[runs["status"][missing_rows] == status]
                axes.plot(
                    runs[variable][rows_of_status],
                    np.full(rows_of_status.size, 0.03 + 0.05 * k),
                    "x",
                    color=shade,
                    ms=6,
                    mew=1.6,
                    transform=axes.get_xaxis_transform(),
                    clip_on=False,
                )
                axes.annotate(
                    words.short_status(str(status)),
                    (runs[variable][rows_of_status[0]], 0.03 + 0.05 * k),
                    xycoords=axes.get_xaxis_transform(),
                    xytext=(6, 4),
                    textcoords="offset points",
                    fontsize=8,
                )
        axes.set(xlabel=label, title=kind)
        if volts[0][0]:
            axes.legend()
    settled_values = runs[column][settles]
    low, high = (float(settled_values.min()), float(settled_values.max())) if settled_values.size else (0.0, 1.0)
    grid[0, 0].set_ylim(min(0.0, 1.1 * low), max(0.0, 1.1 * high) or 1.0)
    grid[0, 0].set_ylabel(axis_label(channel))
    return fig


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
        _set_point_ticks(axes.xaxis, varied[name])
    if len(names) == 2:
        _draw_output_map(fig, others[2], varied[names[0]], varied[names[1]], output, label)
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


def _set_point_ticks(axis: Axis, varied: VariedQuantity) -> None:
    if varied.words:
        axis.set_ticks(range(len(varied.words)), labels=list(varied.words))


def _draw_output_map(
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
    _set_point_ticks(axes.xaxis, one)
    _set_point_ticks(axes.yaxis, other)
    axes.grid(False)
