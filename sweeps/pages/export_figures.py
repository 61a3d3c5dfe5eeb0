"""The figure of an exported drive next to the native model."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure

from sweeps.export.comparison import Comparison
from sweeps.export.joint import channels_of
from sweeps.pages.figure_style import BLUE, FAINT, INK, VERMILION, new_figure


def draw_export_readings(compared: Comparison) -> Figure:
    """Readings of the exported drive over those of the reference, a panel for each channel."""
    at = compared.situation
    shown = [(k, c) for k, c in enumerate(channels_of(at.joint)) if c.name in compared.errors[0].percent]
    reference = at.measured if at.is_measured else at.native
    fig, grid = new_figure(1, max(len(shown), 1), 3.4)
    for axes, (k, channel) in zip(grid[0], shown, strict=False):
        size = 1 / channel.factor
        given = reference[:, k] * size
        ends = np.nanmin(given), np.nanmax(given)
        axes.plot(ends, ends, color=FAINT, lw=1)
        if at.is_measured:
            axes.plot(given, at.native[:, k] * size, "o", color=BLUE, ms=5, mfc="none", label="native")
        axes.plot(given, compared.readings[:, k] * size, ".", color=VERMILION, ms=5, label="exported")
        axes.set_xlabel(f"{compared.reference}: {channel.label} [{channel.unit}]", color=INK)
        axes.set_ylabel(f"{channel.label} [{channel.unit}]", color=INK)
        axes.legend(loc="upper left", frameon=False)
    return fig
