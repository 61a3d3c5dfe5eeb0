"""Figures of runs from standstill: current and speeds over time, with inrush and stages of the start marked."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from calibration.data import Columns
from calibration.data.clock import applied_drive
from calibration.data.runs import Runs
from calibration.data.settling import Settled
from mmrjax.derived.start_figures import (
    StartStages,
    count_finite_samples,
    curve_peak,
    last_samples,
    stages_of_histories,
)
from mmrjax.model import channels
from mmrjax.model.channels import Channel
from mmrjax.model.quantities import MM
from mmrjax.model.robot import Robot
from sweeps.pages import words
from sweeps.pages.figure_style import (
    BLUE,
    FAINT,
    INK,
    ORANGE,
    VERMILION,
    add_corner_note,
    axis_label,
    configuration_looks,
    new_figure,
)
from sweeps.report.run_tables import UNITS
from sweeps.report.settle_report import IMPOSED

#: Samples per segment of a frequency response, and smallest coherence of drawn points.
SEGMENT, COHERENT = 256, 0.7
#: Fewest rows of a run for a frequency response.
SHORTEST = 32


def draw_settled_log(found: Settled) -> Figure:
    """The imposed quantity and each channel over the log, with settled stretches and their means."""
    runs = found.runs
    rows = np.concatenate([s.rows for s in found.stretches]) if found.stretches else np.zeros(0, int)
    rows_drawn = np.unique(np.concatenate([rows, np.arange(len(runs))]))
    clock, begin = np.zeros(len(runs)), 0.0
    run = runs.run_names
    for name in dict.fromkeys(run.tolist()):  # recordings one after the other
        run_rows = np.flatnonzero(run == name)
        clock[run_rows] = begin + runs["time_s"][run_rows] - runs["time_s"][run_rows[0]]
        begin = float(clock[run_rows[-1]])
    order = rows_drawn[np.argsort(clock[rows_drawn], kind="stable")]
    lines = [("{}\n[{}]".format(*IMPOSED[runs.layout.imposed]), applied_drive(runs))]
    lines += [
        (f"{s.channel.label}\n[{s.channel.unit}]", s.shown if len(s.angle) else runs[s.channel.column])
        for s in found.signals
    ]
    fig, grid = new_figure(len(lines), 1, 1.9 * len(lines), sharex=True)
    for axes, (label, values), signal in zip(grid[:, 0], lines, (None, *found.signals), strict=True):
        axes.plot(clock[order], values[order], color=FAINT, lw=0.8, rasterized=len(order) > 3000)
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


INRUSH = 0.04  # s, shown enlarged
_STAGES = (("I", "#fdebd0", "starting"), ("II", "#e3eef7", "slipping"), ("III", "#eaf5ea", "uniform"))


def _largest_magnitude(time: np.ndarray, values: np.ndarray) -> float:
    """Value with the largest magnitude of a sampled curve, also between samples. NaN without samples."""
    if len(values) < 3:
        return float(values[np.argmax(np.abs(values))]) if values.size else np.nan
    return float(
        np.sign(values[np.argmax(np.abs(values))]) * curve_peak(jnp.asarray(time), jnp.asarray(np.abs(values)))
    )


@dataclasses.dataclass(frozen=True)
class StartRun:
    """A run from standstill, up to its last finite sample.

    Attributes:
        name: heading, configuration, status.
        time: [s].
        current: current of all motors [A].
        speed, theoretical: V and r_k ω_k [mm/s].
        stages: stages of the start. Current and speeds are stored multiplied by its `sense`. None without numbers.
    """

    name: str
    configuration: str
    status: str
    time: np.ndarray
    current: np.ndarray
    speed: np.ndarray
    theoretical: np.ndarray
    stages: StartStages | None

    @property
    def sense(self) -> float:
        """Direction in which the shafts turn at the end, 1 or -1."""
        return 1.0 if self.stages is None else self.stages.sense

    @property
    def starting(self) -> float:
        """End of stage I [s]."""
        return 0.0 if self.stages is None else self.stages.starting

    @property
    def slipping(self) -> float:
        """End of stage II [s]."""
        return 0.0 if self.stages is None else self.stages.slipping

    @property
    def settled(self) -> float:
        """t' [s]."""
        return 0.0 if self.stages is None else self.stages.settled

    @property
    def gets_under_way(self) -> bool:
        """True if the start has distinct stages."""
        return self.status in words.UNDER_WAY

    @property
    def peak(self) -> float:
        """Largest current [A], with the drawn sign."""
        return _largest_magnitude(self.time, self.current)

    @property
    def ended(self) -> tuple[float, float]:
        """Current [A] and speed [mm/s] at the end, as means over the last 0.15 s because of ripple."""
        last_instants = last_samples(self.time)
        return float(self.current[last_instants].mean()), float(self.speed[last_instants].mean())


