"""Comparison of an exported drive with the native model: runs, refit, fate of each effect, and errors."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Protocol

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx

from calibration.data import Names
from calibration.data.columns import LOAD, Layout
from calibration.data.input_errors import BadConfiguration, BadData
from calibration.data.runs import Runs
from calibration.inference.simulation_errors import share_of_measured
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

#: Share of an effect's change of current and speed below which the format does not hold it.
LITTLE = 0.1
#: Share above which a format holds an effect within rounding.
NEARLY_ALL = 0.999
#: Weight that keeps undetermined parameters near their translation: a relative change of 1 in a parameter's root
#: counts as much as this relative error of every reading.
NEAR = 1e-3
#: Residual below which translated parameters are exact, and no refit changes them.
EXACT = 1e-7
HELD, APPROXIMATED, DROPPED = "held", "approximated", "dropped"


class FormatLaw(Protocol):
    """Law of a format in steady travel, with the parameters that a refit may change.

    Attributes:
        names: names of the parameters.
        start: their values by translation [SI], all positive or zero.
    """

    names: Names
    start: np.ndarray

    def __call__(self, theta: Any, command: Any, load: Any, way: Any) -> tuple[Any, Any]:
        """Current of one motor [A] and speed of the joint [rad/s], arrays of the shape of `command`."""
        ...


@dataclasses.dataclass(frozen=True)
class EffectFate:
    """Representation of an effect, or of a base term, in a format.

    Attributes:
        name: name of the effect or term.
        verdict: `HELD`, `APPROXIMATED` or `DROPPED`.
        how: explanation in words.
        kept: share of its change of current and speed that the exported drive reproduces [-]. NaN if it has none.
    """

    name: str
    verdict: str
    how: str
    kept: float = np.nan


@dataclasses.dataclass(frozen=True)
class ExportComparison:
    """An exported drive compared with the native model.

    Attributes:
        situation: the runs.
        translated, refitted: parameters of the format by name [SI], before and after the refit.
        fates: fates of base terms and effects.
        errors: rms error over rms [%] by channel, of native, exported, translated, and exported without the effects.
        reference: what errors are relative to, in words.
        readings: readings of the exported drive [SI], (runs, channels).
        exported: result of the exported drive at the joint.
    """

    situation: ComparisonRuns
    translated: Mapping[str, float]
    refitted: Mapping[str, float]
    fates: tuple[EffectFate, ...]
    errors: Mapping[str, Mapping[str, float]]
    reference: str
    readings: np.ndarray
    exported: JointResult


#: Labels of the models whose errors are stated.
NATIVE, EXPORTED, TRANSLATED, WITHOUT = "native", "exported", "exported, not refitted", "exported without the effects"


def compare_format(
    situation: ComparisonRuns,
    law_of: Callable[[DriveJoint, Mapping[str, float]], FormatLaw],
    fates: Sequence[EffectFate],
    held: Mapping[str, str],
    approximated: Callable[[str], str],
) -> ExportComparison:
    """Compares a format with the native model over runs.

    Args:
        law_of: function that returns the format's law of a joint, with given amplitudes of effects by name.
        fates: fates of terms that are not effects inside the joint.
        held: effects for which the format has its own term → words for that term.
        approximated: words for the terms that replace an effect of a balance.
    """
    joint = situation.joint
    law = law_of(joint, {})
    joint_result = situation.inside
    theta = refit_parameters(law, situation, joint_result)
    names = tuple(e.name for e in joint.inside)
    fates_found = list(fates)
    for effect in joint.inside:
        without_effect = situation.solve_without_effects((effect.name,))
        share = share_kept(law, law_of(joint, {effect.name: 0.0}), situation, joint_result, without_effect)
        verdict = HELD if effect.name in held else DROPPED if share < LITTLE else APPROXIMATED
        approximation = held.get(effect.name) or approximated(effect.balance)
        if not np.isfinite(share) and effect.name not in held:
            verdict, approximation = DROPPED, "no effect on these runs, and the format lacks it"
        fates_found.append(EffectFate(effect.name, verdict, approximation, share))
    exported = _law_at(law, theta, situation)
    models = {NATIVE: situation.native, EXPORTED: situation.readings(exported)}
    if law.names:
        models[TRANSLATED] = situation.readings(_law_at(law, law.start, situation))
    if names:
        law_without_effects = law_of(joint, dict.fromkeys(names, 0.0))
        refit_without_effects = refit_parameters(
            law_without_effects, situation, situation.solve_without_effects(names)
        )
        models[WITHOUT] = situation.readings(_law_at(law_without_effects, refit_without_effects, situation))
    reference = situation.measured if situation.is_measured else situation.native
    return ExportComparison(
        situation, dict(zip(law.names, map(float, law.start), strict=True)),
        dict(zip(law.names, map(float, theta), strict=True)), tuple(fates_found),
        {label: channel_errors(joint, readings, reference) for label, readings in models.items()},
        "the measured readings" if situation.is_measured else "the native model",
        models[EXPORTED], exported,
    )  # fmt: skip


def channel_errors(joint: DriveJoint, shown: np.ndarray, reference: np.ndarray) -> dict[str, float]:
    """Rms of the difference over the rms of the reference [%], for each channel with readings."""
    shares = share_of_measured(shown, reference)
    return {c.name: 100 * float(s) for c, s in zip(channels_of(joint), shares, strict=True) if np.isfinite(s)}


def _law_at(law: FormatLaw, theta: Any, situation: ComparisonRuns) -> JointResult:
    current, speed = evaluate_law(law, jnp.asarray(theta), situation.command, situation.load, situation.way)
    return JointResult(np.asarray(current), np.asarray(speed))


@eqx.filter_jit
def evaluate_law(law: FormatLaw, theta: Any, command: Any, load: Any, way: Any) -> tuple[Any, Any]:
    """Current of one motor [A] and speed of the joint [rad/s] by a format's law, compiled."""
    return law(theta, *map(jnp.asarray, (command, load, way)))


