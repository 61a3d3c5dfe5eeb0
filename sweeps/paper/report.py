"""Page of `reproduce`: the paper's figures and tables for a robot, compared with the bench and the paper."""

from __future__ import annotations

from pathlib import Path

import jax.numpy as jnp
import numpy as np

from calibration.data import Columns, Json, runs
from calibration.data.robot_file import RobotFile
from calibration.inference import simulation_errors
from mmrjax.model.channels import find_channel
from mmrjax.model.paper_robots import ROBOTS
from mmrjax.model.paper_tables import CONFIGURATIONS, TRACKED, WHEELED
from mmrjax.model.quantities import MM, RPM
from mmrjax.model.robot import Robot
from sweeps.pages import history_figures, page
from sweeps.pages.words import words_shown
from sweeps.paper import components, data, run_figures
from sweeps.report.run_tables import reading_text


def variant_errors(variants: Columns, rows: data.Rows) -> list[Json]:
    """Rms and worst error (35) of each variant (errors of shape (rows, channels)), all rows and by group."""
    kind = rows.conditions["configuration"]
    answer = []
    for name, values in variants.items():
        for group in ("all", *rows.ratio):
            pick = np.ones(len(kind), bool) if group == "all" else kind == group
            cells = [simulation_errors.error_summary(values[pick, k]) for k in range(values.shape[1])]
            answer.append(
                {"variant": name, "group": group, "rows": cells[0]["rows"], "of": int(pick.sum()), "cells": cells}
            )
    return answer


def error_answer(every: list[Json]) -> str:
    """Sentence on the rms errors (35) over all rows, from `variant_errors`: the robot's and the paper's."""
    own, _, raised, *_, paper = (e for e in every if e["group"] == "all")
    labels = [c.label for c in data.channels_of_paper()]
    mine, theirs = (
        ", ".join(f"{c['rms_percent']:.1f} % {label}" for c, label in zip(e["cells"], labels, strict=True))
        for e in (raised, paper)
    )
    few = f", with adhesion raised ({own['rows']} rows settle on its own)" if own["rows"] < own["of"] else ""
    return (
        f"rms error against {raised['rows']} of {raised['of']} measured rows: {mine}{few}. "
        f"The paper's own simulation: {theirs}."
    )


def implied_resistance(robot: Robot, table: runs.Runs) -> np.ndarray:
    """Resistance [Ω] in series with each motor that current and speed of each row imply by (15)."""
    current = table["total_current_A"]
    back = np.asarray(robot.motor.voltage_back(jnp.asarray(table["motor_speed_rpm"] * RPM)))
    return robot.sides * (table["supply_voltage_V"] - back) / current


def row_by_row(nominal: Robot, rows: data.Rows) -> list[Json]:
    """The 20 rows: bench, the paper's simulation, the nominal robot three ways, and letters that say why."""
    table = rows.conditions
    own, raised, weighed = (data.stack_channels(t) for t in (rows.plain, rows.raised, rows.weighed))
    resistance = implied_resistance(nominal, runs.read_runs("simulated_by_paper"))
    limit = float(nominal.motor.resistance)
    answer = []
    for k in range(len(table)):
        wheeled = table["configuration"][k] == WHEELED
        reasons = []
        if rows.plain["status"][k] == "slides":
            reasons.append("A")
        if wheeled and abs(rows.weighed["total_mass_kg"][k] - table["total_mass_kg"][k]) > 0.05:
            reasons.append("M")
        if wheeled and abs(weighed[k, 0] - rows.paper[k, 0]) > 0.03 * rows.paper[k, 0]:
            reasons.append("W")
        if not wheeled and abs(raised[k, 0] - rows.paper[k, 0]) > 0.01 * rows.paper[k, 0]:
            reasons.append("G")
        if resistance[k] > 1.1 * limit:
            reasons.append("E")
        if raised[k, 1] > 1.03 * rows.measured[k, 1]:
            reasons.append("B")
        following = (table["slope_deg"] == table["slope_deg"][k] + 5) & (
            (table["configuration"] == table["configuration"][k])
            & (table["supply_voltage_V"] == table["supply_voltage_V"][k])
        )
        if following.any() and rows.paper[following, 1][0] > rows.paper[k, 1]:
            reasons.append("N")
        creep = rows.raised["theoretical_speed_mm_s"][k] * rows.raised["slip"][k]
        radius = float(nominal.configurations[str(table["configuration"][k])].radius) / float(nominal.gearbox.ratio)
        creep_paper = rows.paper[k, 1] * RPM * radius / MM - rows.paper[k, 2]
        if creep_paper > 1.5 * creep + 2:
            reasons.append("S")
        answer.append(
            {
                "configuration": table["configuration"][k],
                "voltage": table["supply_voltage_V"][k],
                "mass": table["total_mass_kg"][k],
                "own_mass": float(rows.weighed["total_mass_kg"][k]),
                "slope": table["slope_deg"][k],
                "status": str(rows.plain["status"][k]),
                "reasons": reasons,
                "channels": [
                    _cells(
                        channel.name, rows.measured[k, c], rows.paper[k, c], own[k, c], raised[k, c], weighed[k, c]
                    )
                    for c, channel in enumerate(data.channels_of_paper())
                ],
            }
        )
    return answer


