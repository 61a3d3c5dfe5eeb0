"""Figures of feedforward constants: quasistatic and dynamic."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from calibration.inference.feedforward import Feedforward
from sweeps.pages.figure_style import BLUE, INK, ORANGE, new_figure


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
