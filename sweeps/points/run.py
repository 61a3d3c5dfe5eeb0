"""Runs many operating points in chunks of one vmapped call, and leaves the table of what came out."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import jax
import numpy as np

from calibration.data import robot_file
from calibration.data.errors import BadConfiguration
from calibration.data.runs import Runs
from mmrjax import fidelities, outputs
from mmrjax.conditions import Conditions
from mmrjax.fidelities.base import Run
from mmrjax.power import COULOMB_PER_MAH
from mmrjax.robot import Robot
from mmrjax.signals import FLAGS, STATUSES
from sweeps import capabilities, skeleton
from sweeps import config as configuration
from sweeps.config import FidelityPart, Part, SupplyPart
from sweeps.console import progress as bar
from sweeps.pages import words
from sweeps.skeleton import Page
from sweeps.store import RunFolder


@dataclasses.dataclass(frozen=True)
class SimulationResult:
    """What a simulating command found: typed, by name; what is written is read off it.

    Attributes:
        command: that simulated; model: fidelity; robot: that was simulated.
        runs: what was simulated; table: their conditions and outcomes, a column each as in `runs.csv`.
        further: what the command adds to `result.json`.
    """

    command: str
    model: str
    robot: Robot
    runs: Runs
    table: dict[str, np.ndarray]
    further: dict[str, Any] = dataclasses.field(default_factory=dict)

    @property
    def statuses(self) -> dict[str, int]:
        """How many runs ended in each status; every status is named."""
        return counts(self.table)

    @property
    def flags(self) -> dict[str, int]:
        """How many runs exceed each limit."""
        return {name: int(np.sum(np.char.find(self.table["flags"], name) >= 0)) for name in FLAGS}

    def to_json(self) -> dict[str, Any]:
        """`result.json`."""
        return {
            "schema": f"mmrjax.{self.command}/1",
            **self.further,
            "model": self.model,
            "runs": len(self.table["status"]),
            "statuses": self.statuses,
            "flags": self.flags,
        }


def simulate(
    robot: Robot, conditions: Conditions, config: FidelityPart, progress: Callable[[float], None]
) -> dict[str, np.ndarray]:
    """One batch in the fidelity that the configuration names: the columns that it adds to its runs.

    `progress` is called with the share that is done, by a fidelity that takes long.
    """
    return ended(robot, fidelities.get(config.model).run(robot, conditions, config.options, progress))


def ended(robot: Robot, batch: Run) -> dict[str, np.ndarray]:
    """The columns of how a batch of runs ended, with those of its fidelity alone."""
    result, further = jax.device_get((batch.result, batch.columns))
    return outputs.columns(result, robot.channels, further)


def refuse(robot: Robot, conditions: Conditions, config: FidelityPart) -> None:
    """Refuse what some run could not bear, before the first is simulated.

    Raises:
        BadConfiguration: no whole number of steps, a step too large for the stiffness, and the like.
    """
    try:
        fidelities.get(config.model).check(robot, conditions, config.options)
    except ValueError as error:
        raise BadConfiguration(f"--model {config.model}: {error}") from error


def commanded(robot: Robot, runs: Runs, config: Part) -> Conditions:
    """The conditions of the runs, fed as the configuration says; without a say by the external supply."""
    if not isinstance(config, SupplyPart):
        return runs.conditions(robot)
    return runs.conditions(robot, battery=float(config.battery), discharge=config.discharge_mAh * COULOMB_PER_MAH)


def evaluate(
    robot: Robot,
    runs: Runs,
    config: FidelityPart,
    folder: RunFolder,
    advance: Callable[[float], None] | None = None,
) -> dict[str, np.ndarray]:
    """Simulate every run and return the table of conditions and outcomes.

    Chunks already in the folder (of an interrupted run of the same configuration) are not simulated again.
    The last chunk is filled up with its last run, so that all chunks share one compilation.

    Args:
        advance: called with the number of runs done since its last call; of a chunk under way, its share. None:
            a bar on stderr where it takes long.
    """
    if advance is None:
        slow = fidelities.facts(config.model).slow or len(runs) > config.runs_at_once
        with bar(len(runs), quiet=not slow) as advance:
            return evaluate(robot, runs, config, folder, advance)
    size = min(config.runs_at_once, len(runs))
    refuse(robot, commanded(robot, runs, config), config)
    parts = []
    for first in range(0, len(runs), size):
        rows = np.minimum(np.arange(first, first + size), len(runs) - 1)
        count = min(size, len(runs) - first)
        name = f"chunk-{first // size:06d}"
        part = folder.chunk(name)
        if part is None:
            told = shares(advance, count)
            part = simulate(robot, commanded(robot, runs.where(rows), config), config, told)
            part = {key: value[:count] for key, value in part.items()}
            folder.keep_chunk(name, part)
            told(1.0)
        else:
            advance(count)
        parts.append(part)
    outcome = {key: np.concatenate([part[key] for part in parts]) for key in parts[0]}
    return {**conditions(robot, runs), **outcome}


def shares(advance: Callable[[float], None], count: int) -> Callable[[float], None]:
    """A function to be told what share of `count` runs is done so far, which passes on how many that adds."""
    so_far = 0.0

    def told(share: float) -> None:
        nonlocal so_far
        advance(count * share - so_far)
        so_far = count * share

    return told


def conditions(robot: Robot, runs: Runs) -> dict[str, np.ndarray]:
    """The condition columns of a table, the total mass taken from the robot where none is stated."""
    columns = dict(runs.columns)
    if "total_mass_kg" in runs.layout.axes and "total_mass_kg" not in columns:
        own = np.array([float(chassis.mass) for chassis in robot.configurations.members])
        columns["total_mass_kg"] = own[runs.configurations(robot)] + runs["payload_kg"]
    return {key: columns[key] for key in ("configuration", *runs.layout.axes, "surface", "run_id") if key in columns}


def counts(table: dict[str, np.ndarray]) -> dict[str, int]:
    """How many runs ended in each status; every status is named."""
    return {status: int(np.sum(table["status"] == status)) for status in STATUSES}


def leave(
    folder: RunFolder,
    config: configuration.Simulate | configuration.Sweep | configuration.Compare,
    result: SimulationResult,
    page: Page,
) -> int:
    """Write what every simulating command leaves, and move the folder into place; returns the exit code.

    Args:
        folder: of the command; config: its configuration, with the robot's name; page: its page.
    """
    folder.write_table("runs.csv", capabilities.of(result.robot, result.table))
    robot_file.write(result.robot, folder.partial / "robot.toml", note=f"the robot of this run, from {config.robot}")
    folder.write_json("result.json", result.to_json())
    manifest = {"seed": None, "statuses": result.statuses}
    return skeleton.leave(folder, config, manifest, solved=words.solved(result.statuses), page=page, runs=result.runs)
