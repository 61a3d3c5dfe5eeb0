"""Figures of a sensitivity study: share of every input in every output, and tornadoes."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure

from calibration.sensitivity.result import NEGLIGIBLE, OutputStudy, SensitivityResult
from sweeps.pages.figure_style import BLUE, INK, VERMILION, new_figure
from sweeps.pages.words import short_name

#: Most inputs, and most operating points, in a tornado.
TALLEST, PANELS = 10, 4


def draw_input_shares(found: SensitivityResult) -> Figure:
    """Share of every input in every output, over all operating points together. Cells show their percentage if there
    are few columns.
    """
    shares = np.stack([study.overall_share for study in found.outputs.values()], 1)
    rows = [k for k in np.argsort(-shares.max(1), kind="stable") if shares[k].max() >= NEGLIGIBLE][:14]
    rows = rows or [int(np.argmax(shares.max(1)))]
    shares = shares[rows]
    fig, ((axes,),) = new_figure(1, 1, 0.9 + 0.29 * len(rows))
    axes.grid(False)
    hidden = np.ma.masked_invalid(np.where(shares < NEGLIGIBLE, 0.0, shares))
    axes.imshow(np.sqrt(hidden), cmap="Blues", vmin=0, vmax=1, aspect="auto", interpolation="nearest")
    axes.set_facecolor("#eeeeee")
    axes.spines[["left", "bottom"]].set_visible(False)
    axes.tick_params(length=0)
    if shares.shape[1] <= 12:
        for (i, j), x in np.ndenumerate(shares):
            if np.isfinite(x) and x >= NEGLIGIBLE:
                axes.text(j, i, f"{100 * x:.0f}", ha="center", va="center", color="white" if x > 0.36 else INK)
    axes.set_yticks(range(len(rows)), [short_name(found.names[k]) for k in rows])
    axes.set_xticks(range(shares.shape[1]), [s.row.label for s in found.outputs.values()], rotation=18, ha="left")
    axes.xaxis.tick_top()
    return fig


def _points_of_tornado(study: OutputStudy, found: SensitivityResult) -> list[int]:
    """The gentlest and the hardest operating point of each configuration, and some between."""
    points, picked = found.points, list[int]()
    kinds = list(dict.fromkeys(points.configuration))
    for kind in kinds:
        rows = np.flatnonzero((points.configuration == kind) & np.isfinite(study.value) & study.studied)
        rows = rows[np.lexsort((points.payload[rows], points.slope_deg[rows], points.imposed[1][rows]))]
        if rows.size:
            spread = np.linspace(0, rows.size - 1, max(PANELS // len(kinds), 1)).astype(int)
            picked += rows[np.unique(spread)].tolist()
    return picked[:PANELS]


def draw_tornado(study: OutputStudy, found: SensitivityResult) -> Figure:
    """The output with a single input at the ends of its 95 % interval, at a few operating points."""
    points, unit, factor = _points_of_tornado(study, found), study.row.unit_shown, study.row.factor
    swing, value = study.swing[:, points] / factor, study.value[points] / factor
    reach = np.nanmax(np.abs(swing - value[:, None]), 0, initial=0.0, where=np.isfinite(swing))
    relative = (reach / np.maximum(reach.max(1, keepdims=True), 1e-300)).sum(0)
    top = [i for i in np.argsort(-relative, kind="stable")[:TALLEST] if relative[i] > 0.03]
    fig, (panels,) = new_figure(1, max(len(points), 1), 0.9 + 0.26 * len(top), sharey=True)
    for n, axes in enumerate(panels):
        for place, i in enumerate(top):
            for end, colour in ((swing[0, n, i], VERMILION), (swing[1, n, i], BLUE)):
                if np.isfinite(end):
                    axes.barh(-place, end - value[n], left=value[n], color=colour, height=0.66)
                else:
                    right_end = np.nanmax([value[n], *swing[:, n, i]])
                    axes.text(right_end, -place, " × does not travel", va="center", color=colour)
        axes.axvline(value[n], color=INK, linewidth=0.9)
        axes.set_title(found.points.label(points[n]).replace(", ", "\n", 1), fontsize=8.5)
        axes.locator_params(axis="x", nbins=3, steps=[1, 2, 5, 10])  # few digits, so that numbers do not touch
        axes.grid(axis="y", visible=False)
    panels[0].set_yticks([-p for p in range(len(top))], [short_name(found.names[i]) for i in top])
    panels[0].set_xlabel(f"{study.row.label}{'' if unit == '-' else f' [{unit}]'}")
    return fig
