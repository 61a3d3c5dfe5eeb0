"""Figures of the paper's runs: over slope (Figs. 28, 29), row by row, and uses of power."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from calibration.inference import simulation_errors
from mmrjax.model.paper_tables import TRACKED
from mmrjax.model.robot import Robot
from sweeps.pages.figure_style import (
    BLUE,
    GREEN,
    INK,
    PURPLE,
    SKY,
    VERMILION,
    add_corner_note,
    label_line_end,
    new_figure,
)
from sweeps.pages.words import displayed_robot_name
from sweeps.paper import data
from sweeps.paper.components import MODEL

_MODES = {1: (BLUE, "o"), 2: (SKY, "v"), 3: (GREEN, "^"), 4: (VERMILION, "s")}


def current_over_slope(robot: Robot, rows: data.PaperRows, certainty: Sequence[Sequence[Any]]) -> Figure:
    """Fig. 28: total current over slope in four loading modes, with the measured points and R² (A1).

    Args:
        certainty: R² from `data.slope_certainty`.
    """
    slopes = np.linspace(0, 20, 81)
    lines = data.current_over_slope(robot, rows.ratio, slopes)
    fig, grid = new_figure(1, len(rows.ratio), 4.4, sharey=True)
    for axes, kind in zip(grid[0], rows.ratio, strict=True):
        for mode in data.MODES:
            colour, marker = _MODES[mode]
            own, raised = lines[kind, mode]
            axes.plot(slopes, raised, "--", color=colour, lw=1.3)
            axes.plot(slopes, own, color=colour)
            stop = np.nonzero(np.isfinite(own))[0]
            if stop.size and stop[-1] < len(slopes) - 1:
                axes.plot(slopes[stop[-1]], own[stop[-1]], "x", color=colour, ms=7, mew=2)
            label_line_end(axes, slopes, raised, f"{mode}", colour, fontweight="bold", offset=(5 + 9 * (mode % 2), 0))
            pick = data.rows_of_mode(rows, kind, mode)
            if pick.any():
                table = rows.conditions["slope_deg"][pick]
                axes.plot(table, rows.measured[pick, 0], marker, color=colour, ms=6.5, mec=INK, mew=0.8)
        axes.set(xlabel="slope [°]", xticks=[0, 5, 10, 15, 20], xlim=(-0.5, 20.9))
        axes.set_title(kind)
        texts = [
            f"mode {mode}: R² {weighed:.3f} (straight fit {straight:.3f})"
            for name, mode, straight, *_, weighed in certainty
            if name == kind
        ]
        add_corner_note(axes, "markers: measured\n" + "\n".join(texts), fontsize=8.5)
    grid[0, 0].set_ylim(0, 1.2 * grid[0, 0].dataLim.y1 if np.isfinite(grid[0, 0].dataLim.y1) else 1.0)
    grid[0, 0].set_ylabel("total current [A]")
    modes = "     ".join(f"{m}: {u:g} V, {p:g} kg" for m, (u, p) in data.MODES.items())
    fig.supxlabel(
        f"loading modes   {modes}\nsolid: own adhesion, × where the robot begins to slide, dashed: adhesion raised",
        fontsize=9,
    )
    return fig


def model_errors(robots: dict[str, Robot], rows: dict[str, data.PaperRows]) -> Figure:
    """Fig. 29: errors (35) in current and speed over slope, 6T2A, modes 1 and 2, adhesion raised."""
    fig, grid = new_figure(2, 2, 6.2, sharex=True)
    slopes = np.array([0.0, 5.0, 10.0, 15.0, 20.0])
    for name, robot in robots.items():
        ratio = rows[name].ratio[TRACKED]
        colour = MODEL.get(name, PURPLE)
        for battery in (False, True):
            if battery and name == "sm1":
                continue  # SM-1 and SM-2 share the constant battery; the paper draws one
            for mode, error in data.supply_errors(robot, ratio, rows[name], battery).items():
                for row, channel in ((0, 0), (1, 2)):
                    axes = grid[row, mode - 1]
                    axes.plot(slopes, error[:, channel], ":" if battery else "-", color=colour, marker="o", ms=4)
    from matplotlib.lines import Line2D

    handles = [
        Line2D([], [], color=MODEL.get(n, PURPLE), marker="o", ms=4, label=displayed_robot_name(n)) for n in robots
    ]
    handles.append(Line2D([], [], color=INK, ls=":", marker="o", ms=4, label="on a full battery (mode 2)"))
    paper = simulation_errors.relative_error(next(iter(rows.values())).paper, next(iter(rows.values())).measured)
    table = next(iter(rows.values())).conditions
    for mode, voltage in ((1, 15.0), (2, 33.0)):
        pick = (table["configuration"] == TRACKED) & (table["supply_voltage_V"] == voltage)
        for row, channel in ((0, 0), (1, 2)):
            grid[row, mode - 1].plot(slopes, paper[pick, channel], "-", color=INK, marker="d", ms=5, lw=1)
    handles.append(Line2D([], [], color=INK, marker="d", ms=5, lw=1, label="the paper's own simulation"))
    for row, label in ((0, "error in current [%]"), (1, "error in speed [%]")):
        for mode in (1, 2):
            axes = grid[row, mode - 1]
            axes.axhspan(-7, 7, color="#eef3ee", zorder=0)
            axes.axhline(0, color="#666666", lw=0.9)
            axes.set_xticks(slopes)
        low = min(a.get_ylim()[0] for a in grid[row])
        high = max(a.get_ylim()[1] for a in grid[row])
        for axes in grid[row]:
            axes.set_ylim(low, high)
        grid[row, 0].set_ylabel(label)
    grid[0, 0].set_title("mode 1: 15 V, 0 kg")
    grid[0, 1].set_title("mode 2: 33 V, 8 kg")
    add_corner_note(
        grid[0, 0], "shaded: ±7 %, the paper's claim", x=0.02, y=0.04, va="bottom", fontsize=8, color="#447744"
    )
    for axes in grid[1]:
        axes.set_xlabel("slope [°]")
    labels = [str(h.get_label()) for h in handles]
    fig.legend(handles=handles, loc="outside lower center", ncols=len(labels))
    return fig
