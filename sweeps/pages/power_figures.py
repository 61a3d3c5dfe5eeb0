"""The power chain of runs: what the supply gives and where it is lost on the way to the slope."""

from __future__ import annotations

import itertools

import numpy as np
from matplotlib.figure import Figure

from calibration.data import Columns
from sweeps.pages.figure_style import BLUE, GREEN, INK, ORANGE, PURPLE, SKY, new_figure, outer_legend

#: Where power goes, with its colour: losses in the order of the chain, then what is left.
ITEMS = {
    "winding and motor friction": ORANGE,
    "gearbox": PURPLE,
    "track and slip": BLUE,
    "rolling resistance": SKY,
    "lift": GREEN,
    "back to the supply": INK,
}
_DARK = (PURPLE, BLUE, GREEN, INK)


def power_by_item(runs: Columns) -> Columns:
    """Power [W] of each item, of every run, out of the powers of `runs.csv`.

    Rolling resistance holds the acceleration where a run has not settled.
    """
    chain = [runs[f"power_{place}_W"] for place in ("supply", "motor", "gear", "ground", "lift")]
    losses = [above - below for above, below in itertools.pairwise(chain)]
    ends = [np.maximum(chain[-1], 0.0), np.maximum(-chain[0], 0.0)]
    return dict(zip(ITEMS, [*losses, *ends], strict=True))


def power_sources(runs: Columns) -> tuple[np.ndarray, np.ndarray]:
    """Power [W] that the supply gives, and that the slope gives a run downhill."""
    return np.maximum(runs["power_supply_W"], 0.0), np.maximum(-runs["power_lift_W"], 0.0)


def drawable_runs(runs: Columns) -> np.ndarray:
    """Mask of runs with numbers and without negative losses."""
    parts, given = np.stack(list(power_by_item(runs).values())), sum(power_sources(runs))
    return np.isfinite(parts).all(0) & (parts >= -1e-6 * np.maximum(given, 1.0)).all(0) & (given > 0)


#: Words of an item where the load is a shaft, which takes all that the gearboxes pass on.
ON_SHAFT = {"track and slip": "load"}


def draw_power_chain(runs: Columns, names: list[str], has_ground: bool = True) -> Figure:
    """A bar a run [W], from the motor's losses to the power that lifts the robot, or that the load takes."""
    fig, grid = new_figure(1, 1, 1.15 + 0.42 * len(names))
    axes, parts = grid[0, 0], power_by_item(runs)
    labels = {} if has_ground else ON_SHAFT
    supply, slope = power_sources(runs)
    total = supply + slope
    left = np.zeros(len(names))
    place = np.arange(len(names), dtype=float)
    for item, colour in ITEMS.items():
        value = np.maximum(parts[item], 0.0)
        if value.max() > 1e-6:
            axes.barh(
                place, value, left=left, height=0.7, color=colour, label=labels.get(item, item), ec="white", lw=0.6
            )
        for y, x, width in zip(place, left, value, strict=True):
            if width >= 0.04 * total.max():
                ink = "white" if colour in _DARK else "black"
                axes.text(x + width / 2, y, f"{width:.1f}", ha="center", va="center", fontsize=8, color=ink)
        left = left + value
    for y, watts, given, falls in zip(place, total, supply, slope, strict=True):
        text = f"{given:.1f} W" + (f" + {falls:.1f} W from the slope" if falls > 1e-6 else "")
        axes.text(watts, y, f"  {text}", va="center", fontsize=8.5)
    axes.set_yticks(place, names, fontsize=8.5)
    axes.invert_yaxis()
    axes.grid(False)
    beyond = 1.35 if (slope > 1e-6).any() else 1.1
    axes.set(xlabel="power [W]", xlim=(0, beyond * float(total.max())))
    outer_legend(axes, "upper center")
    return fig
