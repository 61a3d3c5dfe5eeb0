"""The function `simulate`: a robot under conditions, in any fidelity, with checks of all arguments."""

from __future__ import annotations

import dataclasses
import math
import warnings
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import equinox.internal as eqxi
import jax
import numpy as np

from mmrjax import fidelities
from mmrjax.compile.compiling import as_jax_arrays, in_double, in_trace
from mmrjax.compile.programs import has_tracer
from mmrjax.errors import UsageError, allowed_words
from mmrjax.fidelities.base import History
from mmrjax.fidelities.results import PendingBatch, Results, flatten_conditions, reshape_runs, run_batch, total_mass
from mmrjax.missions import mission_batch
from mmrjax.missions.mission import Start
from mmrjax.missions.profile import Profile
from mmrjax.model import params, power
from mmrjax.model.conditions import OF_TURNS, Conditions, NamedConfigurations, sides_contradiction
from mmrjax.model.quantities import CONDITIONS
from mmrjax.model.robot import NO_BRAKE, Robot, turn_error
from mmrjax.model.signals import CODES

#: Warning about runs without data of each side, for a robot with unequal sides.
STRAIGHT = "the robot's sides differ, but these runs travel straight, as if steered"
#: Error message for reverse mode through a fidelity that does not support it.
FORWARD_ALONE = (
    "derivatives are forward (jax.jacfwd, jax.jvp). For jax.grad use model steady, or mmrjax.step for runs over time"
)
STATUS, _ = CODES


@in_double
def simulate(
    robot: Robot,
    conditions: Conditions,
    model: str | None = None,
    *,
    duration: float | None = None,
    step: float | None = None,
    history: bool = True,
    profile: Profile | None = None,
    start: Start | None = None,
    **options: float | None,
) -> Results:
    """Simulates one run or a batch.

    Concrete values are checked. Tracers pass, so that `jax.grad`, `jax.jacfwd`, `jax.vmap` and
    `jax.jit` work. Forward mode works in all fidelities, reverse mode in `steady` and `track`. For reverse mode over
    time see `step`. The results of `steady` are computed when they are read (see `Results`).

    Args:
        robot: any robot. Its parameters may be tracers or, under `jax.vmap`, batches.
        conditions: fields of one shape, configurations by name or index.
        model: fidelity, one of `fidelities.NAMES`. Default `steady`, or `drive` with a profile.
        duration: duration of a run [s]. Default 30 for `drive`, 1.5 for `track`.
        step: step of integration [s]. Default 1e-4 for `track`.
        history: True to return runs over time if the fidelity can. `track` then starts from standstill, else
            rolling at the steady speed.
        profile: a mission that every run follows (`mmrjax.profile`), only with `drive`. The conditions supply what it
            does not state. Results then have `mission`, and the columns of `missions.mission_batch.OUTPUTS`.
            Derivatives are forward, also with respect to its values and times. With tracers state `history=False`.
        start: state at the start of a mission. None: at rest at ambient temperature.
        options: options of a further fidelity, by name.

    Returns:
        Results of the conditions' shape, each run with its status.

    Raises:
        UsageError: a value that is not allowed, an unknown name, an option that the fidelity does not have.
    """
    check_types(robot, conditions)
    model = model or (fidelities.NAMES[0] if profile is None else mission_batch.MODEL)
    if model not in fidelities.TABLE:
        raise UsageError(f"model: got {model}; {allowed_words(str(model), fidelities.TABLE)}")
    if profile is not None or start is not None:
        _check_profile(model, profile, {"duration": duration, "step": step, **options})
    try:
        resolved_options = fidelities.fidelity_facts(model).resolved(duration=duration, step=step, **options)
    except ValueError as error:
        raise UsageError(f"model {model}, {error}") from error
    check_robot(robot)
    conditions = check_conditions(robot, conditions)
    if robot.controller is not None and (model != mission_batch.MODEL or profile is not None):
        raise UsageError(f"model: got {model}; a controller needs model={mission_batch.MODEL!r}, without a profile")
    _check_battery(robot, conditions)
    _check_turning(robot, conditions, profile)
    if conditions.held is not None and (model != "steady" or robot.has_ground or conditions.motor_speed is not None):
        raise UsageError(
            "held: a clamp needs a shaft at an imposed voltage or current and model='steady'; use both, or omit held"
        )
    has_brake = conditions.load_torque is not None or (profile is not None and profile.load_torque is not None)
    if has_brake and robot.has_ground:
        raise UsageError(f"load_torque: {NO_BRAKE}; state slope_deg or payload")
    turns = conditions.turns or (profile is not None and profile.turns)
    if not (turns or has_tracer(robot.effects)) and (unlike := robot.unlike):
        warnings.warn(f"{', '.join(unlike)}: {STRAIGHT}; {OF_TURNS[0]}=1, {OF_TURNS[1]}=1 let it turn", stacklevel=2)
    if in_trace(robot, conditions, profile, start):
        robot = as_jax_arrays(robot)
        conditions, profile, start = jax.device_put((conditions, profile, start))
    if profile is not None:
        return _forward_mode_only(_simulate_missions(robot, conditions, profile, start, history))
    robot = robot.showing_turns() if conditions.turns else robot
    fidelity = fidelities.get_fidelity(model)
    traced = has_tracer((robot, conditions))
    if not traced:
        try:
            fidelity.check(robot, flatten_conditions(conditions), resolved_options)
        except ValueError as error:
            raise UsageError(f"model {model}, {error}") from error
    names = robot.configurations.names
    if fidelity.outputs is not None and not traced:
        return Results.pending(PendingBatch(robot, conditions, fidelity), names, model)
    run = run_batch(
        fidelity, robot, conditions, resolved_options, history and fidelities.fidelity_facts(model).histories
    )
    results = Results(
        conditions, total_mass(robot, conditions), run.result, run.columns, run.history, names, model,
        channels=robot.channels,
    )  # fmt: skip
    return results if fidelities.fidelity_facts(model).reverse else _forward_mode_only(results)


