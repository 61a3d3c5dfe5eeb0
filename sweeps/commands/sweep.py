"""The command `sweep`: every combination of a grid, in vmapped batches."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
from rich.table import Table

from sweeps import config as configuration
from sweeps.console import say, tell
from sweeps.inputs import beside_robot, load_robot
from sweeps.pages import words
from sweeps.points import run, uncertainty
from sweeps.points.grid import axes, grid, resolved
from sweeps.points.zarr_store import STORE
from sweeps.skeleton import page
from sweeps.store import open_folder

#: Most runs of which a grid leaves a table, runs.csv; of more it leaves a store, in a tenth of the time and bytes.
TABLE = 100_000


def sweep(config: configuration.Sweep, where: str, out: Path | None, force: bool) -> int:
    """Simulate a grid and leave a run folder, of more than `TABLE` runs one with a store; returns the exit code.

    Args:
        config: the configuration; where: its file, for messages; out: the run folder; force: replace one.
    """
    file = load_robot(config)
    robot = file.robot
    notes: list[str] = []
    stated = config
    config = resolved(stated, robot, stated.battery, notes)
    count = math.prod(map(len, axes(config, robot, config.battery).values()))
    if count > TABLE and config.posterior is None:
        from sweeps.commands import campaign

        tell(f"{count:,} points: {STORE} in place of runs.csv, which a sweep of at most {TABLE:,} has; the same "
             "command with --export csv writes it too")  # fmt: skip
        return campaign.store_sweep(stated, where, out, force)
    for note in notes:
        tell(note)
    runs = grid(config, robot, config.battery)
    drawn = None if config.posterior is None else beside_robot(file)
    with open_folder("sweep", config, robot, out, force) as folder:
        table = run.evaluate(robot, runs, config, folder)
        print_counts(table)
        if drawn is not None and config.posterior is not None:
            found = uncertainty.intervals(robot, drawn, runs, config, config.posterior, folder)
            uncertainty.say_intervals(table, found)
            table |= found.columns
        result = run.SimulationResult("sweep", config.model, robot, runs, table)
        return run.leave(folder, config, result, page("sweep", file, model=config.model, runs=table))


def print_counts(table: dict[str, np.ndarray]) -> None:
    """How the runs ended, in words."""
    shown = Table(title=f"{len(table['status'])} runs", title_justify="left")
    for heading in ("status", "runs", "meaning"):
        shown.add_column(heading, justify="right" if heading == "runs" else "left")
    for status, count in run.counts(table).items():
        if count:
            shown.add_row(status, str(count), words.STATUSES[status].why)
    say(shown)
