"""Figures 25-27 from the track model: ripple in steady travel, grousers landing, normal reactions."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from mmrjax.fidelities import ripple
from mmrjax.fidelities.stability import largest_step
from mmrjax.fidelities.track import STEP, Trajectory, track_batch
from mmrjax.robot import CONFIGURATIONS, Robot
from mmrjax.signals import CONVERGED, NOT_SETTLED, SLIDES
from mmrjax.tables import PITCH_GROUSER, PITCH_TOOTH
from sweeps.figures_data import command
from sweeps.figures_style import BLUE, CONFIGURATION, FAINT, GREEN, INK, ORANGE, figure, label_end, note

SECONDS = 1.5  # of a run
SAMPLE = 5e-4  # of its record [s]
TAIL = 0.3  # of it at the end that is looked at for ripple [s]
SHOWN = 0.15  # and drawn [s]


def runs(robot: Robot) -> Trajectory:
    """6T2A and 4W2T from standstill on the flat at 33 V without payload, in NumPy.

    A robot too stiff for the model's usual step is run with a smaller one.
    """
    import jax

    conditions = command(robot, configuration=np.array(CONFIGURATIONS), voltage=33.0)
    step = min(STEP, float(largest_step(robot, conditions).min()))
    step = SAMPLE / math.ceil(SAMPLE / step * (1 - 1e-9))
    return jax.device_get(track_batch(robot, conditions, duration=SECONDS, sample=SAMPLE, step=step))


def drives(run: Trajectory) -> bool:
    """Whether both runs moved forward on their contacts to the end, so that there is a ripple to show."""
    return bool(np.isin(np.asarray(run.result.status), (CONVERGED, NOT_SETTLED, SLIDES)).all())


def _tail(run: Trajectory, seconds: float) -> slice:
    return slice(int(np.searchsorted(run.time[0], run.time[0, -1] - seconds)), None)


def _pitch(k: int) -> tuple[float, str]:
    return (PITCH_TOOTH, "teeth, S_t = 5 mm") if k else (PITCH_GROUSER, "grousers, S_g = 35 mm")


def _period(robot: Robot, run: Trajectory, k: int) -> float:
    """Eq. (34) [s], at the mean speed of the driving pulley; the belt runs on the pulley on wheels too."""
    speed = float(run.signals.speed_wheel[k, _tail(run, TAIL)].mean())
    return ripple.period_pitch(_pitch(k)[0], speed, float(robot.configurations["6T2A"].radius))


def ripple_of_current(robot: Robot, run: Trajectory) -> tuple[Figure, list[dict[str, Any]]]:
    """Fig. 25: total current at the end of the run, and what ripples by how much."""
    fig, grid = figure(1, 2, 3.0)
    facts = []
    for k, (axes, kind) in enumerate(zip(grid[0], CONFIGURATIONS, strict=True)):
        shown, tail, expected = _tail(run, SHOWN), _tail(run, TAIL), _period(robot, run, k)
        time, current = run.time[k, shown], run.signals.total_current[k, shown]
        axes.plot(1e3 * (time - time[0]), current, color=CONFIGURATION[kind])
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
        axes.set_title(f"Fig. 25: {kind}")
        found = {
            name: ripple.ripple(run.time[k, tail], np.asarray(getattr(run.signals, name)[k, tail]))
            for name in ("total_current", "speed", "normal")
        }
        facts.append(
            {
                "configuration": kind,
                "pitch": _pitch(k)[1],
                "period_ms": 1e3 * found["total_current"].period,
                "equation_ms": 1e3 * expected,
                "current_percent": 100 * found["total_current"].amplitude,
                "speed_percent": 100 * found["speed"].amplitude,
                "reaction_percent": 100 * found["normal"].amplitude,
                "guide_percent": None if k else 100 * float(run.steady.guide_share[k]),
            }
        )
    return fig, facts


def touchdown(robot: Robot, run: Trajectory) -> Figure:
    """Fig. 26: current of 6T2A over time with touchdowns marked, above the load on each grouser."""
    fig, grid = figure(2, 1, 5.0, sharex=True)
    shown = _tail(run, SHOWN)
    time = 1e3 * (run.time[0, shown] - run.time[0, shown][0])
    lands = ripple.touchdowns(time, run.reactions.grouser[0, shown], run.reactions.place[0, shown])
    upper, lower = grid[:, 0]
    upper.plot(time, run.signals.total_current[0, shown], color=CONFIGURATION["6T2A"])
    upper.set(ylabel="total current [A]")
    upper.set_title("Fig. 26: grousers land (dotted)")
    shades = (BLUE, ORANGE, GREEN)
    loads = np.asarray(run.reactions.grouser[0, shown])
    for j in range(loads.shape[1]):
        bears = loads[:, j] > 0
        if bears.any():
            lower.plot(time, np.where(bears, loads[:, j], np.nan), color=shades[j % 3], lw=1.0)
    lower.set(xlabel="time [ms]", ylabel="normal reaction of a grouser [N]", ylim=(0, None))
    for axes in (upper, lower):
        for instant in lands:
            axes.axvline(instant, color=INK, lw=0.9, ls=":")
    return fig


def reactions(run: Trajectory) -> Figure:
    """Fig. 27: normal reactions of one side, 6T2A (total, guide) and 4W2T (front, rear, total)."""
    fig, grid = figure(1, 2, 3.2)
    shown = _tail(run, SHOWN)
    lines = (
        {
            "all grousers": (run.reactions.grouser[0, shown].sum(-1), CONFIGURATION["6T2A"]),
            "lower guide": (run.reactions.guided[0, shown].sum(-1), ORANGE),
        },
        {
            "both wheels": (run.reactions.support[1, shown].sum(-1), CONFIGURATION["4W2T"]),
            "front wheel": (run.reactions.support[1, shown, 0], BLUE),
            "rear wheel": (run.reactions.support[1, shown, 1], GREEN),
        },
    )
    for k, (axes, kind) in enumerate(zip(grid[0], CONFIGURATIONS, strict=True)):
        time = 1e3 * (run.time[k, shown] - run.time[k, shown][0])
        top = 0.0
        for words, (values, colour) in lines[k].items():
            axes.plot(time, values, color=colour, lw=1.4, alpha=0.9)
            if kind == "4W2T":
                apart = {"front wheel": 7, "rear wheel": -7}.get(words, 0)  # they nearly coincide
                label_end(axes, time, np.asarray(values), words, colour, offset=(5, apart))
            top = max(top, float(np.max(values)))
        axes.set(ylim=(0, 1.25 * top), xlabel="time [ms]", ylabel="normal reaction [N]")
        axes.set_title(f"Fig. 27: {kind}, one side")
    note(grid[0, 0], "blue: all grousers; orange: what the lower guide carries")
    grid[0, 1].set_xlim(0, 1.3e3 * SHOWN)
    return fig
