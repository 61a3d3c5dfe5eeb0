"""Page of `reproduce`: the paper's figures and tables for a robot, compared with the bench and the paper."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from calibration.data import Columns, Json
from calibration.data.robot_file import RobotFile
from calibration.inference import simulation_errors
from mmrjax.model.paper_robots import ROBOTS
from mmrjax.model.paper_tables import TRACKED
from mmrjax.model.robot import Robot
from sweeps.pages import history_figures, page
from sweeps.pages.words import words_shown
from sweeps.paper import components, data, error_tables, run_figures


def write_paper_page(folder: Path, file: RobotFile, *, model: str, gear: bool) -> tuple[Path, data.Rows | None]:
    """Write `report.html` and `figures/` for a robot and its nominal fellows.

    Args:
        folder: an existing run folder.
        file: of any robot; without one of the paper's configurations it is not compared with the bench.
        model: fidelity; gear: whether it resolves the running gear, so that there are Figs. 23-27 from it too.

    Returns:
        The path of the page, and the robot's results for the paper's rows; None without one of their configurations.
    """
    nominal = ROBOTS["nominal"]()
    robot, shown = file.robot, page.robot_section(file)
    name = file.name if shown["robot"] == words_shown(file.name) else shown["robot"]
    robots = {name: robot} | {n: make() for n, make in ROBOTS.items() if n != name}
    album = page.Album(folder)
    known: Json = {"gear": None, "errors": [], "sliding": [], "measured": 0, "raised": ""}
    rows = {
        n: r for n, r in ((n, data.simulate_measured_rows(member)) for n, member in robots.items()) if r is not None
    }
    mine = rows.get(name)
    ratio = dict.fromkeys(data.shown_configurations(robot), 1.0) if mine is None else mine.ratio
    if mine is not None:
        known |= _against_the_bench(album, robots, rows, name)
    starts = data.simulate_starts(robot)
    album.add("fig23_24_from_standstill", lambda: history_figures.from_standstill(starts, data.FIG_23, data.FIG_24))
    if gear:
        from sweeps.paper import running_gear_figures

        known["gear"] = running_gear_figures.draw_running_gear(album, robot)
    known["energy"] = album.add("energy_split", lambda: run_figures.draw_energy(robot, ratio))
    album.add("fig05a_gearbox_efficiency", lambda: components.gearbox_efficiency(robots, mine))
    album.add("fig10_battery", lambda: components.draw_battery(robots))
    album.add("fig11_motor_friction", lambda: components.motor_friction(robots))
    known["idle"] = album.add("fig18_idle_track", lambda: components.idle_track(robots))
    known |= {
        "rows": error_tables.row_by_row(nominal, rows["nominal"]),
        "facts": error_tables.row_by_row_facts(nominal, rows["nominal"]),
        "raised_nominal": data.raised_words(nominal, rows["nominal"].ratio),
        "starts": starts,
        "split": data.SPLIT,
        "paper_channels": {c.name: (c.label, c.unit) for c in data.channels_of_paper()},
        "paper_idle_r2": components.PAPER_IDLE_R2,
    }
    title = f"The paper's figures and tables: {shown['robot']}"
    return page.render_page(folder, "paper.html.j2", album, title=title, model=model, **shown, **known), mine


def _against_the_bench(album: page.Album, robots: dict[str, Robot], rows: dict[str, data.Rows], name: str) -> Json:
    mine, robot = rows[name], robots[name]
    album.add("rows", lambda: run_figures.row_parity(mine, name))
    certainty = album.add("fig28_current_over_slope", lambda: run_figures.current_over_slope(robot, mine))
    if TRACKED in mine.ratio:
        album.add("fig29_model_errors", lambda: run_figures.model_errors(robots, rows))
    errors = error_tables.variant_errors(_variants(name, rows), mine)
    pick = mine.plain["status"] != "converged"
    table = mine.conditions
    shown = (table["configuration"], table["supply_voltage_V"], table["slope_deg"], mine.plain["status"])
    return {
        "answer": error_tables.error_answer(errors),
        "certainty": certainty,
        "errors": errors,
        "raised": data.raised_words(robot, mine.ratio),
        "sliding": list(zip(*tuple(column[pick] for column in shown), strict=True)),
        "measured": len(mine.conditions),
    }


def _variants(name: str, rows: dict[str, data.Rows]) -> Columns:
    """Errors of the rows under the names that the table of errors shows."""
    mine = rows[name]
    error = data.channel_percent_errors
    answer = {
        f"{words_shown(name)}: own adhesion, mass as printed": error(mine.plain, mine.measured),
        f"{words_shown(name)}: adhesion raised, mass as printed": error(mine.raised, mine.measured),
        f"{words_shown(name)}: adhesion raised, the robot's own mass": error(mine.weighed, mine.measured),
    }
    if name != "nominal":
        pick = np.isin(rows["nominal"].conditions["configuration"], list(mine.ratio))
        nominal = rows["nominal"]
        answer["nominal (PM): adhesion raised, its own mass"] = error(nominal.weighed, nominal.measured)[pick]
    return answer | {"the paper's own simulation": simulation_errors.relative_error(mine.paper, mine.measured)}
