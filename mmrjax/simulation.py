"""The public API's one verb: simulate a robot under conditions, in any fidelity. What is wrong is refused here."""

from __future__ import annotations

import dataclasses
import math
import warnings
from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from mmrjax import fidelities, missions, params, power
from mmrjax.conditions import Conditions
from mmrjax.errors import UsageError, choices
from mmrjax.fidelities.base import Fidelity, History, Run
from mmrjax.fidelities.mission import Start
from mmrjax.profile import Profile
from mmrjax.results import Results
from mmrjax.robot import Robot
from mmrjax.tables import CONDITION_LIMITS

#: Runs of which `simulate` keeps histories at once.
HISTORIES = 1000


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
    """Simulate one run, or a batch.

    Values are checked where they are concrete; tracers pass, so that `jax.grad`, `jax.jacfwd`, `jax.vmap` and
    `jax.jit` go through (reverse mode through `steady` and `track`, forward mode through all).

    Args:
        robot: any robot; its parameters may be tracers or, under `jax.vmap`, batches.
        conditions: fields of one shape, configurations by name or index.
        model: fidelity, one of `fidelities.NAMES`; `steady` where not stated, `drive` with a profile.
        duration: of a run [s]; `drive` 30, `track` 1.5 where not stated.
        step: of integration [s]; `track` 1e-4 where not stated.
        history: whether to keep runs over time, where the fidelity can; `track` then starts from standstill, else
            rolling at the steady speed.
        profile: a mission that every run is to follow (`mmrjax.profile.profile`), by `drive` only; what it does not
            state the conditions do. Results then have `mission`, and the columns of `mmrjax.missions.OUTPUTS`.
            Derivatives are forward, by its values and times too; with tracers state `history=False`.
        start: the state that a mission begins in; None: at rest at ambient temperature.
        options: of a further fidelity, by name.

    Returns:
        Numbers of the conditions' shape, each run with its status.

    Raises:
        UsageError: a value that is not allowed, an unknown name, an option that the fidelity does not have.
    """
    if not isinstance(robot, Robot):
        raise UsageError(f"robot: got {type(robot).__name__}; expected a Robot such as mmrjax.nominal()")
    if not isinstance(conditions, Conditions):
        raise UsageError(f"conditions: got {type(conditions).__name__}; expected mmrjax.Conditions(...)")
    model = model or (fidelities.NAMES[0] if profile is None else missions.MODEL)
    if model not in fidelities.TABLE:
        raise UsageError(f"model: got {model}; {choices(str(model), fidelities.TABLE)}")
    if profile is not None or start is not None:
        _check_profile(model, profile, {"duration": duration, "step": step, **options})
    try:
        stated = fidelities.facts(model).resolved(duration=duration, step=step, **options)
    except ValueError as error:
        raise UsageError(f"model {model}, {error}") from error
    _check_robot(robot)
    conditions = _resolved(robot, conditions)
    total_mass = _total_mass(robot, conditions)
    _check_conditions(conditions, total_mass)
    _check_battery(robot, conditions)
    shape, flat = conditions.shape, jax.tree.map(jnp.ravel, conditions)
    if profile is not None:
        return _missions(robot, conditions, total_mass, flat, profile, start, history)
    run = _run(fidelities.get(model), robot, flat, stated, history and fidelities.facts(model).histories)
    run = jax.tree.map(lambda x: jnp.reshape(x, shape + x.shape[1:]), run)
    names = robot.configurations.names
    return Results(conditions, total_mass, run.result, run.columns, run.history, names, model)


def _check_battery(robot: Robot, conditions: Conditions) -> None:
    """Refuse a cut-off at which no cell gives current, and warn of one that hardly acts, where a run is on the
    battery."""
    if _traced((robot.battery, conditions.battery)) or not (np.asarray(conditions.battery) > 0.5).any():
        return
    if any(np.ndim(x) for x in jax.tree.leaves(robot.battery)):  # a batch of robots
        return
    if refused := power.cutoff_refused(robot.battery):
        raise UsageError(f"battery.voltage_cutoff: {refused}")
    if remark := power.cutoff_remark(robot.battery):
        warnings.warn(f"battery.voltage_cutoff: {remark}", stacklevel=3)


def _check_profile(model: str, profile: Any, options: Mapping[str, float | None]) -> None:
    if profile is None:
        raise UsageError("start: got one without a profile; expected profile=mmrjax.profile.profile(...) beside it")
    if not isinstance(profile, Profile):
        raise UsageError(f"profile: got {type(profile).__name__}; expected mmrjax.profile.profile(...)")
    if model != missions.MODEL:
        raise UsageError(f"model: got {model} beside a profile; expected {missions.MODEL}, which follows profiles")
    for name, value in options.items():
        if value is not None:
            raise UsageError(f"{name}: got {value!r} beside a profile, whose last row ends the mission; leave it out")


