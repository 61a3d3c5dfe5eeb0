"""The command `size`: a robot searched for that meets requirements."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

from rich.table import Table

from calibration.data import requirements_file, robot_file
from calibration.data.input_errors import BadConfiguration, choices
from calibration.data.parts import motors
from calibration.sizing import sheet
from calibration.sizing.design import OBJECTIVES
from calibration.sizing.design_search import size as search
from mmrjax.errors import counted
from sweeps import config as configuration
from sweeps.console import say
from sweeps.inputs import load_robot
from sweeps.pages import words
from sweeps.points import imposed
from sweeps.results import check_results
from sweeps.results.size_results import SizeResult, described, missed, objective, verdict
from sweeps.skeleton import leave, page
from sweeps.store import RunFolder, open_folder


def size(config: configuration.Size, out: Path | None, force: bool) -> int:
    """Search, and leave a run folder; returns the exit code.

    0 done, whether or not a design meets everything; 3 where the solver failed at a worst corner of the best.
    """
    asked = requirements_file.load(Path(config.requirements))
    file = load_robot(config)
    robot = file.robot
    imposed.check_on_ground(robot, "size")
    objectives = config.pareto or (config.objective,)
    for name in objectives:
        if name not in OBJECTIVES:
            where = "--pareto" if config.pareto else "--objective"
            raise BadConfiguration(f"{where}: got {name}; {choices(name, OBJECTIVES)}")
    if config.pareto and len(set(config.pareto)) != 2:
        raise BadConfiguration(f"--pareto: got {', '.join(config.pareto)}; expected two different objectives")
    known = [m.name for m in motors()]
    for name in config.motors:
        if name not in known:
            raise BadConfiguration(f"--motors: got {name}; {choices(name, known)}")
    sheet.refuse(robot, asked)
    with open_folder("size", config, robot, out, force) as folder:
        sizing = search(robot, asked, objectives, starts=config.starts, motors=config.motors, seed=config.seed)
        outcomes = () if sizing.best is None else sheet.check(sizing.best.robot, asked, changes=False)
        found = SizeResult(asked, robot, sizing, objectives, outcomes)
        _write(folder, config, found)
        print_size(found)
        manifest = {"seed": config.seed, "feasible": sizing.best is not None}
        return leave(
            folder,
            config,
            manifest,
            solved=words.solved(Counter(o.status for o in outcomes)),
            page=page("size", found, file),
        )


def _write(folder: RunFolder, config: configuration.Size, found: SizeResult) -> None:
    best = found.sizing.best
    folder.write_text("requirements.toml", found.asked.text)
    note = f"the robot that was changed, {config.robot}: no design meets the requirements"
    if best is not None:
        note = f"sized for {found.asked.source} from {config.robot}: {described(best)}"
    robot_file.write(found.robot if best is None else best.robot, folder.partial / "robot.toml", note=note)
    folder.write_json("result.json", found.to_json())


def print_size(found: SizeResult) -> None:
    """The best, the alternatives and what binds each motor; for a person."""
    s = found.sizing
    say(found.statement())
    shown = Table(title="by motor, the best design found of each", box=None, pad_edge=False)
    shown.title_justify = "left"
    shown.add_column("")
    shown.add_column("motor and gearbox")
    for name in ("ratio", "radius [mm]", "cells", "mass [kg]", "energy [Wh/m]", "cost [EUR]"):
        shown.add_column(name, justify="right")
    shown.add_column("what binds, or is missed")
    for f in s.motors.values():
        values = [f"{f.objectives[k]:.4g}" if k in f.objectives else "" for k in OBJECTIVES]
        shown.add_row(
            verdict(f, s.unmeetable), f.drive.name, f"{f.ratio:.3g}", f"{1000 * f.radius:.1f}",
            f"{f.in_series} × {f.parallel:.3g} {f.cell.name}", *values,
            ", ".join(f.binds if f.feasible else missed(f)),
        )  # fmt: skip
    say(shown)
    if s.front:
        first, second = found.objectives
        say(f"{counted(len(s.front), 'design')} on the front of {first} and {second}, from "
            f"{objective(s.front[0], first)} to {objective(s.front[-1], second)}")  # fmt: skip
    lacking = [o for o in found.outcomes if not o.met]
    if lacking:
        say(
            "the best as `check` has it misses: "
            + "; ".join(f"{check_results.label(o)} {check_results.shortfall(o)}" for o in lacking)
        )
