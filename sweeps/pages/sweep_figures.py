"""Figures of a sweep: small multiples of a channel over slope and payload, every status visible."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib import colormaps, colors
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from calibration.data import Columns, Json
from mmrjax.model.channels import Channel
from sweeps.pages import words
from sweeps.pages.figure_style import INK, add_corner_note, axis_label, new_figure
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
