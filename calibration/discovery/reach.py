"""What is within reach of whoever measured a table: the ranges that it used, and what the robot's makers allow."""

from __future__ import annotations

import dataclasses

import numpy as np

from calibration.discovery.active_set import CandidateSpace
from calibration.inference.operating import operating_readings
from mmrjax.model import channels
from mmrjax.model.conditions import Conditions
from mmrjax.model.robot import Robot

#: How much more than the table's a payload and a slope may be: as factors, and of the payload also as a share of the
#: largest total mass [-]. Voltages are never more, unless the robot states what its motors are good for.
PAYLOAD, MASS, SLOPE = 1.5, 0.2, 1.15
#: A motor whose table holds no steady travel is taken to run at these shares of its stall current and of its speed
#: without load [-].
LOADED, RUNNING = 0.3, 0.8


@dataclasses.dataclass(frozen=True)
class Used:
    """What a table used of one configuration, each increasing and without repeats.

    Attributes:
        configuration: its name; index: in the robot.
        voltages [V], slopes [deg], payloads [kg].
        mass: the largest total [kg].
    """

    configuration: str
    index: int
    voltages: tuple[float, ...]
    slopes: tuple[float, ...]
    payloads: tuple[float, ...]
    mass: float

    @property
    def steepest(self) -> float:
        """Largest angle of the slope, whichever way the robot went [deg]."""
        return max(abs(s) for s in self.slopes)

    @property
    def payload(self) -> float:
        """The largest that the robot may be given [kg]: 0 where the table holds none."""
        most = self.payloads[-1]
        return min(PAYLOAD * most, most + MASS * self.mass)


@dataclasses.dataclass(frozen=True)
class Reach:
    """What experiments with a robot may use.

    Attributes:
        used: of each configuration that the table holds.
        measured: names of the channels that it holds.
        voltage: highest of runs under load [V]; geared, alone: of motors that turn their gearboxes alone, or nothing.
        current: largest of one motor in steady travel [A], and what it bears for long.
        motor_speed [rad/s], speed [m/s]: largest in steady travel.
        limit_geared, limit_alone: speeds of the motor shaft that its gearbox and itself are good for, or which the
            table went to [rad/s].
        motors: how many are driven alike.
        resistance [ohm], torque_constant [N·m/A]: of one.
        hot: temperature of a winding that is too hot [°C].
        imposed: on the motors, see `Rig`; levels: of speed [rad/s] or current [A] that the table
            used, where these are imposed.
        has_ground: whether a ground carries it.
        duties: sizes of the driver's duty that the table used [-].
        torques: sizes of a brake's torque that it used [N·m]; empty where it states none, so that there is no brake.
    """

    used: tuple[Used, ...]
    measured: tuple[str, ...]
    voltage: float
    geared: float
    alone: float
    current: float
    motor_speed: float
    speed: float
    limit_geared: float
    limit_alone: float
    motors: int
    resistance: float
    torque_constant: float
    hot: float
    imposed: str = "voltage"
    levels: tuple[float, ...] = ()
    has_ground: bool = True
    duties: tuple[float, ...] = ()
    torques: tuple[float, ...] = ()

    @property
    def voltages(self) -> tuple[float, ...]:
        """All that the table used [V]."""
        return tuple(sorted({v for u in self.used for v in u.voltages}))


def _levels(x: np.ndarray) -> tuple[float, ...]:
    return tuple(np.unique(np.round(x, 6)).tolist())


def reach(robot: Robot, conditions: Conditions, measured: tuple[str, ...]) -> Reach:
    """What a table's robot may be asked for next.

    Args:
        robot: as its file states it, or fitted; conditions: of the table's runs, shape (runs,).
        measured: names of the channels that the table holds.
    """
    which, volts, slope, payload = (
        np.asarray(x)
        for x in (conditions.configuration, conditions.voltage, conditions.slope_deg, conditions.payload)
    )
    own = np.asarray([float(c.mass) for c in robot.configurations.members])
    stated = conditions.total_mass
    mass = own[which] + payload if stated is None else np.asarray(stated)
    used = tuple(
        Used(name, k, _levels(volts[at]), _levels(slope[at]), _levels(payload[at]), float(mass[at].max()))
        for k, name in enumerate(robot.configurations)
        if (at := which == k).any()
    )
    motor, highest = robot.motor, float(volts.max())
    constant, resistance = float(motor.torque_constant), float(motor.resistance)
    motors = int(robot.sides)
    travel = operating_readings(robot, conditions, channels.USUAL)
    largest = {c: float(np.nanmax(travel[:, k], initial=0.0)) for k, c in enumerate(channels.USUAL)}
    bears = float(robot.current_continuous)
    current = min(largest["total_current"] / motors or LOADED * highest / resistance, bears)
    motor_speed = largest["motor_speed"] or RUNNING * highest / constant
    radius = max(float(c.radius) for c in robot.configurations.members)
    speed = largest["speed"] or motor_speed * radius / float(robot.gearbox.ratio)
    voltage = max(highest, motor.voltage_limit or 0.0)
    alone = max(motor.speed_limit, motor_speed)
    geared = max(min(motor.speed_limit, robot.gearbox.speed_limit), motor_speed)
    return Reach(
        used, measured, voltage, min(voltage, constant * geared), min(voltage, constant * alone), current,
        motor_speed, speed, geared, alone, motors, resistance, constant, motor.temperature_limit, robot.rig.imposed,
        _levels(np.asarray(getattr(conditions, robot.rig.imposed))) if conditions.voltage_follows else (),
        robot.has_ground, _levels(np.abs(np.asarray(conditions.duty))),
        () if conditions.load_torque is None else _levels(np.abs(np.asarray(conditions.load_torque))),
    )  # fmt: skip


def reach_of(space: CandidateSpace, robot: Robot | None = None) -> Reach:
    """What the robot of a space may be asked for next; the robot fitted where it is given."""
    weight = space.weight
    measured = tuple(c for k, c in enumerate(channels.names(space.bare.channels)) if weight[:, k].any())
    return reach(space.bare.base if robot is None else robot, space.bare.observe.driven, measured)
