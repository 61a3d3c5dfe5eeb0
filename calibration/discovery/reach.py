"""Reach of a bench: the ranges of conditions that a table used, and the limits of motors and robot."""

from __future__ import annotations

import dataclasses

import numpy as np

from calibration.data import Names
from calibration.discovery.active_set import CandidateSpace
from calibration.inference.ranges import operating_readings
from mmrjax.model import channels
from mmrjax.model.conditions import Conditions
from mmrjax.model.robot import Robot

#: Largest payload and slope compared with the table's: as factors, and for the payload also as a share of the
#: largest total mass [-]. Voltages are not increased, unless the robot states its motors' limit.
PAYLOAD, MASS, SLOPE = 1.5, 0.2, 1.15
#: Assumed shares of stall current and of no-load speed for a motor with a table without steady travel [-].
LOADED, RUNNING = 0.3, 0.8


@dataclasses.dataclass(frozen=True)
class UsedConditions:
    """Conditions that a table used with one configuration, each increasing and without repeats.

    Attributes:
        configuration: name of the configuration.
        index: index of the configuration in the robot.
        voltages, slopes, payloads: values [V], [deg], [kg].
        mass: largest total mass [kg].
    """

    configuration: str
    index: int
    voltages: tuple[float, ...]
    slopes: tuple[float, ...]
    payloads: tuple[float, ...]
    mass: float

    @property
    def steepest(self) -> float:
        """Largest magnitude of the slope [deg]."""
        return max(abs(s) for s in self.slopes)

    @property
    def payload(self) -> float:
        """Largest payload that a proposed run may use [kg]. 0 if the table has none."""
        most = self.payloads[-1]
        return min(PAYLOAD * most, most + MASS * self.mass)


@dataclasses.dataclass(frozen=True)
class Reach:
    """Limits within which experiments are proposed.

    Attributes:
        used: conditions of the table, for each configuration.
        measured: names of the channels in the table.
        voltage: highest voltage of proposed runs under load [V].
        geared, alone: highest voltage of motors with only their gearboxes, and of motors without any load [V].
        current: largest steady current of one motor [A], within its continuous limit.
        motor_speed [rad/s], speed [m/s]: largest steady speeds of motor shaft and robot.
        limit_geared, limit_alone: speed limits of the motor shaft with its gearbox and alone, or the largest speed of
            the table [rad/s].
        motors: number of motors that are driven in the same way.
        resistance [ohm], torque_constant [N·m/A]: constants of one motor.
        hot: temperature limit of a winding [°C].
        imposed: quantity imposed on the motors, see `Rig`.
        levels: levels of the imposed speed [rad/s] or current [A] in the table.
        has_ground: True if a ground carries the robot.
        duties: magnitudes of the driver's duty in the table [-].
        torques: magnitudes of the brake torque in the table [N·m], empty without a brake.
    """

    used: tuple[UsedConditions, ...]
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
        """All voltages of the table [V]."""
        return tuple(sorted({v for u in self.used for v in u.voltages}))


def _levels(x: np.ndarray) -> tuple[float, ...]:
    return tuple(np.unique(np.round(x, 6)).tolist())


def reach_of_table(robot: Robot, conditions: Conditions, measured: Names) -> Reach:
    """Limits of the next experiments, from the conditions of a table and its robot.

    Args:
        robot: robot of the file, or the fitted robot.
        conditions: conditions of the table's runs, shape (runs,).
        measured: names of the measured channels.
    """
    configuration_index, volts, slope, payload = (
        np.asarray(x)
        for x in (conditions.configuration, conditions.voltage, conditions.slope_deg, conditions.payload)
    )
    masses = np.asarray([float(c.mass) for c in robot.configurations.members])
    total_mass = conditions.total_mass
    mass = masses[configuration_index] + payload if total_mass is None else np.asarray(total_mass)
    settings = tuple(
        UsedConditions(
            name, k, _levels(volts[rows]), _levels(slope[rows]), _levels(payload[rows]), float(mass[rows].max())
        )
        for k, name in enumerate(robot.configurations)
        if (rows := configuration_index == k).any()
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
        settings, measured, voltage, min(voltage, constant * geared), min(voltage, constant * free_speed), current,
        motor_speed, speed, geared, free_speed, motors, resistance, constant, motor.temperature_limit,
        robot.rig.imposed,
        _levels(np.asarray(getattr(conditions, robot.rig.imposed))) if conditions.voltage_follows else (),
        robot.has_ground, _levels(np.abs(conditions.duty)),
        () if conditions.load_torque is None else _levels(np.abs(conditions.load_torque)),
    )  # fmt: skip


def reach_of_space(space: CandidateSpace, robot: Robot | None = None) -> Reach:
    """Limits of the next experiments with the robot of a candidate space, or with `robot` if given."""
    weight = space.weight
    measured_channels = tuple(
        c for k, c in enumerate(channels.channel_names(space.bare.channels)) if weight[:, k].any()
    )
    return reach_of_table(space.bare.base if robot is None else robot, space.bare.observe.driven, measured_channels)
