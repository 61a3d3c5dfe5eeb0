"""One robot under a controller of one's own: its first state, the rates of a state, and the state a step later.

Pure functions in SI for `jax.jit`, `jax.vmap`, `jax.grad` and `jax.lax.scan`, in JAX's own precision. The equations
are of the fidelity `drive`, in straight travel; steps have a fixed length, so that reverse mode goes through.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from mmrjax.compile.compiling import compiled
from mmrjax.errors import UsageError, choices
from mmrjax.fidelities import drive
from mmrjax.fidelities.rest import holds
from mmrjax.model.conditions import OF_TURNS, Conditions
from mmrjax.model.params import Scalar
from mmrjax.model.robot import Robot
from mmrjax.model.signals import State
from mmrjax.numerics.rosenbrock import stages

T = TypeVar("T")

#: A duty of the driver, or conditions by name.
Command = Scalar | Mapping[str, Scalar] | None
#: Place of the discharge among the unknowns of `drive`.
_DISCHARGE = 4
#: Lengths of the parts of a step, each three times the one before: a new command changes the current within the
#: winding's time constant, and the speed within the mechanical one, some hundred times as long.
PARTS = 3.0 ** np.arange(4) / np.sum(3.0 ** np.arange(4))


def initial_state(robot: Robot, conditions: Conditions | None = None, *, rolling: bool = False) -> State:
    """Returns the state of a robot at rest, or rolling as the fidelity `steady` travels.

    Args:
        robot: any robot; its parameters may be tracers.
        conditions: of one run, scalar fields; None: `Conditions()`. Its `discharge` is the battery's [C].
        rolling: whether it travels already, under the voltage and duty of the conditions.

    Raises:
        UsageError: conditions of several runs, or such as a step cannot follow, see `step`.
    """
    robot, conditions = _cast((robot, _asked(robot, None, conditions)))
    return drive.state_of(robot, _begun(robot, conditions, rolling))


def rates(robot: Robot, state: State, command: Command, conditions: Conditions | None = None) -> State:
    """Returns the rate of every number of a state [its unit per second], as a state.

    Args:
        robot: any robot; its parameters may be tracers.
        state: where the rates are wanted.
        command, conditions: as of `step`.

    Raises:
        UsageError: as `step`.
    """
    robot, conditions = _cast((robot, _asked(robot, command, conditions)))
    return drive.state_of(robot, drive.rates(robot, conditions, _vector(robot, state)))


def step(robot: Robot, state: State, command: Command, dt: Scalar, conditions: Conditions | None = None) -> State:
    """Returns the state `dt` later, the command held meanwhile.

    The stages of Rodas4 (Hairer and Wanner, Solving Ordinary Differential Equations II, 1996, Section IV.7), an
    L-stable method, over four parts of growing length. At a `dt` of 10 ms the speed of the paper's robot is within
    4 mm/s of that with steps a hundred times as short, also during starts and stops, and its position within 0.1 mm
    (tests/test_stepping.py). Once a robot has stopped, friction at rest holds it if it can.

    Args:
        robot: any robot, a vehicle or a shaft on a bench; its parameters may be tracers.
        state: from `initial_state` or an earlier step.
        command: duty of the driver, -1 to 1, or values by their names in `Conditions` that hold during the step, such
            as `{"voltage": 24.0, "slope_deg": 5.0}`; None: the conditions alone.
        dt: length of the step [s].
        conditions: of one run, scalar fields; None: `Conditions()`.

    Raises:
        UsageError: conditions of several runs, or that impose the motors' speed, or that drive the sides apart; a
            command that names no condition.
    """
    robot, conditions = _cast((robot, _asked(robot, command, conditions)))
    return drive.state_of(robot, _stepped(robot, conditions, _vector(robot, state), jnp.asarray(dt, float)))


@compiled
def _begun(robot: Robot, conditions: Conditions, rolling: bool) -> Float[Array, " unknowns"]:
    return drive.start(robot, conditions, rolling)


@compiled
def _stepped(
    robot: Robot, conditions: Conditions, y: Float[Array, " unknowns"], dt: Scalar
) -> Float[Array, " unknowns"]:
    """The unknowns of `drive` a step later. A robot that has stopped is held if friction at rest can hold it."""
    speeds = np.isin(np.arange(len(y)), (drive.MOTOR, drive.GROUND))
    drawn = np.isin(np.arange(len(y)), (drive.CURRENT, _DISCHARGE))
    held = holds(robot, conditions)
    stands = held & jnp.all(jnp.where(speeds, y, 0.0) == 0)
    moves = jnp.where(stands, jnp.asarray(drawn, y.dtype), 1.0)

    def rate(y: Array) -> tuple[Array, Array]:
        return drive.rates(robot, conditions, y) * moves, y[:0]

    def part(y: Array, share: Array) -> tuple[Array, None]:
        return stages(rate, y, y[:0], share * dt, looped=True)[0], None

    after = jax.lax.scan(part, y, jnp.asarray(PARTS, y.dtype))[0]
    rests = held & jnp.all(jnp.where(speeds, y * after, 0.0) <= 0)
    return jnp.where(rests & speeds, 0.0, after)


def _asked(robot: Robot, command: Command, conditions: Conditions | None) -> Conditions:
    """Conditions of one run while a command acts, their configuration an index."""
    conditions = Conditions() if conditions is None else conditions
    if not isinstance(conditions, Conditions):
        raise UsageError(f"conditions: got {type(conditions).__name__}; expected mmrjax.Conditions(...)")
    values: Mapping[str, Any] = {}
    if command is not None:
        values = command if isinstance(command, Mapping) else {"duty": command}
    known = [field.name for field in dataclasses.fields(Conditions)]
    if unknown := next((name for name in values if name not in known), None):
        raise UsageError(f"command: got {unknown}; {choices(unknown, known)}")
    if conditions.turns or not values.keys().isdisjoint(OF_TURNS):
        raise UsageError("conditions: the sides are driven apart; a step is of straight travel, use mmrjax.simulate")
    conditions = dataclasses.replace(conditions, **values).resolved(robot)
    if conditions.shape:
        raise UsageError(f"conditions: got runs of shape {conditions.shape}; expected one, and jax.vmap over several")
    if conditions.motor_speed is not None:
        raise UsageError("conditions: the motors' speed is imposed; a step needs a voltage or a current")
    return conditions


def _cast(tree: T) -> T:
    """A tree with its floating-point numbers as JAX's arrays, in its precision here."""

    def cast(x: Any) -> Any:
        return jnp.asarray(x, float) if eqx.is_array(x) and jnp.issubdtype(x.dtype, jnp.floating) else x

    return jax.tree.map(cast, tree)


def _vector(robot: Robot, state: State) -> Float[Array, " unknowns"]:
    """The unknowns of `drive` for a state, the inverse of `drive.state_of`."""
    memory = [state.memory[effect.name] for effect in robot.remembering]
    own = [state.current, state.speed_motor, state.speed, state.distance, state.discharge]
    gap = [] if state.gap is None else [state.gap]
    return jnp.stack([jnp.asarray(x, float) for x in (*own, *memory, *gap)]) / jnp.asarray(drive.units(robot))
