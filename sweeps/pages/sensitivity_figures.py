"""Figures of a sensitivity study: share of every input in every output, and tornadoes."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from calibration.sensitivity.result import NEGLIGIBLE, OutputStudy, SensitivityResult
from sweeps.pages.figure_style import BLUE, INK, VERMILION, new_figure
from sweeps.pages.words import short_name

#: Most inputs in a figure, and most operating points in a tornado.
SHOWN, TALLEST, PANELS = 8, 10, 4
_MAP = "Blues"


def draw_input_shares(found: SensitivityResult) -> Figure:
    """Share of every input in every output, over all operating points together."""
    shares = np.stack([study.overall_share for study in found.outputs.values()], 1)
    rows = [k for k in np.argsort(-shares.max(1), kind="stable") if shares[k].max() >= NEGLIGIBLE][:14]
    rows = rows or [int(np.argmax(shares.max(1)))]
    fig, axes = new_figure(1, 1, 0.9 + 0.29 * len(rows))
    ax: Axes = axes[0, 0]
    _draw_heat_map(ax, shares[rows], 12)
    ax.set_yticks(range(len(rows)), [short_name(found.names[k]) for k in rows])
    ax.set_xticks(range(shares.shape[1]), [s.row.label for s in found.outputs.values()], rotation=18, ha="left")
    ax.xaxis.tick_top()
    return fig


def _draw_heat_map(ax: Axes, shares: np.ndarray, labelled: int) -> None:
    """Heat map of shares. Cells show their percentage if there are few columns."""
    ax.grid(False)
    hidden = np.ma.masked_invalid(np.where(shares < NEGLIGIBLE, 0.0, shares))
    ax.imshow(np.sqrt(hidden), cmap=_MAP, vmin=0, vmax=1, aspect="auto", interpolation="nearest")
    ax.set_facecolor("#eeeeee")
    for side in ("left", "bottom"):
        ax.spines[side].set_visible(False)
    ax.tick_params(length=0)
    if shares.shape[1] <= labelled:
        for (i, j), x in np.ndenumerate(shares):
            if np.isfinite(x) and x >= NEGLIGIBLE:
                ink = "white" if x > 0.36 else INK
                ax.text(j, i, f"{100 * x:.0f}", ha="center", va="center", fontsize=8.5, color=ink)


def draw_tornado(study: OutputStudy, found: SensitivityResult) -> Figure:
    """The output with a single input at the ends of its 95 % interval, at a few operating points."""
    # Operating points of a tornado: the gentlest and the hardest of each configuration, or between
    points = found.points
    kinds = list(dict.fromkeys(map(str, points.configuration)))
    panel_rows = max(PANELS // len(kinds), 1)
    shown_points: list[int] = []
    for kind in kinds:
        point_rows = np.flatnonzero((points.configuration == kind) & np.isfinite(study.value) & study.studied)
        order = point_rows[
            np.lexsort((points.payload[point_rows], points.slope_deg[point_rows], points.imposed[1][point_rows]))
        ]
        if order.size:
            shown_points += [int(order[k]) for k in np.unique(np.linspace(0, order.size - 1, panel_rows).astype(int))]
    panel_points = shown_points[:PANELS]
    unit, factor = study.row.unit_shown, study.row.factor
    swing, value = study.swing[:, panel_points] / factor, study.value[panel_points] / factor
    reach = np.nanmax(np.abs(swing - value[:, None]), 0, initial=0.0, where=np.isfinite(swing))
    relative = (reach / np.maximum(reach.max(1, keepdims=True), 1e-300)).sum(0)
    top = [i for i in np.argsort(-relative, kind="stable")[:TALLEST] if relative[i] > 0.03]
    fig, axes = new_figure(1, max(len(panel_points), 1), 0.9 + 0.26 * len(top), sharey=True)
    for n, ax in enumerate(axes[0]):
        for place, i in enumerate(top):
            for end, colour in ((swing[0, n, i], VERMILION), (swing[1, n, i], BLUE)):
                if np.isfinite(end):
                    ax.barh(-place, end - value[n], left=value[n], color=colour, height=0.66)
                else:
                    right_end = np.nanmax([value[n], *swing[:, n, i]])
                    ax.text(right_end, -place, " × does not travel", va="center", fontsize=7.5, color=colour)
        ax.axvline(value[n], color=INK, linewidth=0.9)
        first, *other_words = found.points.label(panel_points[n]).split(", ")
        ax.set_title(f"{first}\n{', '.join(other_words)}", fontsize=8.5)
        ax.tick_params(axis="x", labelsize=8)
        ax.locator_params(axis="x", nbins=3, steps=[1, 2, 5, 10])  # few digits, so that numbers do not touch
        ax.grid(axis="y", visible=False)
    axes[0, 0].set_yticks([-p for p in range(len(top))], [short_name(found.names[i]) for i in top], fontsize=8.5)
    axes[0, 0].set_xlabel(f"{study.row.label}{'' if unit == '-' else f' [{unit}]'}", fontsize=9)
    return fig