def check_types(robot: Any, conditions: Any) -> None:
    """Raises UsageError for arguments that are no robot or no conditions."""
    if not isinstance(robot, Robot):
        raise UsageError(f"robot: got {type(robot).__name__}; expected a Robot such as mmrjax.nominal()")
    if not isinstance(conditions, Conditions):
        raise UsageError(f"conditions: got {type(conditions).__name__}; expected mmrjax.Conditions(...)")


def _forward_mode_only(results: Results) -> Results:
    """Same results with a clear error in reverse mode: a loop over adaptive steps does not support it."""
    if not has_tracer(results):
        return results
    description = results.model if results.mission is None else f"{results.model} over a profile"
    guarded: Results = eqxi.nondifferentiable_backward(results, msg=f"{description}: {FORWARD_ALONE}")
    return guarded


def _check_battery(robot: Robot, conditions: Conditions) -> None:
    """Raises if battery runs have an unreachable cut-off voltage, and warns if the cut-off rarely acts."""
    if has_tracer((robot.battery, conditions.battery)) or not (np.asarray(conditions.battery) > 0.5).any():
        return
    if any(np.ndim(x) for x in jax.tree.leaves(robot.battery)):  # a batch of robots
        return
    if reason := power.cutoff_error(robot.battery):
        raise UsageError(f"battery.voltage_cutoff: {reason}")
    if remark := power.cutoff_remark(robot.battery):
        warnings.warn(f"battery.voltage_cutoff: {remark}", stacklevel=3)