def refit_parameters(law: FormatLaw, situation: ComparisonRuns, native: JointResult) -> np.ndarray:
    """Least-squares fit of a format's parameters to the native model's currents and speeds.

    Residuals are relative to each quantity's rms. Parameters stay positive, because each is the square of an unknown.
    No readings are used, so errors against readings are comparable with those of the native model.
    """
    if not law.names:
        return np.zeros(0)
    inputs = (situation.command, situation.load, situation.way, native.current, native.speed)
    least = 1e-3 * float(np.max(np.abs(situation.load))) + 1e-9
    return np.asarray(_refitted(law, jnp.asarray(least), *map(jnp.asarray, inputs)))


@eqx.filter_jit
def _refitted(law: FormatLaw, least: Any, command: Any, load: Any, way: Any, current: Any, speed: Any) -> Any:
    sizes = [jnp.sqrt(jnp.mean(x**2)) for x in (current, speed)]
    scale = jnp.sqrt(jnp.maximum(law.start, least))

    # The square has no slope at 0, so a parameter of 0 starts slightly above.
    start = jnp.maximum(jnp.sqrt(law.start) / scale, 1e-3)

    def residual(z: jax.Array, args: Any) -> jax.Array:
        solution = law((scale * z) ** 2, command, load, way)
        errors = [(a - b) / s for a, b, s in zip(solution, (current, speed), sizes, strict=True)]
        return jnp.concatenate([*errors, NEAR * jnp.sqrt(1.0 * len(command)) * (z - start)])

    solver: Any = optx.LevenbergMarquardt(rtol=1e-6, atol=1e-6)
    solution: Any = optx.least_squares(residual, solver, start, max_steps=300, throw=False)
    misfit = lambda z: jnp.sqrt(jnp.mean(residual(z, None) ** 2))  # noqa: E731
    exact, better = misfit(jnp.sqrt(law.start) / scale) < EXACT, misfit(solution.value) <= misfit(start)
    return jnp.where(exact, law.start, (scale * jnp.where(better, solution.value, start)) ** 2)


