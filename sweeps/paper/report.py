"""Report of `reproduce`: the paper's figures and tables for a robot, compared with the bench and the paper."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from calibration.data import Columns, Json
from calibration.data.robot_file import RobotFile
from calibration.inference import simulation_errors
from mmrjax.model.paper_robots import ROBOTS
from mmrjax.model.paper_tables import TRACKED
from mmrjax.model.robot import Robot
from sweeps import capabilities
from sweeps.pages import resonance_figures, words
from sweeps.pages.figure_style import (
    BLUE,
    GREEN,
    INK,
    PURPLE,
    SKY,
    VERMILION,
    new_figure,
    outer_legend,
)
from sweeps.pages.words import displayed_robot_name
from sweeps.paper import data
from sweeps.paper.components import MODEL
from sweeps.report import catalogue, fit_tables
from sweeps.report.document import Block, Column, Document, Section
from sweeps.report.fit_tables import error_cell
from sweeps.report.runs_report import ripple_table, starts_table

# --- Figures 23-27 from the track model -----------------------------------------------------------


SECONDS = 1.5  # duration of a run [s]
SAMPLE = 5e-4  # interval of its record [s]


def simulate_gear_runs(robot: Robot) -> Any:
    """Starts of the paper's configurations from standstill on the flat at 33 V without payload, in NumPy.

    A robot that is too stiff for the usual step is simulated with a smaller one.
    """
    import jax

    from mmrjax.fidelities import track
    from mmrjax.undercarriage.modes import largest_step

    conditions = data.batch_conditions(robot, data.shown_configurations(robot), voltage=33.0)
    step = min(track.STEP, float(largest_step(robot, conditions).min()))
    step = SAMPLE / math.ceil(SAMPLE / step * (1 - 1e-9))
    return jax.device_get(track.track_batch(robot, conditions, duration=SECONDS, sample=SAMPLE, step=step))


def gear_blocks(robot: Robot) -> Iterator[Block]:
    """Figures and table of ripple. If a run does not get under way, only the statuses of all runs."""
    run = simulate_gear_runs(robot)
    names = data.shown_configurations(robot)
    configuration_indices = [robot.configurations.index(c) for c in names]
    status, share = np.asarray(run.result.status), np.asarray(run.steady.guide_share)
    gears = resonance_figures.gear_runs(robot, run, status, share, configuration_indices, names)
    yield catalogue.note("paper.gear")
    if not all(gear.rolls for gear in gears):
        status_words = ", ".join(f"{g.name}: {words.short_status(g.status)}" for g in gears)
        yield catalogue.note("paper.gear-left-out", status_words)
        return
    starts = data.starts_from_standstill(robot, run, run.result.status)
    yield catalogue.figure("paper.track_fig23_24_from_standstill", starts, data.FIG_23, data.FIG_24)
    yield catalogue.figure("paper.track_fig25_ripple", gears, "Fig. 25: {}")
    yield ripple_table(gears)
    if TRACKED in names:
        k = names.index(TRACKED)
        lumped = data.operating_points(robot, data.batch_conditions(robot, np.array([TRACKED]), voltage=33.0))
        track = robot.configurations[TRACKED].track
        currents = float(run.result.total_current[k]), float(lumped["total_current_A"][0])
        yield catalogue.note("paper.guide-share", float(track.guide_share), float(track.guide_friction), *currents)
        yield catalogue.figure("paper.track_fig26_touchdown", gears[k], "Fig. 26: grousers land (dotted)")
    yield catalogue.figure("paper.track_fig27_reactions", gears, "Fig. 27: {}, one side")


# --- the report -----------------------------------------------------------------------------------


#: Kinds of readings in the table of rows, by the prefix of their columns.
KINDS = {
    "": "bench", "paper_": "paper", "plain_": "own adhesion", "raised_": "adhesion raised", "weighed_": "own mass",
}  # fmt: skip


def paper_document(file: RobotFile, gear: bool) -> tuple[Document, data.PaperRows | None]:
    """Report on a robot, compared with the nominal robots.

    Args:
        file: file of any robot. Without one of the paper's configurations it is not compared with the bench.
        gear: True if the fidelity resolves the running gear, to add its Figs. 23-27.

    Returns:
        Report, and the robot's results for the paper's rows (None without one of their configurations).
    """
    robot = file.robot
    name = capabilities.displayed_name(file)
    name = file.name if name == words.displayed_robot_name(file.name) else name
    robots = {name: robot} | {n: make() for n, make in ROBOTS.items() if n != name}
    runs_by_robot = {n: data.simulate_measured_rows(member) for n, member in robots.items()}
    rows = {n: of_robot for n, of_robot in runs_by_robot.items() if of_robot is not None}
    robot_rows = rows.get(name)
    blocks: list[Block] = [catalogue.note("paper.lead", capabilities.displayed_name(file))]
    answer = catalogue.text("paper.alone")
    if robot_rows is not None:
        errors = variant_errors(_variants(name, rows), robot_rows)
        answer = error_answer(errors)
        heads = [
            Column(heading, "%", "{:.1f}", channel.label)
            for channel in data.channels_of_paper()
            for heading in ("rms", "worst")
        ]
        error_rows = [
            (
                error["variant"] * (error["group"] == "all"), error["group"], f"{error['rows']} of {error['of']}",
                *(cell for e in error["cells"] for cell in (error_cell(e["rms_percent"]), e["max_percent"])),
            )
            for error in errors
        ]  # fmt: skip
        blocks += [catalogue.table("paper.errors", error_rows, *heads), *_sliding(robot, robot_rows)]

    def sections() -> Iterator[Section]:
        if robot_rows is not None:
            yield _against_the_bench(robots, rows, name)
            table = data.paper_rows_table(robot_rows)
            channels = data.channels_of_paper()
            yield fit_tables.rows_section(table, channels, KINDS, False, mass=True, file="rows.csv")
        starts = data.simulate_starts(robot)
        figure = catalogue.figure("paper.fig23_24_from_standstill", starts, data.FIG_23, data.FIG_24)
        yield Section("From standstill", (figure, starts_table(starts)), "start")
        if gear:
            yield Section("Inside the running gear", tuple(gear_blocks(robot)), "gear")
        ratio = dict.fromkeys(data.shown_configurations(robot), 1.0) if robot_rows is None else robot_rows.ratio
        watt_rows = data.energy_use(robot, ratio)
        columns = (Column(item, form="{:.1f}") for item in data.SPLIT)
        yield Section("Where the energy goes", (catalogue.table("paper.watts", watt_rows, *columns),), "energy")
        figures = (
            catalogue.figure("paper.fig05a_gearbox_efficiency", robots, robot_rows),
            *(catalogue.figure(f"paper.{n}", robots) for n in ("fig10_battery", "fig11_motor_friction")),
            catalogue.figure("paper.fig18_idle_track", robots),
        )
        yield Section("Components", figures, "components")

    title = f"The paper's figures and tables: {capabilities.displayed_name(file)}"
    return Document(title, answer, tuple(blocks), page_sections=sections), robot_rows


def variant_errors(variants: Columns, rows: data.PaperRows) -> list[Json]:
    """Rms and worst error (35) of each variant (errors of shape (rows, channels)), all rows and by group."""
    configurations = rows.conditions["configuration"]
    summaries = []
    for name, values in variants.items():
        for group in ("all", *rows.ratio):
            is_row = np.ones(len(configurations), bool) if group == "all" else configurations == group
            cells = [simulation_errors.error_summary(values[is_row, k]) for k in range(values.shape[1])]
            summaries.append(
                {"variant": name, "group": group, "rows": cells[0]["rows"], "of": int(is_row.sum()), "cells": cells}
            )
    return summaries


def error_answer(summaries: list[Json]) -> str:
    """Sentence on the rms errors (35) over all rows, from `variant_errors`: the robot's and the paper's."""
    own_adhesion, _, raised, *_, paper = (summary for summary in summaries if summary["group"] == "all")
    labels = [c.label for c in data.channels_of_paper()]
    robot_error, paper_error = (
        ", ".join(f"{c['rms_percent']:.1f} % {label}" for c, label in zip(summary["cells"], labels, strict=True))
        for summary in (raised, paper)
    )
    unsettled_text = (
        f", with adhesion raised ({own_adhesion['rows']} rows settle without that)"
        if own_adhesion["rows"] < own_adhesion["of"]
        else ""
    )
    return (
        f"rms error against {raised['rows']} of {raised['of']} measured rows: {robot_error}{unsettled_text}. "
        f"The paper's own simulation: {paper_error}."
    )


def _sliding(robot: Robot, rows: data.PaperRows) -> Iterator[Block]:
    """Note on rows without an operating point with the robot's own adhesion, if there are any."""
    has_no_point = rows.plain["status"] != "converged"
    table = rows.conditions
    sentences = [
        f"{table['configuration'][k]} {table['supply_voltage_V'][k]:.0f} V {table['slope_deg'][k]:.0f}° "
        f"{words.short_status(str(rows.plain['status'][k]))}"
        for k in np.flatnonzero(has_no_point)
    ]
    if sentences:
        raised = data.raised_adhesion_words(robot, rows.ratio)
        yield catalogue.note("paper.sliding", len(sentences), len(table), ", ".join(sentences), raised)


