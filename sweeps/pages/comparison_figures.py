"""Figures of fits: errors over each condition, and the voltage plots of feedforward constants."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from calibration.data import Columns
from calibration.inference.feedforward import Feedforward
from mmrjax.model.channels import Channel
from sweeps.pages.figure_style import (
    BLUE,
    INK,
    LOOKS,
    ORANGE,
    configuration_looks,
    new_figure,
)


def draw_errors_over_conditions(
    table: Columns,
    channels: Sequence[Channel],
    beside: Mapping[str, str] | None = None,
) -> Figure:
    """Simulated minus measured for each channel over each condition that varies, or over the row number.

    A band shows two standard deviations of the readings if they are known.

    Args:
        beside: columns in addition to conditions, with their headings.
    """
    errors_by_condition = {
        "slope_deg": "slope [°]", "supply_voltage_V": "supply voltage [V]", "motor_speed_rpm": "motor speed [rpm]",
        "motor_current_A": "motor current [A]", "payload_kg": "payload [kg]",
    }  # fmt: skip
    conditions = {
        c: words for c, words in errors_by_condition.items() if c in table and f"simulated_{c}" not in table
    }
    conditions |= beside or {}
    varied = {c: words for c, words in conditions.items() if np.unique(table[c]).size > 1}
    conditions = varied or dict(list(conditions.items())[:1])
    if not conditions:
        conditions, table = {"row": "row"}, {**table, "row": np.arange(1.0, len(table["configuration"]) + 1)}
    fig, grid = new_figure(len(channels), len(conditions), 2.3 * len(channels), sharex="col", sharey="row")
    look = configuration_looks(table["configuration"])
    for row, channel in zip(grid, channels, strict=True):
        error = table[f"simulated_{channel.column}"] - table[channel.column]
        sd = table.get(channel.sd_column, np.array([np.nan]))
        half = 2 * float(np.median(sd[np.isfinite(sd)])) if np.isfinite(sd).any() else 0.0
        for axes, (condition, words) in zip(row, conditions.items(), strict=True):
            axes.axhspan(-half, half, color="#eef3ee", zorder=0)
            axes.axhline(0, color="#666666", lw=0.9)
            levels = np.unique(table[condition])
            shift = 0.012 * max(1e-9, float(np.ptp(levels))) if levels.size > 1 else 0.02
            sides = np.linspace(-1, 1, len(look)) if len(look) > 1 else (0.0,)
            for side, (kind, (colour, marker)) in zip(sides, look.items(), strict=True):
                pick = (table["configuration"] == kind) & np.isfinite(error)
                if pick.any():
                    shifted = table[condition][pick] + side * shift
                    _draw_dots(axes, shifted, error[pick], marker, color=colour, label=kind)
            if row[0] is grid[-1, 0]:
                axes.set_xlabel(words)
                if levels.size <= 8:
                    axes.set_xticks(levels)
        row[0].set_ylabel(f"{channel.label}\nerror [{channel.unit}]")
    for axes in grid[0]:
        if axes.get_legend_handles_labels()[0] and len(look) <= LOOKS:
            axes.legend(loc="best")
            break
    return fig


def _draw_dots(axes: Axes, x: np.ndarray, y: np.ndarray, marker: str, **look: Any) -> None:
    """Readings of a configuration as dots, rasterised if there are many."""
    axes.plot(x, y, marker, ms=5, mec="white", mew=0.5, rasterized=len(x) > 500, **look)


def quasistatic(found: Feedforward) -> Figure:
    """Voltage minus kA·a over velocity, for windows of the quasistatic tests."""
    w, k = found.windows, found.constants
    slow = w["quasistatic"] if w["quasistatic"].any() else np.ones(len(w["velocity"]), bool)
    voltage = w["voltage_V"] - k["kA"] * w["acceleration"]
    fig, axes = _points(w["velocity"][slow], voltage[slow], f"velocity [{found.unit}/s]", "V - kA·a [V]")
    for sign in (-1, 1):
        v = w["velocity"][slow & (w["direction"] * sign > 0)]
        if len(v):
            ends = np.array([0.0, v[np.argmax(np.abs(v))]])
            axes.plot(ends, k["kV"] * ends + sign * k["kS"] + k.get("kG", 0.0), color=ORANGE)
    return fig


def dynamic(found: Feedforward) -> Figure:
    """Voltage minus kS and kV·v over acceleration."""
    w, k = found.windows, found.constants
    voltage = w["voltage_V"] - k["kV"] * w["velocity"] - k["kS"] * w["direction"]
    a = w["acceleration"]
    fig, axes = _points(a, voltage, f"acceleration [{found.unit}/s²]", "V - kS - kV·v [V]")
    ends = np.array([a.min(), a.max()])
    axes.plot(ends, k["kA"] * ends + (k.get("kG", 0.0) if found.mechanism == "elevator" else 0.0), color=ORANGE)
    return fig


def _points(x: np.ndarray, y: np.ndarray, along: str, up: str) -> tuple[Figure, Axes]:
    fig, grid = new_figure(1, 1, 3.2)
    axes = grid[0, 0]
    axes.axhline(0, color=INK, lw=0.6)
    axes.plot(x, y, ".", ms=4, color=BLUE)
    axes.set_xlabel(along)
    axes.set_ylabel(up)
    return fig, axes
