"""The command `simulate`: a few given runs, with their histories where the fidelity has them."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from rich.table import Table

from calibration.data import runs as records
from calibration.data.errors import BadConfiguration
from mmrjax import balances, channels
from mmrjax.fidelities.drive import drive_batch
from mmrjax.robot import Robot
from mmrjax.signals import STATUSES
from sweeps import config as configuration
from sweeps import outputs, run, words
from sweeps.console import progress, say
from sweeps.inputs import load_robot, one_run, read_runs
from sweeps.store import RunFolder, open_folder

_POINTS, _INRUSH, _EARLY = 1001, 0.04, 160  # of a history; of its first instants [s], in which the current peaks
_HISTORIES = 1000  # runs of which histories are kept
_SHOWN = 6  # runs on the console


def simulate(config: configuration.Simulate, given: str | dict[str, Any], out: Path | None, force: bool) -> int:
    """Simulate runs of a file (its name), or one of options (by column); leave a run folder; returns the exit code.

    Raises:
        BadConfiguration: more runs than histories can be kept of.
    """
    robot = load_robot(config)
    runs = read_runs(given, robot, measured=False) if isinstance(given, str) else one_run(robot, given)
    if config.model != "steady" and len(runs) > _HISTORIES:
        raise BadConfiguration(
            f"--runs: got {len(runs)} runs; --model {config.model} keeps at most {_HISTORIES} histories"
        )
    with open_folder("simulate", config, robot, out, force, runs) as folder:
        histories = None
        if config.model == "steady":
            table = run.evaluate(robot, runs, config, folder)
        else:
            with progress(len(runs), quiet=config.model != "track") as advance:
                told = run.shares(advance, len(runs))
                outcome, histories = _histories(folder, robot, runs, config, told)
                table = {**run.conditions(robot, runs), **outcome}
                told(1.0)
        print_runs({key: value[:_SHOWN] for key, value in table.items()})
        if len(runs) > _SHOWN:
            say(f"... and {len(runs) - _SHOWN} more in runs.csv")
        if config.report:
            from sweeps import report_runs

            report_runs.write(
                folder.partial, robot=robot, robot_name=config.robot, model=config.model, runs=table,
                histories=histories,
            )  # fmt: skip
        return run.leave(folder, config, robot, table, {"schema": "mmrjax.simulate/1"}, runs)


def _histories(
    folder: RunFolder, robot: Robot, runs: records.Runs, config: configuration.Simulate,
    told: Callable[[float], None],
) -> tuple[dict[str, np.ndarray], Any]:  # fmt: skip
    """Write the runs over time, of the track model with every reaction; the columns of their ends, and the runs."""
    conditions = run.commanded(robot, runs, config)
    if config.model == "drive":
        trajectory = jax.device_get(drive_batch(robot, conditions, jnp.asarray(instants(config.duration))))
        folder.write_table("history.csv", history_table(robot, trajectory, trajectory.distance, runs))
        return outputs.columns(trajectory.result), trajectory
    trajectory = jax.device_get(run.track_runs(robot, conditions, config, rolling=False, progress=told))
    folder.write_table("history.csv", history_table(robot, trajectory, trajectory.q[..., 0], runs))
    folder.write_table("reactions.csv", reactions_table(trajectory, runs))
    return outputs.columns_track(trajectory), trajectory


def instants(duration: float) -> np.ndarray:
    """Times of a history [s] from 0 to `duration`, close together while the current rises to its peak."""
    early = np.linspace(0.0, min(_INRUSH, duration), _EARLY, endpoint=False)
    return np.union1d(early, np.linspace(0.0, duration, _POINTS))


def _names(runs: records.Runs) -> np.ndarray:
    return runs["run_id"] if runs.has("run_id") else np.array([f"run-{k + 1}" for k in range(len(runs))])


def history_table(robot: Robot, trajectory: Any, distance: np.ndarray, runs: records.Runs) -> dict[str, np.ndarray]:
    """Time histories of a batch as one table, a row a sample; the columns that series are read with."""
    signals = trajectory.signals
    return {
        "run_id": np.repeat(_names(runs), trajectory.time.shape[-1]),
        "time_s": trajectory.time.ravel(),
        **{name: np.ravel(value) for name, value in outputs.readings(balances.sensor(robot, signals)).items()},
        "theoretical_speed_mm_s": signals.speed_theoretical.ravel() / channels.MM,
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


def print_runs(table: dict[str, np.ndarray]) -> None:
    """Operating points, one a column."""
    rows = {
        "configuration": ("configuration", ""), "supply_voltage_V": ("supply voltage [V]", "g"),
        "total_mass_kg": ("total mass [kg]", "g"), "slope_deg": ("slope [deg]", "g"),
        **{c.column: (f"{c.label} [{c.unit}]", f".{c.resolution}f") for c in channels.CHANNELS},
        "slip": ("slip", ".4f"),
        "power_supply_W": ("power from supply P_e [W]", ".2f"), "power_motor_W": ("at motor shafts N_d [W]", ".2f"),
        "power_gear_W": ("at gearbox outputs N_r [W]", ".2f"), "power_ground_W": ("to the ground N_t [W]", ".2f"),
        "temperature_winding_C": ("winding, long running [°C]", ".0f"), "adhesion_used": ("adhesion used", ".3f"),
        "status": ("status", ""), "flags": ("limits exceeded", ""),
    }  # fmt: skip
    shown = Table(show_header=False)
    for key, (heading, form) in rows.items():
        cells = (str(v).replace(";", "\n") if not form else "-" if v != v else format(v, form) for v in table[key])
        shown.add_row(heading, *cells)
    say(shown)
    for status in dict.fromkeys(table["status"]):
        if status != STATUSES[0]:
            say(f"{status}: {words.STATUSES[status].why}")