def share_kept(
    law: FormatLaw, bare: FormatLaw, situation: ComparisonRuns, native: JointResult, native_bare: JointResult
) -> float:
    """Fraction of an effect's change of current and speed that a refitted format reproduces [-], at most 1.

    1 minus the rms change of the format's error by the effect, over the rms change of current and speed. NaN if the
    effect changes nothing.
    """
    refitted = [
        _current_and_speed(_law_at(model, refit_parameters(model, situation, exact), situation))
        for model, exact in ((law, native), (bare, native_bare))
    ]
    exact, exact_bare = map(_current_and_speed, (native, native_bare))
    errors, sizes = [exact - refitted[0], exact_bare - refitted[1]], np.sqrt(np.mean(exact**2, 0))
    change = (exact - exact_bare) / sizes
    size = float(np.sqrt(np.mean(change**2)))
    if size < 1e-9:
        return float("nan")
    return 1 - float(np.sqrt(np.mean(((errors[0] - errors[1]) / sizes) ** 2))) / size


def _current_and_speed(found: JointResult) -> np.ndarray:
    return np.stack([found.current, found.speed], -1)


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
        return _joint_result(self.joint, self.signals)

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
        solved = _joint_result(self.joint, signals)
        return JointResult(solved.current[self.kept], solved.speed[self.kept])

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
        return _readings_of_signals(self.joint, signals)


def _joint_result(joint: DriveJoint, signals: Signals) -> JointResult:
    return JointResult(
        np.asarray(signals.current), np.asarray(signals.speed_motor) / float(joint.robot.gearbox.ratio)
    )


def _readings_of_signals(joint: DriveJoint, signals: Signals) -> np.ndarray:
    """Readings of the joint's instruments [SI], shape (runs, channels)."""
    readings = jax.vmap(lambda s: balances.sensor(joint.file.robot, s))(signals)
    return np.stack([np.asarray(readings[c.name]) for c in channels_of(joint)], -1)


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
        if not Layout.of(robot).complete and capabilities.imposed_limit(robot) is None:
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
    native = _readings_of_signals(joint, solution)
    is_moving = moves & turns & np.asarray(np.abs(signals.speed_motor) > 0) & (np.asarray(conditions.open) < 0.5)
    if not is_moving.any():
        raise BadData(f"{source}: the model settles in none of these runs")
    signals = jax.tree.map(lambda x: x[is_moving] if np.shape(x) else x, signals)
    moving_runs = runs.where(is_moving)
    drive_signals = (signals.voltage_source, signals.duty, signals.pause, signals.voltage_back)
    command = np.asarray(robot.driver.voltage(*map(jnp.asarray, drive_signals)))
    measured = np.full_like(native[is_moving], np.nan)
    if data is not None:
        by_name = {c.name: moving_runs.measured()[:, k] for k, c in enumerate(moving_runs.channels)}
        for k, c in enumerate(channels_of(joint)):
            measured[:, k] = by_name.get(c.name, np.nan)
    torque = float(joint.load.radius) * np.asarray(signals.demand)
    return ComparisonRuns(
        joint, source, moving_runs, conditions, is_moving, signals, native[is_moving], measured, command, torque
    )


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
        raise BadData(f"{runs.source}: expected straight travel, not turns")
    if levers := [name for name in runs.axes if name.startswith("lever")]:
        raise BadData(f"{runs.source}, {levers[0]}: an export is one drive; expected runs without lever columns")
    if runs.sampled:
        from calibration.data import settling

        runs = settling.settle_log(runs, robot).settled_runs()
    is_joint_configuration = runs.configurations_named(robot) == joint.configuration
    if not is_joint_configuration.any():
        raise BadData(f"{runs.source}: no run of {joint.configuration}; expected runs in the exported configuration")
    return runs.where(is_joint_configuration)