def _check_turning(robot: Robot, conditions: Conditions, profile: Profile | None) -> None:
    """Raises if the sides are driven independently and the robot cannot turn."""
    turn_inputs = [name for name in OF_TURNS if getattr(conditions, name) is not None]
    turn_inputs += ["profile"] if profile is not None and profile.turns else []
    if not turn_inputs or has_tracer((robot, conditions.configuration)):
        return
    if any(np.ndim(x) for x in jax.tree.leaves((robot.sides, robot.configurations))):  # a batch of robots
        return
    if reason := turn_error(robot, [robot.configurations.names[k] for k in np.unique(conditions.configuration)]):
        raise UsageError(f"{turn_inputs[0]}: {reason}")


def _check_profile(model: str, profile: Any, options: Mapping[str, float | None]) -> None:
    if profile is None:
        raise UsageError("start: got one without a profile; expected profile=mmrjax.profile(...) too")
    if not isinstance(profile, Profile):
        raise UsageError(f"profile: got {type(profile).__name__}; expected mmrjax.profile(...)")
    if model != mission_batch.MODEL:
        raise UsageError(f"model: got {model} with a profile; expected {mission_batch.MODEL}, which follows profiles")
    for name, value in options.items():
        if value is not None:
            raise UsageError(
                f"{name}: got {value!r} with a profile, whose last row ends the mission; leave {name} out"
            )


def _simulate_missions(
    robot: Robot, conditions: Conditions, profile: Profile, start: Start | None, history: bool
) -> Results:
    """Runs every member of a batch over the same profile."""
    runs = flatten_conditions(conditions)
    if not has_tracer((robot, runs, profile, start)):
        cell = mission_batch.cell_below_cutoff(robot, runs, profile, start)
        if np.isfinite(cell).any():
            k = int(np.argmax(np.isfinite(cell)))
            run = f"[{k}]" if len(cell) > 1 else ""
            raise UsageError(
                f"discharge{run}: got {float(np.asarray(runs.discharge)[k]):g} C; a cell is then at {cell[k]:.4g} V, "
                f"below its cut-off of {robot.battery.voltage_cutoff:g} V, before the mission begins"
            )
    missions = mission_batch.missions_of_runs(robot, runs, profile, start, history=history)
    further = mission_batch.numbers_by_column(mission_batch.mission_numbers(robot, runs, missions))
    mission_history = None
    if missions.course is not None:
        mission_history = History.of(robot, missions.course.time, missions.course.distance, missions.course.signals)
    missions, further, mission_history = reshape_runs((missions, further, mission_history), conditions.shape)
    names = robot.configurations.names
    mass = total_mass(robot, conditions)
    return Results(
        conditions,
        mass,
        missions.result,
        further,
        mission_history,
        names,
        mission_batch.MODEL,
        missions,
        profile.stated,
        robot.channels,
    )


def check_robot(robot: Robot) -> None:
    """Raises for parameters that are no single number, or outside the bounds of their fields."""
    concrete = [p for p in params.walk_parameters(robot) if not isinstance(p.value, jax.core.Tracer)]
    for parameter, value in zip(concrete, jax.device_get([p.value for p in concrete]), strict=True):
        spec = parameter.spec
        if np.ndim(value) or np.asarray(value).dtype.kind not in "biuf":
            value_text = f"shape {np.shape(value)}" if np.ndim(value) else repr(value)
            raise UsageError(
                f"{parameter.name}: got {value_text}; expected one number; for several robots use jax.vmap"
            )
        outside = _first_outside(value, *spec.bounds)
        if outside is not None:
            low, high = spec.bounds
            raise UsageError(
                f"{parameter.name}{outside[0]}: got {outside[1]:.6g}; expected {low:g} to {high:g} {spec.unit} "
                f"({spec.meaning})"
            )


def _resolve_conditions(robot: Robot, conditions: Conditions) -> Conditions:
    """Conditions with configuration names replaced by indices, checked against the robot's configurations."""
    names = robot.configurations.names
    configuration = conditions.configuration
    if isinstance(configuration, NamedConfigurations):
        try:
            return replace(conditions, configuration=configuration.among(names))
        except KeyError as error:
            raise UsageError(f"configuration: got {error.args[0]}; {allowed_words(error.args[0], names)}") from error
    if not has_tracer(configuration) and (wrong := _first_outside(configuration, 0, len(names) - 1)):
        numbered_names = ", ".join(f"{k} ({name})" for k, name in enumerate(names))
        raise UsageError(f"configuration{wrong[0]}: got {wrong[1]:g}; expected one of {numbered_names}")
    return conditions


