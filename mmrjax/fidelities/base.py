"""What a fidelity is: functions from a robot and conditions to results, the same for all."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from typing import Any, Protocol, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from mmrjax import fidelities
from mmrjax.compile.compiling import compiled
from mmrjax.fidelities import Facts
from mmrjax.model import balances, channels
from mmrjax.model.conditions import Conditions
from mmrjax.model.params import Scalar
from mmrjax.model.rig import Rig
from mmrjax.model.robot import Robot
from mmrjax.model.signals import Result, Signals
from mmrjax.undercarriage.side_contacts import Reactions

T = TypeVar("T")

#: Is called now and then with the share of the work that is done, 0..1.
Progress = Callable[[float], None]


class History(eqx.Module):
    """Runs over time; fields have shape (runs, samples).

    Attributes:
        time: by the clock of tables, on which what is imposed acts the rig's `delay` later than its column says [s].
        distance: travelled along the slope [m].
        signals: every signal; reading: what the instruments show [SI], by channel, of those that change in a history.
        reactions: loads inside the running gear of one side, where the fidelity resolves them.
    """

    time: Float[Array, "runs samples"]
    distance: Float[Array, "runs samples"]
    signals: Signals
    reading: dict[str, Scalar]
    reactions: Reactions | None = None

    @staticmethod
    def of(
        robot: Robot,
        time: Array,
        distance: Array,
        signals: Signals,
        reactions: Reactions | None = None,
    ) -> History:
        """A history with its readings, of runs known at `time` since what is imposed acts; of signals with a further
        axis for left and right side their means."""
        if jnp.ndim(signals.current) > jnp.ndim(time):
            reading, signals = _shown(robot, signals, apart=True), balances.together(signals)
        else:
            reading = _shown(robot, signals)
        if not robot.knows(channels.VOLTAGE):
            nan = jnp.full_like(signals.current, jnp.nan)
            volts = ("voltage", "voltage_source", "voltage_drop", "voltage_left", "inductance")
            unknown: dict[str, Any] = dict.fromkeys(volts, nan)
            signals = dataclasses.replace(signals, **unknown)
        clock, (distance, signals, reading, reactions) = as_tables(
            robot.rig, time, (distance, signals, reading, reactions)
        )
        return History(clock, distance, signals, reading, reactions)


def as_tables(rig: Rig, time: Float[Array, "runs samples"], values: T) -> tuple[Float[Array, "runs samples"], T]:
    """Runs over time by the clock of tables, which the rig's `delay` sets.

    Args:
        time: since what is imposed acts [s]; values: at those instants, a tree of shape (runs, samples, ...).

    Returns:
        Instants of the tables' clock and values at those (`Rig.clock`, `Rig.before`).
    """
    if rig.prompt:
        return time, values
    values = jax.tree.map(lambda x: jnp.broadcast_to(x, time.shape) if jnp.ndim(x) < 2 else jnp.asarray(x), values)
    clock = rig.clock(time)
    places = _before(rig, time, clock)
    return clock, jax.tree.map(lambda x: _between(x, *places), values)


@compiled
def _shown(robot: Robot, signals: Signals, apart: bool = False) -> dict[str, Scalar]:
    """Readings of the channels that change in a history; `apart`: of signals of left and right side."""
    every = balances.shown(robot, signals) if apart else balances.sensor(robot, signals)
    return {c.name: every[c.name] for c in channels.EVERY if c.over_time}


@compiled
def _before(rig: Rig, time: Array, clock: Array) -> tuple[Array, Array]:
    return jax.vmap(rig.before)(time, clock)


@compiled
def _between(values: Array, k: Array, share: Array) -> Array:
    """One program for all that has a shape."""
    return jax.vmap(Rig.between)(values, k, share)


class Run(eqx.Module):
    """A batch of runs.

    Attributes:
        result: of each run, shape (runs,).
        columns: what this fidelity alone knows, by the column of `runs.csv`, in the column's unit; shape (runs,).
        history: of the runs over time, where it was asked for.
    """

    result: Result
    columns: dict[str, Scalar] = eqx.field(default_factory=dict)
    history: History | None = None


class Simulate(Protocol):
    """Simulates a batch."""

    def __call__(
        self, robot: Robot, conditions: Conditions, options: Mapping[str, float], progress: Progress | None = None, /
    ) -> Run:
        """Simulate a batch in one call.

        Args:
            conditions: shape (runs,), names of configurations resolved.
            options: all of the fidelity's, from `Facts.resolved`.
            progress: called by those that take long.

        Raises:
            ValueError: what `Fidelity.check` refuses.
        """
        ...


def _nothing_to_refuse(robot: Robot, conditions: Conditions, options: Mapping[str, float]) -> None:
    pass


def _nothing_to_say(robot: Robot, conditions: Conditions) -> list[str]:
    return []


@dataclasses.dataclass(frozen=True)
class Implicit:
    """Settled travel of one run, straight or turning, in two halves: one evaluation serves all derivatives of a fit.

    Attributes:
        solve: the unknowns, shape (unknowns,), and whether they were found; no derivatives.
        shown: result and signals at some unknowns (differentiable in them and in the robot), and what the equations
            leave there, shape (unknowns,). What asks more of the ground than it holds is said to slide: in a fit
            it is out of reach, slide or stand.
    """

    solve: Callable[[Robot, Conditions], tuple[Array, Array]]
    shown: Callable[[Robot, Conditions, Array, Array], tuple[Result, Signals, Array]]


@dataclasses.dataclass(frozen=True)
class Fidelity:
    """One way to simulate a robot. Each module of a fidelity ends with its own.

    Attributes:
        name: its line in `fidelities.TABLE`.
        settled: a batch of conditions to results, pure and traceable, with numbers wherever it can give some,
            whatever the status: what calibrations differentiate (forward).
        implicit: the same in two halves; None where it is not the root of equations.
        run: results of a batch, as sweeps make them.
        outputs: those of a batch that are named alone [SI], of `outputs.table`, and `status`, which is quicker than
            `run`; None where it would not be. A fidelity that has it has no options.
        columns: names of what its runs have beside (`Run.columns`).
        histories: a batch from standstill, kept over time; None where there is no time.
        check: refuses, with ValueError, what some run of any batch could not bear; before the first is simulated.
        cautions: what to know before the settled readings of a calibrated robot are trusted, a sentence each.
    """

    name: str
    settled: Callable[[Robot, Conditions], Result]
    run: Simulate
    outputs: Callable[[Robot, Conditions, tuple[str, ...]], dict[str, Array]] | None = None
    implicit: Implicit | None = None
    histories: Simulate | None = None
    check: Callable[[Robot, Conditions, Mapping[str, float]], None] = _nothing_to_refuse
    cautions: Callable[[Robot, Conditions], list[str]] = _nothing_to_say
    columns: tuple[str, ...] = ()

    @property
    def facts(self) -> Facts:
        """What was known of it before it was imported."""
        return fidelities.facts(self.name)
