"""Figures of a calibration: parameters against their priors, profiles, correlations, errors seen and unseen."""

from __future__ import annotations

from typing import Any

import matplotlib
import numpy as np
from matplotlib.figure import Figure

from calibration.data.runs import CHANNELS
from calibration.inference.calibrate import Calibration
from calibration.inference.identifiability import Z95
from sweeps.figures_style import BLUE, CHANNEL_WORDS, FAINT, INK, ORANGE, VERMILION, figure


def short(name: str) -> str:
    """A parameter's name without the words that every such name has."""
    return name.replace("ground.friction.", "").replace("ground.", "").replace("track.", "").replace("effects.", "")


def parameters(found: Calibration) -> Figure:
    """Where each parameter lies in prior sds, with its 95 % interval, over the prior's own."""
    names, profile, coordinates = found.identifiability.names, found.profile, found.problem.coordinates
    fig, grid = figure(1, 1, 1.1 + 0.32 * len(names))
    axes = grid[0, 0]
    axes.axvspan(-Z95, Z95, color="#eeeeee", lw=0, zorder=0)
    axes.axvline(0, color=FAINT, lw=0.9)
    for row, z in enumerate(found.z):
        sd = found.identifiability.sd[row]
        low, high = z - Z95 * sd, z + Z95 * sd
        if profile is not None:
            low, high = (float(np.interp(v, profile.value[row], profile.z[row])) for v in
                         (profile.low[row], profile.high[row]))  # fmt: skip
        held = found.identifiability.held_by_prior[row]
        colour = FAINT if held else BLUE
        axes.plot([low, high], [row, row], color=colour, lw=2.4, solid_capstyle="butt")
        axes.plot(z, row, "o", color=colour, ms=6)
        value = float(coordinates.value(found.z)[row])
        words = f"{value:.3g} {coordinates.units[row]}".removesuffix(" -")
        axes.text(1.01, row, words, transform=axes.get_yaxis_transform(), va="center", fontsize=8.5, color=INK)
    axes.set_yticks(range(len(names)), [short(n) for n in names])
    axes.set(xlabel="shift from the prior [prior sds]")
    axes.invert_yaxis()
    axes.grid(axis="y", visible=False)
    axes.set_title("blue: the data say more; grey: the prior says more; band: the prior's 95 %")
    return fig


def profiles(found: Calibration) -> Figure:
    """Profile likelihood of each parameter: rise of the objective over its value, with the 95 % level."""
    assert found.profile is not None
    names, profile = found.identifiability.names, found.profile
    columns = 4
    rows = -(-len(names) // columns)
    fig, grid = figure(rows, columns, 2.1 * rows, sharey=True)
    for k, axes in enumerate(grid.flat):
        if k >= len(names):
            axes.set_visible(False)
            continue
        near = profile.rise[k] < 12
        axes.axhline(Z95**2, color=ORANGE, lw=1)
        axes.axvspan(profile.low[k], profile.high[k], color="#e3eef7", lw=0, zorder=0)
        axes.plot(profile.value[k][near], profile.rise[k][near], "o-", ms=3, color=BLUE)
        axes.axvline(float(found.problem.coordinates.value(found.z)[k]), color=INK, lw=0.9)
        prior = float(found.problem.coordinates.value(np.zeros(len(names)))[k])
        axes.plot(prior, 0.3, "^", color=VERMILION, ms=6, clip_on=False)
        axes.set_title(short(names[k]), fontsize=9)
        axes.set_xlabel(f"[{found.problem.coordinates.units[k]}]")
        axes.set_ylim(0, 10)
        axes.locator_params(axis="x", nbins=4)
    for row in grid:
        row[0].set_ylabel("rise [σ²]")
    fig.supxlabel("black: the optimum; shaded: its 95 % interval; triangle: the prior's median", fontsize=8.5)
    return fig


def correlations(found: Calibration) -> Figure:
    """Posterior correlation of every pair of parameters, and the singular values."""
    names = [short(n) for n in found.identifiability.names]
    fig, grid = figure(1, 2, 1.6 + 0.36 * len(names), width_ratios=[1.7, 1.0])
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
    fig.colorbar(image, ax=left, shrink=0.8, label="correlation")
    s = np.maximum(found.identifiability.singular_values, 1e-6)
    right.semilogy(np.arange(1, len(s) + 1), s, "o-", color=BLUE)
    right.axhline(1.0, color=ORANGE, lw=1)
    right.text(len(s), 1.1, "below: the prior says more", fontsize=8.5, ha="right", va="bottom")
    right.set_xticks(np.arange(1, len(s) + 1, 2))
    right.set(xlabel="direction", ylabel="singular value (prior sd / data sd)")
    right.set_title("what the data tell apart")
    return fig


def before_after(document: dict[str, Any]) -> Figure:
    """rms of (35) by channel: before, fitted, and with each kind of block held out."""
    lines = {"before": document["errors"]["before"]["fitted"], "fitted": document["errors"]["after"]["fitted"]}
    lines |= {f"held out: {k.replace('_', ' + ')}": v["all"] for k, v in document["held_out_by"].items()}
    fig, grid = figure(1, 3, 1.1 + 0.36 * len(lines), sharey=True)
    for axes, channel in zip(grid[0], CHANNELS, strict=True):
        for row, (words, by) in enumerate(lines.items()):
            rms, rows = by[channel]["rms_percent"], by[channel]["rows"]
            colour = FAINT if words == "before" else BLUE if words == "fitted" else ORANGE
            if rows:
                axes.barh(row, rms, color=colour, height=0.62)
                missing = "" if rows == document["rows"] else f" ({rows} of {document['rows']} rows)"
                axes.text(rms, row, f" {rms:.1f}{missing}", va="center", fontsize=8.5)
            else:
                axes.text(0, row, " no row reached", va="center", fontsize=8.5)
        axes.set_title(CHANNEL_WORDS[channel][0])
        axes.set_xlabel("rms error (35) [%]")
        axes.margins(x=0.55)
        axes.grid(axis="y", visible=False)
    grid[0, 0].set_yticks(range(len(lines)), list(lines))
    grid[0, 0].invert_yaxis()
    return fig


def histories(table: dict[str, np.ndarray], columns: dict[str, str]) -> Figure:
    """Time histories: measured dots and the fitted line, a row of panels for each run (six at most)."""
    names = list(dict.fromkeys(table["run_id"]))[:6] if "run_id" in table else [None]
    fig, grid = figure(len(names), len(columns), 2.2 * len(names))
    for row, name in zip(grid, names, strict=True):
        pick = np.ones(len(table["time_s"]), bool) if name is None else table["run_id"] == name
        order = np.flatnonzero(pick)[np.argsort(table["time_s"][pick])]
        for axes, (channel, column) in zip(row, columns.items(), strict=True):
            axes.plot(table["time_s"][order], table[column][order], "o", ms=3, color=INK)
            axes.plot(table["time_s"][order], table[f"after_{column}"][order], color=BLUE)
            words, unit = CHANNEL_WORDS[channel]
            axes.set(xlabel="time [s]", ylabel=f"{words} [{unit}]")
        row[0].set_title(name or "the run")
    return fig
