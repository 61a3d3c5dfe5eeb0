"""Runs in which an exported drive is compared with the native model, and the native model's results."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np

from calibration.data import Names
from calibration.data.columns import LOAD, Layout
from calibration.data.input_errors import BadConfiguration, BadData
from calibration.data.runs import Runs
from mmrjax.fidelities.steady import results_of_rows
from mmrjax.model import balances, params
from mmrjax.model.conditions import Conditions
from mmrjax.model.paper_tables import SLOPES_DEG
from mmrjax.model.robot import Robot
from mmrjax.model.signals import Signals, is_done
from sweeps import capabilities
from sweeps.config import GridPart
from sweeps.export.joint import DriveJoint, channels_of
from sweeps.inputs import read_runs
from sweeps.points.grid import grid_conditions

#: Loads of a shaft in a grid, as shares of its stall torque.
LOADS = (0.0, 1 / 6, 1 / 3, 1 / 2)


@dataclasses.dataclass(frozen=True)
class JointResult:
    """Motor current and joint speed of a drive in each run, computed by one model. Arrays of shape (runs,).

    Attributes:
        current: current of one motor [A].
        speed: speed of the joint [rad/s].
    """

    current: np.ndarray
    speed: np.ndarray


@dataclasses.dataclass(frozen=True)
class ComparisonRuns:
    """Runs of one configuration, and the results of the native model.

    Attributes:
        joint: the drive.
        source: source of the runs, in words.
        runs: selected rows of the table.
        conditions: conditions of all rows of the table.
        kept: True for compared rows.
        signals: signals of the joint's own model with only the effects inside it, of shape (runs,).
        native: readings of the whole model [SI], shape (runs, channels).
        measured: measured readings in the same form, NaN if missing.
        command: mean voltage at the driver's output [V].
        load: torque that the joint must supply at the wheel [N·m].
    """

    joint: DriveJoint
    source: str
    runs: Runs
    conditions: Conditions
    kept: np.ndarray
    signals: Signals
    native: np.ndarray
    measured: np.ndarray
    command: np.ndarray
    load: np.ndarray

    @property
    def inside(self) -> JointResult:
        """The joint's own model."""
        ratio = float(self.joint.robot.gearbox.ratio)
        return JointResult(np.asarray(self.signals.current), np.asarray(self.signals.speed_motor) / ratio)

    @property
    def way(self) -> np.ndarray:
        """Direction in which the joint turns, -1 or 1."""
        return np.sign(self.inside.speed)

    @property
    def is_measured(self) -> bool:
        """True if there are readings to compare with."""
        return bool(np.isfinite(self.measured).any())

    def solve_without_effects(self, names: Names) -> JointResult:
        """The joint's own model with amplitudes of some of its effects at 0."""
        _, signals = _solve_runs(_with_absent_effects(self.joint, names), self.conditions)
        ratio = float(self.joint.robot.gearbox.ratio)
        return JointResult(np.asarray(signals.current)[self.kept], np.asarray(signals.speed_motor)[self.kept] / ratio)

    def readings(self, found: JointResult) -> np.ndarray:
        """Readings of the instruments for an exported drive [SI], shape (runs, channels).

        The wheel or shaft is read at its rim, because slip belongs to the simulator.
        """
        robot = self.joint.file.robot
        radius, ratio = float(self.joint.load.radius), float(robot.gearbox.ratio)
        share = jnp.asarray(self.signals.share_drawn)
        current, speed = jnp.asarray(found.current), jnp.asarray(found.speed)
        signals = dataclasses.replace(
            self.signals,
            current=current,
            total_current=robot.sides * current * share,
            speed_motor=speed * ratio,
            speed_wheel=speed,
            speed_output=speed,
            speed_theoretical=speed * radius,
            speed=speed * radius,
        )
        sensor_readings = jax.vmap(lambda s: balances.sensor(robot, s))(signals)
        return np.stack([np.asarray(sensor_readings[c.name]) for c in channels_of(self.joint)], -1)


def _with_absent_effects(joint: DriveJoint, names: Names = ()) -> Robot:
    """The whole robot with amplitudes at 0: of effects outside the joint, and of others by name.

    It keeps these effects, so that all models of a comparison are one compiled program.
    """
    outside = tuple(e.name for e in joint.outside)
    return params.replace(joint.file.robot, {f"effects.{n}.amplitude": jnp.zeros(()) for n in (*outside, *names)})


def _solve_runs(robot: Robot, conditions: Conditions) -> tuple[np.ndarray, Signals]:
    """Mask of the runs that end in the commanded direction, and the signals of all runs."""
    result, signals = results_of_rows(robot, conditions)
    return np.asarray(is_done(result.status)), signals


