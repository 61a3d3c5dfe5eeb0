"""Default values of the quantity imposed on a rig's motors: shares of the limit in its file."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Collection, Iterable

import numpy as np

from calibration.data.columns import Layout
from calibration.data.input_errors import BadConfiguration
from mmrjax.model.conditions import OF_TURNS, sides_contradiction
from mmrjax.model.paper_tables import VOLTAGES_V
from mmrjax.model.quantities import RPM
from mmrjax.model.robot import NO_BRAKE, Robot, turn_error
from sweeps import capabilities

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
    if Layout.of(robot).uses_paper_conditions:
        return VOLTAGE
    limit = imposed_limit(robot)
    if limit is None:
        raise BadConfiguration(_missing_limit_message(robot, option, IMPOSED_WORDS[robot.rig.imposed].one))
    return limit if robot.rig.imposed == "voltage" else _digits(limit)


def imposed_example(robot: Robot) -> float:
    """Imposed value for an example [V, rpm]: `imposed_default` if the file states a limit."""
    try:
        return imposed_default(robot, "")
    except BadConfiguration:
        return float(IMPOSED_WORDS[robot.rig.imposed].one)


def imposed_levels(robot: Robot, option: str, notes: list[str] | None) -> tuple[float, ...]:
    """Default imposed values of a grid: one third, two thirds and all of the limit, or those of Table 8.

    Args:
        notes: callback for a sentence with these values.

    Raises:
        BadConfiguration: the file states no limit.
    """
    if Layout.of(robot).uses_paper_conditions:
        return VOLTAGES_V
    limit = imposed_limit(robot)
    if limit is None:
        raise BadConfiguration(_missing_limit_message(robot, option, IMPOSED_WORDS[robot.rig.imposed].several))
    levels = tuple(_digits(share * limit) for share in SHARES)
    if notes is not None:
        level_text = ",".join(f"{v:g}" for v in levels)
        notes.append(
            f"{option}: not given. Thirds of the {_robot_phrase(robot)} in the robot's file are used: {level_text}"
        )
    return levels


def _robot_phrase(robot: Robot) -> str:
    return IMPOSED_WORDS[robot.rig.imposed].limit


def _missing_limit_message(robot: Robot, option: str, example: str) -> str:
    unit = IMPOSED_WORDS[robot.rig.imposed].unit
    if robot.rig.imposed == "motor_current":  # not limited by files
        return f"{option}: not given; give it [{unit}], such as {option} {example}"
    return (
        f"{option}: not given, and the robot's file has no motor.{_robot_phrase(robot)}; "
        f"give it [{unit}], such as {option} "
        f"{example}"
    )


def option_refusal(robot: Robot, option: str, instead: str) -> str:
    """Reason for rejecting an option for a quantity that is not imposed."""
    reason = IMPOSED_WORDS[robot.rig.imposed]
    if robot.rig.imposed != "voltage":
        return f"{option}: the {reason.words} is imposed on this robot; give {instead} [{reason.unit}]"
    return f"{option}: the voltage is imposed on this robot, and the motor speed follows; give {instead} [V]"


def check_acting(robot: Robot, ground: Iterable[str], shaft: Iterable[str]) -> None:
    """Rejects ground conditions for a load without ground, and shaft conditions for a vehicle.

    Args:
        ground, shaft: options or places in a file that state such conditions.

    Raises:
        BadConfiguration: there is one.
    """
    for option in shaft if robot.has_ground else ground:
        why = "slope, payload, mass and surface do not act on a shaft; remove it"
        raise BadConfiguration(f"{option}: {f'{NO_BRAKE}; remove it' if robot.has_ground else why}")


def check_battery(robot: Robot) -> None:
    """Rejects use of the battery if the rig file does not state one.

    Raises:
        BadConfiguration: the motor speed is imposed, or the file states no battery.
    """
    if robot.rig.imposed != "voltage":
        imposed_words = IMPOSED_WORDS[robot.rig.imposed].words
        raise BadConfiguration(
            f"--battery: the {imposed_words} is imposed on this robot, regardless of the supply; remove --battery"
        )
    if not capabilities.has_battery(robot):
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
    if why := turn_error(robot, names):
        raise BadConfiguration(f"{where}: {why}")


def check_turning(robot: Robot, stated: Collection[str], names: Iterable[str], where: str) -> None:
    """Rejects conditions of a turn if the robot cannot turn, or if the drive of a side is not stated.

    Args:
        stated: names of conditions.
        names: names of the configurations that are simulated.
    """
    if not (freed := [name for name in OF_TURNS if name in stated]):
        return
    check_can_turn(robot, names, f"{where}, {freed[0]}")
    if why := sides_contradiction(stated):
        raise BadConfiguration(f"{where}, {why}")
