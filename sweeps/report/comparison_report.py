"""Report of `compare`: errors of a simulation against measured runs or logs."""

from __future__ import annotations

import dataclasses
from collections import Counter

import numpy as np

from calibration.data import Columns, Json, Names
from calibration.data.runs import Runs
from calibration.inference import simulation_errors as simulation_errors
from mmrjax.errors import count_noun
from mmrjax.model.channels import Channel
from mmrjax.model.robot import Robot
from sweeps.pages import words
from sweeps.report import catalogue, fit_tables
from sweeps.report.document import Cell, Document, Note, Section, is_missing, remarks

#: Group → channel → rows, rms_percent, max_percent, rms, unit (of the rms), r2, missing.
Summary = dict[str, dict[str, Json]]


@dataclasses.dataclass(frozen=True)
class Comparison:
    """Simulated and measured readings of a table.

    Attributes:
        table: conditions, `<column>` measured, `simulated_<column>`, `error_<channel>_percent`, `status`.
        summary: errors of all rows and of each configuration.
        channels: channels of the readings.
        source: name of the table.
        model: fidelity.
        robot_name: robot name of the simulated robot.
        fit: `these` if the robot was fitted to these rows, `others` if it was fitted to other rows, "" if no fit is
            recorded.
        notes: sentences on the table.
        against: name of a second robot, "" for none. Its readings are the columns `against_<column>` of the table.
        sampled: True for time histories.
        after_steps: rows of histories at or after a step of the command.
    """

    table: Columns
    summary: Summary
    channels: tuple[Channel, ...]
    source: str
    model: str
    robot_name: str
    fit: str = ""
    notes: Names = ()
    against: str = ""
    sampled: bool = False
    after_steps: np.ndarray | None = None


def compare_readings(measured: Runs, simulated: Columns, robot: Robot | None = None) -> tuple[Columns, Summary]:
    """Measured and simulated readings with their errors, and their summary by group.

    Groups are configurations, or surfaces of `robot`. A missing reading is NaN and counts as `missing`. Percentages
    refer to the channel's measured rms over all rows, as in results of fits.
    """
    table = {
        key: simulated[key] for key in ("configuration", *dict.fromkeys((*measured.layout.axes, *measured.axes)))
    }
    if not measured.layout.complete and measured.has("surface"):
        table["surface"] = measured["surface"]
    empty_column = np.full(len(measured), np.nan)
    for channel in measured.channels:
        table[channel.column] = measured.columns.get(channel.column, empty_column)
        if measured.has(channel.sd_column):
            table[channel.sd_column] = measured[channel.sd_column]
        table[f"simulated_{channel.column}"] = simulated[channel.column]
        table[f"error_{channel.name}_percent"] = simulation_errors.sized_error(
            simulated[channel.column], table[channel.column]
        )
    table["status"] = simulated["status"]
    groups = {"all": np.ones(len(measured), bool)}
    names = measured["configuration"] if robot is None else measured.configurations_named(robot)
    groups |= {str(c): names == c for c in dict.fromkeys(names)}
    summary = {
        name: {c.name: _summary(c, {k: v[rows] for k, v in table.items()}) for c in measured.channels}
        for name, rows in groups.items()
    }
    return table, summary


def _summary(channel: Channel, table: Columns) -> Json:
    measured = table[channel.column]
    simulated = table[f"simulated_{channel.column}"]
    return {
        **simulation_errors.error_summary(table[f"error_{channel.name}_percent"]),
        "rms": simulation_errors.root_mean_square(simulated - measured),
        "unit": channel.unit,
        "r2": simulation_errors.r_squared(measured, simulated),
        "missing": int(np.isnan(measured).sum()),
    }


