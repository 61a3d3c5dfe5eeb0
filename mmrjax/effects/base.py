"""What an effect is: one equation that enters one balance with one linear amplitude."""

from __future__ import annotations

import abc
import math
from typing import TYPE_CHECKING, ClassVar

import equinox as eqx
import jax.numpy as jnp

from mmrjax.conditions import Conditions
from mmrjax.params import Scalar
from mmrjax.signals import Signals

if TYPE_CHECKING:
    from mmrjax.robot import Robot


class Effect(eqx.Module):
    """A term that the paper's model lacks.

    A subclass states its equation and source in its docstring, declares `amplitude` as a parameter with
    default 0 (absent) and `amplitude=True`, any shape parameters beside it, and the class attributes:

    Attributes:
        name: its name in files and reports.
        balance: the balance it enters, one of `balances.BALANCES`, whose unit its term has. A positive
            term takes away: a voltage drop, a loss torque, a resisting force, a lost speed; in `mass`,
            `inertia` and `inductance` it adds, and in `sensor` it adds to the reading of `channel`.
        dissipative: whether a positive amplitude may only take power out.
        channel: for `sensor` alone: the field of `Reading` that it changes.
        transient: whether settled travel shows nothing of it, so that only time series can.
        memory_size: size of its memory, for an effect whose term depends on the past of the run (a
            temperature, a phase); None has none. A run starts with memory 0.
        memory_unit: unit of its memory.
        movers: `tracks` or `wheels` where it acts on configurations of that kind alone.
        configurations: names of the configurations that it acts on; none: all, or those with its `movers`.

    An effect with a memory defines `rate`, and `settled` for the fidelities that keep no memory.
    """

    name: ClassVar[str]
    balance: ClassVar[str]
    dissipative: ClassVar[bool]
    channel: ClassVar[str] = ""
    transient: ClassVar[bool] = False
    memory_size: ClassVar[float | None] = None
    memory_unit: ClassVar[str] = "-"
    movers: ClassVar[str] = ""

    amplitude: eqx.AbstractVar[Scalar]
    configurations: tuple[str, ...] = eqx.field(default=(), static=True, kw_only=True)

    @property
    def acts_everywhere(self) -> bool:
        """Whether it acts in every configuration of any robot."""
        return not self.movers and not self.configurations

    def acts(self, robot: Robot, signals: Signals) -> Scalar:
        """1 in configurations on which it acts, else 0 [-]: those that it names, else those with its `movers`."""
        if self.configurations:
            named = [robot.configurations.index(n) for n in self.configurations if n in robot.configurations]
            return sum((jnp.where(signals.configuration == k, 1.0, 0.0) for k in named), jnp.zeros(()))
        return signals.on_tracks if self.movers == "tracks" else 1 - signals.on_tracks

    @abc.abstractmethod
    def term(self, robot: Robot, signals: Signals) -> Scalar:
        """The term [unit of its balance], linear in `amplitude`; may read any signal computed before."""

    def rate(self, robot: Robot, signals: Signals) -> Scalar:
        """How fast its memory changes [unit of the memory / s]; may read every signal."""
        raise NotImplementedError(f"{self.name} has a memory and no rate")

    def settled(self, robot: Robot, signals: Signals) -> Scalar:
        """Its memory after long steady travel; may read any signal computed before its balance."""
        raise NotImplementedError(f"{self.name} has a memory and no settled value")

    def recall(self, robot: Robot, signals: Signals) -> Scalar:
        """Its memory: of the run so far where one is kept (`drive`, `track`), else settled."""
        return signals.memory[self.name] if self.name in signals.memory else self.settled(robot, signals)

    def step_longest(self, robot: Robot, conditions: Conditions) -> Scalar | float:
        """Longest integration step that resolves an effect with a memory [s].

        An integrator chooses its steps by what happens in the run; for the derivative at amplitude 0 to be
        right it has to see also what would happen.
        """
        return math.inf