def _missions(
    robot: Robot,
    conditions: Conditions,
    total_mass: jax.Array,
    flat: Conditions,
    profile: Profile,
    start: Start | None,
    history: bool,
) -> Results:
    """Every run of a batch over the same profile."""
    if not _traced((robot, flat, profile, start)):
        cell = missions.begins_below(robot, flat, profile, start)
        if np.isfinite(cell).any():
            k = int(np.argmax(np.isfinite(cell)))
            at = f"[{k}]" if len(cell) > 1 else ""
            raise UsageError(
                f"discharge{at}: got {float(np.asarray(flat.discharge)[k]):g} C; a cell is then at {cell[k]:.4g} V, "
                f"below its cut-off of {robot.battery.voltage_cutoff:g} V, before the mission begins"
            )
    found = missions.batch(robot, flat, profile, start, history=history)
    further = missions.columns(missions.numbers(robot, flat, found))
    course = None
    if found.course is not None:
        course = History.of(robot, found.course.time, found.course.distance, found.course.signals)
    shape, names = conditions.shape, robot.configurations.names
    found, further, course = jax.tree.map(lambda x: jnp.reshape(x, shape + x.shape[1:]), (found, further, course))
    return Results(
        conditions, total_mass, found.result, further, course, names, missions.MODEL, found, profile.stated
    )


def _run(
    fidelity: Fidelity, robot: Robot, conditions: Conditions, options: Mapping[str, float], history: bool
) -> Run:
    """A batch of shape (runs,) in chunks, the last filled up with its last run, so that all share one compilation."""
    (runs,) = conditions.shape
    if history and runs > HISTORIES:
        raise UsageError(f"history: got {runs} runs; at most {HISTORIES} are kept over time; expected history=False")
    simulate = fidelity.histories if history else fidelity.run
    assert simulate is not None
    traced = _traced((robot, conditions))
    if not traced:
        try:
            fidelity.check(robot, conditions, options)
        except ValueError as error:
            raise UsageError(f"model {fidelity.name}, {error}") from error
    if runs <= fidelity.chunk or traced:
        return simulate(robot, conditions, options)
    parts = []
    for first in range(0, runs, fidelity.chunk):
        rows = np.minimum(np.arange(first, first + fidelity.chunk), runs - 1)
        parts.append(simulate(robot, jax.tree.map(lambda x, rows=rows: x[rows], conditions), options))
    return jax.tree.map(lambda *x: jnp.concatenate(x)[:runs], *parts)


def _traced(tree: Any) -> bool:
    return any(isinstance(x, jax.core.Tracer) for x in jax.tree.leaves(tree))


def _check_robot(robot: Robot) -> None:
    """Refuse parameters out of the bounds that their fields declare."""
    concrete = [p for p in params.walk(robot) if not isinstance(p.value, jax.core.Tracer)]
    for parameter, value in zip(concrete, jax.device_get([p.value for p in concrete]), strict=True):
        spec = parameter.spec
        wrong = _first_outside(value, *spec.bounds)
        if wrong is not None:
            low, high = spec.bounds
            raise UsageError(
                f"{parameter.name}{wrong[0]}: got {wrong[1]:.6g}; expected {low:g} to {high:g} {spec.unit} "
                f"({spec.meaning})"
            )


def _resolved(robot: Robot, conditions: Conditions) -> Conditions:
    """Conditions with indices for names, every index one that the robot has."""
    names, which = robot.configurations.names, conditions.configuration
    if isinstance(which, np.ndarray) and which.dtype.kind == "U":
        for name in np.unique(which):
            if name not in names:
                raise UsageError(f"configuration: got {name}; {choices(str(name), names)}")
        return conditions.resolved(robot)
    if not _traced(which):
        wrong = _first_outside(np.asarray(which), 0, len(names) - 1)
        if wrong is not None:
            known = ", ".join(f"{k} ({name})" for k, name in enumerate(names))
            raise UsageError(f"configuration{wrong[0]}: got {wrong[1]:g}; expected one of {known}")
    return conditions


def _total_mass(robot: Robot, conditions: Conditions) -> jax.Array:
    """Mass of robot and payload, stated or the robot's own [kg]."""
    if conditions.total_mass is not None:
        return conditions.total_mass
    own = jnp.stack([jnp.asarray(chassis.mass) for chassis in robot.configurations.members])
    return own[conditions.configuration] + conditions.payload


def _check_conditions(conditions: Conditions, total_mass: jax.Array) -> None:
    for field in dataclasses.fields(conditions):
        value = getattr(conditions, field.name)
        if field.name == "configuration" or value is None or _traced(value):
            continue
        low, high, unit = CONDITION_LIMITS[field.name]
        wrong = _first_outside(np.asarray(value), low, high)
        if wrong is not None:
            raise UsageError(
                f"{field.name}{wrong[0]}: got {wrong[1]:.6g}; expected {low:g} to {high:g} {unit}".rstrip()
            )
    if conditions.total_mass is None or _traced((total_mass, conditions.payload)):
        return
    bare = np.asarray(total_mass) - np.asarray(conditions.payload)
    wrong = _first_outside(bare, np.nextafter(0.0, 1.0), math.inf)
    if wrong is not None:
        at = np.unravel_index(int(np.argmax(~(bare > 0))), bare.shape)
        mass, payload = float(np.asarray(total_mass)[at]), float(np.asarray(conditions.payload)[at])
        raise UsageError(f"total_mass{wrong[0]}: got {mass:g} kg; expected more than the payload, {payload:g} kg")


def _first_outside(value: Any, low: float, high: float) -> tuple[str, float] | None:
    """Index in brackets (none for one number) and value of the first number that is not within the limits."""
    numbers = np.asarray(value)
    bad = ~((numbers >= low) & (numbers <= high) & np.isfinite(numbers))
    if not bad.any():
        return None
    at = np.unravel_index(int(np.argmax(bad)), bad.shape)
    return ("[" + ", ".join(str(int(k)) for k in at) + "]" if at else ""), float(numbers[at])
