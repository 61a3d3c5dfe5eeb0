"""The report: one offline HTML file with the paper's figures remade, and what a sweep or a comparison found."""

from __future__ import annotations

import base64
import math
from collections.abc import Callable
from importlib import resources
from pathlib import Path
from typing import TYPE_CHECKING, Any

import jinja2
import numpy as np

from calibration.inference import errors as residual
from mmrjax import __version__
from mmrjax.robot import CONFIGURATIONS
from sweeps import figures, figures_data, figures_runs, figures_sweep, report_tables
from sweeps.figures_style import CHANNEL_WORDS, STATUS_WORDS, style, svg

if TYPE_CHECKING:
    from mmrjax.robot import Robot

#: Column of each channel, as in the tables of runs.
COLUMNS = {"total_current": "total_current_A", "motor_speed": "motor_speed_rpm", "speed": "speed_mm_s"}


class Album:
    """Draws figures into `folder/figures` and keeps them, encoded, for the page."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder / "figures"
        self.folder.mkdir(parents=True, exist_ok=True)
        self.pictures: dict[str, str] = {}

    def add(self, name: str, draw: Callable[[], Any]) -> Any:
        """Draw one figure; `draw` returns it, alone or followed by numbers, which are returned."""
        with style():
            drawn = draw()
            figure, *numbers = drawn if isinstance(drawn, tuple) else (drawn,)
            text = svg(figure)
        (self.folder / f"{name}.svg").write_text(text, encoding="utf-8")
        self.pictures[name] = "data:image/svg+xml;base64," + base64.b64encode(text.encode()).decode()
        return numbers[0] if numbers else None


def write(
    folder: Path, *, robot: Robot, robot_name: str, model: str, runs: dict[str, np.ndarray] | None, title: str
) -> Path:
    """Write `report.html` and `figures/` for a robot and, where there is one, its finished sweep.

    Args:
        folder: an existing run folder.
        robot: the robot that was simulated; the paper's figures are made from it and its nominal fellows.
        robot_name: its name or file; of a file only the last part is shown.
        model: fidelity of the sweep; with `track` the page has Figs. 23-27 from that model too.
        runs: the finished runs table, any grid; None leaves the sweep's own section out.
        title: heading of the page.

    Returns:
        The path of the page.
    """
    from mmrjax.nominal import ROBOTS

    folder = Path(folder)
    nominal = ROBOTS["nominal"]()
    name, changed = _named(robot, robot_name, nominal)
    robots = {name: robot} | {n: make() for n, make in ROBOTS.items() if n != name}
    rows = {n: figures_data.rows(r) for n, r in robots.items()}
    album = Album(folder)
    known: dict[str, Any] = {"gear": None}
    if runs is not None and len(runs["status"]):
        known["counts"] = report_tables.counts(runs)
        known["volts_drawn"] = _drawn(runs)
        known["single"] = _single(runs) if len(runs["status"]) <= 3 else None
        if known["single"] is None:
            for quantity in figures_sweep.VALUES:
                album.add(f"sweep_{quantity}", lambda q=quantity: figures_sweep.sweep(runs, q))
    mine, ratio = rows[name], rows[name].ratio
    album.add("rows", lambda: figures_runs.row_parity(mine, name))
    known["certainty"] = album.add("fig28_current_over_slope", lambda: figures_runs.current_over_slope(robot, mine))
    known["model_errors"] = album.add("fig29_model_errors", lambda: figures_runs.model_errors(robots, rows))
    starts = figures_data.starts(robot)
    album.add("fig23_24_from_standstill", lambda: figures_runs.from_standstill(starts))
    if model == "track":
        known["gear"] = _running_gear(album, robot)
    known["energy"] = album.add("energy_split", lambda: figures_runs.energy(robot, ratio))
    album.add("fig05a_gearbox_efficiency", lambda: figures.gearbox_efficiency(robots, mine))
    album.add("fig10_battery", lambda: figures.battery(robots))
    album.add("fig11_motor_friction", lambda: figures.motor_friction(robots))
    known["idle"] = album.add("fig18_idle_track", lambda: figures.idle_track(robots))
    known |= {
        "errors": report_tables.errors(_variants(name, rows), mine),
        "rows": report_tables.row_by_row(nominal, rows["nominal"]),
        "facts": report_tables.facts(nominal, rows["nominal"]),
        "raised": figures_data.raised_words(robot, ratio),
        "raised_nominal": figures_data.raised_words(nominal, rows["nominal"].ratio),
        "sliding": list(zip(*_sliding_rows(mine), strict=True)),
        "starts": starts,
        "changed": changed,
        "split": figures_data.SPLIT,
        "paper_idle_r2": figures.PAPER_IDLE_R2,
    }
    return render(folder, "report.html.j2", album, title=title, robot=words_shown(name), model=model, **known)


def _running_gear(album: Album, robot: Robot) -> dict[str, Any]:
    """Figs. 23-27 from the track model, both configurations from standstill on the flat at 33 V.

    Returns:
        `left_out` None, `rows` of the ripple table, and of 6T2A the guide `friction`, the robot's own `share`
        and both `currents` [A], by `steady` at that share and with the share resolved; or `left_out`, the
        statuses of both, and no figures drawn.
    """
    from mmrjax.signals import STATUSES
    from sweeps import figures_track

    run = figures_track.runs(robot)
    if not figures_track.drives(run):
        return {"left_out": [STATUSES[k] for k in np.asarray(run.result.status)]}
    starts = figures_data.starts_of(robot, run)
    album.add("track_fig23_24_from_standstill", lambda: figures_runs.from_standstill(starts))
    facts = album.add("track_fig25_ripple", lambda: figures_track.ripple_of_current(robot, run))
    album.add("track_fig26_touchdown", lambda: figures_track.touchdown(robot, run))
    album.add("track_fig27_reactions", lambda: figures_track.reactions(run))
    tracked = np.array(CONFIGURATIONS[:1])
    lumped = figures_data.operating_points(robot, figures_data.command(robot, configuration=tracked, voltage=33.0))
    resolved = np.asarray(run.result.reading.total_current)[0]
    return {
        "left_out": None,
        "rows": facts,
        "share": float(robot.configurations["6T2A"].track.guide_share),
        "friction": float(robot.configurations["6T2A"].track.guide_friction),
        "currents": (float(lumped["total_current_A"][0]), float(resolved)),
    }


def write_comparison(
    folder: Path,
    *,
    robot: Robot,
    robot_name: str,
    model: str,
    data_name: str,
    table: dict[str, np.ndarray],
    summary: dict[str, dict[str, dict[str, Any]]],
) -> Path:
    """Write `report.html` and `figures/` for a simulation set against a table of measured runs.

    Args:
        table: conditions, `<column>` measured, `simulated_<column>`, `error_<channel>_percent`, `status`.
        summary: group (`all`, `6T2A`, `4W2T`) → channel → rows, rms_percent, max_percent, r2.

    The other arguments and the result are those of `write`.
    """
    from mmrjax.nominal import ROBOTS

    folder = Path(folder)
    name, changed = _named(robot, robot_name, ROBOTS["nominal"]())
    album = Album(folder)
    album.add("parity", lambda: figures_sweep.parity(table, COLUMNS))
    album.add("errors", lambda: figures_sweep.errors_over(table, COLUMNS))
    shown = min(len(table["status"]), 200)
    rows = [{k: v[i] for k, v in table.items()} for i in range(shown)]
    statuses = [
        {"name": s, "count": int((table["status"] == s).sum()), "meaning": report_tables.STATUS_MEANING.get(s, "")}
        for s in dict.fromkeys(map(str, table["status"]))
    ]
    return render(
        folder,
        "comparison.html.j2",
        album,
        title=f"{words_shown(name)} against {Path(data_name).name}",
        robot=words_shown(name),
        model=model,
        data_name=Path(data_name).name,
        rows=rows,
        total=len(table["status"]),
        statuses=statuses,
        summary=summary,
        columns=COLUMNS,
        changed=changed,
    )


def _named(robot: Robot, robot_name: str, nominal: Robot) -> tuple[str, list[dict[str, str]]]:
    """The name to show and the parameters that are not nominal; a changed paper's robot is said to be one."""
    from mmrjax.nominal import ROBOTS

    name = Path(robot_name).name
    if name in ROBOTS and report_tables.changed_parameters(robot, ROBOTS[name]()):
        name = f"{name}, changed"
    return name, report_tables.changed_parameters(robot, nominal)


