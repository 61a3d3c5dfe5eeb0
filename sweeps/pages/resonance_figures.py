"""Figures of the running gear: loads and ripple over time, and resonances over speed and payload."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib import colors
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
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
    configuration_looks,
    new_figure,
)
from sweeps.report.resonance_report import ResonanceResult, ripple_percent

ORDERS = 8  # lines of the Campbell diagram
MAPS = ("reaction", "current", "speed")
_MARKS = {"reaction": (BLUE, "o"), "current": (VERMILION, "s")}
_BANDS = {"bounce": BLUE, "pitch": ORANGE}
_OTHERS = (GREEN, PURPLE, SKY)
_STATUS_MARKERS = {"slides": ">", "failed": "x", "tips": "^", "stalled": "_", "too_slow": "|", "battery_empty": "+"}


def draw_resonance_map(result: ResonanceResult) -> Figure:
    """Natural frequencies and harmonics of the passing frequency. Below them, ripple at every speed and payload."""
    heights = [4.4, *[0.5 + 0.2 * len(result.modes)] * len(MAPS)]
    fig, grid = new_figure(4, 1, sum(heights) + 0.6, sharex=True, height_ratios=heights)
    campbell, *maps = grid[:, 0]
    _draw_campbell_diagram(campbell, result)
    for axes, name in zip(maps, MAPS, strict=True):
        _draw_ripple_map(axes, result, name)
    maps[-1].set_xlabel("speed of the robot [mm/s]")
    campbell.set_xlim(0, 1.06 * np.nanmax(result.table["speed_mean_mm_s"]))
    return fig


def _draw_campbell_diagram(axes: Axes, result: ResonanceResult) -> None:
    """Lines n × V / S, bands of natural frequencies, and the strongest line of each run, larger for more ripple."""
    table, passing, is_evaluated = result.table, result.passing, result.is_evaluated
    bands = [m.high for modes in result.modes.values() for m in modes if m.resonant]
    lines = [table[f"{name}_frequency_Hz"][is_evaluated] for name in _MARKS]
    highest = float(np.nanpercentile(np.concatenate(lines), 90)) if is_evaluated.any() else 0.0
    top = 1.15 * max([highest, *bands, 10.0])
    fastest = float(np.nanmax(table["speed_mean_mm_s"]))
    label_speed = np.inf
    for order in range(1, ORDERS + 1):
        end_frequency = order * fastest * MM / passing.travel
        previous_label_speed = label_speed
        axes.plot([0, fastest], [0, end_frequency], color=FAINT, lw=0.8, zorder=1)
        label_speed = fastest * min(1.0, 0.985 * top / end_frequency)
        if end_frequency > top and previous_label_speed - label_speed < 0.03 * fastest:
            break  # labels and lines would overlap
        axes.annotate(f"{order}×", (label_speed, min(end_frequency, 0.985 * top)), xytext=(4, 0),
                      textcoords="offset points", color=FAINT,
                      va="center" if end_frequency <= top else "top")  # fmt: skip
    _draw_mode_bands(axes, result)
    for name, (colour, marker) in _MARKS.items():
        ripple = table[f"{name}_ripple_percent"][is_evaluated]
        largest_ripple = float(np.nanmax(ripple))
        axes.scatter(
            table["speed_mean_mm_s"][is_evaluated], table[f"{name}_frequency_Hz"][is_evaluated],
            s=4 + 60 * (ripple / max(largest_ripple, 1e-9)) ** 2, marker=marker, color=colour, alpha=0.55, lw=0,
            zorder=3, label=f"{SIGNALS[name].label}, up to {ripple_percent(largest_ripple)}",
        )  # fmt: skip
    confirmed = [p for p in result.strong_peaks if p.mode]
    axes.scatter(
        [p.speed / MM for p in confirmed], [p.frequency for p in confirmed], s=130, marker="*", color="white",
        edgecolor=INK, lw=0.9, zorder=4, label="ripple peaks at a natural frequency: avoid" if confirmed else None,
    )  # fmt: skip
    heading = f"{result.configuration}: {passing.name} pass every {passing.travel / MM:.4g} mm of travel"
    axes.set(ylim=(0, top), ylabel="frequency [Hz]", title=heading)
    axes.legend(
        loc="upper center", bbox_to_anchor=(0.5, -0.02), ncols=3, handletextpad=0.2, columnspacing=1.2,
        title="a run's strongest line, larger for more ripple (sd / mean):", alignment="center",
    )  # fmt: skip


def _draw_mode_bands(axes: Axes, result: ResonanceResult) -> None:
    """One band for each mode, from the smallest to the largest frequency over payloads and positions of the belt."""
    other_colours = iter(_OTHERS * 3)
    names = dict.fromkeys(m.name for modes in result.modes.values() for m in modes if m.resonant)
    for name in names:
        modes = [(p, m) for p, members in result.modes.items() for m in members if m.name == name and m.resonant]
        colour = _BANDS.get(name) or next(other_colours)
        low, high = min(m.low for _, m in modes), max(m.high for _, m in modes)
        axes.axhspan(low, high, color=colour, alpha=0.13, lw=0, zorder=0)
        ends = {modes[0][0]: modes[0][1], modes[-1][0]: modes[-1][1]}
        for mode, style in zip(ends.values(), ("-", "--"), strict=False):
            axes.axhline(mode.frequency, color=colour, lw=1.0, ls=style, zorder=1)
        means = " to ".join(dict.fromkeys(f"{mode.frequency:.0f}" for mode in ends.values()))
        loads = " to ".join(f"{payload:g}" for payload in ends)
        axes.annotate(
            f"{name} {means} Hz\n({loads} kg)", (0, (low + high) / 2), xytext=(4, 0), textcoords="offset points",
            va="center", color=colour, fontweight="bold", zorder=5,
            bbox=dict(boxstyle="round,pad=0.15", fc="white", ec="none", alpha=0.75),
        )  # fmt: skip


def _draw_ripple_map(axes: Axes, result: ResonanceResult, name: str) -> None:
    """Ripple of one signal over speed, one row per payload. Bars mark peaks to avoid."""
    table = result.table
    payloads = list(result.modes)
    speed = result.run_speeds
    ripple = table[f"{name}_ripple_percent"]
    is_unsettled = table["status"] != "converged"
    is_settled = result.is_evaluated & ~is_unsettled
    largest = float(np.nanmax(ripple[is_settled if is_settled.any() else result.is_evaluated])) or 1.0
    norm = colors.Normalize(0, largest)
    for row, payload in enumerate(payloads):
        rows = np.flatnonzero(table["payload_kg"] == payload)
        rows = rows[np.argsort(speed[rows])]
        evaluated_rows = rows[result.is_evaluated[rows]]
        if len(evaluated_rows) > 1:
            x = speed[evaluated_rows]
            middle = (x[1:] + x[:-1]) / 2
            edges = np.concatenate([[2 * x[0] - middle[0]], middle, [2 * x[-1] - middle[-1]]])
            axes.pcolormesh(edges, [row - 0.5, row + 0.5], ripple[evaluated_rows][None], norm=norm, cmap="YlOrBr",
                            rasterized=True)  # fmt: skip
        for k in rows[is_unsettled[rows] & np.isfinite(speed[rows])]:
            marker = _STATUS_MARKERS.get(str(table["status"][k]), ".")
            axes.scatter(speed[k], row, marker=marker, s=14, color=INK, lw=0.9, zorder=4)
    for p in result.strong_peaks:
        if p.signal == name:
            place = (p.low / MM, payloads.index(p.payload) - 0.5)
            axes.add_patch(Rectangle(place, (p.high - p.low) / MM, 1.0, fill=False, ec=INK, lw=1.3, zorder=3,
                                     ls="-" if p.mode else ":"))  # fmt: skip
    axes.set(ylim=(-0.5, len(payloads) - 0.5), ylabel="payload [kg]")
    axes.set_yticks(range(len(payloads)), [f"{p:g}" for p in payloads])
    axes.grid(False)
    axes.figure.colorbar(ScalarMappable(norm, "YlOrBr"), ax=axes, pad=0.01, aspect=8, label="sd / mean [%]")
    remarks = [] if largest >= 100 * MATTERS else [f"under {100 * MATTERS:g} %: no speed to avoid"]
    statuses = dict.fromkeys(map(str, table["status"][is_unsettled]))
    remarks += [f"{_STATUS_MARKERS.get(s, '·').replace('_', '–')} {words.short_status(s)}" for s in statuses]
    axes.set_title(f"Ripple of {SIGNALS[name].label}" + (f"   ({'; '.join(remarks)})" if remarks else ""))


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
    def drawn_time(self) -> np.ndarray:
        """Time since the start of the drawn part [ms]."""
        time = self.time[self.tail(SHOWN)]
        return 1e3 * (time - time[0])

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
    configuration_indices: Sequence[int],
    names: Sequence[str],
) -> list[GearRun]:
    """Members of a batch of runs whose running gear is resolved.

    Args:
        history: time, signals and reactions of the batch.
        status: codes of how its members ended.
        guide_share: guide share of each member [-].
        configuration_indices: index of each member's configuration in `robot`.
        names: headings of the members.
    """
    import jax

    gears = []
    for k, name in enumerate(names):
        on_tracks = float(robot.configurations.members[int(configuration_indices[k])].on_tracks) > 0.5
        over_time = (history.time, history.signals, history.reactions)
        time, signals, reactions = jax.tree.map(lambda x, k=k: np.asarray(x[k]), over_time)
        status_word = STATUSES[int(status[k])]
        share = float(guide_share[k])
        gears.append(
            GearRun(name, on_tracks, status_word, float(robot.radius_pulley), time, signals, reactions, share)
        )
    return gears


def ripple_row(gear: GearRun) -> tuple[Any, ...]:
    """Row of the table of ripples: run, pitch, period measured and by eq. (34), amplitudes, load on the guides."""
    tail = gear.tail(TAIL)
    signals = gear.signals
    drawn_signals = signals.total_current, signals.speed, signals.normal
    ripples = [ripple_peaks.measure_ripple(gear.time[tail], x[tail]) for x in drawn_signals]
    pitch = "grousers, S_g = 35 mm" if gear.on_tracks else "teeth, S_t = 5 mm"
    amplitudes = (100 * amplitude for _, amplitude, _ in ripples)
    on_guides = 100 * gear.guide_share if gear.on_tracks else None
    return gear.name, pitch, 1e3 * ripples[0][2], 1e3 * gear.period, *amplitudes, on_guides


def draw_current_ripple(gears: list[GearRun], title: str = "{}") -> Figure:
    """Total current over the last `SHOWN` seconds of each run, with the period expected from eq. (34)."""
    fig, (panels,) = new_figure(1, len(gears), 3.0)
    looks = configuration_looks(gear.name for gear in gears)
    for axes, gear in zip(panels, gears, strict=True):
        time = gear.drawn_time
        current = gear.signals.total_current[gear.tail(SHOWN)]
        period = 1e3 * gear.period
        axes.plot(time, current, color=looks[gear.name][0])
        axes.axhline(current.mean(), color=FAINT, lw=0.9)
        low, high = current.min(), current.max()
        span = max(high - low, 1e-6)
        axes.set(ylim=(low - 0.2 * span, high + 0.45 * span), xlabel="time [ms]", ylabel="total current [A]")
        axes.ticklabel_format(axis="y", useOffset=False)
        start = time[int(np.argmax(current[: len(current) // 2]))]
        level = high + 0.12 * span
        arrow = dict(arrowstyle="<->", color=INK, lw=1.0)
        axes.annotate("", (start, level), (start + period, level), arrowprops=arrow)
        axes.text(start, level + 0.05 * span, f"{period:.1f} ms, eq. (34)", va="bottom")
        axes.set_title(title.format(gear.name))
    return fig


def draw_touchdowns(gear: GearRun, title: str = "grousers land (dotted)") -> Figure:
    """Current of a run on tracks over time with touchdowns marked, above the load on each grouser."""
    fig, ((upper,), (lower,)) = new_figure(2, 1, 5.0, sharex=True)
    rows = gear.tail(SHOWN)
    time = gear.drawn_time
    loads = gear.reactions.grouser[rows]
    upper.plot(time, gear.signals.total_current[rows], color=BLUE)
    upper.set(ylabel="total current [A]", title=title)
    for load, colour in zip(loads.T, itertools.cycle((BLUE, ORANGE, GREEN)), strict=False):
        if (load > 0).any():
            lower.plot(time, np.where(load > 0, load, np.nan), color=colour, lw=1.0)
    lower.set(xlabel="time [ms]", ylabel="normal reaction of a grouser [N]", ylim=(0, None))
    for instant in ripple_peaks.touchdown_times(time, loads, gear.reactions.place[rows]):
        upper.axvline(instant, color=INK, lw=0.9, ls=":")
        lower.axvline(instant, color=INK, lw=0.9, ls=":")
    return fig


def draw_reactions(gears: list[GearRun], title: str = "{}, one side") -> Figure:
    """Normal reactions of one side: of all grousers and the lower guide on tracks, of both wheels on wheels."""
    fig, (panels,) = new_figure(1, len(gears), 3.2)
    looks = configuration_looks(gear.name for gear in gears)
    for axes, gear in zip(panels, gears, strict=True):
        loads = gear.reactions
        rows = gear.tail(SHOWN)
        colour = looks[gear.name][0]
        if gear.on_tracks:
            lines = {
                "all grousers": (loads.grouser[rows].sum(-1), colour),
                "lower guide": (loads.guided[rows].sum(-1), ORANGE),
            }
        else:
            wheels = loads.support[rows]
            lines = {
                "both wheels": (wheels.sum(-1), colour), "front wheel": (wheels[:, 0], BLUE),
                "rear wheel": (wheels[:, 1], GREEN),
            }  # fmt: skip
        for label, (values, shade) in lines.items():
            axes.plot(gear.drawn_time, values, color=shade, lw=1.4, alpha=0.9, label=label)
        top = max(float(np.max(values)) for values, _ in lines.values())
        axes.set(
            ylim=(0, 1.25 * top), xlabel="time [ms]", ylabel="normal reaction [N]", title=title.format(gear.name)
        )
        axes.legend(loc="upper center", ncols=3)
    return fig
