"""Figures of the resolved running gear: ripple in steady travel, grousers landing, normal reactions."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from mmrjax.model.paper_tables import PITCH_GROUSER, PITCH_TOOTH
from mmrjax.model.robot import Robot
from mmrjax.model.signals import STATUSES
from mmrjax.undercarriage import ripple_peaks
from sweeps.pages.figure_style import (
    BLUE,
    FAINT,
    GREEN,
    INK,
    ORANGE,
    add_corner_note,
    configuration_looks,
    label_line_end,
    new_figure,
)

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
        for words, (values, shade) in lines.items():
            axes.plot(time, values, color=shade, lw=1.4, alpha=0.9)
            if not gear.on_tracks:
                label_offset = {"front wheel": 7, "rear wheel": -7}.get(words, 0)  # they nearly coincide
                label_line_end(axes, time, np.asarray(values), words, shade, offset=(5, label_offset))
            top = max(top, float(np.max(values)))
        axes.set(ylim=(0, 1.25 * top), xlabel="time [ms]", ylabel="normal reaction [N]")
        axes.set_title(title.format(gear.name))
        if gear.on_tracks:
            add_corner_note(axes, "orange: load on the lower guide, above it: load on all grousers")
        else:
            axes.set_xlim(0, 1.3e3 * SHOWN)
    return fig
