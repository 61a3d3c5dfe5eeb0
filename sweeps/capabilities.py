"""Results that a robot can have: a shaft has no ground, and a rig has only what its file states."""

from __future__ import annotations

from typing import Any

import equinox as eqx
import numpy as np

from calibration.data import Columns, rig_file
from calibration.data.robot_file import RobotFile
from mmrjax.fidelities import outputs
from mmrjax.model import params, quantities
from mmrjax.model.channels import SIDES
from mmrjax.model.paper_robots import blank_robot
from mmrjax.model.power import Battery
from mmrjax.model.quantities import WARMING
from mmrjax.model.robot import Robot
from sweeps.pages import words

#: Columns of runs and histories about the ground.
OF_GROUND = (
    "slip", "adhesion_used", "traction_N", "slope_deg", "power_ground_W", "power_lift_W", "efficiency_chassis",
)  # fmt: skip
#: Columns of travel, which a shaft has only if a channel shows it.
OF_TRAVEL = (
    "theoretical_speed_mm_s", "distance_m", "displacement_m", "demanded_speed_mm_s", "energy_per_metre_Wh", "range_m",
)  # fmt: skip
#: Column → parameters that it depends on and that a rig file may omit. Channels over time are last.
RESTS_ON = {q.column: q.rests_on for rows in quantities.TABLE.values() for q in rows if q.rests_on}


def states_running_gear(robot: Robot) -> bool:
    """True if the robot's file or its base gives a parameter of the running gear."""
    return any(p.name.startswith("running_gear.") and robot.knows([p.name]) for p in params.walk_parameters(robot))


def has_battery(robot: Robot) -> bool:
    """True if the robot has its own battery."""
    if robot.rig.inherits:
        return True
    nothing, other = Battery(), "battery.current_other"  # `rig_file.DEFAULTS` states that one
    has_own = any(
        getattr(robot.battery, name) != value for name, value in vars(nothing).items() if not eqx.is_array(value)
    )
    return has_own or any(
        robot.knows([f"battery.{p.name}"]) for p in params.walk_parameters(nothing) if f"battery.{p.name}" != other
    )


def unknown_numbers_sentence(robot: Robot) -> list[str]:
    """Sentences on results that cannot be computed because the robot's file lacks their parameters."""
    unknown_outputs = [output for output in outputs.FURTHER if not robot.knows(output.rests_on)]
    lacking = dict.fromkeys(name for output in unknown_outputs for name in robot.unknown(output.rests_on))
    labels = "; ".join(output.label for output in unknown_outputs)
    return (
        [f"cannot be computed: the robot's file does not give {', '.join(lacking)}: {labels}"]
        if unknown_outputs
        else []
    )


def inapplicable_columns(robot: Robot) -> set[str]:
    """Columns of runs and histories that do not apply to a robot."""
    idle: set[str] = set()
    if not robot.has_ground:
        idle |= {*OF_GROUND}
    if not robot.shows_travel:
        idle |= {*OF_TRAVEL}
    idle |= {column for column, names in RESTS_ON.items() if not robot.knows(names)}
    warm = [column.removesuffix("_C") for column in idle if RESTS_ON.get(column) == WARMING]
    idle |= {f"{name}_{side}_C" for name in warm for side in SIDES}
    if not has_battery(robot):
        idle |= {"voltage_cell_V"}
    return idle


def drop_inapplicable_columns(robot: Robot, table: Columns) -> Columns:
    """Table without the columns that do not apply to the robot. Columns of its channels are kept."""
    idle = inapplicable_columns(robot) - {c.column for c in robot.channels}
    ends = ("", "_sd", "_lower", "_upper")
    dropped = {column + end for column in idle for end in ends}
    return {column: values for column, values in table.items() if column not in dropped}


def rig_parameters(file: RobotFile) -> list[tuple[str, float, str, str, str]]:
    """Parameters that a rig file states, and others with an effect: name, value, unit, meaning, source."""
    robot = file.robot
    bare = blank_robot(robot.configurations, rig=robot.rig)
    nothing, stated_parameters = params.values_by_name(bare), []
    for p in params.walk_parameters(robot):
        head = p.name.partition(".")[0]
        load = head in robot.configurations
        is_own = p.name in file.stated and head not in file.linear
        moved = p.name not in nothing or float(p.value) != nothing[p.name]
        if not is_own and not moved and not (load and float(p.value) != 0):
            continue
        if not is_own and (p.name in rig_file.DEFAULTS or (p.name.endswith(".radius") and not robot.shows_travel)):
            continue
        of_file = is_own or head in file.linear
        source = f"stated in {file.name}" if of_file else "default" if not moved or load else "changed"
        stated_parameters.append((p.name, float(p.value), p.spec.unit, p.spec.meaning, source))
    return stated_parameters


def changed_parameters(robot: Robot, nominal: Robot) -> list[tuple[Any, ...]]:
    """Parameters of `robot` that differ from the nominal robot's: name, both values, unit, meaning."""
    base = params.values_by_name(nominal)
    return [
        (p.name, float(p.value), base.get(p.name, "not in the paper's model"), p.spec.unit, p.spec.meaning)
        for p in params.walk_parameters(robot)
        if p.name not in base or not np.isclose(float(p.value), base[p.name], rtol=1e-9, atol=0.0)
    ]


def displayed_name(file: RobotFile) -> str:
    """Name of a robot as pages show it. A packaged robot with other parameters is marked as changed."""
    from mmrjax.model.paper_robots import ROBOTS

    name = file.name
    if not file.robot.rig.inherits:
        return name
    if name in ROBOTS and changed_parameters(file.robot, ROBOTS[name]()):
        return f"{name}, changed"
    return words.displayed_robot_name(name)