def words_shown(name: str) -> str:
    """A robot's name as the page shows it."""
    return figures.words_robot(name)


def _variants(name: str, rows: dict[str, figures_data.Rows]) -> dict[str, np.ndarray]:
    """Errors of the 20 rows under the names that the table of errors shows."""
    mine = rows[name]
    error = figures_data.errors
    answer = {
        f"{words_shown(name)}: own adhesion, mass as printed": error(mine.plain, mine.measured),
        f"{words_shown(name)}: adhesion raised, mass as printed": error(mine.raised, mine.measured),
        f"{words_shown(name)}: adhesion raised, the robot's own mass": error(mine.weighed, mine.measured),
    }
    if name != "nominal":
        nominal = rows["nominal"]
        answer["nominal (PM): adhesion raised, its own mass"] = error(nominal.weighed, nominal.measured)
    return answer | {"the paper's own simulation": residual.relative_error(mine.paper, mine.measured)}


def _sliding_rows(rows: figures_data.Rows) -> tuple[np.ndarray, ...]:
    pick = rows.plain["status"] != "converged"
    table = rows.conditions
    shown = (table["configuration"], table["supply_voltage_V"], table["slope_deg"], rows.plain["status"])
    return tuple(column[pick] for column in shown)


def _drawn(runs: dict[str, np.ndarray]) -> str:
    shown = figures_sweep.panels(runs["supply_voltage_V"])
    if sum(int(mask.sum()) for _, mask in shown) == len(runs["status"]):
        return ""
    return f"{', '.join(words for words, _ in shown)} of {np.unique(runs['supply_voltage_V']).size} voltages"


def _single(runs: dict[str, np.ndarray]) -> list[dict[str, Any]]:
    return [{k: v[i] for k, v in runs.items()} for i in range(len(runs["status"]))]


def _number(value: Any, form: str = "{:.2f}") -> str:
    if isinstance(value, int | float | np.number):
        return form.format(float(value)) if math.isfinite(float(value)) else "–"
    return str(value)


def _grade(value: Any) -> str:
    """Class of a cell by the size of its error [%]: the paper claims 7 %."""
    size = abs(float(value))
    return "none" if not math.isfinite(size) else "good" if size <= 5 else "fair" if size <= 10 else "bad"


def render(folder: Path, template: str, album: Album, **known: Any) -> Path:
    """Write `report.html` from a template, the album's pictures and what the template asks for."""
    environment = jinja2.Environment(
        loader=jinja2.FunctionLoader(lambda n: (resources.files("sweeps") / "templates" / n).read_text("utf-8")),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters |= {"number": _number, "grade": _grade}
    environment.globals |= {"channels": CHANNEL_WORDS, "status_words": STATUS_WORDS, "version": __version__}
    known.setdefault("counts", None)
    page = environment.get_template(template).render(pictures=album.pictures, **known)
    path = folder / "report.html"
    path.write_text(page, encoding="utf-8")
    return path
