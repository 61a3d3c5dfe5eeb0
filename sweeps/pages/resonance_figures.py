"""Figures of the running gear: loads and ripple over time, and resonances over speed and payload."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib import colors
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from mmrjax.model.paper_tables import PITCH_GROUSER, PITCH_TOOTH
from mmrjax.model.quantities import MM
from mmrjax.model.robot import Robot
from mmrjax.model.signals import STATUSES
from mmrjax.undercarriage import ripple_peaks
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
    add_corner_note,
    configuration_looks,
    label_line_end,
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


TAIL = 0.3  # duration at the end of a run that is evaluated for ripple [s]
SHOWN = 0.15  # and drawn [s]


@dataclasses.dataclass(frozen=True)
class GearRun:
    """One run of the track model, with its loads.

    Attributes:
        name: heading.
        on_tracks: True on tracks, False on wheels.
        status: status of the run.
        radius: radius of the pulleys [m].
        time: time of the samples [s].
        signals, reactions: signals and reactions at these times.
        guide_share: guide share on average at the end [-].
    """

    name: str
    on_tracks: bool
    status: str
    radius: float
    time: np.ndarray
    signals: Any
    reactions: Any
    guide_share: float

    def tail(self, seconds: float) -> slice:
        """The last `seconds` of the record."""
        return slice(int(np.searchsorted(self.time, self.time[-1] - seconds)), None)

    def settled_since(self, instant: float) -> bool:
        """True if the run after this instant [s] is long enough to evaluate ripple."""
        return bool(instant <= self.time[-1] - TAIL)

    @property
    def rolls(self) -> bool:
        """True if it moved forward on its contacts to the end, so that it has a ripple to show."""
        return self.status in ("converged", "not_settled", "slides")

    @property
    def period(self) -> float:
        """Period of eq. (34) [s] at the mean speed of the driving pulley. The belt also runs on the pulley of wheeled
        robots.
        """
        speed = float(self.signals.speed_wheel[self.tail(TAIL)].mean())
        return ripple_peaks.period_pitch(PITCH_GROUSER if self.on_tracks else PITCH_TOOTH, speed, self.radius)


def gear_runs(
    robot: Robot,
    history: Any,
    status: np.ndarray,
    guide_share: np.ndarray,
    which: Sequence[int],
    names: Sequence[str],
) -> list[GearRun]:
    """Members of a batch of runs whose running gear is resolved.

    Args:
        history: time, signals and reactions of the batch.
        status: codes of how its members ended.
        guide_share: guide share of each member [-].
        which: index of each member's configuration in `robot`.
        names: headings of the members.
    """
    import jax

    answer = []
    for k, name in enumerate(names):
        on_tracks = float(robot.configurations.members[int(which[k])].on_tracks) > 0.5
        over_time = (history.time, history.signals, history.reactions)
        time, signals, reactions = jax.tree.map(lambda x, k=k: np.asarray(x[k]), over_time)
        status_word, share = STATUSES[int(status[k])], float(guide_share[k])
        answer.append(
            GearRun(name, on_tracks, status_word, float(robot.radius_pulley), time, signals, reactions, share)
        )
    return answer


def ripple_row(gear: GearRun) -> tuple[Any, ...]:
    """Row of the table of ripples: run, pitch, period measured and by eq. (34), amplitudes, load on the guides."""
    tail, signals = gear.tail(TAIL), gear.signals
    shown = signals.total_current, signals.speed, signals.normal
    ripples = [ripple_peaks.measure_ripple(gear.time[tail], x[tail]) for x in shown]
    pitch = "grousers, S_g = 35 mm" if gear.on_tracks else "teeth, S_t = 5 mm"
    amplitudes = (100 * amplitude for _, amplitude, _ in ripples)
    on_guides = 100 * gear.guide_share if gear.on_tracks else None
    return gear.name, pitch, 1e3 * ripples[0][2], 1e3 * gear.period, *amplitudes, on_guides


def draw_current_ripple(shown: list[GearRun], title: str = "{}") -> Figure:
    """Total current over the last `SHOWN` seconds of each run, with the period expected from eq. (34)."""
    fig, grid = new_figure(1, len(shown), 3.0)
    look = configuration_looks(gear.name for gear in shown)
    for axes, gear in zip(grid[0], shown, strict=True):
        shown_samples, expected = gear.tail(SHOWN), gear.period
        time, current = gear.time[shown_samples], gear.signals.total_current[shown_samples]
        axes.plot(1e3 * (time - time[0]), current, color=look[gear.name][0])
        axes.axhline(current.mean(), color=FAINT, lw=0.9)
        low, high = current.min(), current.max()
        span = max(high - low, 1e-6)
        axes.set(ylim=(low - 0.2 * span, high + 0.45 * span), xlabel="time [ms]", ylabel="total current [A]")
        axes.ticklabel_format(axis="y", useOffset=False)
        start = 1e3 * (time[int(np.argmax(current[: len(current) // 2]))] - time[0])
        level = high + 0.12 * span
        arrow = dict(arrowstyle="<->", color=INK, lw=1.0)
        axes.annotate("", (start, level), (start + 1e3 * expected, level), arrowprops=arrow)
        axes.text(start, level + 0.05 * span, f"{1e3 * expected:.1f} ms, eq. (34)", fontsize=8.5, va="bottom")
        axes.set_title(title.format(gear.name))
    return fig


def draw_touchdowns(gear: GearRun, title: str = "grousers land (dotted)") -> Figure:
    """Current of a run on tracks over time with touchdowns marked, above the load on each grouser."""
    fig, grid = new_figure(2, 1, 5.0, sharex=True)
    shown_samples = gear.tail(SHOWN)
    time = 1e3 * (gear.time[shown_samples] - gear.time[shown_samples][0])
    lands = ripple_peaks.touchdown_times(
        time, gear.reactions.grouser[shown_samples], gear.reactions.place[shown_samples]
    )
    upper, lower = grid[:, 0]
    upper.plot(time, gear.signals.total_current[shown_samples], color=BLUE)
    upper.set(ylabel="total current [A]")
    upper.set_title(title)
    shades = (BLUE, ORANGE, GREEN)
    loads = gear.reactions.grouser[shown_samples]
    for j in range(loads.shape[1]):
        is_loaded = loads[:, j] > 0
        if is_loaded.any():
            lower.plot(time, np.where(is_loaded, loads[:, j], np.nan), color=shades[j % 3], lw=1.0)
    lower.set(xlabel="time [ms]", ylabel="normal reaction of a grouser [N]", ylim=(0, None))
    for axes in (upper, lower):
        for instant in lands:
            axes.axvline(instant, color=INK, lw=0.9, ls=":")
    return fig


def draw_reactions(shown: list[GearRun], title: str = "{}, one side") -> Figure:
    """Normal reactions of one side: of all grousers and the lower guide on tracks, of both wheels on wheels."""
    fig, grid = new_figure(1, len(shown), 3.2)
    look = configuration_looks(gear.name for gear in shown)
    for axes, gear in zip(grid[0], shown, strict=True):
        shown_samples, colour = gear.tail(SHOWN), look[gear.name][0]
        loads = gear.reactions
        lines = (
            {
                "all grousers": (loads.grouser[shown_samples].sum(-1), colour),
                "lower guide": (loads.guided[shown_samples].sum(-1), ORANGE),
            }
            if gear.on_tracks
            else {
                "both wheels": (loads.support[shown_samples].sum(-1), colour),
                "front wheel": (loads.support[shown_samples, 0], BLUE),
                "rear wheel": (loads.support[shown_samples, 1], GREEN),
            }
        )
        time = 1e3 * (gear.time[shown_samples] - gear.time[shown_samples][0])
        top = 0.0
        for label, (values, shade) in lines.items():
            axes.plot(time, values, color=shade, lw=1.4, alpha=0.9)
            if not gear.on_tracks:
                label_offset = {"front wheel": 7, "rear wheel": -7}.get(label, 0)  # they nearly coincide
                label_line_end(axes, time, np.asarray(values), label, shade, offset=(5, label_offset))
            top = max(top, float(np.max(values)))
        axes.set(ylim=(0, 1.25 * top), xlabel="time [ms]", ylabel="normal reaction [N]")
        axes.set_title(title.format(gear.name))
        if gear.on_tracks:
            add_corner_note(axes, "orange: load on the lower guide, above it: load on all grousers")
        else:
            axes.set_xlim(0, 1.3e3 * SHOWN)
    return fig
