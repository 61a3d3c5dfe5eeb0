"""Simulation of one robot step by step, for controllers of users: initial state, rates of a state, and one step.

Pure functions in SI units for `jax.jit`, `jax.vmap`, `jax.grad` and `jax.lax.scan`, in JAX's own precision. The
equations are those of the fidelity `drive` in straight travel. Steps have a fixed length, so reverse mode works.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from mmrjax.compile.compiling import as_floats, compiled
from mmrjax.compile.programs import has_tracer
from mmrjax.errors import UsageError, allowed_words
from mmrjax.fidelities import drive
from mmrjax.fidelities.rest import holds
from mmrjax.fidelities.simulation import check_conditions, check_types
from mmrjax.model import balances
from mmrjax.model.conditions import OF_TURNS, Conditions
from mmrjax.model.params import Scalar
from mmrjax.model.robot import Robot
from mmrjax.model.signals import State
from mmrjax.numerics.rosenbrock import Unknowns, rosenbrock_stages

#: Duty of the driver, or values of conditions by name.
Command = Scalar | Mapping[str, Scalar] | None
#: Index of the discharge in the unknowns of `drive`.
_DISCHARGE = 4
#: Lengths of the parts of a step [share of the step], each longer than the one before it. A new command changes the
#: current within the winding's time constant, and the speed within the mechanical one, about a hundred times as long.
PARTS = 1.7 ** np.arange(8) / np.sum(1.7 ** np.arange(8))


def initial_state(robot: Robot, conditions: Conditions | None = None, *, rolling: bool = False) -> State:
    """Returns the state of a robot at rest, or rolling at the speed that the fidelity `steady` finds.

    Args:
        robot: any robot. Its parameters may be tracers.
        conditions: conditions of one run, scalar fields. None: `Conditions()`. `discharge` is the charge taken from
            the battery so far [C].
        rolling: True for a robot that already travels under the voltage and duty of the conditions.

    Raises:
        UsageError: an argument that `step` refuses too.
    """
    robot, conditions = as_floats((robot, _commanded_conditions(robot, None, conditions)))
    return drive.state_of_unknowns(robot, _initial_unknowns(robot, conditions, rolling))


def rates(robot: Robot, state: State, command: Command, conditions: Conditions | None = None) -> State:
    """Returns the time derivative of a state, as a state with the unit of each number per second.

    Args:
        robot: any robot. Its parameters may be tracers.
        state: state from `initial_state` or a step.
        command, conditions: as for `step`.

    Raises:
        UsageError: an argument that `step` refuses too.
    """
    robot, conditions = as_floats((robot, _commanded_conditions(robot, command, conditions)))
    return drive.state_of_unknowns(robot, drive.drive_rates(robot, conditions, _unknowns_of_state(robot, state)))


def step(robot: Robot, state: State, command: Command, dt: Scalar, conditions: Conditions | None = None) -> State:
    """Returns the state `dt` later under a constant command.

    The step is split into eight parts of growing length, each by Rodas4, an L-stable method (Hairer and Wanner,
    Solving Ordinary Differential Equations II, 1996, Section IV.7). At a `dt` of 10 ms, the speed of the paper's
    robot is within 4 mm/s of that with steps of 0.1 ms, also during starts and stops. Its position is within 0.1 mm
    (tests/test_stepping.py). A robot that has stopped stays at rest as long as friction can hold it.

    Args:
        robot: any robot, a vehicle or a shaft on a bench. Its parameters may be tracers.
        state: state from `initial_state` or an earlier step.
        command: duty of the driver, -1 to 1, or values by their names in `Conditions` that hold during the step, such
            as `{"voltage": 24.0, "slope_deg": 5.0}`. None: the conditions alone.
        dt: length of the step [s], above 0, 0.02 s or less. A step has no error control. In starts of the paper's
            robot, speeds are within 0.3 % at 0.02 s and at 0.05 s, and off by up to 6 % at 0.1 s. With a duty that
            jumps anywhere in its range at each step, they are within 3 % of the largest speed at 0.02 s.
        conditions: conditions of one run, scalar fields. None: `Conditions()`.

    Raises:
        UsageError: conditions of several runs, conditions that impose the motors' speed or drive the sides
            independently, a value out of range or NaN, a configuration that the robot lacks. Also a command that is
            no number or names no condition, a state of another robot, a `dt` that is not above 0. Tracers pass.
    """
    robot, conditions = as_floats((robot, _commanded_conditions(robot, command, conditions)))
    y = _unknowns_of_state(robot, state)
    rate = 0.0 if robot.controller is None else robot.controller.rate
    if _shape_of_numbers(dt) != () or not (has_tracer(dt) or 0 < float(dt) < math.inf):
        raise UsageError(f"dt: got {_text_of_value(dt)}; expected a number of seconds above 0")
    if rate and not has_tracer(dt) and abs((parts := 1 / rate / float(dt)) - round(parts)) > 1e-6 * parts:
        raise UsageError(f"dt: got {float(dt):g}; expected a whole part of the controller's period, {1 / rate:g} s")
    return drive.state_of_unknowns(robot, _unknowns_after_step(robot, conditions, y, jnp.asarray(dt, float)))


@compiled
def _initial_unknowns(robot: Robot, conditions: Conditions, rolling: bool) -> Unknowns:
    return drive.drive_start(robot, conditions, rolling)


@compiled
def _unknowns_after_step(robot: Robot, conditions: Conditions, y: Unknowns, dt: Scalar) -> Unknowns:
    """Unknowns of `drive` after a step. A robot that has stopped is held if friction can hold it."""
    speeds = np.isin(np.arange(len(y)), (drive.MOTOR, drive.GROUND))
    controller_end = len(y) - robot.loose
    keeps_changing = np.isin(
        np.arange(len(y)),
        (drive.CURRENT, _DISCHARGE, *range(controller_end - len(robot.controller_states), controller_end)),
    )
    y = drive.sampled_unknowns(robot, conditions, y)
    can_hold = holds(robot, balances.with_controller_duty(robot, conditions, drive.state_of_unknowns(robot, y)))
    is_at_rest = can_hold & jnp.all(jnp.where(speeds, y, 0.0) == 0)
    rate_factor = jnp.where(is_at_rest, jnp.asarray(keeps_changing, y.dtype), 1.0)

    def rate(y: Array) -> tuple[Array, Array]:
        return drive.drive_rates(robot, conditions, y) * rate_factor, y[:0]

    def advance(y: Array, share: Array) -> tuple[Array, None]:
        return rosenbrock_stages(rate, y, y[:0], share * dt, looped=True)[0], None

    after = jax.lax.scan(advance, y, jnp.asarray(PARTS, y.dtype))[0]
    comes_to_rest = can_hold & jnp.all(jnp.where(speeds, y * after, 0.0) <= 0)
    return jnp.where(comes_to_rest & speeds, 0.0, after)


def _commanded_conditions(robot: Robot, command: Command, conditions: Conditions | None) -> Conditions:
    """Conditions of one run under a command, checked, with the index of their configuration."""
    conditions = Conditions() if conditions is None else conditions
    check_types(robot, conditions)
    values: Mapping[str, Any] = {}
    if command is not None:
        values = command if isinstance(command, Mapping) else {"duty": command}
    field_names = [field.name for field in dataclasses.fields(Conditions)]
    if unknown := next((name for name in values if name not in field_names), None):
        raise UsageError(f"command: got {unknown}; {allowed_words(str(unknown), field_names)}")
    for name, value in values.items():
        if name != "configuration" and _shape_of_numbers(value) is None:
            raise UsageError(f"command, {name}: got {_text_of_value(value)}; expected a number")
        if shape := _shape_of_numbers(value):
            raise UsageError(f"command, {name}: got shape {shape}; expected one number, or jax.vmap over several")
    if conditions.turns or not values.keys().isdisjoint(OF_TURNS):
        raise UsageError("conditions: got a command for each side; a step travels straight, use mmrjax.simulate")
    if conditions.shape:
        raise UsageError(f"conditions: got runs of shape {conditions.shape}; expected one, and jax.vmap over several")
    conditions = check_conditions(robot, replace(conditions, **values))
    if conditions.motor_speed is not None:
        raise UsageError("conditions: the motors' speed is imposed; a step needs a voltage or a current")
    return conditions


def _shape_of_numbers(value: Any) -> tuple[int, ...] | None:
    """Shape of a number or an array of numbers, tracers included. None of anything else."""
    if isinstance(value, jax.Array):
        return value.shape
    if value is None or isinstance(value, str):
        return None
    try:
        return np.asarray(value, float).shape
    except (TypeError, ValueError):
        return None


def _text_of_value(value: Any) -> str:
    """A number or a word as written, of anything else its type."""
    return f"{value!r:.40}" if isinstance(value, str | float | int) else type(value).__name__


def _unknowns_of_state(robot: Robot, state: State) -> Unknowns:
    """The unknowns of `drive` for a state, the inverse of `drive.state_of_unknowns`."""
    if not isinstance(state, State):
        raise UsageError(f"state: got {type(state).__name__}; expected one from mmrjax.initial_state or a step")
    remembered = {effect.name for effect in robot.remembering}
    controlled = {name for name in ("integral", "command", "pending", "clock") if getattr(state, name) is not None}
    differs = (state.gap is not None) != bool(robot.loose) or controlled != {*robot.controller_states}
    if remembered != state.memory.keys() or differs:
        raise UsageError("state: got one of another robot; expected one from mmrjax.initial_state(robot)")
    if shape := next((np.shape(x) for x in jax.tree.leaves(state) if np.shape(x)), ()):
        raise UsageError(f"state: got numbers of shape {shape}; expected one state, or jax.vmap over several")
    return drive.unknowns_of_state(robot, state)