def _cells(channel: str, measured: float, paper: float, own: float, raised: float, weighed: float) -> Json:
    """Texts of one channel in a row. Differences by (35) of the nominal (raised, own mass) from paper and bench."""
    return {
        "measured": reading_text(measured, find_channel(channel)),
        "paper": reading_text(paper, find_channel(channel)),
        "own": reading_text(own, find_channel(channel)) if np.isfinite(own) else "slides",
        "raised": reading_text(raised, find_channel(channel)) if np.isfinite(raised) else "no number",
        "weighed": reading_text(weighed, find_channel(channel)) if np.isfinite(weighed) else "no number",
        "to_paper": float(simulation_errors.relative_error(np.array(raised), np.array(paper))),
        "to_paper_weighed": float(simulation_errors.relative_error(np.array(weighed), np.array(paper))),
        "to_measured": float(simulation_errors.relative_error(np.array(raised), np.array(measured))),
        "to_measured_weighed": float(simulation_errors.relative_error(np.array(weighed), np.array(measured))),
    }


def row_by_row_facts(nominal: Robot, rows: data.Rows) -> Json:
    """The numbers behind the letters of `row_by_row`, for the page to put into words."""
    measured = rows.conditions
    of_paper = implied_resistance(nominal, runs.read_runs("simulated_by_paper"))
    tracked = measured["configuration"] == TRACKED
    slow, slope = measured["supply_voltage_V"] == 15.0, measured["slope_deg"]
    used = rows.plain["adhesion_used"]
    extra = rows.weighed["total_current_A"] - rows.paper[:, 0]
    gap = 100 * (rows.raised["total_current_A"] - rows.paper[:, 0])[tracked] / rows.paper[tracked, 0]

    def span(values: np.ndarray) -> tuple[float, float]:
        return float(values.min()), float(values.max())

    return {
        "adhesion": tuple(float(nominal.configurations[c].ground.friction.static) for c in CONFIGURATIONS),
        "used_tracked_15": float(used[tracked & (slope == 15)][0]),
        "used_tracked_20": float(used[tracked & (slope == 20)][0]),
        "used_wheeled_20": float(used[~tracked & (slope == 20)][0]),
        "extra_slow": span(extra[~tracked & slow]),
        "extra_fast": span(extra[~tracked & ~slow]),
        "extra_flat": span(extra[~tracked & (slope == 0)]),
        "guide_share": float(nominal.configurations[TRACKED].track.guide_share),
        "gap": span(gap),
        "resistance": float(nominal.motor.resistance),
        "paper_slow": span(of_paper[tracked & slow]),
        "paper_fast": span(of_paper[tracked & ~slow]),
        "paper_wheeled": float(np.median(of_paper[~tracked])),
        "bench": float(np.median(implied_resistance(nominal, measured))),
    }


