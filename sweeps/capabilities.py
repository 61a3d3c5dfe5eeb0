"""Results that a robot can have, and default values of the quantity imposed on its motors."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Collection, Iterable
from typing import Any

import equinox as eqx
import numpy as np

from calibration.data import Columns
from calibration.data.columns import Layout
from calibration.data.input_errors import BadConfiguration
from calibration.data.robot_file import RobotFile
from mmrjax.fidelities import outputs
from mmrjax.model import params, quantities
from mmrjax.model.channels import SIDES
from mmrjax.model.conditions import OF_TURNS, sides_contradiction
from mmrjax.model.paper_tables import VOLTAGES_V
from mmrjax.model.power import Battery
from mmrjax.model.quantities import RPM, WARMING
from mmrjax.model.robot import NO_BRAKE, Robot, turn_error
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
    default_battery = Battery()
    own_default = "battery.current_other"  # `rig_file.DEFAULTS` states that one
    states_value = any(
        getattr(robot.battery, name) != value
        for name, value in vars(default_battery).items()
        if not eqx.is_array(value)
    )
    return states_value or any(
        robot.knows([f"battery.{p.name}"])
        for p in params.walk_parameters(default_battery)
        if f"battery.{p.name}" != own_default
    )


def unknown_numbers_sentence(robot: Robot) -> list[str]:
    """Sentence on results that cannot be computed because the robot's file lacks their parameters, if any."""
    unknown_outputs = [output for output in outputs.FURTHER if not robot.knows(output.rests_on)]
    missing_parameters = dict.fromkeys(name for output in unknown_outputs for name in robot.unknown(output.rests_on))
    labels = "; ".join(output.label for output in unknown_outputs)
    return (
        [f"cannot be computed: the robot's file does not give {', '.join(missing_parameters)}: {labels}"]
        if unknown_outputs
        else []
    )


def inapplicable_columns(robot: Robot) -> set[str]:
    """Columns of runs and histories that do not apply to a robot."""
    inapplicable: set[str] = set()
    if not robot.has_ground:
        inapplicable |= {*OF_GROUND}
    if not robot.shows_travel:
        inapplicable |= {*OF_TRAVEL}
    inapplicable |= {column for column, names in RESTS_ON.items() if not robot.knows(names)}
    heat_columns = [column.removesuffix("_C") for column in inapplicable if RESTS_ON.get(column) == WARMING]
    inapplicable |= {f"{name}_{side}_C" for name in heat_columns for side in SIDES}
    if not has_battery(robot):
        inapplicable |= {"voltage_cell_V"}
    return inapplicable


def drop_inapplicable_columns(robot: Robot, table: Columns) -> Columns:
    """Table without the columns that do not apply to the robot. Columns of its channels are kept."""
    inapplicable = inapplicable_columns(robot) - {c.column for c in robot.channels}
    endings = ("", "_sd", "_lower", "_upper")
    dropped = {column + ending for column in inapplicable for ending in endings}
    return {column: values for column, values in table.items() if column not in dropped}


def rig_parameters(file: RobotFile) -> list[tuple[Any, ...]]:
    """Parameters that a rig's file or `--set` states: name, value, unit, meaning."""
    return [
        (p.name, float(p.value), p.spec.unit, p.spec.meaning)
        for p in params.walk_parameters(file.robot)
        if p.name in file.stated
    ]


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


#: A limit of this size means no limit (`robots.blank`).
UNLIMITED = 1e8
#: Default supply voltage of a single run [V], the highest of Table 8.
VOLTAGE = 33.0
#: Levels of a grid, as shares of the limit.
SHARES = (1 / 3, 2 / 3, 1.0)


@dataclasses.dataclass(frozen=True)
class ImposedWords:
    """Description of an imposed quantity: name in words, unit, limiting parameter, and example options for one run
    and for a grid.
    """

    words: str
    unit: str
    limit: str
    one: str
    several: str


IMPOSED_WORDS = {
    "voltage": ImposedWords("voltage", "V", "voltage_limit", "12", "6,12,24"),
    "motor_speed": ImposedWords("motors' speed", "rpm", "speed_limit", "3000", "1000,2000"),
    "motor_current": ImposedWords("motors' current", "A", "current_limit", "2", "0.5,1,2"),
}


def imposed_limit(robot: Robot) -> float | None:
    """Largest imposed value: supply voltage [V] or motor speed [rpm]. None if not stated, as for currents."""
    if robot.rig.imposed == "motor_current":
        return None
    if robot.rig.imposed == "voltage":
        return robot.motor.voltage_limit
    speed_limit = min(float(robot.motor.speed_limit), float(robot.gearbox.speed_limit))
    return speed_limit / RPM if speed_limit < UNLIMITED else None


