"""Figures of the loop: residuals before and after, defects, laws."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.figure import Figure

from calibration.data import Columns
from calibration.discovery.findings import UnnamedDiscrepancy
from calibration.discovery.result import DiscoveryResult
from calibration.discovery.settings import WITHOUT_NAME
from calibration.inference.bases import place_in_words
from calibration.inference.details import TimeStatistics
from mmrjax.effects import BY_NAME
from mmrjax.effects.curve import EVERY_VARIABLE, Variable
from mmrjax.model.channels import EVERY, SIDES, Channel
from sweeps.pages.figure_style import (
    BLUE,
    FAINT,
    GREEN,
    INK,
    ORANGE,
    axis_label,
    configuration_looks,
    new_figure,
    outer_legend,
)
from sweeps.report.fit_tables import Change
from sweeps.report.run_tables import axis_title, imposed_column

#: Label and unit of the error of each equation, and the variable over which it is drawn, with its label.
DEFECT_WORDS = {
    "electrical": ("voltage missing", "V", "current_A", "total motor current [A]"),
    "track": ("torque missing at the pulley", "N·m", "motor_speed_rpm", "motor speed [rpm]"),
    "slip": ("speed lost", "mm/s", "slope_deg", "slope [°]"),
}

#: Label of the same error for a rig, whose output may be no pulley.
RIG_TORQUE = "torque missing at the output"


def draw_residuals_before_after(table: Columns, channels: Sequence[Channel], verdict: str) -> Figure:
    """Residual of every reading in sigmas, before and after, over the number of the row."""
    fig, grid = new_figure(len(channels), 1, 1.8 * len(channels), sharex=True)
    for axes, channel in zip(grid[:, 0], channels, strict=True):
        before, after = (table[f"residual_{when}_{channel.name}_sigma"] for when in ("before", "after"))
        axes.axhspan(-2, 2, color="#eeeeee", lw=0, zorder=0)
        axes.axhline(0, color=FAINT, lw=0.8)
        if verdict == "none":
            axes.plot(table["row"], before, "o", ms=4.5, color=BLUE, label="the fitted model")
        else:
            axes.plot(table["row"], before, "o", ms=5.5, mfc="none", color=ORANGE, label="before: the fitted model")
            axes.plot(table["row"], after, "o", ms=4, color=BLUE, label="after: with the effects found")
        axes.set_ylabel(f"{channel.label} [σ]")
    outer_legend(grid[0, 0], "upper left")
    grid[-1, 0].set_xlabel("row, band: ±2σ of the instruments")
    grid[-1, 0].locator_params(axis="x", integer=True)
    return fig


def draw_time_statistics(detail: TimeStatistics, channels: Sequence[Channel], verdict: str) -> Figure:
    """Statistics that need histories: autocorrelation of the residual, waves in shaft angle, drift in time."""
    sides = [("before", detail.before, ORANGE), ("after", detail.after, BLUE)][verdict == "none" :]
    lags, limit = np.arange(1, detail.before.lags + 1), 2 / np.sqrt(detail.samples)
    fig, ((*panels, explained),) = new_figure(1, len(channels) + 1, 2.9, width_ratios=[1] * len(channels) + [1.5])
    for axes, channel in zip(panels, channels, strict=True):
        axes.axhspan(-limit, limit, color="#eeeeee", lw=0, zorder=0)
        axes.axhline(0, color=FAINT, lw=0.8)
        for when, side, colour in sides:
            axes.plot(lags, side.autocorrelation[channel.name], "o-", ms=3, lw=1, color=colour, label=when)
        axes.set(title=channel.label, xlabel="lag [samples]")
    panels[0].set_ylabel("autocorrelation of the residual")
    panels[0].legend(loc="best")
    lines = [*(word for word, _ in detail.before.orders), *["drift in time"] * (detail.before.drift is not None)]
    for k, (_, side, colour) in enumerate(sides):
        values = [o.explained for o in (*side.orders.values(), side.drift) if o]
        place = np.arange(len(lines)) + (k - (len(sides) - 1) / 2) * 0.36
        explained.barh(place, np.sqrt(values), height=0.34, color=colour)
    explained.set_yticks(range(len(lines)), lines)
    explained.invert_yaxis()
    explained.grid(axis="y", visible=False)
    explained.set_xlabel("would explain [σ]")
    return fig


#: Share of a variable's range over which the change by an effect is averaged to measure its smoothness.
NEAR = 1 / 12
#: Roughness up to which the change by an effect is drawn as a single line. A rougher change has one line for each
#: level of the imposed quantity.
SMOOTH = 0.02


def imposed_axis(table: Columns) -> tuple[np.ndarray, str]:
    """Imposed quantity of runs and its label. For a supply with a driver, the voltage after the duty."""
    column = imposed_column(table)
    if column == "supply_voltage_V" and "duty" in table and np.isfinite(table["duty"]).all():
        return table[column] * table["duty"], "voltage given to the motors [V]"
    return table[column], axis_title(column)


def roughness(x: np.ndarray, y: np.ndarray) -> float:
    """Share of the variance of y that remains after subtracting the mean of other rows near x [-]. inf if x is
    constant.
    """
    if not np.ptp(x) > 0:
        return np.inf
    near = np.exp(-0.5 * ((x[:, None] - x) / (NEAR * np.ptp(x))) ** 2) * (1 - np.eye(len(x)))
    return float(np.mean((y - near @ y / near.sum(1)) ** 2) / max(np.var(y), 1e-300))


def conditions_and_readings(table: Columns) -> Columns:
    """Variables that vary between rows, by label: imposed quantity, payload, slope and readings.

    A variable of each side also appears as mean and difference.
    """
    columns = {axis_label(c): table[c.column] for c in EVERY if c.column in table}
    names = ("supply_voltage_V", "payload_kg", "slope_deg", "load_torque_Nm")
    columns |= {axis_title(name): table[name] for name in names if name in table}
    if "duty_left" in table and "supply_voltage_V" in table:
        columns |= {f"voltage, {s} [V]": table["supply_voltage_V"] * table[f"duty_{s}"] for s in SIDES}
    values, imposed_label = imposed_axis(table)
    columns |= {imposed_label: values}
    for label, column in list(columns.items()):
        if (right := columns.get(label.replace(", left", ", right"))) is not None and ", left" in label:
            side_label = label.replace(", left", "")
            columns |= {
                f"mean of both sides: {side_label}": (column + right) / 2,
                f"left minus right: {side_label}": column - right,
            }
    return columns


def driving_variable(table: Columns, change: np.ndarray, driver: str = "") -> tuple[np.ndarray, str]:
    """Abscissa of an effect and its label: the condition or reading that makes the change of a reading smoothest.

    Args:
        change: change of the reading, shape (rows,), NaN for excluded rows.
        driver: driver of the effect. Variables with that word are preferred.
    """
    use = np.isfinite(change)
    columns = {k: np.asarray(v, float) for k, v in conditions_and_readings(table).items()}
    columns = {k: v for k, v in columns.items() if np.isfinite(v[use]).all()}
    preferred = {k: v for k, v in columns.items() if driver in k.split() and np.ptp(v[use]) > 0} or columns
    label = min(preferred, key=lambda k: roughness(preferred[k][use], change[use]))
    return preferred[label], label


def _turns_once(values: np.ndarray) -> bool:
    """True if a sequence changes its direction at most once."""
    return len(values) > 1 and int(np.count_nonzero(np.diff(np.sign(np.diff(values))))) <= 1


def draw_effect_law(result: DiscoveryResult, table: Columns, name: str, change: Change) -> Figure:
    """Law of an effect found, over its condition: readings minus those of the robot without the effect.

    The figure shows measurements with ±2 sd, the refit without effects, and the law with the 95 % band of its
    amplitude. Backward runs have hollow dots and their own line.
    """
    fig, ((axes,),) = new_figure(1, 1, 3.4)
    readings, included, c = result.readings_of_rows, result.included, change.channel
    effect = BY_NAME.get(name)
    x, label = driving_variable(
        table, np.where(included, change.with_it - change.without, np.nan), "" if effect is None else effect.driver
    )
    k = [x.name for x in result.channels].index(c.name)
    amplitude = next(e.parameters["amplitude"] for e in result.effects if e.name == name)
    measured, before, law = (
        (values - change.without)[included] / c.factor
        for values in (readings.measured[:, k], readings.before[:, k], change.with_it)
    )
    imposed, imposed_label = imposed_axis(table)
    backward, imposed = (table[imposed_column(table)] < 0)[included], imposed[included]
    x, sd, share = x[included], readings.sd[included, k] / c.factor, 196 * abs(amplitude.sd / amplitude.value)
    band = share / 100 * abs(law)
    axes.axhline(0, color=FAINT, lw=0.8)
    refit_label: str | None = "old law, refitted"
    for way, face, points_label in ((~backward, ORANGE, "measured, ±2 sd"), (backward, "white", "backward")):
        if not way.any():
            continue
        rows = np.flatnonzero(way)[np.argsort(x[way])]
        axes.errorbar(x[rows], measured[rows], 2 * sd[rows], fmt="o", ms=4.5, mfc=face, color=ORANGE, lw=0.9,
                      label=points_label)  # fmt: skip
        axes.plot(x[rows], before[rows], "x", ms=5, color=INK, label=refit_label)
        is_line = _turns_once(law[rows]) or roughness(x[rows], law[rows]) < SMOOTH
        lines = [rows] if is_line else [rows[imposed[rows] == level] for level in np.unique(imposed[rows])]
        by_level = "" if is_line else f" by {imposed_label.partition(' [')[0]}"
        law_label = f"new law{by_level}, 95 % band (±{share:.2g} %)" if refit_label else None
        for line in lines:
            if is_line or _turns_once(law[line]):
                axes.plot(x[line], law[line], color=BLUE, lw=1.2, label=law_label)
                axes.fill_between(x[line], (law - band)[line], (law + band)[line], color=BLUE, alpha=0.3, lw=0)
            else:
                axes.errorbar(x[line], law[line], band[line], fmt="_", ms=13, mew=2.2, color=BLUE, elinewidth=6,
                              alpha=0.6, label=law_label)  # fmt: skip
            law_label = None
        refit_label = None  # the legend names each law once
    axes.set(xlabel=label, ylabel=f"change of {c.label} [{c.unit}]", title=name)
    outer_legend(axes, "upper left")
    return fig


def defects_by_side(table: Columns, when: str, balance: str) -> Columns:
    """Defects of a balance by side. The side's name is empty if both sides are the same."""
    sides = {side: f"defect_{when}_{balance}{'_' * bool(side)}{side}" for side in ("", *SIDES)}
    return {side: table[column] for side, column in sides.items() if column in table}


