"""Interface of a fidelity: functions from a robot and conditions to results."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from typing import Any, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from mmrjax import fidelities
from mmrjax.compile.compiling import compiled
from mmrjax.fidelities import FidelityFacts
from mmrjax.model import balances, channels
from mmrjax.model.conditions import Conditions
from mmrjax.model.params import Scalars
from mmrjax.model.quantities import VOLTAGE
from mmrjax.model.rig import Rig
from mmrjax.model.robot import Robot
from mmrjax.model.signals import Result, Signals
from mmrjax.undercarriage.side_contacts import GearReactions

T = TypeVar("T")

#: Callback for progress; receives the finished share of the work, 0..1.
Progress = Callable[[float], None]


class History(eqx.Module):
    """Runs over time. Fields have shape (runs, samples).

    Attributes:
        time: time in the clock of tables [s]. The imposed quantity acts the rig's `delay` later than its column
            states.
        distance: distance travelled along the slope [m].
        signals: all signals.
        reading: readings [SI] by channel, of the channels that change in a history.
        reactions: loads inside the running gear of one side, if the fidelity computes them.
    """

    time: Float[Array, "runs samples"]
    distance: Float[Array, "runs samples"]
    signals: Signals
    reading: Scalars
    reactions: GearReactions | None = None

    @staticmethod
    def of(
        robot: Robot,
        time: Array,
        distance: Array,
        signals: Signals,
        reactions: GearReactions | None = None,
    ) -> History:
        """Runs over time with their readings. `time` counts from the action of the imposed quantity.

        Signals with a further axis of left and right side are averaged over it.
        """
        if jnp.ndim(signals.current) > jnp.ndim(time):
            reading, signals = _channel_readings(robot, signals, apart=True), balances.mean_of_sides(signals)
        else:
            reading = _channel_readings(robot, signals)
        if not robot.knows(VOLTAGE):
            nan = jnp.full_like(signals.current, jnp.nan)
            volts = ("voltage", "voltage_source", "voltage_drop", "voltage_left", "inductance")
            unknown: dict[str, Any] = dict.fromkeys(volts, nan)
            signals = dataclasses.replace(signals, **unknown)
        clock, (distance, signals, reading, reactions) = in_table_time(
            robot.rig, time, (distance, signals, reading, reactions)
        )
        return History(clock, distance, signals, reading, reactions)


def in_table_time(rig: Rig, time: Float[Array, "runs samples"], values: T) -> tuple[Float[Array, "runs samples"], T]:
    """Runs over time in the clock of tables, which the rig's `delay` shifts.

    Args:
        time: time since the imposed quantity acts [s].
        values: values at those instants, a tree of shape (runs, samples, ...).

    Returns:
        Instants of the tables' clock, and the values there (`Rig.clock`, `Rig.before`).
    """
    if rig.prompt:
        return time, values
    values = jax.tree.map(lambda x: jnp.broadcast_to(x, time.shape) if jnp.ndim(x) < 2 else jnp.asarray(x), values)
    clock = rig.clock(time)
    places = _before(rig, time, clock)
    return clock, jax.tree.map(lambda x: _between_for_batch(x, *places), values)


@compiled
def _channel_readings(robot: Robot, signals: Signals, apart: bool = False) -> Scalars:
    """Readings of the channels that change in a history. `apart`: signals have a left and a right side."""
    readings = balances.readings_of_sides(robot, signals) if apart else balances.sensor(robot, signals)
    return {c.name: readings[c.name] for c in channels.EVERY if c.over_time}


@compiled
def _before(rig: Rig, time: Array, clock: Array) -> tuple[Array, Array]:
    return jax.vmap(rig.before)(time, clock)


@compiled
def _between_for_batch(values: Array, k: Array, share: Array) -> Array:
    """`Rig.between` for a batch, compiled once for each shape."""
    return jax.vmap(Rig.between)(values, k, share)


class RunBatch(eqx.Module):
    """A simulated batch of runs.

    Attributes:
        result: result of each run, shape (runs,).
        columns: outputs that only this fidelity has: column of `runs.csv` → values in the unit of the column, shape
            (runs,).
        history: the runs over time, if requested.
    """

    result: Result
    columns: Scalars = eqx.field(default_factory=dict)
    history: History | None = None


#: Function that simulates a batch in one call, of a robot, conditions of shape (runs,), all options of the fidelity
#: from `FidelityFacts.resolved`, and a callback for progress. Raises ValueError if `Fidelity.check` refuses a run.
SimulateBatch = Callable[..., RunBatch]


@dataclasses.dataclass(frozen=True)
class ImplicitSolution:
    """Steady travel of one run in two parts, straight or turning. This lets a fit take all derivatives from one
    evaluation.

    Attributes:
        solve: function that returns the unknowns, shape (unknowns,), and True if they were found. Without
            derivatives.
        shown: returns result and signals for given unknowns (differentiable in them and in the robot) and the
            residuals of the equations, shape (unknowns,). A demand above the ground's limit counts as sliding. For a
            fit it is out of reach in any case.
    """

    solve: Callable[[Robot, Conditions], tuple[Array, Array]]
    shown: Callable[[Robot, Conditions, Array, Array], tuple[Result, Signals, Array]]


def _accept_every_run(
    robot: Robot, conditions: Conditions, options: Mapping[str, float]
) -> None:  # results are pickled
    """Accepts every run."""


def _without_cautions(robot: Robot, conditions: Conditions) -> list[str]:
    return []


@dataclasses.dataclass(frozen=True)
class Fidelity:
    """One way to simulate a robot. Each module of a fidelity ends with one.

    Attributes:
        name: its line in `fidelities.TABLE`.
        settled: function from a batch of conditions to results. Pure and traceable, with finite numbers for every
            status if possible. Calibrations differentiate it in forward mode.
        implicit: the same in two parts. None if it is not the solution of equations.
        run: results of a batch, as in a sweep.
        outputs: function that computes only the named outputs of a batch [SI] and `status`, faster than `run`. None
            if it would not be faster. A fidelity with it has no options.
        columns: names of further columns of its runs (`Run.columns`).
        histories: a batch from standstill over time, None for a fidelity without time.
        check: function that raises ValueError before the first simulation if some run of a batch cannot be computed.
        cautions: warnings about the steady readings of a calibrated robot, one sentence each.
    """

    name: str
    settled: Callable[[Robot, Conditions], Result]
    run: SimulateBatch
    outputs: Callable[[Robot, Conditions, tuple[str, ...]], dict[str, Array]] | None = None
    implicit: ImplicitSolution | None = None
    histories: SimulateBatch | None = None
    check: Callable[[Robot, Conditions, Mapping[str, float]], None] = _accept_every_run
    cautions: Callable[[Robot, Conditions], list[str]] = _without_cautions
    columns: tuple[str, ...] = ()

    @property
    def facts(self) -> FidelityFacts:
        """Properties that are known without importing the fidelity."""
        return fidelities.fidelity_facts(self.name)
