"""Figure of a resonance map: Campbell diagram, and below it ripple over speed and payload, on a common speed axis."""

from __future__ import annotations

import numpy as np
from matplotlib import colors
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from mmrjax.model.quantities import MM
from mmrjax.undercarriage.ripple_peaks import MATTERS, SIGNALS
from sweeps.pages import words
from sweeps.pages.figure_style import (
    BLUE,
    FAINT,
    GREEN,
    INK,
    ORANGE,
    PURPLE,
    SKY,
    VERMILION,
    new_figure,
)
from sweeps.report.resonance_report import ResonanceResult, ripple_percent

ORDERS = 8  # lines of the Campbell diagram
MAPS = ("reaction", "current", "speed")
_MARKS = {"reaction": (BLUE, "o"), "current": (VERMILION, "s")}
_BANDS = {"bounce": BLUE, "pitch": ORANGE}
_OTHERS = (GREEN, PURPLE, SKY)
_UNREAD = {"slides": ">", "failed": "x", "tips": "^", "stalled": "_", "too_slow": "|", "battery_empty": "+"}


def draw_resonance_map(found: ResonanceResult) -> Figure:
    """Natural frequencies and harmonics of the passing frequency. Below them, ripple at every speed and payload."""
    rows = len(found.modes)
    heights = [4.4, *(0.5 + 0.2 * rows for _ in MAPS)]
    fig, grid = new_figure(4, 1, sum(heights) + 0.6, sharex=True, height_ratios=heights)
    draw_campbell_diagram(grid[0, 0], found)
    for axes, name in zip(grid[1:, 0], MAPS, strict=True):
        draw_ripple_map(axes, found, name)
    grid[-1, 0].set_xlabel("speed of the robot [mm/s]")
    fastest = np.nanmax(found.table["speed_mean_mm_s"])
    grid[0, 0].set_xlim(0, 1.06 * fastest)
    return fig


def draw_campbell_diagram(axes: Axes, found: ResonanceResult) -> None:
    """Lines n × V / S, bands of natural frequencies, and the strongest line of each run, larger for more ripple."""
    bands = [m.high for modes in found.modes.values() for m in modes if m.resonant]
    lines = [found.table[f"{name}_frequency_Hz"][found.read] for name in _MARKS]
    highest = float(np.nanpercentile(np.concatenate(lines), 90)) if found.read.any() else 0.0
    table, parts, top = found.table, found.passing, 1.15 * max([highest, *bands, 10.0])
    fastest = float(np.nanmax(table["speed_mean_mm_s"]))
    place = np.inf
    for order in range(1, ORDERS + 1):
        at_end = order * fastest * MM / parts.travel
        axes.plot([0, fastest], [0, at_end], color=FAINT, lw=0.8, zorder=1)
        is_inside, last = at_end <= top, place
        place = fastest if is_inside else fastest * 0.985 * top / at_end
        if last - place < 0.03 * fastest and not is_inside:
            break  # labels and lines would overlap
        axes.annotate(
            f"{order}×", (place, min(at_end, 0.985 * top)), xytext=(4, 0) if is_inside else (0, -2),
            textcoords="offset points", color=FAINT, fontsize=8.5, va="center" if is_inside else "top",
            bbox=None if is_inside else dict(boxstyle="round,pad=0.1", fc="white", ec="none"),
        )  # fmt: skip
    _draw_mode_bands(axes, found)
    for name, (colour, marker) in _MARKS.items():
        ripple = table[f"{name}_ripple_percent"][found.read]
        axes.scatter(
            table["speed_mean_mm_s"][found.read], table[f"{name}_frequency_Hz"][found.read],
            s=4 + 60 * (ripple / max(float(np.nanmax(ripple)), 1e-9)) ** 2, marker=marker, color=colour, alpha=0.55,
            lw=0, zorder=3, label=f"{SIGNALS[name].label}, up to {ripple_percent(float(np.nanmax(ripple)))}",
        )  # fmt: skip
    hits = [p for p in found.strong if p.mode]
    axes.scatter(
        [p.speed / MM for p in hits], [p.frequency for p in hits], s=130, marker="*", color="white",
        edgecolor=INK, lw=0.9, zorder=4, label="ripple peaks at a natural frequency: avoid" if hits else None,
    )  # fmt: skip
    axes.set(ylim=(0, top), ylabel="frequency [Hz]")
    heading = f"{found.configuration}: {parts.name} pass every {parts.travel / MM:.4g} mm of travel"
    axes.set_title(heading)
    axes.legend(
        loc="upper center", bbox_to_anchor=(0.5, -0.02), ncols=3, handletextpad=0.2,
        columnspacing=1.2,
        title="a run's strongest line, larger for more ripple (sd / mean):", title_fontsize=8.5, alignment="center",
    )  # fmt: skip


