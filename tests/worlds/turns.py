"""Tables of settled turns by the second implementation of a robot that turns, with what nobody declares planted.

A table holds turns of the paper's robot on tracks at duties and voltages drawn at random, with noisy readings. The truth
is narrower and grips more aside than the nominal robot. What is planted is a law of one side or of the turn, in the
second implementation's own words. Nothing is read from mmrjax but the names and units of columns.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path

import numpy as np
from worlds import turning as world
from worlds.paper import NOMINAL

from mmrjax.model import channels

SHOWN = ("motor_current_left", "motor_current_right", "motor_speed_left", "motor_speed_right", "yaw_rate")
#: Sds of the instruments, in the units of the columns.
SDS = dict(zip(SHOWN, (0.02, 0.02, 8.0, 8.0, 0.01), strict=True))
NOISE = ",".join(f"{name}={sd}{channels.find_channel(name).unit}" for name, sd in SDS.items())
#: Of the truth: distance of the sides [m], φ_y/φ_x [-], height of the centre of mass, as the packaged robot's [m].
WIDTH, LATERAL, HEIGHT = 0.236, 1.45, 0.0476
VOLTAGES = (15.0, 24.0, 33.0)
#: Of a log: samples of a turn, their distance [s], lag of all readings [s].
HOLD, EVERY, LAG = 60, 0.02, 0.06
#: Function of case, count and seed that returns columns.
Columns = Callable[[str, int, int], dict[str, np.ndarray]]


@dataclasses.dataclass(frozen=True)
class Planted:
    """What a table has and no robot file says.

    Attributes:
        left, right: constants of one side, by their names, over the nominal ones.
        duty: what a side gets of the duty that its column states, left and right.
        grip: φ_y/φ_x at a yaw rate [rad/s]. None: constant.
        moment: against the turn, over load and yaw rate [m·s].
        named: effects that are its name.
        family: equation that an answer without a name has to be in.
    """

    left: dict[str, float] = dataclasses.field(default_factory=dict)
    right: dict[str, float] = dataclasses.field(default_factory=dict)
    duty: tuple[float, float] = (1.0, 1.0)
    grip: Callable[[float], float] | None = None
    moment: float = 0.0
    named: tuple[str, ...] = ()
    family: str = ""


_DRY, _TORQUE, _RADIUS = (NOMINAL[n] for n in ("motor.friction_coulomb", "motor.torque_constant", "6T2A.radius"))
CASES = {
    "clean": Planted(),
    "friction": Planted(left={"motor.friction_coulomb": 1.6 * _DRY}, named=("side_friction",), family="loss torque"),
    "torque": Planted(right={"motor.torque_constant": 0.93 * _TORQUE}, named=("side_torque",)),
    "voltage": Planted(duty=(1.0, 0.97), named=("side_voltage",), family="voltage drop"),
    "moment": Planted(moment=0.004, named=("turning_resistance",), family="resistance to turning"),
    "grip": Planted(grip=lambda omega: LATERAL * (1 + 0.1 * abs(omega)), named=("lateral_grip",)),
    "radius": Planted(left={"6T2A.radius": 1.015 * _RADIUS}, named=("side_radius",), family="slip"),
}


def _circling(planted: Planted, drive: world.Inputs) -> world.Circling | None:
    """A settled turn of the truth with what is planted, None where none was found."""
    kept = world.ground

    def ground(robot: world.Robot, v_x: float, v_y: float, omega: float, *rest: object) -> world.Ground:
        if planted.grip is not None:
            robot = dataclasses.replace(robot, ratio=planted.grip(omega))
        found = kept(robot, v_x, v_y, omega, *rest)  # type: ignore[arg-type]
        return dataclasses.replace(found, moment=found.moment - planted.moment * float(found.N.sum()) * omega)

    robot = world.paper_robot(
        left=planted.left, right=planted.right, ratio=LATERAL, width=WIDTH, inertia=0.23, height=HEIGHT, nodes=16
    )
    world.ground = ground
    try:
        return world.circling(robot, drive)
    finally:
        world.ground = kept


def rows(case: str, count: int = 40, seed: int = 0, noise: float = 1.0) -> dict[str, np.ndarray]:
    """Columns of a table of a case. `noise`: factor on the sds of the instruments."""
    random, planted = np.random.default_rng(seed), CASES[case]
    told, seen = [], []
    while len(told) < count:
        voltage = float(random.choice(VOLTAGES))
        duty = np.round(random.uniform(-1.0, 1.0, 2), 2)
        if len(told) < count // 8:
            duty = np.repeat(np.round(random.uniform(0.3, 1.0), 2), 2)  # straight ahead
        if np.max(np.abs(duty)) * voltage < 5.0 or np.min(np.abs(duty)) * voltage < 1.0:
            continue
        given = duty * np.asarray(planted.duty)
        found = _circling(planted, world.Inputs(*map(float, given), kind="duty", supply=voltage))
        if found is not None and np.all(np.isfinite([*found.I, *found.w, found.omega])):
            told.append((voltage, *duty))
            seen.append((*found.I, *found.w, found.omega))
    told, read = np.array(told), np.array(seen)
    mass = world.paper_robot().mass
    columns = {"configuration": np.full(count, "6T2A"), "supply_voltage_V": told[:, 0], "total_mass_kg": mass}
    columns |= {"payload_kg": 0.0, "slope_deg": 0.0, "duty_left": told[:, 1], "duty_right": told[:, 2]}
    for k, name in enumerate(SHOWN):
        channel = channels.find_channel(name)
        columns[channel.column] = np.round(
            read[:, k] / channel.factor + noise * SDS[name] * random.normal(size=count), 4
        )
    return {name: np.broadcast_to(x, count) for name, x in columns.items()}


def log(case: str, count: int = 40, seed: int = 0) -> dict[str, np.ndarray]:
    """Columns of a log that holds each turn of a case for `HOLD` samples. Readings follow with a lag."""
    random, table = np.random.default_rng([seed, 1]), rows(case, count, seed, noise=0.0)
    columns = {"time_s": np.round(EVERY * np.arange(count * HOLD), 4)}
    columns |= {name: np.repeat(x, HOLD) for name, x in table.items()}
    fades = np.exp(-EVERY * np.arange(HOLD) / LAG)
    for name in SHOWN:
        column = channels.find_channel(name).column
        steps = np.diff(table[column], prepend=0.0)
        late = columns[column] - np.outer(steps, fades).ravel()
        columns[column] = np.round(late + SDS[name] * random.normal(size=len(late)), 4)
    return columns


def write(folder: Path, case: str, count: int = 40, seed: int = 0, form: Columns = rows) -> tuple[Path, Path]:
    """A table or log of a case, and the robot that its instruments belong to: the nominal one."""
    columns = form(case, count, seed)
    lines = [",".join(map(str, row)) for row in zip(*columns.values(), strict=True)]
    table, robot = folder / f"{case}.csv", folder / "robot.toml"
    table.write_text("\n".join([",".join(columns), *lines]) + "\n")
    robot.write_text(f'base = "nominal"\nchannels = [{", ".join(map(repr, SHOWN))}]\n')
    return table, robot
