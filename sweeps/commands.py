"""What each command does, once its options are checked; jax is imported here and not before."""

from __future__ import annotations

import dataclasses
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from rich.table import Table

from calibration.data import effect_file, robot_file
from calibration.data import runs as records
from calibration.data.errors import BadConfiguration, BadData
from calibration.inference import errors as residual
from mmrjax import __version__, balances, params
from mmrjax.fidelities.drive import drive_batch
from mmrjax.robot import Robot
from mmrjax.signals import FLAGS, STATUSES
from sweeps import config as configuration
from sweeps import outputs, run
from sweeps.config import Simulation
from sweeps.grid import grid
from sweeps.store import RunFolder, default_path

jax.config.update("jax_enable_x64", True)

DONE, SOME_NOT_CONVERGED = 0, 3
#: Why a run has a status, for people.
WHY = {
    "converged": "steady travel",
    "stalled": "the motors cannot turn the load",
    "slides": "traction demand above the adhesion limit",
    "not_settled": "still accelerating at the end of the run; try a longer --duration",
    "battery_empty": "the battery has no charge left",
    "failed": "the solver gave up",
    "tips": "the line of gravity passes outside the contacts: the robot turns over",
}
_HISTORY_POINTS = 1001
_HISTORIES = 1000  # runs of which `simulate` keeps one
_WIDTH = None if sys.stdout.isatty() else 120  # a file has no width of its own
_out = Console(highlight=False, soft_wrap=True, markup=False, width=_WIDTH)
_err = Console(stderr=True, highlight=False, soft_wrap=True, markup=False)


def sweep(config: configuration.Sweep, out: Path | None, force: bool) -> int:
    """Simulate a grid and leave a run folder; returns the exit code."""
    robot = load_robot(config)
    runs = grid(config)
    with open_folder("sweep", config, robot, out, force) as folder:
        table = _evaluate(robot, runs, config, folder)
        print_counts(table)
        if config.report:
            from sweeps import report

            report.write(
                folder.partial, robot=robot, robot_name=config.robot, model=config.model, runs=table,
                title=f"Sweep of {len(runs)} runs",
            )  # fmt: skip
        return _finish(folder, config, robot, table, {"schema": "mmrjax.sweep/1"}, runs)


def simulate(config: Simulation, runs: records.Runs, out: Path | None, force: bool) -> int:
    """Simulate a few given runs; with `drive` and `track` from standstill, with their histories.

    Raises:
        BadConfiguration: more runs than histories can be kept of.
    """
    robot = load_robot(config)
    if config.model != "steady" and len(runs) > _HISTORIES:
        raise BadConfiguration(
            f"--runs: got {len(runs)} runs; --model {config.model} keeps at most {_HISTORIES} histories"
        )
    with open_folder("simulate", config, robot, out, force, runs) as folder:
        with _progress(len(runs), quiet=config.model != "track") as advance:
            if config.model == "steady":
                table = run.evaluate(robot, runs, config, folder, advance)
            else:
                told = run.shares(advance, len(runs))
                table = {**run.conditions(robot, runs), **_histories(folder, robot, runs, config, told)}
                told(1.0)
        shown = min(len(runs), 6)
        print_runs({key: value[:shown] for key, value in table.items()})
        if shown < len(runs):
            _out.print(f"... and {len(runs) - shown} more in runs.csv")
        if config.report:
            from sweeps import report

            report.write(
                folder.partial, robot=robot, robot_name=config.robot, model=config.model, runs=table,
                title="Simulation of one run" if len(runs) == 1 else f"Simulation of {len(runs)} runs",
            )  # fmt: skip
        return _finish(folder, config, robot, table, {"schema": "mmrjax.simulate/1"}, runs)


def _histories(
    folder: RunFolder, robot: Robot, runs: records.Runs, config: Simulation, progress: Callable[[float], None]
) -> dict[str, np.ndarray]:
    """Write the runs over time, of the track model with every reaction; returns the columns of their ends."""
    command = runs.command(battery=float(config.battery), discharge=run.charge(config))
    if config.model == "drive":
        times = jnp.linspace(0.0, config.duration, _HISTORY_POINTS)
        trajectory = jax.device_get(drive_batch(robot, command, times))
        folder.write_table("history.csv", history_table(robot, trajectory, trajectory.distance, runs))
        return outputs.columns(trajectory.result)
    trajectory = jax.device_get(run.track_runs(robot, command, config, rolling=False, progress=progress))
    folder.write_table("history.csv", history_table(robot, trajectory, trajectory.q[..., 0], runs))
    folder.write_table("reactions.csv", reactions_table(trajectory, runs))
    return outputs.columns_track(trajectory)


