"""Figures of measured and simulated readings: errors over conditions, overlays over time, voltage plots."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from calibration.data import Columns, Json
from calibration.data.table import Runs
from calibration.inference.feedforward import Feedforward
from mmrjax.model.channels import Channel
from sweeps.pages.figure_style import (
    BLUE,
    FAINT,
    INK,
    LOOKS,
    ORANGE,
    axis_label,
    configuration_looks,
    new_figure,
)
from sweeps.report.run_tables import axis_title

#: Columns over which errors are drawn if they vary and are not simulated.
_CONDITIONS = (
    "slope_deg", "supply_voltage_V", "motor_speed_rpm", "motor_current_A", "goal_angle_deg", "goal_speed_rpm",
    "goal_current_A", "payload_kg", "load_torque_Nm",
)  # fmt: skip


def draw_errors_over_conditions(table: Columns, channels: Sequence[Channel]) -> Figure:
    """Simulated minus measured for each channel over each condition that varies, or over the row number.

    A band shows two standard deviations of the readings if they are known.
    """
    imposed = [c for c in _CONDITIONS if c in table and f"simulated_{c}" not in table]
    conditions = {axis_title(c): table[c] for c in imposed if np.unique(table[c]).size > 1}
    conditions = conditions or {"row": np.arange(1.0, len(table["configuration"]) + 1)}
    fig, grid = new_figure(len(channels), len(conditions), 2.3 * len(channels), sharex="col", sharey="row")
    looks = configuration_looks(table["configuration"])
    for panels_of_channel, channel in zip(grid, channels, strict=True):
        error = table[f"simulated_{channel.column}"] - table[channel.column]
        sd = table.get(channel.sd_column, np.array([np.nan]))
        half_band = 2 * float(np.median(sd[np.isfinite(sd)])) if np.isfinite(sd).any() else 0.0
        for axes, (label, x) in zip(panels_of_channel, conditions.items(), strict=True):
            axes.axhspan(-half_band, half_band, color="#eef3ee", zorder=0)
            axes.axhline(0, color="#666666", lw=0.9)
            shifts = 0.012 * np.ptp(x) * (np.linspace(-1, 1, len(looks)) if len(looks) > 1 else np.zeros(1))
            for shift, (configuration, (colour, marker)) in zip(shifts, looks.items(), strict=True):
                rows = (table["configuration"] == configuration) & np.isfinite(error)
                if rows.any():
                    axes.plot(x[rows] + shift, error[rows], marker, ms=5, mec="white", mew=0.5, color=colour,
                              label=configuration, rasterized=np.count_nonzero(rows) > 500)  # fmt: skip
            if panels_of_channel[0] is grid[-1, 0]:
                axes.set_xlabel(label)
                if np.unique(x).size <= 8:
                    axes.set_xticks(np.unique(x))
        panels_of_channel[0].set_ylabel(f"{channel.label}\nerror [{channel.unit}]")
    if grid[0, 0].get_legend_handles_labels()[0] and len(looks) <= LOOKS:
        grid[0, 0].legend(loc="best")
    return fig


def quasistatic(fit: Feedforward) -> Figure:
    """Voltage minus kA·a over velocity, for windows of the quasistatic tests."""
    windows, constants = fit.windows, fit.constants
    is_quasistatic = (
        windows["quasistatic"] if windows["quasistatic"].any() else np.ones(len(windows["velocity"]), bool)
    )
    voltage = windows["voltage_V"] - constants["kA"] * windows["acceleration"]
    fig, axes = _points(
        windows["velocity"][is_quasistatic], voltage[is_quasistatic], f"velocity [{fit.unit}/s]", "V - kA·a [V]"
    )
    for sign in (-1, 1):
        velocity = windows["velocity"][is_quasistatic & (windows["direction"] * sign > 0)]
        if len(velocity):
            ends = np.array([0.0, velocity[np.argmax(np.abs(velocity))]])
            axes.plot(ends, constants["kV"] * ends + sign * constants["kS"] + constants.get("kG", 0.0), color=ORANGE)
    return fig


def dynamic(fit: Feedforward) -> Figure:
    """Voltage minus kS and kV·v over acceleration."""
    windows, constants = fit.windows, fit.constants
    voltage = windows["voltage_V"] - constants["kV"] * windows["velocity"] - constants["kS"] * windows["direction"]
    acceleration = windows["acceleration"]
    fig, axes = _points(acceleration, voltage, f"acceleration [{fit.unit}/s²]", "V - kS - kV·v [V]")
    ends = np.array([acceleration.min(), acceleration.max()])
    axes.plot(
        ends,
        constants["kA"] * ends + (constants.get("kG", 0.0) if fit.mechanism == "elevator" else 0.0),
        color=ORANGE,
    )
    return fig


def _points(x: np.ndarray, y: np.ndarray, x_label: str, y_label: str) -> tuple[Figure, Axes]:
    fig, ((axes,),) = new_figure(1, 1, 3.2)
    axes.axhline(0, color=INK, lw=0.6)
    axes.plot(x, y, ".", ms=4, color=BLUE)
    axes.set(xlabel=x_label, ylabel=y_label)
    return fig, axes


#: Number of readings on a page, for all runs and channels together, so that a page is smaller than 1.5 MB.
POINTS = 24_000
COLOURS = (BLUE, ORANGE)


@dataclasses.dataclass(frozen=True)
class TimeOverlay:
    """Readings of runs over time.

    Attributes:
        table: columns of the measured channels, of their simulations and `time_s`, each of shape (rows,).
        channels: channels to show.
        simulated: prefix of the columns of a simulation → its name in the legend. The first one has the residuals.
        rows: rows of each run in the order of time.
    """

    table: Columns
    channels: Sequence[Channel]
    simulated: Mapping[str, str]
    rows: Columns

    @property
    def worst(self) -> str:
        """The run with the largest rms residual, relative to the channel's measured rms."""
        return max(self.rows, key=lambda name: np.nan_to_num(self._misfit(self.rows[name])))

    def _misfit(self, rows: np.ndarray) -> float:
        shares = [np.nan]
        for channel in self.channels:
            size = float(np.nanmean(np.square(self.table[channel.column])))
            if size > 0:
                shares.append(np.nanmean(np.square(self._residual(channel)[rows])) / size)
        return float(np.nanmean(shares)) if np.isfinite(shares).any() else np.nan

    def _residual(self, channel: Channel) -> np.ndarray:
        first_prefix = next(iter(self.simulated))
        return np.asarray(self.table[first_prefix + channel.column] - self.table[channel.column])

    def draw(self) -> Figure:
        """Figure of the worst run: for each channel the readings, and below them simulated minus measured."""
        name = self.worst
        count = len(self.channels)
        rows = self._thinned(self.rows[name], POINTS // (4 * count))
        time = self.table["time_s"][rows]
        fig, grid = new_figure(2 * count, 1, 2.9 * count, sharex=True, height_ratios=[3, 1] * count)
        for readings, residual, channel in zip(grid[::2, 0], grid[1::2, 0], self.channels, strict=True):
            measured = self.table[channel.column][rows]
            readings.plot(time, measured, ".", ms=3, color=INK, label="measured", rasterized=len(rows) > 500)
            for (prefix, words), colour in zip(self.simulated.items(), COLOURS, strict=False):
                readings.plot(time, self.table[prefix + channel.column][rows], color=colour, lw=1.3, label=words)
            residual.axhline(0, color=FAINT, lw=0.8)
            residual.plot(time, self._residual(channel)[rows], color=BLUE, lw=1)
            readings.set_ylabel(axis_label(channel))
            residual.set_ylabel("residual")
        grid[0, 0].legend(loc="best")
        grid[0, 0].set_title(f"run {name}" if len(self.rows) > 1 else "")
        grid[-1, 0].set_xlabel("time [s]")
        return fig

    def to_json(self) -> str:
        """Data of the interactive figure: for each run its times and, by channel, measured and simulated readings."""
        curves = len(self.channels) * (1 + len(self.simulated))
        rows_per_run = max(200, POINTS // (len(self.rows) * curves))
        points_so_far = 0
        worst = self.worst
        runs: Json = {}
        for name in sorted(self.rows, key=lambda name: name != worst):
            rows = self._thinned(self.rows[name], rows_per_run)
            points_so_far += len(rows) * curves
            if runs and points_so_far > 2 * POINTS:
                break
            runs[name] = {
                "time": _numbers(self.table["time_s"][rows]),
                "channels": [
                    [_numbers(self.table[prefix + c.column][rows]) for prefix in ("", *self.simulated)]
                    for c in self.channels
                ],
            }
        data: Json = {
            "labels": ["measured", *self.simulated.values()],
            "channels": [{"label": c.label, "unit": c.unit} for c in self.channels],
            "runs": runs,
        }
        return json.dumps(data, separators=(",", ":")).replace("<", "\\u003c")

    def _thinned(self, rows: np.ndarray, max_rows: int) -> np.ndarray:
        """Up to about `max_rows` rows in order: of each group the rows of the extreme readings of every channel."""
        if len(rows) <= max_rows:
            return rows
        kept_rows = {0, len(rows) - 1}
        for part in np.array_split(np.arange(len(rows)), max(1, max_rows // (2 * len(self.channels)))):
            for channel in self.channels:
                readings = self.table[channel.column][rows[part]]
                if np.isfinite(readings).any():
                    kept_rows |= {int(part[np.nanargmin(readings)]), int(part[np.nanargmax(readings)])}
        return rows[sorted(kept_rows)]


def _numbers(values: np.ndarray) -> list[float | None]:
    """Numbers with six digits, None for a missing one."""
    return [float(f"{v:.6g}") if np.isfinite(v) else None for v in values]


def time_overlay(table: Columns, channels: Sequence[Channel], simulated: Mapping[str, str]) -> TimeOverlay:
    """Overlay of a table of time histories, run by run.

    Args:
        table: table with `time_s`, `run_id` where there are several runs, measured and simulated columns.
        channels: channels to show. Those without any reading are left out.
        simulated: prefixes of the simulated columns and their names, as in `TimeOverlay`.
    """
    runs = Runs("a table", {name: table[name] for name in ("run_id", "time_s") if name in table})
    shown_channels = [c for c in channels if np.isfinite(table[c.column]).any()]
    rows = {str(name): ordered for name, ordered in runs.rows_by_run().items()}
    return TimeOverlay(table, shown_channels, simulated, rows)
