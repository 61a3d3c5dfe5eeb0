"""The figure of a sheet of requirements: margins as bars."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure

from sweeps.pages.figure_style import FAINT, GREEN, INK, VERMILION, is_narrow, new_figure
from sweeps.report.check_report import (
    CheckResult,
    reached_value_text,
    required_value_text,
    requirement_label,
    requirement_limit,
)

#: Margins beyond are drawn so far [%]; their number says how large they are.
LONGEST = 100.0


def draw_margins(found: CheckResult) -> Figure:
    """A bar for each requirement: its margin in percent of what is required, right where it is met.

    The values reached are left out for phones, where the page's table shows them.
    """
    rows = found.outcomes
    fig, axes = new_figure(1, 1, 0.9 + 0.42 * len(rows))
    ax = axes[0, 0]
    for k, o in enumerate(rows):
        if o.margin is None:
            ax.text(
                -1.5, k, f"no value: {reached_value_text(o)}", va="center", ha="right", color=VERMILION, fontsize=8.5
            )
            continue
        share = 100 * o.margin / max(abs(requirement_limit(o)), 1e-12)
        drawn = float(np.clip(share, -LONGEST, LONGEST))
        ax.barh(k, drawn, height=0.62, color=GREEN if o.met else VERMILION)
        beyond = "" if abs(share) <= LONGEST or is_narrow() else " (beyond the axis)"
        right = drawn >= 0
        reached = "" if is_narrow() else f"{reached_value_text(o)}, "
        ax.annotate(
            f"{reached}{share:+.0f} %{beyond}", (drawn, k), xytext=(5 if right else -5, 0),
            textcoords="offset points", va="center", ha="left" if right else "right", fontsize=8.5, color=INK,
        )  # fmt: skip
    ax.set_yticks(range(len(rows)), [f"{requirement_label(o)} {required_value_text(o)}" for o in rows])
    ax.set_ylim(len(rows) - 0.4, -0.6)
    ax.set_xlim(-1.45 * LONGEST, 1.6 * LONGEST)
    ax.set_xticks(np.arange(-100, 101, 100 if is_narrow() else 50))
    ax.axvline(0, color=INK, linewidth=1)
    ax.grid(axis="y", visible=False)
    ax.set_xlabel("margin [% of what is required]")
    ax.text(0.005, 1.01, "missed", transform=ax.transAxes, color=FAINT, fontsize=8.5, ha="left", va="bottom")
    ax.text(0.995, 1.01, "met", transform=ax.transAxes, color=FAINT, fontsize=8.5, ha="right", va="bottom")
    return fig
