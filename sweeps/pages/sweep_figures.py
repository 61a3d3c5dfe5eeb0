"""Figures of sweeps and sensitivity studies: maps, lines, spreads and verdicts, shares of inputs and tornadoes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib import colormaps, colors
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from calibration.data import Columns
from calibration.sensitivity.result import NEGLIGIBLE, OutputStudy, SensitivityResult
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
from sweeps.report.run_tables import axis_title, imposed_column, quantity_column, reading_text
from sweeps.report.sweep_report import VariedQuantity

_PANELS = 3  # most voltages drawn for a configuration
_LABELLED_COLUMNS, _LABELLED_ROWS = 20, 12  # most labelled cells across a figure, and most rows of them


def _panels_by_imposed(runs: Columns) -> list[tuple[str, np.ndarray]]:
    """Panels of a figure by imposed quantity: a title and a mask for each of at most three panels.

    Up to three voltages each have a panel. A grid with more has panels for the lowest, a middle and the highest.
    """
    column = imposed_column(runs)
    values = runs[column]
    if np.isnan(values).all():
        return [("battery", np.ones(len(values), bool))]
    levels = np.unique(values)
    if levels.size > _PANELS:
        levels = levels[[0, levels.size // 2, -1]]
    return [(f"{v:.4g} {quantity_column(column).unit}", values == v) for v in levels]


def _values_with_number(runs: Columns, channel: Channel) -> np.ndarray:
    """Readings of the runs that settled, otherwise NaN. `drive` leaves instantaneous numbers with other statuses."""
    return np.where(np.isin(runs["status"], words.SETTLED), runs[channel.column], np.nan)


def draw_sweep(runs: Columns, channel: Channel) -> Figure:
    """One channel over slope and payload, a panel for each voltage and configuration.

    With a single slope or payload the panels are lines over the other. A cell that did not settle is grey and
    names the reason.
    """
    axes_of_grid = ("payload_kg", "slope_deg", "load_torque_Nm", imposed_column(runs))
    levels = {name: np.unique(runs[name]).size for name in axes_of_grid if name in runs}
    if min(levels.get("payload_kg", 1), levels.get("slope_deg", 1)) == 1:
        return _draw_lines(runs, channel, max(levels, key=lambda name: levels[name] > 1))
    configurations = list(dict.fromkeys(runs["configuration"]))
    panels = _panels_by_imposed(runs)
    values = _values_with_number(runs, channel)
    low, high = np.nanmin(values, initial=np.inf), np.nanmax(values, initial=-np.inf)
    norm = colors.Normalize(low, high if high > low else low + 1.0) if low <= high else colors.Normalize(0.0, 1.0)
    height = max(2.0, min(0.3 * levels["payload_kg"], 2.2) + 1.0)
    fig, grid = new_figure(len(configurations), len(panels), height * len(configurations) + 0.5)
    for row, configuration in zip(grid, configurations, strict=True):
        for axes, (imposed, mask) in zip(row, panels, strict=True):
            is_in_panel = mask & (runs["configuration"] == configuration)
            panel_runs = {n: runs[n][is_in_panel] for n in ("slope_deg", "payload_kg", "status")}
            _draw_map(axes, panel_runs, values[is_in_panel], channel, norm, _LABELLED_COLUMNS // len(panels))
            axes.set(
                title=f"{configuration}, {imposed}", xlabel=axis_title("slope_deg"), ylabel=axis_title("payload_kg")
            )
    fig.colorbar(ScalarMappable(norm, "viridis"), ax=grid, shrink=0.8, pad=0.01, label=axis_label(channel))
    return fig


def _draw_map(
    axes: Axes, runs: Columns, values: np.ndarray, channel: Channel, norm: colors.Normalize, max_columns: int
) -> None:
    """Map of a channel. Cells show their numbers if there are at most so many columns."""
    axes.grid(False)
    if not values.size:
        add_corner_note(axes, "no runs")
        return
    slopes, x = np.unique(runs["slope_deg"], return_inverse=True)
    payloads, y = np.unique(runs["payload_kg"], return_inverse=True)
    image = np.full((payloads.size, slopes.size), np.nan)
    image[y, x] = values
    axes.imshow(image, origin="lower", aspect="auto", cmap="viridis", norm=norm, interpolation="nearest")
    axes.set_facecolor("#d9d9d9")  # behind cells without a number
    if slopes.size <= max_columns and payloads.size <= _LABELLED_ROWS:
        for j, i in zip(*np.nonzero(np.isfinite(image)), strict=True):
            ink = "white" if norm(image[j, i]) < 0.63 else INK
            axes.text(i, j, reading_text(image[j, i], channel), color=ink, ha="center", va="center", in_layout=False)
    text_box = {"fc": "white", "ec": "none", "pad": 0.6, "alpha": 0.85}
    is_missing = np.isnan(values)
    for status in np.unique(runs["status"][is_missing]):  # named in its most central cell
        cells = np.stack([x, y], 1)[is_missing & (runs["status"] == status)]
        i, j = cells[np.argmin(((cells - cells.mean(0)) ** 2).sum(1))]
        side = "right" if i > 0.88 * slopes.size else "left" if i < 0.12 * slopes.size - 0.5 else "center"
        axes.text(i, j, words.short_status(str(status)), ha=side, va="center", bbox=text_box, in_layout=False)
    _set_ticks(axes.set_xticks, slopes)
    _set_ticks(axes.set_yticks, payloads)


def _set_ticks(setter: Any, levels: np.ndarray) -> None:
    """Sets ticks at every level, or at round numbers if there are many levels."""
    if levels.size <= 8:
        setter(range(levels.size), [f"{v:.3g}" for v in levels])
        return
    low, high = float(levels[0]), float(levels[-1])
    values = np.asarray(MaxNLocator(6, steps=[1, 2, 5, 10]).tick_values(low, high))
    values = values[(values >= low - 1e-9 * (high - low)) & (values <= high + 1e-9 * (high - low))]
    setter(np.interp(values, levels, np.arange(levels.size)), [f"{v:g}" for v in values])


def _draw_lines(runs: Columns, channel: Channel, variable: str) -> Figure:
    """Lines over a `variable`, one for each level of the imposed quantity."""
    configurations = list(dict.fromkeys(runs["configuration"]))
    values = _values_with_number(runs, channel)
    lines = [("", np.ones(len(values), bool))] if variable == imposed_column(runs) else _panels_by_imposed(runs)
    fig, grid = new_figure(1, len(configurations), 3.2, sharey=True)
    for axes, configuration in zip(grid[0], configurations, strict=True):
        for k, (label, mask) in enumerate(lines):
            rows = np.flatnonzero(mask & (runs["configuration"] == configuration))
            rows = rows[np.argsort(runs[variable][rows], kind="stable")]
            x = runs[variable]
            colour = colormaps["viridis"](0.15 + 0.7 * k / max(1, len(lines) - 1))
            axes.plot(
                x[rows], values[rows], "o-" if rows.size <= 60 else "-", ms=4, color=colour, label=label or None
            )
        if np.isnan(values[runs["configuration"] == configuration]).all():
            add_corner_note(axes, "no operating point")
        axes.set(xlabel=axis_title(variable), title=configuration)
        if lines[0][0]:
            axes.legend()
    low, high = 1.1 * np.nanmin(values, initial=0.0), 1.1 * np.nanmax(values, initial=0.0)
    grid[0, 0].set(ylim=(low, high or 1.0), ylabel=axis_label(channel))
    return fig


#: Bins of a histogram. Most and fewest bins along a quantity, and points per bin required for more than the fewest.
HISTOGRAM_BINS, MAX_BINS = 40, 24
FEWEST_BINS, POINTS_PER_BIN = 6, 5
#: Colours of verdicts, in the order of their codes.
ENDINGS = (GREEN, VERMILION, ORANGE, SKY, PURPLE, FAINT, INK)


def draw_output_spread(output: np.ndarray, label: str, varied: Mapping[str, VariedQuantity]) -> Figure:
    """Histogram of an output, and its median against the two quantities that it depends on most.

    Args:
        output: output of the points that settled.
        label: label with its unit.
        varied: varied quantities by name, at these points.
    """
    top_quantities = sorted(varied.values(), key=lambda quantity: -variance_share(quantity.values, output))[:2]
    fig, ((histogram, *others),) = new_figure(1, 1 + len(top_quantities), 2.9)
    histogram.hist(output, bins=_number_of_bins(output, HISTOGRAM_BINS), color=BLUE)
    histogram.set(xlabel=label, ylabel="points", title="distribution")
    for axes, quantity in zip(others, top_quantities, strict=True):
        bin_index, middles = bin_values(quantity.values)
        quantiles = np.array([np.quantile(output[bin_index == k], (0.05, 0.5, 0.95)) for k in range(len(middles))])
        axes.fill_between(middles, quantiles[:, 0], quantiles[:, 2], color=BLUE, alpha=0.2, linewidth=0)
        axes.plot(middles, quantiles[:, 1], color=BLUE)
        axes.set(xlabel=quantity.label, ylabel=label)
        if quantity.words:
            axes.set_xticks(range(len(quantity.words)), list(quantity.words))
    return fig


def draw_grid_statuses(codes: np.ndarray, names: Sequence[str], across: VariedQuantity, up: VariedQuantity) -> Figure:
    """Status of the points of a grid over two of its axes.

    Args:
        codes: codes of the points.
        names: names of the codes.
    """
    fig, ((axes,),) = new_figure(1, 1, 4.2)
    x, y = np.unique(across.values), np.unique(up.values)
    grid = np.full((len(y), len(x)), np.nan)
    grid[np.searchsorted(y, up.values), np.searchsorted(x, across.values)] = codes
    axes.pcolormesh(
        x, y, grid, cmap=ListedColormap(ENDINGS[: len(names)]), vmin=-0.5, vmax=len(names) - 0.5, shading="nearest",
        rasterized=True,
    )  # fmt: skip
    for k in np.unique(codes):
        axes.plot([], [], "s", color=ENDINGS[k], label=names[k])
    axes.legend(loc="upper left", bbox_to_anchor=(1.01, 1.0))
    axes.set(xlabel=across.label, ylabel=up.label)
    return fig


def _number_of_bins(values: np.ndarray, max_bins: int) -> int:
    """Number of bins for this many values."""
    return min(max_bins, max(FEWEST_BINS, len(values) // POINTS_PER_BIN))


def bin_values(values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Bin of each value, and the middles of the bins: the levels if there are few, otherwise bins with equal numbers
    of points.
    """
    levels = np.unique(values)
    number = _number_of_bins(values, MAX_BINS)
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


