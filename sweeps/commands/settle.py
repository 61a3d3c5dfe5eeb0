"""The command `settle`: find the settled runs of a log over time."""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np

from calibration.data import robot_file, settling
from calibration.data.settling import Inertia, Settled
from calibration.described import sentences
from calibration.inference import ranges
from calibration.inference.observers import SettledRuns
from calibration.words import settle_words
from mmrjax.model import balances
from mmrjax.model.channels import Channel
from mmrjax.model.conditions import Conditions
from mmrjax.model.robot import Robot
from mmrjax.model.signals import State
from sweeps import config as configuration
from sweeps.inputs import load_robot, read_runs
from sweeps.report import settle_report
from sweeps.skeleton import finish_run_folder, print_report
from sweeps.store import open_folder


def settle_to_folder(config: configuration.Settle, source: str, out: Path | None, force: bool) -> int:
    """Find the settled runs of a log and write a run folder with their table; returns the exit code, 0."""
    robot = load_robot(config).robot
    runs = read_runs(source, robot, columns=config.columns, measured=True, series=True)
    named = [] if config.columns is None else ["--columns", config.columns]
    loop = shlex.join(["mmrjax", "loop", source, "--robot", config.robot, *named])
    found = settling.settle_log(
        runs,
        shortest=config.shortest_s,
        drift=config.drift,
        inertia=acceleration_currents(robot),
        rolling=rolling_readings(robot),
        loop=loop,
    )
    few = settle_words.too_few(found, SettledRuns.fewest, loop)
    with open_folder("settle", config, robot, out, force, runs) as folder:
        robot_file.write_robot(
            robot, folder.results() / "robot.toml", note=f"the rig of this log, from {config.robot}"
        )
        folder.write_table("settled.csv", found.table())
        folder.write_table("stretches.csv", stretches_table(found))
        folder.write_json("result.json", to_json(found, few))
        turned = sentences(ranges.turned_signs(found.settled_runs(), robot))
        shown = print_report(settle_report.settle_document(found, few, turned))
        return finish_run_folder(folder, config, {"seed": None, "settled": len(found.kept)}, page=shown, runs=runs)


def rolling_readings(robot: Robot) -> dict[str, dict[str, float]]:
    """Readings of speeds in each configuration at 1 rad/s of the motors, the load rolling [unit of the column].

    By channel; only speeds of shafts for a vehicle, which slips.
    """
    found = {}
    for k, (name, load) in enumerate(robot.configurations.items()):
        none, turns = jnp.zeros(()), float(load.radius) / float(robot.gearbox.ratio)
        state = State(none, jnp.ones(()), jnp.asarray(turns), none)
        speeds = {c.name: _shown(robot, k, c, state) for c in settling.settled_channels(robot) if c.zero_at_rest}
        found[name] = {n: x for n, x in speeds.items() if n != "speed" or not robot.has_ground}
    return found


def acceleration_currents(robot: Robot) -> dict[str, Inertia]:
    """Current that acceleration takes in each configuration, where it is known."""
    constant, ratio = float(robot.motor.torque_constant), float(robot.gearbox.ratio)
    found = {}
    for k, (name, load) in enumerate(robot.configurations.items()):
        moved = float(load.mass) * float(load.radius) ** 2 / float(robot.sides)
        at_motor = float(robot.motor.inertia) + (float(load.inertia) + moved) / ratio**2
        none, one = jnp.zeros(()), jnp.ones(())
        rolling = float(load.radius) / ratio
        states = State(one, none, none, none), State(none, one, jnp.asarray(rolling), none)  # of 1 A, and of 1 rad/s
        currents, speeds = (
            {c.name: _shown(robot, k, c, state) for c in settling.settled_channels(robot)} for state in states
        )
        current = next((n for n, x in currents.items() if x and not speeds[n]), "")
        speed = next((n for n, x in speeds.items() if x), "")
        known = current or robot.rig.imposed == "motor_current"
        currents[""] = 1.0  # of the imposed one
        if known and speed and at_motor > 0 and constant > 0:
            per_rate = at_motor / constant * currents[current] / speeds[speed]
            found[name] = Inertia(speed, current, per_rate, least=1e-3)
    return found


def _shown(robot: Robot, configuration: int, channel: Channel, state: State) -> float:
    """Reading of a channel that follows from a state alone [unit of its column]; 0 for others."""
    signals = balances.begin_signals(robot, Conditions(configuration), state)
    try:
        return float(channel.read(robot, signals)) / channel.factor
    except (AttributeError, TypeError):  # a signal that the balances fill in
        return 0.0


def stretches_table(found: Settled) -> dict[str, np.ndarray]:
    """Every stretch of a log, a row each: where it is, why it is left out, means, their sds, changes."""
    every = found.stretches
    table: dict[str, np.ndarray] = {
        "run_id": np.array([s.run for s in every]),
        "from_s": np.array([s.begin for s in every]),
        "until_s": np.array([s.end for s in every]),
        "first_row": np.array([s.rows[0] + 1 for s in every]),
        "last_row": np.array([s.rows[-1] + 1 for s in every]),
        "imposed": np.array([s.imposed for s in every]),
        "left_out": np.array([settle_words.left_out_reason(s) if s.why else "" for s in every]),
    }
    for signal in found.signals:
        channel = signal.channel
        fields = {
            channel.column: "mean",
            channel.sd_column: "sd",
            channel.sd_column.replace("_sd_", "_change_"): "drift",
        }
        for column, field in fields.items():
            table[column] = np.array([getattr(s, field).get(channel.name, np.nan) for s in every])
    return table


def to_json(found: Settled, few: str = "") -> dict[str, Any]:
    """`result.json`; `few` is the sentence of `words.too_few`."""
    left = settle_words.left_out(found.stretches, bool(few))
    return {
        "schema": "mmrjax.settle/1",
        "statement": settle_words.settle_statement(found),
        "samples": len(found.runs),
        "settled": len(found.kept),
        "shortest_s": found.shortest,
        "drift": found.drift,
        "gaps": len(found.gaps),
        "scatter": dict(found.scatter),
        "glitches": {
            s.channel.name: sum(k.glitches.get(s.channel.name, 0) for k in found.kept) for s in found.signals
        },
        "left_out": [dict(zip(("why", "stretches", "samples", "rows", "do"), row, strict=True)) for row in left],
        "notes": [*filter(None, [few]), *settle_words.settle_remarks(found)],
    }