def comparison_document(comparison: Comparison) -> Document:
    """Report of a comparison."""
    table = comparison.table
    status = comparison.table["status"]
    lead = (
        f"Robot: **{comparison.robot_name}**. Fidelity: **{comparison.model}**. Measured: **{comparison.source}**, "
        f"{count_noun(len(status), 'row')}."
    )
    has_sd = any(np.isfinite(table.get(c.sd_column, [])).any() for c in comparison.channels)
    band = " Band: ±2 standard deviations of the readings." * has_sd
    error_figure = catalogue.figure("comparison.errors", table, comparison.channels, more=band)
    rows = []
    groups = dict(
        list(comparison.summary.items())[: None if len(comparison.summary) > 2 else 1]
    )  # one equals the total
    for group, by_channel in groups.items():
        for channel in comparison.channels:
            summary = by_channel[channel.name]
            rms = None if is_missing(summary["rms"]) else f"{summary['rms']:.{channel.resolution}f} {channel.unit}"
            rows.append(
                (
                    group,
                    channel.label,
                    summary["rows"],
                    rms,
                    summary["rms_percent"],
                    summary["max_percent"],
                    summary["r2"],
                )
            )
    ending_sentences = [
        f"{words.short_status(name).capitalize()}: {count} of {len(status)} rows; {words.status_meaning(name)}."
        for name, count in Counter(map(str, status)).items()
        if name not in words.SETTLED
    ]
    status_cells = [Cell(words.short_status(s), "" if s in words.SETTLED else "slides") for s in map(str, status)]
    kinds = {"": "measured", "simulated_": "simulated"}
    return Document(
        f"{comparison.robot_name} against {comparison.source}",
        comparison_answer(comparison),
        (
            Note(lead, "lead"),
            *(Note(text, "warn", terminal=True) for text in ending_sentences),
            catalogue.table("comparison.errors", rows),
            catalogue.note("comparison.errors-note"),
            *remarks(comparison.notes),
        ),
        (
            *_over_time(comparison),
            Section("Errors against conditions", (error_figure,)),
            fit_tables.rows_section(
                table, comparison.channels, kinds, True, mass=True, last={"status": status_cells},
                file="comparison.csv", terminal=True,
            ),
        ),
    )  # fmt: skip


def _over_time(comparison: Comparison) -> tuple[Section, ...]:
    """Section with the readings of a log over time. None for a table of settled runs."""
    if not comparison.sampled:
        return ()
    lines = {"simulated_": "simulated"}
    if comparison.against:
        lines = {"simulated_": comparison.robot_name, "against_": comparison.against}
    fits = fit_tables.fits_of_runs(comparison.table, comparison.channels, lines)
    if comparison.after_steps is not None and 0 < np.count_nonzero(comparison.after_steps) < len(
        comparison.after_steps
    ):
        away_from_steps = {column: values[~comparison.after_steps] for column, values in comparison.table.items()}
        lines_away = {prefix: f"{name}, without the two samples after each step" for prefix, name in lines.items()}
        rows = [*fits.rows, *fit_tables.fits_of_runs(away_from_steps, comparison.channels, lines_away).rows]
        fits = dataclasses.replace(fits, rows=sorted(rows, key=lambda row: row[0]))
    answer = comparison_answer(comparison)
    overlay = catalogue.figure("fit.overlay", comparison.table, comparison.channels, lines, finding=answer)
    return (Section("Over time", (overlay, fits)),)


def comparison_answer(comparison: Comparison) -> str:
    """The rms errors with their numbers of rows, the worst reading, and if the robot was fitted to these rows."""
    error_summary = comparison.summary["all"]
    total = len(comparison.table["status"])
    channel_errors = {c.label: error_summary[c.name] for c in comparison.channels if error_summary[c.name]["rows"]}
    if not channel_errors:
        return "No row has a simulated and a measured value."
    errors = ", ".join(f"{e['rms_percent']:.1f} % {label}" for label, e in channel_errors.items())
    rows, worst = (max(e[name] for e in channel_errors.values()) for name in ("rows", "max_percent"))
    extent = f"{rows} of {total} rows" if rows < total else count_noun(total, "row")
    if comparison.sampled:
        runs = Runs(
            comparison.source, {k: comparison.table[k] for k in ("run_id", "time_s") if k in comparison.table}
        )
        extent = f"{sum(np.ptp(runs['time_s'][r]) for r in runs.rows_by_run().values()):.3g} s of log"
    parts = [f"{extent}: rms error {errors} (worst reading {worst:.1f} %)."]
    parts += [catalogue.text(f"comparison.{comparison.fit}")] if comparison.fit else []
    return " ".join([*parts, *([_second_robot(comparison)] if comparison.against else [])])


def _second_robot(comparison: Comparison) -> str:
    """Errors of both robots on the rows for which both have values."""
    parts = []
    compared_rows = 0
    for c in comparison.channels:
        simulated = np.stack([comparison.table[prefix + c.column] for prefix in ("simulated_", "against_")], 1)
        measured = comparison.table[c.column]
        rows = np.isfinite(simulated).all(1) & np.isfinite(measured)
        if rows.any():
            first, second = 100 * simulation_errors.share_of_measured(simulated[rows], measured[rows, None])
            parts.append(f"{c.label} {first:.1f} and {second:.1f} %")
            compared_rows = max(compared_rows, int(rows.sum()))
    if not parts:
        return f"No row has values for both this robot and {comparison.against}."
    return f"This robot and {comparison.against} on the same {count_noun(compared_rows, 'row')}: {', '.join(parts)}."