#: Most inputs, and most operating points, in a tornado.
TORNADO_INPUTS, TORNADO_POINTS = 10, 4


def draw_input_shares(result: SensitivityResult) -> Figure:
    """Share of every input in every output, over all operating points together. Cells show their percentage if there
    are few columns.
    """
    shares = np.stack([study.overall_share for study in result.outputs.values()], 1)
    rows = [k for k in np.argsort(-shares.max(1), kind="stable") if shares[k].max() >= NEGLIGIBLE][:14]
    rows = rows or [int(np.argmax(shares.max(1)))]
    shares = shares[rows]
    fig, ((axes,),) = new_figure(1, 1, 0.9 + 0.29 * len(rows))
    axes.grid(False)
    visible_shares = np.ma.masked_invalid(np.where(shares < NEGLIGIBLE, 0.0, shares))
    axes.imshow(np.sqrt(visible_shares), cmap="Blues", vmin=0, vmax=1, aspect="auto", interpolation="nearest")
    axes.set_facecolor("#eeeeee")
    axes.spines[["left", "bottom"]].set_visible(False)
    axes.tick_params(length=0)
    if shares.shape[1] <= 12:
        for (i, j), share in np.ndenumerate(shares):
            if np.isfinite(share) and share >= NEGLIGIBLE:
                axes.text(
                    j, i, f"{100 * share:.0f}", ha="center", va="center", color="white" if share > 0.36 else INK
                )
    axes.set_yticks(range(len(rows)), [words.short_name(result.names[k]) for k in rows])
    axes.set_xticks(
        range(shares.shape[1]), [study.row.label for study in result.outputs.values()], rotation=18, ha="left"
    )
    axes.xaxis.tick_top()
    return fig