def closed_equations(table: Columns) -> list[str]:
    """Equations whose defects the readings determine: those with a nonzero defect, at least one."""
    balances = [
        b for b in DEFECT_WORDS if any(np.nan_to_num(x).any() for x in defects_by_side(table, "before", b).values())
    ]
    return balances or ["track"]


def _defect_variable(table: Columns, column: str, label: str, side: str = "") -> tuple[np.ndarray, str]:
    """Variable over which a defect is drawn, with its label, for one side if each side has its own.

    The imposed quantity replaces a variable that the table lacks or that does not vary.
    """
    imposed = imposed_column(table)
    if side:
        column = f"motor_current_{side}_A" if column == "current_A" else f"motor_speed_{side}_rpm"
        label = f"motor {'current' if 'current' in column else 'speed'} of that side [{column.rpartition('_')[2]}]"
    column = "total_" + column if column == "current_A" else column
    if column not in table or (column not in ("total_current_A", imposed) and np.unique(table[column]).size == 1):
        return imposed_axis(table)
    return table[column], label


def draw_defects(table: Columns, verdict: str, crosses_zero: bool = False) -> Figure:
    """Defect of each equation by run, over the variable that shows it best, before and after.

    Args:
        crosses_zero: True if readings may cross zero (`Layout.crosses_zero`). Only closed equations are then drawn.
    """
    whens = ("before",) if verdict in ("none", *WITHOUT_NAME) else ("before", "after")
    balances = closed_equations(table) if crosses_zero else list(DEFECT_WORDS)
    fig, grid = new_figure(len(whens), len(balances), 2.6 * len(whens) + 0.5, sharex="col", sharey="col")
    for row, when in zip(grid, whens, strict=True):
        for axes, balance in zip(row, balances, strict=True):
            words, unit, column, variable = DEFECT_WORDS[balance]
            by_side = defects_by_side(table, when, balance)
            names = [(name, side) for name in dict.fromkeys(table["configuration"]) for side in by_side]
            looks = configuration_looks(map(", ".join, names)).values()
            axes.axhline(0, color=FAINT, lw=0.8)
            for (name, side), (colour, marker) in zip(names, looks, strict=True):
                rows = table["configuration"] == name
                x, label = _defect_variable(table, column, variable, side)
                y = by_side[side][rows] * (1e3 if balance == "slip" else 1.0)
                axes.plot(x[rows], y, marker, ms=4.5, color=colour, label=f"{name}, {side}".removesuffix(", "))
            torque = crosses_zero and balance == "track"
            axes.set(
                title=f"{'torque' if torque else balance}, {when}",
                ylabel=f"{RIG_TORQUE if torque else words} [{unit}]",
            )
            axes.locator_params(axis="x", nbins=5)
            if when == whens[-1]:
                axes.set_xlabel(label)
    outer_legend(grid[0, 0], "upper right")
    return fig


