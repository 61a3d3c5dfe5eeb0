"""Figures of a sweep (small multiples over slope and payload, every status visible) and of a comparison."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib import colormaps, colors
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from mmrjax.tables import CONFIGURATIONS
from sweeps.figures_style import CHANNEL_WORDS, CONFIGURATION, FAINT, INK, STATUS_WORDS, figure, note

#: Quantities of the sweep's maps: column, axis label, format of a cell.
VALUES = {
    "current": ("total_current_A", "total current [A]", "{:.2f}"),
    "speed": ("speed_mm_s", "speed [mm/s]", "{:.0f}"),
}
_PANELS = 3  # voltages drawn of a configuration
_CELLS = 12  # along an axis up to which cells are labelled


def panels(voltages: np.ndarray) -> list[tuple[str, np.ndarray]]:
    """How a figure splits runs by supply voltage: a title and a mask for each of at most three panels.

    Every voltage up to three; of a grid of more, the least, a middle and the greatest; where nearly every
    run has a voltage of its own, thirds of the range.
    """
    levels = np.unique(voltages)
    if levels.size > _PANELS and 4 * levels.size > voltages.size:
        bounds = np.linspace(levels[0], levels[-1], _PANELS + 1)
        third = np.clip(np.searchsorted(bounds, voltages, side="right") - 1, 0, _PANELS - 1)
        return [(f"{bounds[k]:.3g} to {bounds[k + 1]:.3g} V", third == k) for k in range(_PANELS)]
    if levels.size > _PANELS:
        levels = levels[[0, levels.size // 2, -1]]
    return [(f"{v:.4g} V", voltages == v) for v in levels]


def is_map(runs: dict[str, np.ndarray]) -> bool:
    """Whether the runs have at least two slopes and two payloads, and so fill a map."""
    return np.unique(runs["slope_deg"]).size > 1 and np.unique(runs["payload_kg"]).size > 1


def settled(runs: dict[str, np.ndarray]) -> np.ndarray:
    """Which runs have a number to draw: `drive` leaves numbers of a moment with other statuses too."""
    return (runs["status"] == "converged") & np.isfinite(runs["total_current_A"])


def sweep(runs: dict[str, np.ndarray], quantity: str) -> Figure:
    """One quantity of `VALUES` over slope and payload, a panel for each voltage and configuration.

    With a single slope or payload the panels are lines over the other. A cell that did not settle is hatched
    and says why. Where several runs share a cell their median is shown.
    """
    kinds = [c for c in CONFIGURATIONS if (runs["configuration"] == c).any()]
    volts = panels(runs["supply_voltage_V"])
    if not is_map(runs):
        return _lines(runs, quantity, kinds)
    values = runs[VALUES[quantity][0]]
    there = values[settled(runs)]
    low, high = (float(there.min()), float(there.max())) if there.size else (0.0, 1.0)
    norm = colors.Normalize(low, high if high > low else low + 1.0)
    payloads = np.unique(runs["payload_kg"])
    tall = min(0.3 * payloads.size, 2.2) + 1.0
    fig, grid = figure(len(kinds), len(volts), max(2.0, tall) * len(kinds) + 0.5)
    for row, kind in zip(grid, kinds, strict=True):
        for axes, (volt, mask) in zip(row, volts, strict=True):
            _map(axes, runs, np.nonzero((runs["configuration"] == kind) & mask)[0], quantity, norm)
            axes.set_title(f"{kind}, {volt}")
            axes.set(xlabel="slope [°]", ylabel="payload [kg]")
    from matplotlib.cm import ScalarMappable

    bar = fig.colorbar(ScalarMappable(norm, "viridis"), ax=grid, shrink=0.8, pad=0.01)
    bar.set_label(VALUES[quantity][1])
    return fig


def _map(axes: Axes, runs: dict[str, np.ndarray], index: np.ndarray, quantity: str, norm: Any) -> None:
    axes.grid(False)
    if not index.size:
        note(axes, "no runs")
        return
    column, _, form = VALUES[quantity]
    slopes, at_slope = np.unique(runs["slope_deg"][index], return_inverse=True)
    payloads, at_payload = np.unique(runs["payload_kg"][index], return_inverse=True)
    if slopes.size * payloads.size > 4 * index.size:  # scattered, no grid
        _scatter(axes, runs, index, column, norm)
        return
    cells: dict[tuple[int, int], list[int]] = {}
    for run, i, j in zip(index, at_slope, at_payload, strict=True):
        cells.setdefault((int(i), int(j)), []).append(int(run))
    image = np.full((payloads.size, slopes.size), np.nan)
    missing: dict[tuple[int, int], str] = {}
    has_number = settled(runs)
    for (i, j), members in cells.items():
        values = runs[column][[m for m in members if has_number[m]]]
        if values.size:
            image[j, i] = np.median(values)
        else:
            missing[i, j] = str(runs["status"][members[0]])
    axes.imshow(image, origin="lower", aspect="auto", cmap="viridis", norm=norm, interpolation="nearest")
    labelled = slopes.size <= _CELLS and payloads.size <= _CELLS
    if labelled:
        for j, i in zip(*np.nonzero(np.isfinite(image)), strict=True):
            shade = colormaps["viridis"](norm(image[j, i]))
            ink = "white" if 0.299 * shade[0] + 0.587 * shade[1] + 0.114 * shade[2] < 0.52 else INK
            axes.text(i, j, form.format(image[j, i]), ha="center", va="center", fontsize=7.5, color=ink)
    for i, j, wide, tall in _blocks(set(missing), joined=not labelled):
        axes.add_patch(Rectangle((i - 0.5, j - 0.5), wide, tall, fc="#f4f4f4", ec="#b5b5b5", hatch="////", lw=0.4))
    _say_missing(axes, missing, labelled)
    _ticks(axes.set_xticks, slopes)
    _ticks(axes.set_yticks, payloads)


def _blocks(cells: set[tuple[int, int]], joined: bool) -> list[tuple[int, int, int, int]]:
    """Rectangles (i, j, width, height) that cover the cells; joined where they touch, or one a cell."""
    if not joined:
        return [(i, j, 1, 1) for i, j in sorted(cells)]
    blocks = []
    left = set(cells)
    while left:
        i, j = min(left)
        tall = 1
        while (i, j + tall) in left:
            tall += 1
        wide = 1
        while all((i + wide, j + k) in left for k in range(tall)):
            wide += 1
        left -= {(i + p, j + q) for p in range(wide) for q in range(tall)}
        blocks.append((i, j, wide, tall))
    return blocks


def _say_missing(axes: Axes, missing: dict[tuple[int, int], str], each: bool) -> None:
    box = {"fc": "white", "ec": "none", "pad": 0.6, "alpha": 0.85}
    if each:
        for (i, j), status in missing.items():
            axes.text(i, j, STATUS_WORDS.get(status, status), ha="center", va="center", fontsize=6.8, bbox=box)
        return
    for status in sorted(set(missing.values())):
        places = np.array([p for p, s in missing.items() if s == status], float)
        i, j = places[np.argmin(((places - places.mean(0)) ** 2).sum(1))]
        edge = axes.get_xlim()[1]
        side = "right" if i > 0.88 * edge else "left" if i < 0.12 * edge else "center"
        axes.text(i, j, STATUS_WORDS.get(status, status), ha=side, va="center", fontsize=8.5, bbox=box)


def _ticks(setter: Any, levels: np.ndarray) -> None:
    every = 1 if levels.size <= 8 else -(-levels.size // 5)
    setter(range(0, levels.size, every), [f"{v:.3g}" for v in levels[::every]])


def _scatter(axes: Axes, runs: dict[str, np.ndarray], index: np.ndarray, column: str, norm: Any) -> None:
    values = runs[column][index]
    there = settled(runs)[index]
    x, y = runs["slope_deg"][index], runs["payload_kg"][index]
    axes.scatter(x[there], y[there], c=values[there], cmap="viridis", norm=norm, s=8, rasterized=True)
    for status in np.unique(runs["status"][index][~there]):
        pick = ~there & (runs["status"][index] == status)
        axes.plot(x[pick], y[pick], "x", ms=3, color=FAINT, rasterized=True, label=STATUS_WORDS.get(status, status))
    if not there.all():
        axes.legend(loc="upper right", fontsize=7.5, frameon=True, markerscale=1.5)


def _lines(runs: dict[str, np.ndarray], quantity: str, kinds: list[str]) -> Figure:
    column, words, _ = VALUES[quantity]
    over = "payload_kg" if np.unique(runs["payload_kg"]).size > 1 else "slope_deg"
    if np.unique(runs[over]).size == 1 and np.unique(runs["supply_voltage_V"]).size > 1:
        over = "supply_voltage_V"
    label = {"payload_kg": "payload [kg]", "slope_deg": "slope [°]", "supply_voltage_V": "supply voltage [V]"}[over]
    fig, grid = figure(1, len(kinds), 3.2, sharey=True)
    for axes, kind in zip(grid[0], kinds, strict=True):
        mine = runs["configuration"] == kind
        volts = [("", mine)] if over == "supply_voltage_V" else panels(runs["supply_voltage_V"])
        for k, (volt, mask) in enumerate(volts):
            pick = np.nonzero(mine & mask)[0]
            pick = pick[np.argsort(runs[over][pick], kind="stable")]
            shade = colormaps["viridis"](0.15 + 0.7 * k / max(1, len(volts) - 1))
            shown = np.where(settled(runs)[pick], runs[column][pick], np.nan)
            axes.plot(
                runs[over][pick],
                shown,
                "o-" if pick.size <= 60 else "-",
                ms=4,
                color=shade,
                label=volt or None,
            )
            gone = pick[~np.isfinite(shown)]
            for status in np.unique(runs["status"][gone]):
                at = gone[runs["status"][gone] == status]
                axes.plot(
                    runs[over][at],
                    np.full(at.size, 0.03 + 0.05 * k),
                    "x",
                    color=shade,
                    ms=6,
                    mew=1.6,
                    transform=axes.get_xaxis_transform(),
                    clip_on=False,
                )
                axes.annotate(
                    f"{STATUS_WORDS.get(str(status), str(status))}",
                    (runs[over][at[0]], 0.03 + 0.05 * k),
                    xycoords=axes.get_xaxis_transform(),
                    xytext=(6, 4),
                    textcoords="offset points",
                    fontsize=8,
                )
        axes.set(xlabel=label, title=kind)
        if volts[0][0]:
            axes.legend()
    drawn = runs[column][settled(runs)]
    low, high = (float(drawn.min()), float(drawn.max())) if drawn.size else (0.0, 1.0)
    grid[0, 0].set_ylim(min(0.0, 1.1 * low), max(0.0, 1.1 * high) or 1.0)
    grid[0, 0].set_ylabel(words)
    return fig


# --- comparison with a table of measurements ----------------------------------------------------------


def parity(table: dict[str, np.ndarray], columns: dict[str, str]) -> Figure:
    """Simulated over measured, one panel a channel."""
    fig, grid = figure(1, len(columns), 3.6)
    for axes, (channel, column) in zip(grid[0], columns.items(), strict=True):
        measured, simulated = table[column], table[f"simulated_{column}"]
        both = np.isfinite(measured) & np.isfinite(simulated)
        ends = np.concatenate([measured[both], simulated[both]]) if both.any() else np.array([0.0, 1.0])
        low, high = min(0.0, float(ends.min())), max(0.0, float(ends.max()))
        span = np.array([low - 0.05 * (high - low) * (low < 0), high + 0.05 * (high - low)])
        axes.fill_between(span, span * 0.95, span * 1.05, color="#eef3ee", lw=0)
        axes.plot(span, span, color="#666666", lw=0.9)
        for kind in CONFIGURATIONS:
            pick = both & (table["configuration"] == kind)
            if pick.any():
                axes.plot(
                    measured[pick],
                    simulated[pick],
                    "o" if kind == "6T2A" else "s",
                    ms=5,
                    mec="white",
                    mew=0.5,
                    color=CONFIGURATION[kind],
                    label=kind,
                    rasterized=bool(pick.sum() > 2000),
                )
        words, unit = CHANNEL_WORDS[channel]
        axes.set(xlabel=f"measured {words} [{unit}]", ylabel=f"simulated {words} [{unit}]")
        axes.set_xlim(*span)
        axes.set_ylim(*span)
        if not both.any():
            note(axes, "no row has both numbers")
    if grid[0, 0].get_legend_handles_labels()[0]:
        grid[0, 0].legend(loc="lower right")
    note(grid[0, 0], "band: ±5 %")
    return fig


def errors_over(table: dict[str, np.ndarray], columns: dict[str, str]) -> Figure:
    """Error (35) of each channel over each condition."""
    conditions = {"slope_deg": "slope [°]", "supply_voltage_V": "supply voltage [V]", "payload_kg": "payload [kg]"}
    fig, grid = figure(len(columns), len(conditions), 2.3 * len(columns), sharex="col", sharey="row")
    for row, channel in zip(grid, columns, strict=True):
        error = table[f"error_{channel}_percent"]
        for axes, (condition, words) in zip(row, conditions.items(), strict=True):
            axes.axhspan(-5, 5, color="#eef3ee", zorder=0)
            axes.axhline(0, color="#666666", lw=0.9)
            levels = np.unique(table[condition])
            shift = 0.012 * max(1e-9, float(np.ptp(levels))) if levels.size > 1 else 0.02
            for side, kind in zip((-1, 1), CONFIGURATIONS, strict=True):
                pick = (table["configuration"] == kind) & np.isfinite(error)
                if pick.any():
                    axes.plot(
                        table[condition][pick] + side * shift,
                        error[pick],
                        "o" if kind == "6T2A" else "s",
                        ms=5,
                        mec="white",
                        mew=0.5,
                        color=CONFIGURATION[kind],
                        label=kind,
                        rasterized=bool(pick.sum() > 2000),
                    )
            if row[0] is grid[-1, 0]:
                axes.set_xlabel(words)
                if levels.size <= 8:
                    axes.set_xticks(levels)
        row[0].set_ylabel(f"{CHANNEL_WORDS[channel][0]}\nerror [%]")
    for axes in grid[0]:
        if axes.get_legend_handles_labels()[0]:
            axes.legend(loc="best")
            break
    return fig