def _points_of_tornado(study: OutputStudy, result: SensitivityResult) -> list[int]:
    """The gentlest and the hardest operating point of each configuration, and some between."""
    points = result.points
    picked = list[int]()
    configurations = list(dict.fromkeys(points.configuration))
    for configuration in configurations:
        rows = np.flatnonzero((points.configuration == configuration) & np.isfinite(study.value) & study.studied)
        rows = rows[np.lexsort((points.payload[rows], points.slope_deg[rows], points.imposed[1][rows]))]
        if rows.size:
            evenly_spaced = np.linspace(0, rows.size - 1, max(TORNADO_POINTS // len(configurations), 1)).astype(int)
            picked += rows[np.unique(evenly_spaced)].tolist()
    return picked[:TORNADO_POINTS]


def draw_tornado(study: OutputStudy, result: SensitivityResult) -> Figure:
    """The output with a single input at the ends of its 95 % interval, at a few operating points."""
    points = _points_of_tornado(study, result)
    unit = study.row.unit_shown
    factor = study.row.factor
    swing = study.swing[:, points] / factor
    value = study.value[points] / factor
    largest_change = np.nanmax(np.abs(swing - value[:, None]), 0, initial=0.0, where=np.isfinite(swing))
    relative = (largest_change / np.maximum(largest_change.max(1, keepdims=True), 1e-300)).sum(0)
    inputs = [i for i in np.argsort(-relative, kind="stable")[:TORNADO_INPUTS] if relative[i] > 0.03]
    fig, (panels,) = new_figure(1, max(len(points), 1), 0.9 + 0.26 * len(inputs), sharey=True)
    for n, axes in enumerate(panels):
        for bar_row, i in enumerate(inputs):
            for end, colour in ((swing[0, n, i], VERMILION), (swing[1, n, i], BLUE)):
                if np.isfinite(end):
                    axes.barh(-bar_row, end - value[n], left=value[n], color=colour, height=0.66)
                else:
                    right_end = np.nanmax([value[n], *swing[:, n, i]])
                    axes.text(right_end, -bar_row, " × does not travel", va="center", color=colour)
        axes.axvline(value[n], color=INK, linewidth=0.9)
        axes.set_title(result.points.label(points[n]).replace(", ", "\n", 1), fontsize=8.5)
        axes.locator_params(axis="x", nbins=3, steps=[1, 2, 5, 10])  # few digits, so that numbers do not touch
        axes.grid(axis="y", visible=False)
    panels[0].set_yticks([-p for p in range(len(inputs))], [words.short_name(result.names[i]) for i in inputs])
    panels[0].set_xlabel(f"{study.row.label}{'' if unit == '-' else f' [{unit}]'}")
    return fig