def _names(runs: records.Runs) -> np.ndarray:
    return runs["run_id"] if runs.has("run_id") else np.array([f"run-{k + 1}" for k in range(len(runs))])


def history_table(robot: Robot, trajectory: Any, distance: np.ndarray, runs: records.Runs) -> dict[str, np.ndarray]:
    """Time histories of a batch as one table, a row a sample; the columns that series are read with."""
    signals = trajectory.signals
    shown = balances.sensor(robot, signals)
    return {
        "run_id": np.repeat(_names(runs), trajectory.time.shape[-1]),
        "time_s": trajectory.time.ravel(),
        "total_current_A": np.ravel(shown.total_current),
        "motor_speed_rpm": np.ravel(shown.motor_speed) / records.RPM,
        "speed_mm_s": np.ravel(shown.speed) / records.MM,
        "theoretical_speed_mm_s": signals.speed_theoretical.ravel() / records.MM,
        "distance_m": distance.ravel(),
        "voltage_V": signals.voltage.ravel(),
        "traction_N": robot.sides * signals.traction.ravel(),
    }


def reactions_table(trajectory: Any, runs: records.Runs) -> dict[str, np.ndarray]:
    """Loads inside one side's running gear over time [N], a row a sample."""
    loads = trajectory.reactions
    table = {
        "run_id": np.repeat(_names(runs), trajectory.time.shape[-1]),
        "time_s": trajectory.time.ravel(),
        "guide_N": loads.guided.sum(-1).ravel(),
        "front_N": loads.support[..., 0].ravel(),
        "rear_N": loads.support[..., 1].ravel(),
        "centrifugal_tension_N": loads.centrifugal.ravel(),
    }
    for name in ("grouser", "tension"):
        values = getattr(loads, name)
        table |= {f"{name}_{k + 1:02d}_N": values[..., k].ravel() for k in range(values.shape[-1])}
    return table


def render(config: Simulation, runs: records.Runs, file: Path, begin: float, end: float | None, slow: float,
           force: bool) -> int:  # fmt: skip
    """Draw one run of the track model from standstill as a picture or a film."""
    from mmrjax import render as pictures

    try:
        pictures.instants(file, begin, end, slow, config.duration)
    except ValueError as error:
        raise BadConfiguration(f"render: {error}") from error
    if file.exists() and not force:
        raise BadConfiguration(f"FILE: {file} exists already; choose another name (--force replaces it)")
    if not file.parent.is_dir():
        raise BadConfiguration(f"FILE: {file.parent} is no folder; choose another path")
    robot = load_robot(config)
    command = runs.command(battery=float(config.battery), discharge=run.charge(config))
    with _progress(1, quiet=False) as advance:
        told = run.shares(advance, 1)
        trajectory = run.track_runs(robot, command, config, rolling=False, progress=told)
        told(1.0)
    first = jax.tree.map(lambda x: x[0], (trajectory, command))
    aside = file.with_name(f".{file.stem}.writing{file.suffix}")
    try:
        view = pictures.scene(robot, first[1], first[0])
        with _progress(1, quiet=False, doing="drawing") as advance:
            pictures.render(view, aside, begin, end, slow)
            advance(1)
        aside.replace(file)
    except ValueError as error:
        raise BadConfiguration(f"render: {error}") from error
    finally:
        aside.unlink(missing_ok=True)
    status = STATUSES[int(first[0].result.status)]
    _out.print(f"{status}: {WHY[status]}")
    _out.print(str(file))
    return DONE if status == STATUSES[0] else SOME_NOT_CONVERGED