def _against_the_bench(robots: dict[str, Robot], rows: dict[str, data.PaperRows], name: str) -> Section:
    robot_rows = rows[name]
    r_squared = data.slope_certainty(robot_rows)
    table = [(*row[:3], f"{row[3]:.3f} ({row[4]})", *row[5:]) for row in r_squared]
    blocks: list[Block] = [
        catalogue.figure("paper.fig28_current_over_slope", robots[name], robot_rows, r_squared),
        catalogue.table("paper.certainty", table),
    ]
    if TRACKED in robot_rows.ratio:
        blocks.append(catalogue.figure("paper.fig29_model_errors", robots, rows))
    return Section("Against the bench", tuple(blocks), "bench")


def _variants(name: str, rows: dict[str, data.PaperRows]) -> Columns:
    """Errors of the rows by variant, with the names in the table of errors."""
    robot_rows = rows[name]
    displayed = words.displayed_robot_name(name)
    errors = robot_rows.errors
    errors_by_variant = {
        f"{displayed}: own adhesion, mass as printed": errors["plain"],
        f"{displayed}: adhesion raised, mass as printed": errors["raised"],
        f"{displayed}: adhesion raised, the robot's own mass": errors["weighed"],
    }
    if name != "nominal":
        is_shared = np.isin(rows["nominal"].conditions["configuration"], list(robot_rows.ratio))
        errors_by_variant["nominal (PM): adhesion raised, its own mass"] = rows["nominal"].errors["weighed"][
            is_shared
        ]
    return errors_by_variant | {"the paper's own simulation": errors["paper"]}


