"""The command `compare`: a simulation set against a table of measured runs, equation (35) and R² of (A1)."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from rich.table import Table

from calibration.data import instruments
from calibration.data import runs as records
from calibration.data.input_errors import BadConfiguration
from calibration.data.robot_file import RobotFile
from calibration.inference import preparation, simulation_errors
from calibration.inference.ranges import check_ranges
from calibration.words.note_words import sentences
from mmrjax import fidelities
from mmrjax.model.channels import Channel
from mmrjax.model.robot import Robot
from sweeps import config as configuration
from sweeps.console import say
from sweeps.inputs import beside_robot, load_robot, read_runs
from sweeps.pages import words
from sweeps.points import run, uncertainty
from sweeps.skeleton import page
from sweeps.store import open_folder

#: Fidelity that follows time histories, and over what their errors are shown besides.
HISTORIES, OVER = "drive", {"time_s": "time [s]"}
#: Conditions that are printed, and their headings.
HEADINGS = {
    "supply_voltage_V": "U [V]", "motor_speed_rpm": "n [rpm]", "total_mass_kg": "M [kg]", "slope_deg": "slope [deg]",
    "load_torque_Nm": "load torque [N·m]", "duty_left": "duty, left", "duty_right": "duty, right",
    "heading_deg": "heading [deg]",
}  # fmt: skip
#: Group → channel → rows, rms_percent, max_percent, rms, unit (of the rms), r2, missing.
Summary = dict[str, dict[str, dict[str, Any]]]


def compare(config: configuration.Compare, source: str, own_mass: bool, out: Path | None, force: bool) -> int:
    """Simulate the runs of a table, set them beside its readings, leave a run folder; returns the exit code."""
    file = load_robot(config)
    stated = runs = read_runs(source, file.robot, columns=config.columns, measured=True, series=True, of_turns=True)
    if runs.turns:
        file = dataclasses.replace(file, robot=file.robot.showing_turns(runs.layout.measured_columns), remarks=())
    if runs.sampled:
        return _over_time(config, file, runs, own_mass, out, force)
    robot = instruments.with_inferred_instruments(file.robot, runs)
    if own_mass:
        runs = dataclasses.replace(runs, columns={k: v for k, v in runs.columns.items() if k != "total_mass_kg"})
    said = sentences(check_ranges(runs, robot))
    drawn = None if config.posterior is None else beside_robot(file)
    with open_folder("compare", config, robot, out, force, runs) as folder:
        table = run.evaluate(robot, runs, config, folder)
        sized = stated.turns or stated.layout.crosses_zero
        comparison, summary = compared(stated, table, robot, sized)
        folder.write_table("comparison.csv", comparison)
        notes = [*missing(comparison, stated.channels), *said]
        print_comparison(comparison, summary, stated.channels, notes, sized=sized)
        if drawn is not None and config.posterior is not None:
            found = uncertainty.intervals(robot, drawn, runs, config, config.posterior, folder)
            uncertainty.say_intervals(table, found)
            table |= found.columns
            ends = (uncertainty.SD, uncertainty.LOWER, uncertainty.UPPER)
            kept = [c.column + end for c in robot.channels for end in ends]
            folder.write_table(
                "comparison.csv", comparison | {f"simulated_{key}": found.columns[key] for key in kept}
            )
        further = {"errors": summary, "notes": [*file.remarks, *notes]}
        result = run.SimulationResult("compare", config.model, robot, runs, table, further)
        shown = page(
            "comparison", dataclasses.replace(file, robot=robot), model=config.model, data_name=runs.source,
            table=comparison, summary=summary, notes=notes,
        )  # fmt: skip
        return run.leave(folder, config, result, shown)


def _over_time(
    config: configuration.Compare, file: RobotFile, runs: records.Runs, own_mass: bool, out: Path | None, force: bool
) -> int:
    """The same for time histories, which the robot follows as its fits do, from each run's own beginning."""
    options = {"--own-mass": own_mass, "--posterior": config.posterior, "--duration": config.duration_s}
    for option in (name for name, stated in options.items() if stated):
        raise BadConfiguration(
            f"{option}: {Path(runs.source).name} holds time histories, which are followed sample by sample, with the "
            "masses and times that they state; leave it out"
        )
    model = None if config.model == fidelities.NAMES[0] else config.model
    ready = preparation.prepare(runs, file.robot)
    with open_folder("compare", config, ready.robot, out, force, runs) as folder:
        table = run.followed(ready.robot, runs, model)
        comparison, summary = compared(runs, table, ready.robot, sized=True)
        comparison |= {column: runs[column] for column in (*OVER, "run_id") if runs.has(column)}
        folder.write_table("comparison.csv", comparison)
        notes = [*missing(comparison, runs.channels), *sentences((*ready.checked, *ready.begins, *ready.weighed))]
        print_comparison(comparison, summary, runs.channels, notes, sized=True)
        result = run.SimulationResult(
            "compare", HISTORIES, ready.robot, runs, table, {"errors": summary, "notes": [*file.remarks, *notes]}
        )
        shown = page(
            "comparison", dataclasses.replace(file, robot=ready.robot), model=HISTORIES, data_name=runs.source,
            table=comparison, summary=summary, notes=notes, over=OVER,
        )  # fmt: skip
        return run.leave(folder, config, result, shown)