def compare(config: Simulation, source: str, own_mass: bool, out: Path | None, force: bool) -> int:
    """Set a simulation against a table of measured runs: equation (35) and R² of (A1)."""
    runs = read_runs(source, measured=True)
    robot = load_robot(config)
    stated = runs
    if own_mass:
        runs = dataclasses.replace(runs, columns={k: v for k, v in runs.columns.items() if k != "total_mass_kg"})
    with open_folder("compare", config, robot, out, force, runs) as folder:
        table = _evaluate(robot, runs, config, folder)
        comparison, summary = compared(stated, table)
        folder.write_table("comparison.csv", comparison)
        print_comparison(comparison, summary)
        if config.report:
            from sweeps import report

            report.write_comparison(
                folder.partial, robot=robot, robot_name=config.robot, model=config.model, data_name=runs.source,
                table=comparison, summary=summary,
            )  # fmt: skip
        return _finish(folder, config, robot, table, {"schema": "mmrjax.compare/1", "errors": summary}, runs)


def compared(
    measured: records.Runs, simulated: dict[str, np.ndarray]
) -> tuple[dict[str, np.ndarray], dict[str, dict[str, dict[str, Any]]]]:
    """Rows side by side with their errors (35), and the errors' summary for all rows and by configuration."""
    table = {key: simulated[key] for key in ("configuration", *records.CONDITIONS)}
    for channel, column in zip(records.CHANNELS, records.MEASURED, strict=True):
        table[column] = measured[column]
        table[f"simulated_{column}"] = simulated[column]
        table[f"error_{channel}_percent"] = residual.relative_error(simulated[column], measured[column])
    table["status"] = simulated["status"]
    groups = {"all": np.ones(len(measured), bool)}
    groups |= {c: measured["configuration"] == c for c in records.CONFIGURATIONS}
    summary = {
        name: {
            channel: {
                **residual.summary(table[f"error_{channel}_percent"][rows]),
                "r2": residual.certainty(measured[column][rows], simulated[column][rows]),
            }
            for channel, column in zip(records.CHANNELS, records.MEASURED, strict=True)
        }
        for name, rows in groups.items()
        if rows.any()
    }
    return table, summary


def load_robot(config: Simulation) -> Robot:
    """The robot that a configuration names, with its changes; its effects may be the user's own."""
    library = effect_file.library(config.effects)
    return robot_file.change(robot_file.load(config.robot, library), config.set, where="--set")


def read_runs(source: str, *, measured: bool, series: bool = False) -> records.Runs:
    """Read a table, and say on stderr which of its columns are not used."""
    runs = records.read(source, measured=measured)
    if runs.has("time_s") and not series:
        raise BadData(
            f"{runs.source}: column time_s: time histories are for calibrate and loop; expected one row a run"
        )
    if runs.unknown:
        _err.print(f"{runs.source}: not used: {', '.join(runs.unknown)}")
    return runs


def say(what: Any) -> None:
    """Print text or a table to stdout."""
    _out.print(what)


def tell(text: str) -> None:
    """Print a line to stderr, where what is not the result goes."""
    _err.print(text)


def print_counts(table: dict[str, np.ndarray]) -> None:
    """How the runs ended, in words."""
    shown = Table(title=f"{len(table['status'])} runs", title_justify="left")
    for heading in ("status", "runs", "meaning"):
        shown.add_column(heading, justify="right" if heading == "runs" else "left")
    for status, count in run.counts(table).items():
        if count:
            shown.add_row(status, str(count), WHY[status])
    _out.print(shown)


def print_runs(table: dict[str, np.ndarray]) -> None:
    """Operating points, one a column."""
    rows = {
        "configuration": ("configuration", ""), "supply_voltage_V": ("supply voltage [V]", "g"),
        "total_mass_kg": ("total mass [kg]", "g"), "slope_deg": ("slope [deg]", "g"),
        "total_current_A": ("total current [A]", ".3f"), "motor_speed_rpm": ("motor speed [rpm]", ".1f"),
        "speed_mm_s": ("speed [mm/s]", ".1f"), "slip": ("slip", ".4f"),
        "power_supply_W": ("power from supply P_e [W]", ".2f"), "power_motor_W": ("at motor shafts N_d [W]", ".2f"),
        "power_gear_W": ("at gearbox outputs N_r [W]", ".2f"), "power_ground_W": ("to the ground N_t [W]", ".2f"),
        "temperature_winding_C": ("winding, long running [°C]", ".0f"), "adhesion_used": ("adhesion used", ".3f"),
        "status": ("status", ""), "flags": ("limits exceeded", ""),
    }  # fmt: skip
    shown = Table(show_header=False)
    for key, (heading, form) in rows.items():
        cells = (str(v).replace(";", "\n") if not form else "-" if v != v else format(v, form) for v in table[key])
        shown.add_row(heading, *cells)
    _out.print(shown)
    for status in dict.fromkeys(table["status"]):
        if status != STATUSES[0]:
            _out.print(f"{status}: {WHY[status]}")