def _draw_mode_bands(axes: Axes, found: ResonanceResult) -> None:
    """One band for each mode, from the smallest to the largest frequency over payloads and positions of the belt."""
    other_colours = iter(_OTHERS * 3)
    names = dict.fromkeys(m.name for modes in found.modes.values() for m in modes if m.resonant)
    for name in names:
        modes = [(p, m) for p, members in found.modes.items() for m in members if m.name == name and m.resonant]
        colour = _BANDS.get(name) or next(other_colours)
        low, high = min(m.low for _, m in modes), max(m.high for _, m in modes)
        axes.axhspan(low, high, color=colour, alpha=0.13, lw=0, zorder=0)
        ends = (modes[0], modes[-1]) if len(modes) > 1 else (modes[0],)
        for payload, mode in ends:
            axes.axhline(mode.frequency, color=colour, lw=1.0, ls="-" if payload == modes[0][0] else "--", zorder=1)
        means = " to ".join(dict.fromkeys(f"{mode.frequency:.0f}" for _, mode in ends))
        loads = " to ".join(dict.fromkeys(f"{payload:g}" for payload, _ in ends))
        axes.annotate(
            f"{name} {means} Hz\n({loads} kg)", (0, (low + high) / 2), xytext=(4, 0), textcoords="offset points",
            va="center", color=colour, fontsize=8.5, fontweight="bold", zorder=5,
            bbox=dict(boxstyle="round,pad=0.15", fc="white", ec="none", alpha=0.75),
        )  # fmt: skip


def draw_ripple_map(axes: Axes, found: ResonanceResult, name: str) -> None:
    """Ripple of one signal over speed, one row per payload. Bars mark peaks to avoid."""
    table, payloads = found.table, list(found.modes)
    ripple = table[f"{name}_ripple_percent"]
    settled = found.read & (table["status"] == "converged")
    shown_ripple = ripple[settled] if settled.any() else ripple[found.read]
    largest_ripple = float(np.nanmax(shown_ripple)) or 1.0
    norm = colors.Normalize(0, largest_ripple)
    guess = found.travel
    for row, payload in enumerate(payloads):
        rows = np.flatnonzero(table["payload_kg"] == payload)
        rows = rows[np.argsort(guess[rows])]
        good = rows[found.read[rows]]
        if len(good) > 1:
            x = guess[good]
            middle = (x[1:] + x[:-1]) / 2
            edges = np.concatenate([[2 * x[0] - middle[0]], middle, [2 * x[-1] - middle[-1]]])
            mesh = axes.pcolormesh(
                edges, [row - 0.5, row + 0.5], ripple[good][None], norm=norm, cmap="YlOrBr", rasterized=True
            )
        for k in rows:
            status = str(table["status"][k])
            if status != "converged" and np.isfinite(guess[k]):
                marker = _UNREAD.get(status, ".")
                axes.scatter(guess[k], row, marker=marker, s=14, color=INK, lw=0.9, zorder=4)
    for p in found.strong:
        if p.signal == name:
            place = (p.low / MM, payloads.index(p.payload) - 0.5)
            axes.add_patch(Rectangle(place, (p.high - p.low) / MM, 1.0, fill=False, ec=INK, lw=1.3, zorder=3,
                                     ls="-" if p.mode else ":"))  # fmt: skip
    axes.set(ylim=(-0.5, len(payloads) - 0.5), ylabel="payload [kg]")
    axes.set_yticks(range(len(payloads)), [f"{p:g}" for p in payloads])
    axes.grid(False)
    other_statuses = [s for s in dict.fromkeys(map(str, table["status"])) if s != "converged"]
    kinds = "; ".join(f"{_UNREAD.get(s, '·').replace('_', '–')} {words.short_status(s)}" for s in other_statuses)
    label = SIGNALS[name].label
    remarks = [] if largest_ripple >= 100 * MATTERS else [f"under {100 * MATTERS:g} %: no speed to avoid"]
    remarks += [kinds] if kinds else []
    axes.set_title(f"Ripple of {label}" + (f"   ({'; '.join(remarks)})" if remarks else ""))
    if len(axes.collections) and "mesh" in locals():
        axes.figure.colorbar(mesh, ax=axes, pad=0.01, aspect=8, label="sd / mean [%]")
