"""Reach of whoever measured a table: the ranges that it used, and limits of the robot's makers."""

from __future__ import annotations

import dataclasses

import numpy as np

from calibration.data import Names
from calibration.discovery.active_set import CandidateSpace
from calibration.inference.operating import operating_readings
from mmrjax.model import channels
from mmrjax.model.conditions import Conditions
from mmrjax.model.robot import Robot

#: Largest payload and slope compared with the table's: as factors, and for the payload also as a share of the
#: largest total mass [-]. Voltages are not increased, unless the robot states its motors' limit.
PAYLOAD, MASS, SLOPE = 1.5, 0.2, 1.15
#: Assumed shares of stall current and of no-load speed for a motor with a table without steady travel [-].
LOADED, RUNNING = 0.3, 0.8


@dataclasses.dataclass(frozen=True)
class Used:
    """Values of the conditions in a table for one configuration, increasing and without repeats.

    Attributes:
        configuration: name of the configuration.
        index: index in the robot.
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
        """Largest angle of the slope, in either direction [deg]."""
        return max(abs(s) for s in self.slopes)

    @property
    def payload(self) -> float:
        """Largest payload that the robot may carry [kg]: 0 if the table has none."""
        most = self.payloads[-1]
        return min(PAYLOAD * most, most + MASS * self.mass)


@dataclasses.dataclass(frozen=True)
class Reach:
    """Limits of experiments with a robot.

    Attributes:
        used: ranges of each configuration in the table.
        measured: names of the channels in the table.
        voltage: highest of runs under load [V].
        geared, alone: limits of motors with only their gearboxes, or without any load.
        current: largest of one motor in steady travel [A], within its continuous limit.
        motor_speed [rad/s], speed [m/s]: largest in steady travel.
        limit_geared, limit_alone: speed limits of the motor shaft with its gearbox and alone, or the table's largest
            speed [rad/s].
        motors: number of motors driven in the same way.
        resistance [ohm], torque_constant [N·m/A]: of one.
        hot: temperature limit of a winding [°C].
        imposed: quantity on the motors, see `Rig`.
        levels: levels of speed [rad/s] or current [A] that the table used, if these are imposed.
        has_ground: True if it is carried by a ground.
        duties: magnitudes of the driver's duty that the table used [-].
        torques: magnitudes of a brake's torque that it used [N·m], empty without a brake.
    """

    used: tuple[Used, ...]
    measured: Names
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
        """All voltages that the table used [V]."""
        return tuple(sorted({v for u in self.used for v in u.voltages}))


def _levels(x: np.ndarray) -> tuple[float, ...]:
    return tuple(np.unique(np.round(x, 6)).tolist())


def reach_of_table(robot: Robot, conditions: Conditions, measured: Names) -> Reach:
    """Limits of the next experiments with a table's robot.

    Args:
        robot: as in its file, or fitted.
        conditions: conditions of the table's runs, shape (runs,).
        measured: names of the channels in the table.
    """
    which, volts, slope, payload = (
        np.asarray(x)
        for x in (conditions.configuration, conditions.voltage, conditions.slope_deg, conditions.payload)
    )
    masses = np.asarray([float(c.mass) for c in robot.configurations.members])
    total_mass = conditions.total_mass
    mass = masses[which] + payload if total_mass is None else np.asarray(total_mass)
    used = tuple(
        Used(name, k, _levels(volts[rows]), _levels(slope[rows]), _levels(payload[rows]), float(mass[rows].max()))
        for k, name in enumerate(robot.configurations)
        if (rows := which == k).any()
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
    free_speed = max(motor.speed_limit, motor_speed)
    geared = max(min(motor.speed_limit, robot.gearbox.speed_limit), motor_speed)
    return Reach(
        used, measured, voltage, min(voltage, constant * geared), min(voltage, constant * free_speed), current,
        motor_speed, speed, geared, free_speed, motors, resistance, constant, motor.temperature_limit,
        robot.rig.imposed,
        _levels(np.asarray(getattr(conditions, robot.rig.imposed))) if conditions.voltage_follows else (),
        robot.has_ground, _levels(np.abs(np.asarray(conditions.duty))),
        () if conditions.load_torque is None else _levels(np.abs(np.asarray(conditions.load_torque))),
    )  # fmt: skip


def reach_of_space(space: CandidateSpace, robot: Robot | None = None) -> Reach:
    """Limits of the next experiments with the robot of a space, or with a fitted one if given."""
    weight = space.weight
    measured_channels = tuple(
        c for k, c in enumerate(channels.channel_names(space.bare.channels)) if weight[:, k].any()
    )
    return reach_of_table(space.bare.base if robot is None else robot, space.bare.observe.driven, measured_channels)
