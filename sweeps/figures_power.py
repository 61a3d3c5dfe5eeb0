"""The power chain of runs: what the supply gives and where it is lost on the way to the slope."""

from __future__ import annotations

import itertools

import numpy as np
from matplotlib.figure import Figure

from sweeps.figures_style import BLUE, GREEN, INK, ORANGE, PURPLE, SKY, figure

#: Items of the chain with their colours; each is the difference of two powers of `runs.csv`.
ITEMS = {
    "winding and motor friction": ORANGE,
    "gearbox": PURPLE,
    "track and slip": BLUE,
    "rolling resistance": SKY,
    "lift": GREEN,
}
_DARK = (PURPLE, BLUE, GREEN)


def split(runs: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Power [W] of each item, of every run; rolling resistance holds the acceleration where a run has not settled."""
    chain = [runs[f"power_{at}_W"] for at in ("supply", "motor", "gear", "ground", "lift")]
    parts = [above - below for above, below in itertools.pairwise(chain)]
    return dict(zip(ITEMS, [*parts, chain[-1]], strict=True))


def drawable(runs: dict[str, np.ndarray]) -> np.ndarray:
    """Which runs are a chain of losses: numbers, and power that flows from the supply to the ground throughout."""
    parts = np.stack(list(split(runs).values()))
    return np.isfinite(parts).all(0) & (parts >= -1e-6).all(0) & (runs["power_supply_W"] > 0)


def chain(runs: dict[str, np.ndarray], names: list[str]) -> Figure:
    """A bar a run [W], from the motor's losses to the power that lifts the robot."""
    fig, grid = figure(1, 1, 1.15 + 0.42 * len(names))
    axes, parts = grid[0, 0], split(runs)
    total = runs["power_supply_W"]
    left = np.zeros(len(names))
    place = np.arange(len(names), dtype=float)
    for item, colour in ITEMS.items():
        value = np.maximum(parts[item], 0.0)
        if value.max() > 0:
            axes.barh(place, value, left=left, height=0.7, color=colour, label=item, ec="white", lw=0.6)
        for y, x, width in zip(place, left, value, strict=True):
            if width >= 0.04 * total.max():
                ink = "white" if colour in _DARK else INK
                axes.text(x + width / 2, y, f"{width:.1f}", ha="center", va="center", fontsize=8, color=ink)
        left = left + value
    for y, watts in zip(place, total, strict=True):
        axes.text(watts, y, f"  {watts:.1f} W", va="center", fontsize=8.5)
    axes.set_yticks(place, names, fontsize=8.5)
    axes.invert_yaxis()
    axes.grid(False)
    axes.set(xlabel="power taken from the supply [W]", xlim=(0, 1.1 * float(total.max())))
    fig.legend(*axes.get_legend_handles_labels(), loc="outside upper center", ncols=len(ITEMS))
    return fig