def _digits(value: float) -> float:
    """Rounded down to two significant digits."""
    size = 10.0 ** (math.floor(math.log10(value)) - 1)
    return float(np.round(math.floor(value / size + 1e-9) * size, 9))


def imposed_default(robot: Robot, option: str) -> float:
    """Default imposed value of a single run: the limit, or `VOLTAGE` for the paper's robot.

    Raises:
        BadConfiguration: the file states no limit.
    """
    if Layout.of(robot).complete:
        return VOLTAGE
    limit = _stated_limit(robot, option, IMPOSED_WORDS[robot.rig.imposed].one)
    return limit if robot.rig.imposed == "voltage" else _digits(limit)


def _stated_limit(robot: Robot, option: str, example: str) -> float:
    """`imposed_limit` of a file that states it. `example`: value of the option, for the error message."""
    limit = imposed_limit(robot)
    words_of_quantity = IMPOSED_WORDS[robot.rig.imposed]
    if limit is None:
        # currents are not limited by files
        missing = f", and the robot's file has no motor.{words_of_quantity.limit}" * (
            robot.rig.imposed != "motor_current"
        )
        raise BadConfiguration(
            f"{option}: not given{missing}; give it [{words_of_quantity.unit}], such as {option} {example}"
        )
    return limit


def imposed_levels(robot: Robot, option: str, notes: list[str] | None) -> tuple[float, ...]:
    """Default imposed values of a grid: one third, two thirds and all of the limit, or those of Table 8.

    Args:
        notes: list to which a sentence with these values is added, if they follow from a limit.

    Raises:
        BadConfiguration: the file states no limit.
    """
    if Layout.of(robot).complete:
        return VOLTAGES_V
    words_of_quantity = IMPOSED_WORDS[robot.rig.imposed]
    limit = _stated_limit(robot, option, words_of_quantity.several)
    levels = tuple(_digits(share * limit) for share in SHARES)
    if notes is not None:
        level_text = ",".join(f"{v:g}" for v in levels)
        notes.append(
            f"{option}: not given. Thirds of the {words_of_quantity.limit} in the robot's file are used: {level_text}"
        )
    return levels


def option_refusal(robot: Robot, option: str, instead: str) -> str:
    """Reason for rejecting an option for a quantity that is not imposed."""
    words_of_quantity = IMPOSED_WORDS[robot.rig.imposed]
    return (
        f"{option}: the {words_of_quantity.words} is imposed on this robot; give {instead} [{words_of_quantity.unit}]"
    )


def check_acting(robot: Robot, ground: Iterable[str], shaft: Iterable[str]) -> None:
    """Rejects ground conditions for a load without ground, and shaft conditions for a vehicle.

    Args:
        ground, shaft: options or places in a file that state such conditions.

    Raises:
        BadConfiguration: such a condition is stated.
    """
    options, reason = (shaft, NO_BRAKE) if robot.has_ground else (ground, "has no effect on a shaft")
    for option in options:
        raise BadConfiguration(f"{option}: {reason}; remove it")


def check_battery(robot: Robot) -> None:
    """Rejects use of the battery if the rig file does not state one.

    Raises:
        BadConfiguration: the motor speed is imposed, or the file states no battery.
    """
    if robot.rig.imposed != "voltage":
        imposed_words = IMPOSED_WORDS[robot.rig.imposed].words
        raise BadConfiguration(f"--battery: the {imposed_words} is imposed on this robot; remove --battery")
    if not has_battery(robot):
        raise BadConfiguration("--battery: the robot's file has no battery; add [battery], or give --voltage")


def check_on_ground(robot: Robot, command: str) -> None:
    """Rejects a command about running gear for a load without it.

    Raises:
        BadConfiguration: the load is a shaft.
    """
    if not robot.has_ground:
        raise BadConfiguration(
            f"{command}: the robot's load is a shaft; use simulate, sweep, compare, calibrate, loop or sensitivity"
        )


def check_can_turn(robot: Robot, names: Iterable[str], where: str) -> None:
    """Rejects a robot that cannot turn in one of these configurations.

    Raises:
        BadConfiguration: it cannot turn. The message begins with `where` and gives the reason.
    """
    if reason := turn_error(robot, names):
        raise BadConfiguration(f"{where}: {reason}")


def check_turning(robot: Robot, stated: Collection[str], names: Iterable[str], where: str) -> None:
    """Rejects conditions of a turn if the robot cannot turn, or if the drive of a side is not stated.

    Args:
        stated: names of conditions.
        names: names of the configurations that are simulated.
    """
    if not (turn_conditions := [name for name in OF_TURNS if name in stated]):
        return
    check_can_turn(robot, names, f"{where}, {turn_conditions[0]}")
    if reason := sides_contradiction(stated):
        raise BadConfiguration(f"{where}, {reason}")