def start_runs(
    robot: Robot, history: Any, status: np.ndarray, which: Sequence[int], names: Sequence[str]
) -> list[StartRun]:
    """Members of a batch of runs from standstill, of any fidelity that has histories.

    Args:
        history: time and signals of the batch.
        status: codes of how its members ended.
        which: index of each member's configuration in `robot`.
        names: headings of the members.
    """
    from mmrjax.model.signals import STATUSES

    answer = []
    for k, (name, found) in enumerate(
        zip(names, stages_of_histories(robot, history, which[: len(names)]), strict=True)
    ):
        current = np.asarray(history.signals.total_current[k])
        upto = slice(0, count_finite_samples(current))
        speed, theoretical = (
            np.asarray(x[k])[upto] for x in (history.signals.speed, history.signals.speed_theoretical)
        )
        sense = 1.0 if found is None else found.sense
        kind, status_word, scale = robot.configurations.names[int(which[k])], STATUSES[int(status[k])], sense / MM
        times = np.asarray(history.time[k])[upto]
        answer.append(
            StartRun(name, kind, status_word, times, sense * current[upto], scale * speed, scale * theoretical, found)
        )
    return answer


def draw_starts(shown: list[StartRun], current_title: str = "total current", speed_title: str = "speeds") -> Figure:
    """One row for each run: inrush enlarged, total current, V and shaft speed, with the stages shaded.

    For a run that ends backward, backward is drawn positive.
    """
    fig, grid = new_figure(len(shown), 3, 3.1 * len(shown), width_ratios=[0.85, 1.2, 1.35])
    look = configuration_looks(start.configuration for start in shown)
    for (zoom, current, speed), start in zip(grid, shown, strict=True):
        zoom.set_title(f"{start.name}\nfirst {1e3 * INRUSH:.0f} ms")
        backward = ", backward positive" if start.sense < 0 else ""
        current.set_title(current_title + backward)
        speed.set_title(speed_title + backward)
        if not start.time.size:
            add_corner_note(zoom, f"no numbers: {words.short_status(start.status)}", color=VERMILION)
            continue
        colour = look[start.configuration][0]
        peak = int(np.argmax(start.current))
        early = start.time <= INRUSH
        zoom.plot(1e3 * start.time[early], start.current[early], color=colour)
        top = 1.3 * max(float(start.current[early].max()), 1e-3)
        zoom.set(xlim=(0, 1e3 * INRUSH), ylim=(min(0.0, 1.1 * float(start.current[early].min())), top))
        zoom.set(xlabel="time [ms]", ylabel="total current [A]")
        if early[peak]:
            peak_point = (1e3 * start.time[peak], start.current[peak])
            zoom.plot(*peak_point, "o", ms=5, color=colour)
            zoom.annotate(
                f"peak {start.current[peak]:.3g} A\nat {1e3 * start.time[peak]:.1f} ms", peak_point, xytext=(8, -2),
                textcoords="offset points", fontsize=8.5, va="top",
            )  # fmt: skip
        _shade_stages(zoom, start, 1e3)
        _draw_current(current, start, colour)
        _draw_speeds(speed, start, colour)
    return fig