_MODES = {1: (BLUE, "o"), 2: (SKY, "v"), 3: (GREEN, "^"), 4: (VERMILION, "s")}


def current_over_slope(robot: Robot, rows: data.PaperRows, r_squared_rows: Sequence[Sequence[Any]]) -> Figure:
    """Fig. 28: total current over slope in four loading modes, with the measured points and R² (A1).

    Args:
        r_squared_rows: R² from `data.slope_certainty`.
    """
    slopes = np.linspace(0, 20, 81)
    lines = data.current_over_slope(robot, rows.ratio, slopes)
    fig, grid = new_figure(1, len(rows.ratio), 4.4, sharey=True)
    fits = {
        (configuration, mode): f": R² {weighed:.3f} ({straight:.3f})"
        for configuration, mode, straight, *_, weighed in r_squared_rows
    }
    for axes, configuration in zip(grid[0], rows.ratio, strict=True):
        for mode, (volts, payload) in data.MODES.items():
            colour, marker = _MODES[mode]
            own_adhesion, raised = lines[configuration, mode]
            axes.plot(slopes, raised, "--", color=colour, lw=1.3)
            axes.plot(
                slopes,
                own_adhesion,
                color=colour,
                label=f"{volts:g} V, {payload:g} kg{fits.get((configuration, mode), '')}",
            )
            is_row = data.rows_of_mode(rows, configuration, mode)
            points = rows.conditions["slope_deg"][is_row], rows.measured[is_row, 0]
            axes.plot(*points, marker, color=colour, ms=6.5, mec=INK, mew=0.8)
        axes.set(xlabel="slope [°]", xlim=(-0.5, 20.9), ylim=(0, None))
        axes.set_title(configuration)
        axes.legend()
    grid[0, 0].set_ylabel("total current [A]")
    fig.supxlabel(
        "solid: own adhesion, until the robot slides. Dashed: adhesion raised. Markers: measured", fontsize=9
    )
    return fig


def model_errors(robots: dict[str, Robot], rows: dict[str, data.PaperRows]) -> Figure:
    """Fig. 29: errors (35) in current and speed over slope, 6T2A, modes 1 and 2, adhesion raised."""
    fig, grid = new_figure(2, 2, 6.2, sharex=True, sharey="row")
    slopes = np.array([0.0, 5.0, 10.0, 15.0, 20.0])
    first_rows = next(iter(rows.values()))
    is_tracked = first_rows.conditions["configuration"] == TRACKED

    def draw(column: np.ndarray, errors: np.ndarray, style: str, **style_arguments: Any) -> None:
        for axes, channel in zip(column, (0, 2), strict=True):
            axes.plot(slopes, errors[:, channel], style, ms=4, **style_arguments)

    for k, column, (volts, payload) in zip((1, 2), grid.T, (data.MODES[1], data.MODES[4]), strict=True):
        for name, robot in robots.items():
            style_arguments: Json = {"color": MODEL.get(name, PURPLE), "marker": "o"}
            errors = data.supply_errors(robot, rows[name], volts, battery=False)
            draw(column, errors, "-", label=displayed_robot_name(name), **style_arguments)
            # A full battery of 8 cells gives the 33 V of mode 2. SM-1 and SM-2 share one constant battery.
            if k == 2 and name != "sm1":
                draw(column, data.supply_errors(robot, rows[name], volts, battery=True), ":", **style_arguments)
        is_row = is_tracked & (first_rows.conditions["supply_voltage_V"] == volts)
        label = "the paper's own simulation"
        draw(column, first_rows.errors["paper"][is_row], "-", color=INK, marker="d", lw=1, label=label)
        column[0].set_title(f"mode {k}: {volts:g} V, {payload:g} kg")
        column[1].set_xlabel("slope [°]")
    for axes in grid.flat:
        axes.axhspan(-7, 7, color="#eef3ee", zorder=0)
        axes.axhline(0, color="#666666", lw=0.9)
    grid[0, 0].set_ylabel("error in current [%]")
    grid[1, 0].set_ylabel("error in speed [%]")
    outer_legend(grid[0, 0], "lower center")
    return fig