def check_conditions(robot: Robot, conditions: Conditions) -> Conditions:
    """Conditions with configuration names replaced by indices. Values are checked unless they are tracers.

    Raises:
        UsageError: a configuration that the robot lacks, a value out of range or NaN, or values that contradict.
    """
    conditions = _resolve_conditions(robot, conditions)
    if (conditions.goal is None) != (robot.controller is None):
        raise UsageError(
            "goal: got one, and the robot has no controller; leave it out"
            if robot.controller is None
            else f"goal: not stated; the robot's controller needs it ({robot.rig.imposed}, SI)"
        )
    _check_conditions(conditions)
    return conditions


def _check_conditions(conditions: Conditions) -> None:
    stated_names = {f.name for f in dataclasses.fields(conditions) if getattr(conditions, f.name) is not None}
    # An unstated duty is 1, and under a transformation a tracer; neither counts as stated.
    if has_tracer(conditions.duty) or (np.asarray(conditions.duty) == 1).all():
        stated_names.remove("duty")
    if reason := sides_contradiction(stated_names):
        raise UsageError(reason)
    extremes: dict[int, tuple[float, float]] = {}  # by array: several fields may share one
    for field in dataclasses.fields(conditions):
        value = getattr(conditions, field.name)
        if field.name == "configuration" or value is None or has_tracer(value) or not value.size:
            continue
        condition = CONDITIONS[field.name]
        (low, high), unit = condition.range, condition.unit_shown
        if id(value) not in extremes:
            extremes[id(value)] = _smallest_and_largest(value)
        least, most = extremes[id(value)]
        if not low <= least <= most <= high and (wrong := _first_outside(value, low, high)):
            raise UsageError(
                f"{field.name}{wrong[0]}: got {wrong[1]:.6g}; expected {low:g} to {high:g} {unit}".rstrip()
            )
    declared_mass, payload = conditions.total_mass, conditions.payload
    if declared_mass is None or has_tracer((declared_mass, payload)):
        return
    mass_without_payload = np.asarray(declared_mass) - np.asarray(payload)
    wrong = _first_outside(mass_without_payload, np.nextafter(0.0, 1.0), math.inf)
    if wrong is not None:
        index = np.unravel_index(int(np.argmax(~(mass_without_payload > 0))), mass_without_payload.shape)
        mass, load = float(np.asarray(declared_mass)[index]), float(np.asarray(payload)[index])
        raise UsageError(f"total_mass{wrong[0]}: got {mass:g} kg; expected more than the payload, {load:g} kg")


def _smallest_and_largest(values: jax.Array | np.ndarray) -> tuple[float, float]:
    """Smallest and largest number, computed by the library that holds them. NaN if one of them is NaN."""
    on_host = not isinstance(values, jax.Array) or all(device.platform == "cpu" for device in values.devices())
    numbers = np.asarray(values) if on_host else values
    least, most = jax.device_get((numbers.min(), numbers.max()))
    return float(least), float(most)


def _first_outside(value: Any, low: float, high: float) -> tuple[str, float] | None:
    """Index in brackets (empty for a scalar) and value of the first number outside the limits, or None."""
    numbers = np.asarray(value)
    if not numbers.shape and low <= numbers <= high and math.isfinite(numbers):
        return None
    is_outside = ~((numbers >= low) & (numbers <= high) & np.isfinite(numbers))
    if not is_outside.any():
        return None
    index = np.unravel_index(int(np.argmax(is_outside)), is_outside.shape)
    return ("[" + ", ".join(str(int(k)) for k in index) + "]" if index else ""), float(numbers[index])