def situation_of_joint(joint: DriveJoint, data: Runs | str | None) -> ComparisonRuns:
    """Runs of a table in the joint's configuration, or of a grid if there is no table.

    Raises:
        BadData: the table is rejected, has no runs in this configuration, or belongs to a robot that is not a single
            joint.
        BadConfiguration: there is no table, and the robot file states no voltage limit for a grid.
    """
    robot = joint.file.robot
    if data is None:
        if not Layout.of(robot).uses_paper_conditions and capabilities.imposed_limit(robot) is None:
            raise BadConfiguration(
                f"--data: not given, and {joint.file.name} has no motor.voltage_limit; give a table of runs, or "
                "add the limit"
            )
        runs = export_grid(joint)
        source = "a grid in both directions, without readings"
    else:
        runs = _runs_of_joint(data, joint)
        source = runs.source
    conditions = runs.conditions(robot)
    moves, solution = _solve_runs(robot, conditions)
    turns, signals = _solve_runs(_with_absent_effects(joint), conditions) if joint.outside else (moves, solution)
    channels = channels_of(joint)
    sensor_readings = jax.vmap(lambda s: balances.sensor(robot, s))(solution)
    native = np.stack([np.asarray(sensor_readings[c.name]) for c in channels], -1)
    is_moving = moves & turns & np.asarray(np.abs(signals.speed_motor) > 0) & (np.asarray(conditions.open) < 0.5)
    if not is_moving.any():
        raise BadData(f"{source}: the model settles in none of these runs")
    signals = jax.tree.map(lambda x: x[is_moving] if np.shape(x) else x, signals)
    moving_runs = runs.where(is_moving)
    radius = float(joint.load.radius)
    drive_signals = (signals.voltage_source, signals.duty, signals.pause, signals.voltage_back)
    command = robot.driver.voltage(*map(jnp.asarray, drive_signals))
    measured = np.full((len(moving_runs), len(channels)), np.nan)
    if data is not None:
        by_name = {c.name: moving_runs.measured()[:, k] for k, c in enumerate(moving_runs.channels)}
        measured = np.stack([by_name.get(c.name, x) for c, x in zip(channels, measured.T, strict=True)], -1)
    return ComparisonRuns(
        joint, source, moving_runs, conditions, is_moving, signals, native[is_moving], measured, np.asarray(command),
        radius * np.asarray(signals.demand),
    )  # fmt: skip


def export_grid(joint: DriveJoint) -> Runs:
    """Operating points in both directions, with loads that oppose the motion.

    Voltages are Table 8's or thirds of the motor's limit. A vehicle climbs the slopes of Table 8. A shaft carries
    shares of its stall torque at each voltage, up to half of it, where the power of a motor is largest.
    """
    robot = joint.file.robot
    slopes = SLOPES_DEG if robot.has_ground else None
    config = GridPart.model_construct(configurations=(joint.configuration,), slopes_deg=slopes)
    runs = grid_conditions(config, robot)
    columns = dict(runs.columns)
    volts = runs.layout.imposed_column
    if not robot.has_ground:
        shares = np.tile(LOADS, len(runs))
        columns = {name: np.repeat(values, len(LOADS)) for name, values in columns.items()}
        columns[LOAD] = shares * stall_torque(joint, columns[volts])
    reversed_columns = {name: -values for name, values in columns.items() if name in (volts, LOAD, "slope_deg")}
    all_columns = {
        name: np.concatenate([values, reversed_columns.get(name, values)]) for name, values in columns.items()
    }
    return dataclasses.replace(runs, columns=all_columns)


def stall_torque(joint: DriveJoint, voltage: np.ndarray) -> np.ndarray:
    """Load torque that stalls a shaft's motor [N·m], without effects and within the limits of driver and
    gearbox."""
    motor, gear, load = joint.robot.motor, joint.robot.gearbox, joint.load
    current = np.minimum(voltage / float(motor.resistance), float(joint.robot.driver.current_limit))
    torque = float(motor.torque_constant) * current - float(motor.friction_coulomb + gear.friction_coulomb)
    output_torque = float(gear.ratio * gear.efficiency_load) * torque - float(load.loss_coulomb)
    return np.clip(output_torque, 0.0, np.inf if gear.torque_limit is None else gear.torque_limit)


def _runs_of_joint(data: Runs | str, joint: DriveJoint) -> Runs:
    """Runs of a table in the joint's configuration. For a log, its settled segments."""
    robot = joint.file.robot
    runs = read_runs(data, robot, measured=True, series=True) if isinstance(data, str) else data.of(robot)
    if runs.turns:
        raise BadData(f"{runs.source}: its runs drive the sides differently; expected straight travel")
    if levers := [name for name in runs.axes if name.startswith("lever")]:
        raise BadData(f"{runs.source}, {levers[0]}: an export is one drive; expected runs without lever columns")
    if runs.sampled:
        from calibration.data import settling

        runs = settling.settle_log(runs, robot).settled_runs()
    is_joint_configuration = runs.configurations_named(robot) == joint.configuration
    if not is_joint_configuration.any():
        raise BadData(f"{runs.source}: no run of {joint.configuration}; expected runs in the exported configuration")
    return runs.where(is_joint_configuration)
