"""Figure of what residuals cluster by: one strip of rows a level of a column without a role."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.figure import Figure

from calibration.inference.residual_clusters import ResidualCluster
from mmrjax.model import channels
from sweeps.pages.figure_style import BLUE, FAINT, INK, new_figure

#: Clusters shown, panels in a row, width of a strip.
SHOWN, ACROSS, WIDE = 6, 3, 0.5


def draw_clusters(found: Sequence[ResidualCluster]) -> Figure:
    """Residuals of each finding over its column, a dot a row; bar: mean of a level."""
    found = found[:SHOWN]
    across = min(ACROSS, len(found))
    rows = -(-len(found) // across)
    fig, grid = new_figure(rows, across, 2.6 * rows)
    for axes in grid.flat[len(found) :]:
        axes.set_visible(False)
    for axes, one in zip(grid.flat, found, strict=False):
        axes.axhline(0, color=FAINT, lw=0.8)
        if one.correlation is None:
            for place, level in enumerate(one.levels):
                y = one.residual[one.at == level.name]
                side = np.linspace(-0.5, 0.5, len(y)) if len(y) > 1 else np.zeros(1)
                axes.plot(place + WIDE * side, y, "o", ms=3, color=BLUE, alpha=0.7)
                axes.plot(place + WIDE * np.array([-0.6, 0.6]), [y.mean()] * 2, color=INK, lw=2)
            turned = 30 if len(one.levels) > ACROSS else 0
            axes.set_xticks(range(len(one.levels)), [m.name for m in one.levels], rotation=turned, fontsize=8)
        else:
            axes.plot(one.at, one.residual, "o", ms=3, color=BLUE, alpha=0.7)
        axes.set(xlabel=one.column, ylabel=f"{channels.find_channel(one.channel).label} [{one.unit}]")
        words = f"within {one.within}" if one.within else "all rows"
        axes.set_title(f"{words}, p = {one.p:.1g}", fontsize=9)
    return fig
