"""Figures of a design search: chart of limits over payload and slope, and Pareto front."""

from __future__ import annotations

import numpy as np
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure
from matplotlib.patches import Patch, Rectangle

from calibration.sizing.chart import LIMITS, MarginChart
from calibration.sizing.design import OBJECTIVES
from sweeps.pages.figure_style import BLUE, GREEN, INK, ORANGE, PURPLE, SKY, VERMILION, legend_columns, new_figure
from sweeps.report.size_report import SizeResult

_COLOURS = dict(zip(LIMITS, (BLUE, "#555555", VERMILION, PURPLE, ORANGE, "#8c564b", SKY, GREEN), strict=True))


def draw_nearest_limits(found: SizeResult, charts: dict[str, MarginChart]) -> Figure:
    """One panel per robot. The colour shows the nearest limit, and the line where it is reached."""
    fig, axes = new_figure(1, len(charts), 4.6, sharex=True, sharey=True)
    e = found.asked.envelope
    palette = ListedColormap([_COLOURS[name] for name in LIMITS])
    nearest_limits: set[int] = set()
    for ax, (name, chart) in zip(axes[0], charts.items(), strict=True):
        nearest_limits |= set(np.unique(chart.nearest).tolist())
        ax.pcolormesh(
            chart.payload, chart.slope, chart.nearest, cmap=palette, vmin=-0.5, vmax=len(LIMITS) - 0.5, alpha=0.55,
            shading="nearest", rasterized=True,
        )  # fmt: skip
        ax.contourf(chart.payload, chart.slope, chart.margin, levels=[-1e9, 0.0], colors=["white"], alpha=0.55)
        if chart.margin.min() < 0 < chart.margin.max():
            ax.contour(chart.payload, chart.slope, chart.margin, levels=[0.0], colors=[INK], linewidths=2.2)
        (p0, p1), (s0, s1) = e.payload_kg, e.slope_deg
        ax.add_patch(Rectangle((p0, s0), p1 - p0, s1 - s0, fill=False, edgecolor=INK, linestyle="--", linewidth=1.3))
        ax.annotate(
            "envelope", (p1, s1), xytext=(-3, -3), textcoords="offset points", ha="right", va="top", fontsize=8.5
        )
        ax.set_title(name)
        ax.set_xlabel("payload [kg]")
        ax.grid(visible=False)
    axes[0, 0].set_ylabel("slope [deg]")
    handles = [Patch(color=_COLOURS[LIMITS[k]], alpha=0.55, label=LIMITS[k]) for k in sorted(nearest_limits)]
    fig.legend(
        handles=handles,
        loc="outside lower center",
        ncols=legend_columns(str(h.get_label()) for h in handles),
        title="nearest limit",
    )
    return fig


def draw_pareto_front(found: SizeResult) -> Figure:
    """Pareto front of two objectives, with the names of motors."""
    first, second = found.objectives
    fig, axes = new_figure(1, 1, 3.8)
    ax = axes[0, 0]
    x, y = (np.array([f.objectives[name] for f in found.sizing.front]) for name in (first, second))
    ax.step(x, y, where="post", color="#bbbbbb", linewidth=1.2)
    names = list(dict.fromkeys(f.drive.motor.name for f in found.sizing.front))
    colours = (BLUE, VERMILION, GREEN, PURPLE, ORANGE, SKY, "#8c564b", "#555555")
    for k, name in enumerate(names):
        members = [i for i, f in enumerate(found.sizing.front) if f.drive.motor.name == name]
        ax.plot(x[members], y[members], "o", color=colours[k % len(colours)], label=name)
    ax.set_xlabel(f"{OBJECTIVES[first][1]} [{OBJECTIVES[first][0]}]")
    ax.set_ylabel(f"{OBJECTIVES[second][1]} [{OBJECTIVES[second][0]}]")
    ax.legend(title="motor")
    return fig