def print_comparison(table: dict[str, np.ndarray], summary: dict[str, dict[str, dict[str, Any]]]) -> None:
    """Every row's errors, and their summary."""
    rows = Table(title="(simulated - measured) / simulated, eq. (35) [%]", title_justify="left")
    for heading in ("", "U [V]", "M [kg]", "slope [deg]", "current", "motor speed", "speed", "status"):
        rows.add_column(heading, justify="left" if heading in ("", "status") else "right")
    for k in range(len(table["status"])):
        errors = (table[f"error_{channel}_percent"][k] for channel in records.CHANNELS)
        stated = (f"{table[c][k]:g}" for c in ("supply_voltage_V", "total_mass_kg", "slope_deg"))
        rows.add_row(
            table["configuration"][k], *stated,
            *("-" if e != e else f"{e:+.1f}" for e in errors), table["status"][k],
        )  # fmt: skip
    if len(table["status"]) <= 60:
        _out.print(rows)
    shown = Table(title="Summary", title_justify="left")
    for heading in ("rows of", "channel", "rows", "rms [%]", "worst [%]", "R²"):
        shown.add_column(heading, justify="left" if heading in ("rows of", "channel") else "right")
    for group, channels in summary.items():
        for channel, numbers in channels.items():
            figures = (numbers["rms_percent"], numbers["max_percent"], numbers["r2"])
            cells = ("-" if v != v else format(v, f) for v, f in zip(figures, (".1f", ".1f", ".3f"), strict=True))
            shown.add_row(group, channel.replace("_", " "), str(numbers["rows"]), *cells)
    _out.print(shown)
    lost = int(np.sum(table["status"] != STATUSES[0]))
    if lost:
        _out.print(
            f"{lost} of {len(table['status'])} rows did not converge; rows with no simulated value are left out."
        )


def open_folder(
    command: str, config: Simulation, robot: Robot, out: Path | None, force: bool, runs: records.Runs | None = None
) -> RunFolder:
    """The run folder of a command, whose identity is what it was told."""
    identity = {
        "command": command,
        "program": f"{__version__}, jax {jax.__version__}, {jax.default_backend()}",
        "config": config.model_dump(exclude={"report"}),
        "robot": {p.name: float(p.value) for p in params.walk(robot)},
        "runs": None if runs is None else {key: value.tolist() for key, value in runs.columns.items()},
    }
    return RunFolder(out or default_path(command), identity, force=force)


def _evaluate(robot: Robot, runs: records.Runs, config: Simulation, folder: RunFolder) -> dict[str, np.ndarray]:
    slow = config.model == "track" or len(runs) > config.runs_at_once
    with _progress(len(runs), quiet=not slow) as advance:
        return run.evaluate(robot, runs, config, folder, advance)


@contextmanager
def _progress(total: int, quiet: bool, doing: str = "simulating") -> Iterator[Any]:
    columns = (TextColumn(doing), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn(), TimeRemainingColumn())
    with Progress(*columns, console=_err, disable=quiet) as bar:
        task = bar.add_task("", total=total)
        # rounded, or the sum of a chunk's shares would end a hair below its runs
        yield lambda count: bar.update(task, completed=round(bar.tasks[task].completed + count, 6))


def _finish(
    folder: RunFolder, config: Simulation, robot: Robot, table: dict[str, np.ndarray], result: dict[str, Any],
    runs: records.Runs,
) -> int:  # fmt: skip
    folder.write_table("runs.csv", table)
    folder.write_text("config.resolved.toml", configuration.as_toml(config))
    robot_file.write(robot, folder.partial / "robot.toml", note=f"the robot of this run, from {config.robot}")
    counts = run.counts(table)
    flags = {name: int(np.sum(np.char.find(table["flags"], name) >= 0)) for name in FLAGS}
    folder.write_json("result.json", {**result, "model": config.model, "runs": len(table["status"]),
                                      "statuses": counts, "flags": flags})  # fmt: skip
    path = folder.finish({"seed": None, "statuses": counts}, runs)
    _out.print(str(path))
    return DONE if counts["converged"] == len(table["status"]) else SOME_NOT_CONVERGED
