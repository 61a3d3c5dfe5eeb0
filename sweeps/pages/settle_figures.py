"""The figure of `settle`: a log over time with its settled stretches."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure

from calibration.data.courses import applied_drive
from calibration.data.settling import Settled
from sweeps.pages.figure_style import BLUE, FAINT, INK, VERMILION, new_figure
from sweeps.report.settle_report import IMPOSED

#: Most points of a line of a figure, in pairs of the least and the greatest of as many samples.
POINTS = 3000


def over_log(found: Settled) -> Figure:
    """The imposed quantity and each channel over the log, with settled stretches and their means."""
    runs = found.runs
    rows = np.concatenate([s.rows for s in found.stretches]) if found.stretches else np.zeros(0, int)
    every = np.unique(np.concatenate([rows, np.arange(len(runs))]))
    clock, begin = np.zeros(len(runs)), 0.0
    run = runs.run_names
    for name in dict.fromkeys(run.tolist()):  # recordings one after the other
        mine = np.flatnonzero(run == name)
        clock[mine] = begin + runs["time_s"][mine] - runs["time_s"][mine[0]]
        begin = float(clock[mine[-1]])
    order = every[np.argsort(clock[every], kind="stable")]
    lines = [("{}\n[{}]".format(*IMPOSED[runs.layout.imposed]), applied_drive(runs))]
    lines += [
        (f"{s.channel.label}\n[{s.channel.unit}]", s.shown if len(s.angle) else runs[s.channel.column])
        for s in found.signals
    ]
    fig, grid = new_figure(len(lines), 1, 1.9 * len(lines), sharex=True)
    for axes, (label, values), signal in zip(grid[:, 0], lines, (None, *found.signals), strict=True):
        axes.plot(*_thinned(clock[order], values[order]), color=FAINT, lw=0.8)
        for s in found.stretches:
            ends = clock[s.rows[0]], clock[s.rows[-1]]
            if s.why:
                continue
            axes.axvspan(*ends, color="#e3eef7", lw=0, zorder=0)
            mean = s.imposed if signal is None else s.mean[signal.channel.name]
            axes.plot(ends, (mean, mean), color=BLUE if signal is None else VERMILION, lw=2)
        axes.set_ylabel(label, color=INK)
    grid[-1, 0].set_xlabel("time [s], recordings one after the other")
    return fig


def _thinned(x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A line of few points that looks the same: the least and the greatest sample of each group."""
    size = -(-2 * len(x) // POINTS)
    if size <= 2:
        return x, y
    groups = [slice(k, k + size) for k in range(0, len(x), size)]
    with np.errstate(all="ignore"):
        ends = [(np.nanmin(y[g]), np.nanmax(y[g])) if np.isfinite(y[g]).any() else (np.nan, np.nan) for g in groups]
    return np.repeat([x[g][0] for g in groups], 2), np.ravel(ends)