def write_paper_page(folder: Path, file: RobotFile, *, model: str, gear: bool) -> tuple[Path, data.Rows | None]:
    """Write `report.html` and `figures/` for a robot and its nominal fellows.

    Args:
        folder: an existing run folder.
        file: of any robot, without one of the paper's configurations it is not compared with the bench.
        model: fidelity.
        gear: whether it resolves the running gear, so that there are Figs. 23-27 from it too.

    Returns:
        The path of the page, and the robot's results for the paper's rows, None without one of their configurations.
    """
    nominal = ROBOTS["nominal"]()
    robot, robot_blocks = file.robot, page.robot_section(file)
    name = file.name if robot_blocks["robot"] == words_shown(file.name) else robot_blocks["robot"]
    robots = {name: robot} | {n: make() for n, make in ROBOTS.items() if n != name}
    album = page.Album(folder)
    facts: Json = {"gear": None, "errors": [], "sliding": [], "measured": 0, "raised": ""}
    rows = {
        n: r for n, r in ((n, data.simulate_measured_rows(member)) for n, member in robots.items()) if r is not None
    }
    own_rows = rows.get(name)
    ratio = dict.fromkeys(data.shown_configurations(robot), 1.0) if own_rows is None else own_rows.ratio
    if own_rows is not None:
        facts |= _against_the_bench(album, robots, rows, name)
    starts = data.simulate_starts(robot)
    album.add("fig23_24_from_standstill", lambda: history_figures.from_standstill(starts, data.FIG_23, data.FIG_24))
    if gear:
        from sweeps.paper import running_gear_figures

        facts["gear"] = running_gear_figures.draw_running_gear(album, robot)
    facts["energy"] = album.add("energy_split", lambda: run_figures.draw_energy(robot, ratio))
    album.add("fig05a_gearbox_efficiency", lambda: components.gearbox_efficiency(robots, own_rows))
    album.add("fig10_battery", lambda: components.draw_battery(robots))
    album.add("fig11_motor_friction", lambda: components.motor_friction(robots))
    facts["idle"] = album.add("fig18_idle_track", lambda: components.idle_track(robots))
    facts |= {
        "rows": row_by_row(nominal, rows["nominal"]),
        "facts": row_by_row_facts(nominal, rows["nominal"]),
        "raised_nominal": data.raised_words(nominal, rows["nominal"].ratio),
        "starts": starts,
        "split": data.SPLIT,
        "paper_channels": {c.name: (c.label, c.unit) for c in data.channels_of_paper()},
        "paper_idle_r2": components.PAPER_IDLE_R2,
    }
    title = f"The paper's figures and tables: {robot_blocks['robot']}"
    return page.render_page(
        folder, "paper.html.j2", album, title=title, model=model, **robot_blocks, **facts
    ), own_rows


def _against_the_bench(album: page.Album, robots: dict[str, Robot], rows: dict[str, data.Rows], name: str) -> Json:
    own_rows, robot = rows[name], robots[name]
    album.add("rows", lambda: run_figures.row_parity(own_rows, name))
    certainty = album.add("fig28_current_over_slope", lambda: run_figures.current_over_slope(robot, own_rows))
    if TRACKED in own_rows.ratio:
        album.add("fig29_model_errors", lambda: run_figures.model_errors(robots, rows))
    errors = variant_errors(_variants(name, rows), own_rows)
    pick = own_rows.plain["status"] != "converged"
    table = own_rows.conditions
    row_conditions = (table["configuration"], table["supply_voltage_V"], table["slope_deg"], own_rows.plain["status"])
    return {
        "answer": error_answer(errors),
        "certainty": certainty,
        "errors": errors,
        "raised": data.raised_words(robot, own_rows.ratio),
        "sliding": list(zip(*tuple(column[pick] for column in row_conditions), strict=True)),
        "measured": len(own_rows.conditions),
    }


def _variants(name: str, rows: dict[str, data.Rows]) -> Columns:
    """Errors of the rows under the names that the table of errors shows."""
    own_rows = rows[name]
    error = data.channel_percent_errors
    answer = {
        f"{words_shown(name)}: own adhesion, mass as printed": error(own_rows.plain, own_rows.measured),
        f"{words_shown(name)}: adhesion raised, mass as printed": error(own_rows.raised, own_rows.measured),
        f"{words_shown(name)}: adhesion raised, the robot's own mass": error(own_rows.weighed, own_rows.measured),
    }
    if name != "nominal":
        pick = np.isin(rows["nominal"].conditions["configuration"], list(own_rows.ratio))
        nominal = rows["nominal"]
        answer["nominal (PM): adhesion raised, its own mass"] = error(nominal.weighed, nominal.measured)[pick]
    return answer | {
        "the paper's own simulation": simulation_errors.relative_error(own_rows.paper, own_rows.measured)
    }
