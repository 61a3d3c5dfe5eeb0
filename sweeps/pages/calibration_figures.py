"""Figures of a calibration: parameters against their priors, profiles, correlations, errors seen and unseen."""

from __future__ import annotations

from collections.abc import Sequence

import matplotlib
import numpy as np
from matplotlib.figure import Figure

from calibration.inference.identifiability import Z95
from calibration.inference.residual_clusters import ResidualCluster
from calibration.inference.result import CalibrationResult
from mmrjax.model import channels
from sweeps.pages.figure_style import BLUE, FAINT, INK, ORANGE, VERMILION, colour_bar, new_figure
from sweeps.pages.words import short_name

#: Clusters shown, panels in a row, width of a strip.
SHOWN, ACROSS, WIDE = 6, 3, 0.5


def draw_clusters(found: Sequence[ResidualCluster]) -> Figure:
    """Residuals that depend on a column: one dot for each row, bars for the means of levels."""
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
            label_angle = 30 if len(one.levels) > ACROSS else 0
            axes.set_xticks(range(len(one.levels)), [m.name for m in one.levels], rotation=label_angle, fontsize=8)
        else:
            axes.plot(one.at, one.residual, "o", ms=3, color=BLUE, alpha=0.7)
        axes.set(xlabel=one.column, ylabel=f"{channels.find_channel(one.channel).label} [{one.unit}]")
        words = f"within {one.within}" if one.within else "all rows"
        axes.set_title(f"{words}, p = {one.p:.1g}", fontsize=9)
    return fig


def draw_parameter_intervals(found: CalibrationResult) -> Figure:
    """Estimate of each parameter in prior sds, with its 95 % interval and the prior's."""
    fig, grid = new_figure(1, 1, 1.1 + 0.32 * len(found.parameters))
    axes = grid[0, 0]
    axes.axvspan(-Z95, Z95, color="#eeeeee", lw=0, zorder=0)
    axes.axvline(0, color=FAINT, lw=0.9)
    for row, p in enumerate(found.parameters.values()):
        colour = FAINT if p.held_by_prior else BLUE
        axes.plot(p.interval_shift, [row, row], color=colour, lw=2.4, solid_capstyle="butt")
        axes.plot(p.shift, row, "o", color=colour, ms=6)
        words = f"{p.value:.3g} {p.unit}".removesuffix(" -")
        axes.text(1.01, row, words, transform=axes.get_yaxis_transform(), va="center", fontsize=8.5, color=INK)
    axes.set_yticks(range(len(found.parameters)), [short_name(n) for n in found.parameters])
    axes.set(xlabel="shift from the prior [prior sds]")
    axes.invert_yaxis()
    axes.grid(axis="y", visible=False)
    axes.set_title("grey: not determined by these runs, band: the prior's 95 %")
    return fig


def draw_profile_likelihoods(found: CalibrationResult) -> Figure:
    """Profile likelihood of each parameter, with the 95 % level."""
    profiled = [(name, p, p.profile) for name, p in found.parameters.items() if p.profile is not None]
    rows = -(-len(profiled) // 4)
    fig, grid = new_figure(rows, 4, 2.1 * rows, sharey=True)
    for axes in grid.flat[len(profiled) :]:
        axes.set_visible(False)
    for axes, (name, p, profile) in zip(grid.flat, profiled, strict=False):
        near = profile.rise < 12
        axes.axhline(Z95**2, color=ORANGE, lw=1)
        axes.axvspan(*p.interval, color="#e3eef7", lw=0, zorder=0)
        axes.plot(profile.value[near], profile.rise[near], "o-", ms=3, color=BLUE)
        axes.axvline(p.value, color=INK, lw=0.9)
        axes.plot(p.prior.median, 0.3, "^", color=VERMILION, ms=6, clip_on=False)
        axes.set_title(short_name(name), fontsize=9)
        axes.set_xlabel(f"[{p.unit}]")
        axes.set_ylim(0, 10)
        axes.locator_params(axis="x", nbins=4)
    for row in grid:
        row[0].set_ylabel("rise [σ²]")
    fig.supxlabel("black: the optimum, shaded: its 95 % interval, triangle: the prior's median", fontsize=8.5)
    return fig


def draw_correlations(found: CalibrationResult) -> Figure:
    """Posterior correlation of every pair of parameters, and the singular values."""
    names = [short_name(n) for n in found.identifiability.names]
    fig, grid = new_figure(1, 2, 1.6 + 0.36 * max(len(names), 5), width_ratios=[1.7, 1.0])
    left, right = grid[0]
    c = found.identifiability.correlation
    image = left.imshow(c, cmap=matplotlib.colormaps["RdBu_r"], vmin=-1, vmax=1)
    left.set_xticks(range(len(names)), names, rotation=60, ha="right", fontsize=8.5)
    left.set_yticks(range(len(names)), names, fontsize=8.5)
    left.grid(visible=False)
    for i in range(len(names)):
        for j in range(i):
            if abs(c[i, j]) > 0.3:
                left.text(j, i, f"{c[i, j]:.2f}".replace("0.", "."), ha="center", va="center", fontsize=7.5,
                          color="white" if abs(c[i, j]) > 0.7 else INK)  # fmt: skip
    colour_bar(fig, image, left, shrink=0.8, label="correlation")
    s = np.maximum(found.identifiability.singular_values, 1e-6)
    right.semilogy(np.arange(1, len(s) + 1), s, "o-", color=BLUE)
    right.axhline(1.0, color=ORANGE, lw=1)
    right.text(len(s), 1.1, "below: known from the prior", fontsize=8.5, ha="right", va="bottom")
    right.set_xticks(np.arange(1, len(s) + 1, 2))
    right.set(xlabel="direction", ylabel="prior sd / data sd")
    right.set_title("combinations of parameters")
    return fig