def draw_unnamed_curve(discrepancy: UnnamedDiscrepancy) -> Figure:
    """The unnamed defect, run by run over the variable that shows it best, with the smooth curve and its band."""
    variable = discrepancy.variable if discrepancy.window is None else str(discrepancy.window["axis"])
    abscissa = EVERY_VARIABLE.get(variable, Variable("rad", 0.0, 0.0, "", f"phase of the wave, {variable}", "rad"))
    label = f"{abscissa.label} [{abscissa.unit_shown}]".removesuffix(" []")
    fig, ((axes,),) = new_figure(1, 1, 3.4)
    axes.axhline(0, color=FAINT, lw=0.8)
    if discrepancy.over is not None and discrepancy.defect is not None and discrepancy.defect_sd is not None:
        axes.errorbar(discrepancy.over / abscissa.shown, discrepancy.defect, 2 * discrepancy.defect_sd, fmt="o", ms=4,
                      color=ORANGE, lw=0.7, label="each run, ±2 sd")  # fmt: skip
    if discrepancy.window is not None:
        first, last = (float(discrepancy.window[end]) / abscissa.shown for end in ("low", "high"))
        axes.axvspan(first, last, color="#eeeeee", lw=0, zorder=0)
    x, half = discrepancy.at / abscissa.shown, 1.96 * discrepancy.sd
    axes.fill_between(x, discrepancy.value - half, discrepancy.value + half, color="#cfe3f2", lw=0, label="95 %")
    axes.plot(x, discrepancy.value, color=GREEN, label="smooth curve")
    axes.set(xlabel=label, ylabel=f"missing in the {place_in_words(discrepancy.place)} [{discrepancy.unit}]")
    axes.legend(loc="best")
    return fig