def compared(
    measured: records.Runs, simulated: dict[str, np.ndarray], robot: Robot | None = None, sized: bool | None = None
) -> tuple[dict[str, np.ndarray], Summary]:
    """Rows side by side with their errors (35), and the errors' summary for all rows and by configuration, of `robot`
    those of its surfaces.

    A reading that is missing is NaN in its row; it weighs nothing and is counted as `missing`.

    Args:
        sized: whether percent are of a channel's size; None: where readings of the table's layout cross zero.
    """
    crosses_zero = measured.layout.crosses_zero if sized is None else sized
    table = {
        key: simulated[key] for key in ("configuration", *dict.fromkeys((*measured.layout.axes, *measured.axes)))
    }
    if not measured.layout.complete and measured.has("surface"):
        table["surface"] = measured["surface"]
    nothing = np.full(len(measured), np.nan)
    for channel in measured.channels:
        table[channel.column] = measured.columns.get(channel.column, nothing)
        table[f"simulated_{channel.column}"] = simulated[channel.column]
        table[f"error_{channel.name}_percent"] = simulation_errors.percent_error(
            simulated[channel.column], table[channel.column], crosses_zero=crosses_zero
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


def _summary(channel: Channel, table: dict[str, np.ndarray]) -> dict[str, Any]:
    measured, simulated = table[channel.column], table[f"simulated_{channel.column}"]
    return {
        **simulation_errors.summary(table[f"error_{channel.name}_percent"]),
        "rms": simulation_errors.root_mean_square(simulated - measured),
        "unit": channel.unit,
        "r2": simulation_errors.certainty(measured, simulated),
        "missing": int(np.isnan(measured).sum()),
    }


def missing(table: dict[str, np.ndarray], channels: Sequence[Channel]) -> list[str]:
    """A sentence for each channel of which the table lacks readings."""
    lost = {c.column: int(np.isnan(table[c.column]).sum()) for c in channels}
    rows = len(table["status"])
    return [
        f"{column}: {'all' if count == rows else f'{count} of {rows}'} readings are missing; they weigh nothing"
        for column, count in lost.items()
        if count
    ]


def print_comparison(
    table: dict[str, np.ndarray],
    summary: Summary,
    channels: Sequence[Channel],
    notes: list[str],
    sized: bool = False,
) -> None:
    """Every row's errors, their summary, and which readings are missing.

    Args:
        sized: whether percent are of a channel's size; rows then show errors in the channel's unit.
    """
    title = "simulated - measured" if sized else "(simulated - measured) / simulated, eq. (35) [%]"
    rows = Table(title=title, title_justify="left")
    stated_here = {c: words for c, words in HEADINGS.items() if c in table and f"simulated_{c}" not in table}
    for heading in ("", *stated_here.values(), *(_words(c, sized) for c in channels), "status"):
        rows.add_column(heading, justify="left" if heading in ("", "status") else "right")
    for k in range(len(table["status"])):
        errors = [
            (table[f"simulated_{c.column}"][k] - table[c.column][k], f"+.{c.resolution}f")
            if sized else (table[f"error_{c.name}_percent"][k], "+.1f")
            for c in channels
        ]  # fmt: skip
        stated = (f"{table[c][k]:g}" for c in stated_here)
        rows.add_row(
            table["configuration"][k], *stated,
            *("-" if e != e else format(e, form) for e, form in errors), table["status"][k],
        )  # fmt: skip
    if len(table["status"]) <= 60:
        say(rows)
    shown = Table(title="Summary", title_justify="left")
    share = " of its size" if sized else ""
    units = ("rms",) if sized else ()
    for heading in ("rows of", "channel", "rows", *units, f"rms [%{share}]", f"worst [%{share}]", "R²"):
        shown.add_column(heading, justify="left" if heading in ("rows of", "channel") else "right")
    for group, by_channel in summary.items():
        for channel in channels:
            numbers = by_channel[channel.name]
            figures = (numbers["rms_percent"], numbers["max_percent"], numbers["r2"])
            cells = ("-" if v != v else format(v, f) for v, f in zip(figures, (".1f", ".1f", ".3f"), strict=True))
            rms = numbers["rms"]
            in_unit = "-" if rms != rms else f"{rms:.{channel.resolution}f} {channel.unit}"
            shown.add_row(group, channel.label, str(numbers["rows"]), *((in_unit,) if sized else ()), *cells)
    say(shown)
    lost = int(np.sum(~np.isin(table["status"], words.SETTLED)))
    if lost:
        say(f"{lost} of {len(table['status'])} rows did not converge; rows with no simulated value are left out.")
    for note in notes:
        say(note)


def _words(channel: Channel, with_unit: bool) -> str:
    return channel.word.replace("_", " ") + (f" [{channel.unit}]" if with_unit else "")
