"""Figures over time: settled logs, starts from standstill with their stages, readings, frequency responses."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

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
from mmrjax.model.channels import Channel
from mmrjax.model.quantities import MM
from mmrjax.model.robot import Robot
from mmrjax.model.signals import STATUSES
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
from sweeps.report.run_tables import axis_title, quantity_column

#: Samples per segment of a frequency response, and smallest coherence of drawn points.
SEGMENT, MIN_COHERENCE = 256, 0.7
#: Fewest rows of a run for a frequency response.
FEWEST_ROWS = 32


def draw_settled_log(settled_log: Settled) -> Figure:
    """The imposed quantity and each channel over the log, with settled stretches and their means."""
    runs = settled_log.runs
    clock = np.zeros(len(settled_log.runs))
    begin = 0.0
    for rows in runs.rows_by_run().values():  # recordings one after the other
        clock[rows] = begin + runs["time_s"][rows] - runs["time_s"][rows[0]]
        begin = float(clock[rows[-1]])
    order = np.argsort(clock, kind="stable")
    lines = [(axis_title(runs.layout.imposed_column).replace(" [", "\n["), applied_drive(runs))]
    lines += [
        (
            f"{signal.channel.label}\n[{signal.channel.unit}]",
            signal.shown if len(signal.angle) else runs[signal.channel.column],
        )
        for signal in settled_log.signals
    ]
    fig, grid = new_figure(len(lines), 1, 1.9 * len(lines), sharex=True)
    for axes, (label, values), signal in zip(grid[:, 0], lines, (None, *settled_log.signals), strict=True):
        axes.plot(clock[order], values[order], color=FAINT, lw=0.8, rasterized=len(order) > 3000)
        for stretch in settled_log.stretches:
            if stretch.why:
                continue
            ends = clock[stretch.rows[[0, -1]]]
            axes.axvspan(*ends, color="#e3eef7", lw=0, zorder=0)
            mean = stretch.imposed if signal is None else stretch.mean[signal.channel.name]
            axes.plot(ends, (mean, mean), color=BLUE if signal is None else VERMILION, lw=2)
        axes.set_ylabel(label)
    grid[-1, 0].set_xlabel("time [s], recordings one after the other")
    return fig


INRUSH = 0.04  # s, shown enlarged
_STAGES = (("I", "#fdebd0"), ("II", "#e3eef7"), ("III", "#eaf5ea"))
#: Stages of a run without samples.
_NO_STAGES = StartStages(1.0, 0.0, 0.0, 0.0, 0.0, (np.nan,) * 3, np.nan)


@dataclasses.dataclass(frozen=True)
class StartRun:
    """A run from standstill, up to its last finite sample, with current and speeds times its sense.

    Attributes:
        name: heading, configuration, status.
        stages: stages of the start.
        time: [s].
        current: current of all motors [A].
        speed, theoretical: V and r_k ω_k [mm/s].
    """

    name: str
    configuration: str
    status: str
    stages: StartStages
    time: np.ndarray
    current: np.ndarray
    speed: np.ndarray
    theoretical: np.ndarray

    @property
    def gets_under_way(self) -> bool:
        """True if the start has distinct stages."""
        return self.status in words.UNDER_WAY

    @property
    def peak(self) -> float:
        """Current of the largest magnitude, also between samples [A]."""
        size = np.abs(self.current)
        return float(np.sign(self.current[size.argmax()]) * curve_peak(jnp.asarray(self.time), jnp.asarray(size)))

    @property
    def end_values(self) -> tuple[float, float]:
        """Current [A] and speed [mm/s] at the end, as means over the last 0.15 s because of ripple."""
        last_instants = last_samples(self.time)
        return float(self.current[last_instants].mean()), float(self.speed[last_instants].mean())


def start_runs(
    robot: Robot, history: Any, status: np.ndarray, configuration_indices: Sequence[int], names: Sequence[str]
) -> list[StartRun]:
    """Members of a batch of runs from standstill, of any fidelity that has histories.

    Args:
        history: time and signals of the batch.
        status: codes of how its members ended.
        configuration_indices: index of each member's configuration in `robot`.
        names: headings of the members.
    """
    starts = []
    signals = history.signals
    for k, (name, stages) in enumerate(
        zip(names, stages_of_histories(robot, history, configuration_indices[: len(names)]), strict=True)
    ):
        stages = stages or _NO_STAGES
        sample_count = count_finite_samples(np.asarray(signals.total_current[k]))
        time, current, speed, theoretical = (
            np.asarray(x[k])[:sample_count]
            for x in (history.time, signals.total_current, signals.speed, signals.speed_theoretical)
        )
        scale = stages.sense / MM
        starts.append(
            StartRun(
                name, robot.configurations.names[int(configuration_indices[k])], STATUSES[int(status[k])], stages,
                time, stages.sense * current, scale * speed, scale * theoretical,
            )
        )  # fmt: skip
    return starts


def draw_starts(starts: list[StartRun], current_title: str = "total current", speed_title: str = "speeds") -> Figure:
    """One row for each run: inrush enlarged, total current, V and shaft speed, with the stages shaded.

    For a run that ends backward, backward is drawn positive.
    """
    fig, grid = new_figure(len(starts), 3, 3.1 * len(starts), width_ratios=[0.85, 1.2, 1.35])
    looks = configuration_looks(start.configuration for start in starts)
    for (inrush_axes, current_axes, speed_axes), start in zip(grid, starts, strict=True):
        inrush_axes.set_title(f"{start.name}\nfirst {1e3 * INRUSH:.0f} ms")
        backward = ", backward positive" if start.stages.sense < 0 else ""
        current_axes.set_title(current_title + backward)
        speed_axes.set_title(speed_title + backward)
        if not start.time.size:
            add_corner_note(inrush_axes, f"no numbers: {words.short_status(start.status)}", color=VERMILION)
            continue
        colour = looks[start.configuration][0]
        _draw_inrush(inrush_axes, start, colour)
        _draw_current(current_axes, start, colour)
        _draw_speeds(speed_axes, start, colour)
        for axes, scale in ((inrush_axes, 1e3), (current_axes, 1.0), (speed_axes, 1.0)):
            _shade_stages(axes, start, scale)
    return fig


def _draw_inrush(axes: Axes, start: StartRun, colour: str) -> None:
    early = start.time <= INRUSH
    peak = int(np.argmax(start.current))
    current = start.current[early]
    axes.plot(1e3 * start.time[early], current, color=colour)
    axes.set(xlim=(0, 1e3 * INRUSH), ylim=(min(0.0, 1.1 * current.min()), 1.3 * max(current.max(), 1e-3)))
    axes.set(xlabel="time [ms]", ylabel="total current [A]")
    if early[peak]:
        time = 1e3 * start.time[peak]
        largest = start.current[peak]
        axes.plot(time, largest, "o", ms=5, color=colour)
        axes.annotate(f"peak {largest:.3g} A\nat {time:.1f} ms", (time, largest), xytext=(8, -2),
                      textcoords="offset points", va="top")  # fmt: skip


def _draw_current(axes: Axes, start: StartRun, colour: str) -> None:
    peak = float(start.current.max())
    later_current = start.current[start.time > start.stages.starting]
    later_current = later_current[len(later_current) // 20 :] if len(later_current) > 20 else start.current
    top = max(1.75 * float(later_current.max()), 0.1)
    axes.plot(start.time, np.minimum(start.current, 1.2 * top), color=colour)
    low = min(0.0, 1.1 * float(start.current.min()))
    axes.set(xlim=(0, start.time[-1]), ylim=(low, top if peak > top else 1.3 * max(peak, 1e-3)))
    axes.set(xlabel="time [s]", ylabel="total current [A]")
    if peak > top:
        add_corner_note(axes, f"peak {peak:.3g} A cut off", y=0.8, color=colour)


def _draw_speeds(axes: Axes, start: StartRun, colour: str) -> None:
    top = max(float(start.theoretical.max()), 1.0)
    settled_time = start.stages.settled
    axes.plot(start.time, start.theoretical, "--", color=INK, lw=1.4, label=r"$V_{x\,teor}$ (shafts)")
    axes.plot(start.time, start.speed, color=colour, label="$V_x$ (robot)")
    axes.set(xlim=(0, start.time[-1]), ylim=(min(0.0, 1.1 * float(start.speed.min())), 1.38 * top))
    axes.set(xlabel="time [s]", ylabel="speed [mm/s]")
    if 0 < settled_time < start.time[-1] and start.gets_under_way:
        axes.axvline(settled_time, color=FAINT, lw=0.9, ls=":", label=f"t' = {settled_time:.2f} s")
    axes.legend(loc="lower right")
    if start.status not in words.SETTLED:
        add_corner_note(axes, f"ends: {words.short_status(start.status)}", y=0.15, color=VERMILION)


def _shade_stages(axes: Axes, start: StartRun, scale: float) -> None:
    """Shades the stages behind a plot over time (unit 1/`scale` s), and numbers them at the top."""
    bounds = np.minimum(scale * np.array(start.stages.bounds), axes.get_xlim()[1])
    for (stage, shade), left, right in zip(_STAGES, bounds[:-1], bounds[1:], strict=True):
        if right > left and start.gets_under_way:
            axes.axvspan(left, right, color=shade, zorder=0, lw=0)
            if right - left > 0.04 * bounds[-1]:
                axes.text((left + right) / 2, 0.985, stage, transform=axes.get_xaxis_transform(), ha="center",
                          va="top", fontweight="bold")  # fmt: skip


def draw_readings_over_time(
    channels: Iterable[Channel], history: Any, status: np.ndarray, names: Sequence[str]
) -> Figure:
    """Readings of runs on a shaft over time: one row for each run, one panel for each channel.

    Args:
        channels: channels of the robot.
        history: history of the batch.
        status: codes of how its members ended.
        names: headings of the members.
    """
    over_time = [c for c in channels if c.over_time]
    fig, grid = new_figure(len(names), len(over_time), 2.6 * len(names))
    for k, (row, name) in enumerate(zip(grid, names, strict=True)):
        row[0].set_title(name)
        for axes, channel in zip(row, over_time, strict=True):
            axes.plot(history.time[k], history.reading[channel.name][k] / channel.factor, color=BLUE)
            axes.set(xlabel="time [s]", ylabel=axis_label(channel))
        ending = STATUSES[int(status[k])]
        if ending not in words.SETTLED:
            add_corner_note(row[0], f"ends: {words.short_status(ending)}", color=VERMILION)
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
        even_times = time[0] + time_step * np.arange(int(np.ptp(time) / time_step) + 1)
        resampled_drive = drive[np.searchsorted(time, even_times + 1e-3 * time_step, side="right") - 1]
        series = np.stack([resampled_drive, *(np.interp(even_times, time, reading) for reading in readings)])
        frequency, cross = signal.csd(resampled_drive, series, 1 / time_step, nperseg=length)
        _, power = signal.welch(series, 1 / time_step, nperseg=length)
        spectra = spectra + len(even_times) * np.stack([cross, power + 0j])
    cross = spectra[0, 1:, 1:]
    power = spectra[1, :, 1:].real
    coherence = np.abs(cross) ** 2 / np.maximum(power[0] * power[1:], 1e-300)
    return frequency[1:-1], (cross / np.maximum(power[0], 1e-300))[:, :-1], coherence[:, :-1]


def draw_frequency_response(runs: Runs, channels: Sequence[Channel], simulated: Mapping[str, str]) -> Figure:
    """Gain and phase of each channel over frequency: measured as points, simulated as lines.

    Args:
        runs: runs with measured and simulated columns.
        channels: channels.
        simulated: prefixes of the simulated columns, and their names.
    """
    table = runs.columns
    drive = applied_drive(runs)
    rows = runs.rows_by_run().values()
    unit = quantity_column(runs.layout.imposed_column).unit
    fig, grid = new_figure(2, len(channels), 4.4, sharex=True)
    for (gain_axes, phase_axes), channel in zip(grid.T, channels, strict=True):
        columns = [channel.column, *(prefix + channel.column for prefix in simulated)]
        finite_rows = [
            run_rows[np.all([np.isfinite(table[c][run_rows]) for c in columns], axis=0)] for run_rows in rows
        ]
        series = [
            (table["time_s"][run_rows], drive[run_rows], np.stack([table[c][run_rows] for c in columns]))
            for run_rows in finite_rows
            if len(run_rows) >= FEWEST_ROWS
        ]
        if not series:
            add_corner_note(gain_axes, "no run is long enough")
            continue
        frequency, response, coherence = frequency_response(series)
        looks = zip(response, coherence, ("measured", *simulated.values()), (INK, BLUE, ORANGE), strict=False)
        for values, coherent, label, colour in looks:
            drawn = np.where(coherent > MIN_COHERENCE, values, np.nan)
            style = {"ls": "none", "marker": "o", "ms": 3} if label == "measured" else {"lw": 1.5}
            gain_axes.loglog(frequency, np.abs(drawn), color=colour, label=label, **style)
            angle = np.degrees(np.angle(drawn))
            if label != "measured":
                angle[1:][np.abs(np.diff(angle)) > 180] = np.nan  # no line from -180° to 180°
            phase_axes.semilogx(frequency, angle, color=colour, **style)
        gain_axes.set(title=channel.label, ylabel=f"gain [{channel.unit}/{unit}]")
        phase_axes.set(xlabel="frequency [Hz]", ylabel="phase [°]", ylim=(-190, 190), yticks=[-180, -90, 0, 90, 180])
    grid[0, 0].legend(loc="best")
    return fig
