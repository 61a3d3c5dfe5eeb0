"""The command `simulate`: a few given runs, with their histories where the fidelity has them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import jax
import numpy as np
from rich.table import Table

from calibration.data import runs as records
from calibration.data.errors import BadConfiguration
from mmrjax import channels, fidelities
from mmrjax.fidelities.base import History, Run
from mmrjax.robot import Robot
from mmrjax.signals import STATUSES
from sweeps import config as configuration
from sweeps import run, uncertainty, words
from sweeps.console import progress, say
from sweeps.inputs import beside_robot, load_robot, one_run, read_runs
from sweeps.store import RunFolder, open_folder

_HISTORIES = 1000  # runs of which histories are kept
_SHOWN = 6  # runs on the console


def simulate(config: configuration.Simulate, given: str | dict[str, Any], out: Path | None, force: bool) -> int:
    """Simulate runs of a file (its name), or one of options (by column); leave a run folder; returns the exit code.

    Raises:
        BadConfiguration: more runs than histories can be kept of.
    """
    robot = load_robot(config)
    runs = read_runs(given, robot, measured=False) if isinstance(given, str) else one_run(robot, given)
    if fidelities.facts(config.model).histories and len(runs) > _HISTORIES:
        raise BadConfiguration(
            f"--runs: got {len(runs)} runs; --model {config.model} keeps at most {_HISTORIES} histories"
        )
    drawn = None if config.posterior is None else beside_robot(config, robot)
    with open_folder("simulate", config, robot, out, force, runs) as folder:
        table, histories = _simulated(folder, robot, runs, config)
        found = None
        if drawn is not None and config.posterior is not None:
            found = uncertainty.intervals(robot, drawn, runs, config, config.posterior)
            table |= found.columns
        print_runs({key: value[:_SHOWN] for key, value in table.items()})
        if found is not None:
            say(f"± one sd over {found.draws} robots drawn from the posterior; 95 % intervals are in runs.csv")
            uncertainty.say_lost(found)
        if len(runs) > _SHOWN:
            say(f"... and {len(runs) - _SHOWN} more in runs.csv")
        if config.report:
            from sweeps import report_runs

            report_runs.write(
                folder.partial, robot=robot, robot_name=config.robot, model=config.model, runs=table,
                histories=histories,
            )  # fmt: skip
        return run.leave(folder, config, run.SimulationResult("simulate", config.model, robot, runs, table))


def _simulated(
    folder: RunFolder, robot: Robot, runs: records.Runs, config: configuration.Simulate
) -> tuple[dict[str, np.ndarray], Run | None]:
    """The table of the runs; where the fidelity keeps them over time these are written, and returned too."""
    fidelity = fidelities.get(config.model)
    if fidelity.histories is None:
        return run.evaluate(robot, runs, config, folder), None
    conditions = run.commanded(robot, runs, config)
    run.refuse(robot, conditions, config)
    with progress(len(runs), quiet=not fidelity.facts.slow) as advance:
        told = run.shares(advance, len(runs))
        batch = jax.device_get(fidelity.histories(robot, conditions, config.options, told))
        told(1.0)
    assert batch.history is not None  # the fidelity was asked for it
    folder.write_table("history.csv", history_table(robot, batch.history, runs))
    if batch.history.reactions is not None:
        folder.write_table("reactions.csv", reactions_table(batch.history, runs))
    return {**run.conditions(robot, runs), **run.ended(batch)}, batch


def _names(runs: records.Runs) -> np.ndarray:
    return runs["run_id"] if runs.has("run_id") else np.array([f"run-{k + 1}" for k in range(len(runs))])


def history_table(robot: Robot, history: History, runs: records.Runs) -> dict[str, np.ndarray]:
    """Time histories of a batch as one table, a row a sample; the columns that series are read with."""
    signals = history.signals
    return {
        "run_id": np.repeat(_names(runs), history.time.shape[-1]),
        "time_s": np.ravel(history.time),
        **{c.column: np.ravel(history.reading[c.name]) / c.factor for c in channels.CHANNELS},
        "theoretical_speed_mm_s": np.ravel(signals.speed_theoretical) / channels.MM,
        "distance_m": np.ravel(history.distance),
        "voltage_V": np.ravel(signals.voltage),
        "traction_N": float(robot.sides) * np.ravel(signals.traction),
    }


def reactions_table(history: History, runs: records.Runs) -> dict[str, np.ndarray]:
    """Loads inside one side's running gear over time [N], a row a sample."""
    loads = history.reactions
    assert loads is not None  # the fidelity resolves them
    table = {
        "run_id": np.repeat(_names(runs), history.time.shape[-1]),
        "time_s": np.ravel(history.time),
        "guide_N": np.ravel(loads.guided.sum(-1)),
        "front_N": np.ravel(loads.support[..., 0]),
        "rear_N": np.ravel(loads.support[..., 1]),
        "centrifugal_tension_N": np.ravel(loads.centrifugal),
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
        cells = [str(v).replace(";", "\n") if not form else "-" if v != v else format(v, form) for v in table[key]]
        if form and key + uncertainty.SD in table:
            digits = int(form.strip(".f"))
            pairs = zip(table[key], table[key + uncertainty.SD], strict=True)
            cells = ["-" if v != v else uncertainty.with_sd(v, sd, digits) for v, sd in pairs]
        shown.add_row(heading, *cells)
    say(shown)
    for status in dict.fromkeys(table["status"]):
        if status != STATUSES[0]:
            say(f"{status}: {words.STATUSES[status].why}")
