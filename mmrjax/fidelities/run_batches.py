"""Batches of runs of any shape: computed at once or in chunks of one size, or pending until a number is read."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Mapping
from typing import TypeVar

import jax
import jax.numpy as jnp
import numpy as np

from mmrjax.compile.compiling import compiled
from mmrjax.compile.precision import computed_outside_trace
from mmrjax.compile.programs import has_tracer
from mmrjax.errors import UsageError
from mmrjax.fidelities.base import Fidelity, Run
from mmrjax.model import channels
from mmrjax.model.conditions import Conditions
from mmrjax.model.params import Scalar
from mmrjax.model.robot import Robot
from mmrjax.model.signals import CODES, Result

#: Most runs of one `simulate` with histories.
HISTORIES = 1000
STATUS, _ = CODES


@dataclasses.dataclass(frozen=True)
class Pending:
    """A checked batch that has not been computed.

    Attributes:
        robot: concrete; conditions: of any shape, configurations resolved; fidelity: with `outputs`.
    """

    robot: Robot
    conditions: Conditions
    fidelity: Fidelity

    @computed_outside_trace
    def shown(self) -> dict[str, jax.Array]:
        """Readings of the robot's instruments by channel, and the status codes as `status`."""
        outputs, names = self.fidelity.outputs, (*channels.channel_names(self.robot.channels), STATUS)
        assert outputs is not None
        return _in_chunks(self.fidelity, lambda runs: outputs(self.robot, runs, names), self.conditions)

    @computed_outside_trace
    def result(self) -> Result:
        """All numbers of the results."""
        return run_batch(self.fidelity, self.robot, self.conditions, {}, history=False).result

    @computed_outside_trace
    def total_mass(self) -> jax.Array:
        """Mass of robot and payload, stated or the robot's own [kg]."""
        return total_mass(self.robot, self.conditions)


def run_batch(
    fidelity: Fidelity, robot: Robot, conditions: Conditions, options: Mapping[str, float], history: bool
) -> Run:
    """Computes a batch of any shape."""
    runs = math.prod(conditions.shape)
    if history and runs > HISTORIES:
        raise UsageError(f"history: got {runs} runs; at most {HISTORIES} can be kept over time; state history=False")
    simulate = fidelity.histories if history else fidelity.run
    assert simulate is not None
    if has_tracer((robot, conditions)):
        return reshape_runs(simulate(robot, flatten_conditions(conditions), options), conditions.shape)
    return _in_chunks(fidelity, lambda runs: simulate(robot, runs, options), conditions)


T = TypeVar("T")


def _in_chunks(fidelity: Fidelity, function: Callable[[Conditions], T], conditions: Conditions) -> T:
    """Returns the values of a function of conditions of shape (runs,), in the shape of the conditions.

    Large batches are split into chunks of one size, which share a compilation; the last chunk ends
    with the last run. Small batches are padded (`Facts.filled`) by NumPy, which compiles nothing. Dispatching JAX
    operations leaf by leaf took twenty times as long as the equations at 262 144 runs.
    """
    size = fidelity.facts.at_once(jax.default_backend() != "cpu")
    runs = math.prod(conditions.shape)
    filled = min(fidelity.facts.filled(runs), size)
    if 0 < runs < filled:
        rows = np.minimum(np.arange(filled), runs - 1)  # padding repeats the last run
        found = function(jax.device_put(jax.tree.map(lambda x: np.ravel(x)[rows], conditions)))
        return jax.device_put(
            jax.tree.map(lambda x: np.asarray(x)[:runs].reshape((*conditions.shape, *x.shape[1:])), found)
        )
    every = flatten_conditions(conditions)
    if runs <= size:
        return reshape_runs(function(every), conditions.shape)
    parts = [function(_rows(every, np.asarray(first), size)) for first in range(0, runs, size)]
    return reshape_runs(_joined(parts, runs), conditions.shape)


def flatten_conditions(conditions: Conditions) -> Conditions:
    """Conditions of shape (runs,)."""
    return conditions if len(conditions.shape) == 1 else _raveled(conditions)


@compiled
def _raveled(conditions: Conditions) -> Conditions:
    return jax.tree.map(jnp.ravel, conditions)


def reshape_runs(tree: T, shape: tuple[int, ...]) -> T:
    """A tree with a leading axis of runs in its leaves, reshaped to the batch's own shape."""
    return tree if len(shape) == 1 else _reshaped(tree, shape)


@compiled
def _reshaped(tree: T, shape: tuple[int, ...]) -> T:
    return jax.tree.map(lambda x: jnp.reshape(x, shape + x.shape[1:]), tree)


@compiled
def _rows(conditions: Conditions, first: np.ndarray, size: int) -> Conditions:
    """`size` runs starting with `first`, or the last ones if fewer remain."""
    return jax.tree.map(lambda x: jax.lax.dynamic_slice_in_dim(x, first, size), conditions)


@compiled
def _joined(parts: list[T], runs: int) -> T:
    """Joins chunks of one size; drops the part of the last chunk that repeats the previous one."""
    return jax.tree.map(lambda *x: jnp.concatenate([*x[:-1], x[-1][(len(x) * len(x[-1]) - runs) :]]), *parts)


def total_mass(robot: Robot, conditions: Conditions) -> jax.Array:
    """Mass of robot and payload, stated or the robot's own [kg]."""
    if conditions.total_mass is not None:
        return conditions.total_mass
    own = tuple(chassis.mass for chassis in robot.configurations.members)
    return _own_mass(own, conditions.configuration, conditions.payload)


@compiled
def _own_mass(own: tuple[Scalar, ...], configuration: jax.Array | np.ndarray, payload: jax.Array) -> jax.Array:
    return jnp.stack([jnp.asarray(mass) for mass in own])[configuration] + payload