def _draw_current(axes: Axes, start: StartRun, colour: str) -> None:
    peak = float(start.current.max())
    run = start.current[start.time > start.starting]
    run = run[len(run) // 20 :] if len(run) > 20 else start.current
    top = max(1.75 * float(run.max()), 0.1)
    axes.plot(start.time, np.minimum(start.current, 1.2 * top), color=colour)
    low = min(0.0, 1.1 * float(start.current.min()))
    axes.set(xlim=(0, start.time[-1]), ylim=(low, top if peak > top else 1.3 * max(peak, 1e-3)))
    axes.set(xlabel="time [s]", ylabel="total current [A]")
    _shade_stages(axes, start)
    if peak > top:
        add_corner_note(axes, f"peak {peak:.3g} A cut off", x=0.02, y=0.8, color=colour)


def _draw_speeds(axes: Axes, start: StartRun, colour: str) -> None:
    top = max(float(start.theoretical.max()), 1.0)
    axes.plot(start.time, start.theoretical, "--", color=INK, lw=1.4, label=r"$V_{x\,teor}$ (shafts)")
    axes.plot(start.time, start.speed, color=colour, label="$V_x$ (robot)")
    axes.set(xlim=(0, start.time[-1]), ylim=(min(0.0, 1.1 * float(start.speed.min())), 1.38 * top))
    axes.set(xlabel="time [s]", ylabel="speed [mm/s]")
    _shade_stages(axes, start)
    if 0 < start.settled < start.time[-1] and start.gets_under_way:
        axes.axvline(start.settled, color=FAINT, lw=0.9, ls=":", label=f"t' = {start.settled:.2f} s")
    axes.legend(loc="lower right")
    if start.status not in words.SETTLED:
        add_corner_note(axes, f"ends: {words.short_status(start.status)}", y=0.15, color=VERMILION)


def _shade_stages(axes: Axes, start: StartRun, scale: float = 1.0) -> None:
    """Shades the stages behind a plot over time (unit 1/`scale` s), and labels them at the top."""
    if not start.gets_under_way:
        return
    bounds = scale * np.array([0.0, start.starting, start.slipping, start.time[-1]])
    left_edge, right_edge = axes.get_xlim()
    for (stage, shade, name), left, right in zip(_STAGES, bounds[:-1], bounds[1:], strict=True):
        right = min(right, right_edge)
        if right <= left:
            continue
        axes.axvspan(left, right, color=shade, zorder=0, lw=0)
        width = (right - left) / (right_edge - left_edge)
        if width > _text_width_share(axes, stage):
            text = f"{stage}\n{name}" if width > _text_width_share(axes, name) else stage
            axes.text(
                (left + right) / 2, 0.985, text, transform=axes.get_xaxis_transform(), ha="center",
                va="top", fontsize=8.5, fontweight="bold", color=INK,
            )  # fmt: skip


def _text_width_share(axes: Axes, text: str) -> float:
    """Approximate fraction of the axes' width that a bold text of 8.5 points takes [-]."""
    return 0.72 * 8.5 * len(text) / 72 * axes.figure.dpi / axes.bbox.width


@dataclasses.dataclass(frozen=True)
class ShaftRun:
    """A run of a shaft over time, up to its last finite sample.

    Attributes:
        name: heading, status.
        time: [s].
        readings: readings of each channel by name, in the unit of its column.
    """

    name: str
    status: str
    time: np.ndarray
    readings: Columns

    def largest(self, channel: str) -> float:
        """Reading with the largest magnitude."""
        return _largest_magnitude(self.time, self.readings[channel])

    def last(self, channel: str) -> float:
        """Reading at the end."""
        values = self.readings[channel]
        return float(values[-1]) if values.size else np.nan


def shaft_runs(read: Iterable[Channel], history: Any, status: np.ndarray, names: Sequence[str]) -> list[ShaftRun]:
    """Members of a batch of runs, with the readings of their instruments.

    Args:
        read: channels of the robot.
        history: history of the batch.
        status: codes of how its members ended.
        names: headings of the members.
    """
    from mmrjax.model.signals import STATUSES

    answer, shown_channels = [], tuple(c for c in read if c.over_time)
    for k, name in enumerate(names):
        readings = {c.name: np.asarray(history.reading[c.name][k]) / c.factor for c in shown_channels}
        finite = np.flatnonzero(np.isfinite(np.stack(list(readings.values()))).all(0))
        upto = slice(0, int(finite[-1]) + 1 if finite.size else 0)
        member_readings = {channel: values[upto] for channel, values in readings.items()}
        answer.append(ShaftRun(name, STATUSES[int(status[k])], np.asarray(history.time[k])[upto], member_readings))
    return answer


def draw_readings_over_time(shown: list[ShaftRun]) -> Figure:
    """One row for each run, one panel for each channel."""
    read = channels.channels_named(shown[0].readings)
    fig, grid = new_figure(len(shown), len(read), 2.6 * len(shown))
    for row, course in zip(grid, shown, strict=True):
        row[0].set_title(course.name)
        for axes, channel in zip(row, read, strict=True):
            axes.plot(course.time, course.readings[channel.name], color=BLUE)
            axes.set(xlabel="time [s]", ylabel=axis_label(channel))
        if course.status not in words.SETTLED:
            add_corner_note(row[0], f"ends: {words.short_status(course.status)}", color=VERMILION)
    return fig


def frequency_response(
    runs: Sequence[tuple[np.ndarray, np.ndarray, np.ndarray]],
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Response of readings to a drive by Welch's method, averaged over runs (the H1 estimate).

    Bendat and Piersol, Random Data (2010), ch. 6. Runs are resampled at even times, one median interval apart.

    Args:
        runs: time [s], shape (rows,), drive, shape (rows,), and readings, shape (readings, rows), of each run.

    Returns:
        Frequencies between 0 and half the sampling rate [Hz], complex responses, shape (readings, frequencies), and
        coherence of each.
    """
    from scipy import signal

    time_step = float(np.median(np.concatenate([np.diff(time) for time, _, _ in runs])))
    length = min(SEGMENT, *(int(np.ptp(time) / time_step) + 1 for time, _, _ in runs))
    spectra: Any = 0.0
    for time, drive, readings in runs:
        even = time[0] + time_step * np.arange(int(np.ptp(time) / time_step) + 1)
        resampled_drive = drive[np.searchsorted(time, even + 1e-3 * time_step, side="right") - 1]
        series = np.stack([resampled_drive, *(np.interp(even, time, reading) for reading in readings)])
        frequency, cross = signal.csd(resampled_drive, series, 1 / time_step, nperseg=length)
        _, power = signal.welch(series, 1 / time_step, nperseg=length)
        spectra = spectra + len(even) * np.stack([cross, power + 0j])
    cross, power = spectra[0, 1:, 1:], spectra[1, :, 1:].real
    coherence = np.abs(cross) ** 2 / np.maximum(power[0] * power[1:], 1e-300)
    return frequency[1:-1], (cross / np.maximum(power[0], 1e-300))[:, :-1], coherence[:, :-1]


def draw_frequency_response(runs: Runs, read: Sequence[Channel], simulated: Mapping[str, str]) -> Figure:
    """Gain and phase of each channel over frequency: measured as points, simulated as lines.

    Args:
        runs: runs with measured and simulated columns.
        read: channels.
        simulated: prefixes of the simulated columns, and their names.
    """
    table, drive, rows = runs.columns, applied_drive(runs), runs.rows_by_run().values()
    fig, grid = new_figure(2, len(read), 4.4, sharex=True)
    for (gain, phase), channel in zip(grid.T, read, strict=True):
        columns = [channel.column, *(prefix + channel.column for prefix in simulated)]
        finite = [r[np.all([np.isfinite(table[c][r]) for c in columns], axis=0)] for r in rows]
        series = [
            (table["time_s"][r], drive[r], np.stack([table[c][r] for c in columns]))
            for r in finite
            if len(r) >= SHORTEST
        ]
        if not series:
            add_corner_note(gain, "no run is long enough")
            continue
        frequency, response, coherence = frequency_response(series)
        looks = zip(response, coherence, ("measured", *simulated.values()), (INK, BLUE, ORANGE), strict=False)
        for values, coherent, label, colour in looks:
            drawn = np.where(coherent > COHERENT, values, np.nan)
            style = {"ls": "none", "marker": "o", "ms": 3} if label == "measured" else {"lw": 1.5}
            gain.loglog(frequency, np.abs(drawn), color=colour, label=label, **style)
            angle = np.degrees(np.angle(drawn))
            if label != "measured":
                angle[1:][np.abs(np.diff(angle)) > 180] = np.nan  # no line from -180° to 180°
            phase.semilogx(frequency, angle, color=colour, **style)
        gain.set(title=channel.label, ylabel=f"gain [{channel.unit}/{UNITS[runs.layout.imposed_column]}]")
        phase.set(xlabel="frequency [Hz]", ylabel="phase [°]", ylim=(-190, 190), yticks=[-180, -90, 0, 90, 180])
    grid[0, 0].legend(loc="best")
    return fig
