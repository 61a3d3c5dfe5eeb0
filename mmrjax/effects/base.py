"""What an effect is: one equation that enters one balance with one linear amplitude."""

from __future__ import annotations

import abc
import dataclasses
import inspect
import math
import re
from types import ModuleType
from typing import TYPE_CHECKING, Any, ClassVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from mmrjax.model.conditions import Conditions
from mmrjax.model.params import Scalar, parameter
from mmrjax.model.robot import Robot
from mmrjax.model.signals import Signals

#: What the balances of one equation add up to, in words: those of a line act alike on the readings.
EQUATION = {
    **dict.fromkeys(("supply", "electrical"), "voltage drop"),
    **dict.fromkeys(("motor", "gearbox", "track"), "loss torque"),
    "ground": "resistance to travel",
    **dict.fromkeys(("lateral", "yaw"), "resistance to turning"),
    "slip": "slip",
    "mass": "mass",
    "inertia": "inertia",
    "inductance": "inductance",
    "sensor": "reading",
}
#: Driver of an effect that is not the same on both sides: a robot that has it does not travel straight by itself.
THE_SIDE = "the side"


def amplitude(*, unit: str, meaning: str, bounds: tuple[float, float], sd: float, source: str) -> Any:
    """Declare the amplitude of an effect, 0 (absent) by default; see `params.Spec` for the arguments."""
    return parameter(0.0, unit=unit, meaning=meaning, bounds=bounds, sd=sd, source=source, amplitude=True)


class Effect(eqx.Module):
    """A term that the paper's model lacks.

    A subclass states its equation and source in its docstring, declares its `amplitude` (see the function of
    that name), any shape parameters beside it, and defines `term`. The class attributes that differ from their
    defaults are stated as `dissipative = True`:

    Attributes:
        name: its name in files and reports; by default that of the class, `MassError` as `mass_error`.
        balance: the balance it enters, one of `balances.BALANCES`, whose unit its term has; has no default. A
            positive term takes away: a voltage drop, a loss torque, a resisting force, a lost speed; in `mass`,
            `inertia` and `inductance` it adds, and in `sensor` it adds to what the instrument of `channel` shows,
            which may be the magnitude alone.
        driver: what its term changes with: `speed`, `current`, `load`, ...; `direction` if it is the way round that
            it is about, `the side` if it is not the same on both sides. Effects
            of one equation with one driver are a family: the forms of a law that data may not tell apart. Empty where
            it is the same share everywhere.
        rests_on: dotted names of parameters of the robot in proportion to which its term is, for whoever finds its
            amplitude too large.
        dissipative: whether a positive amplitude may only take power out; in `slip` that of the demand, which is the
            traction in steady travel.
        channel: for `sensor` alone: the channel that it changes, one of `channels.EVERY`.
        transient: whether settled travel shows nothing of it, so that only histories can.
        settles_to: name of the effect from which settled travel cannot tell it, so that only histories can.
        needs_battery: whether it acts with the on-board battery alone, so that no run on an external supply
            shows it.
        needs_reverse: whether runs one way alone cannot tell it from a parameter of the robot, so that no such table
            shows it.
        needs_duty: whether it acts at a duty below 1 alone.
        odd_in_travel: whether it keeps its sign in space and not in the frame of travel, as a wrong slope does:
            a robot that travels backward, looked at so that its travel is forward again, meets minus its amplitude.
        resolved: whether the track model has by itself what it stands for.
        movers: `tracks` or `wheels` where it acts on configurations of that kind alone.
        needs_belt: whether it is of a belt, which no load on a shaft has.
        memory_size: size of its memory, for an effect whose term depends on the past of the run (a
            temperature, a phase); None has none. A run starts with memory 0.
        memory_unit: unit of its memory.
        plain: of a class with priors of its own, the class that it differs from by these alone; factors: by what it
            does, see `effects.scaled`.
        configurations: names of the configurations that it acts on; none: all, or those with its `movers`. A
            field: what a class states is the default, and a robot file may say `configurations = ["4W2T"]`.

    An effect with a memory defines `rate`, and `settled` for the fidelities that keep no memory.
    """

    name: ClassVar[str]
    balance: ClassVar[str]
    driver: ClassVar[str] = ""
    rests_on: ClassVar[tuple[str, ...]] = ()
    dissipative: ClassVar[bool] = False
    channel: ClassVar[str] = ""
    transient: ClassVar[bool] = False
    settles_to: ClassVar[str] = ""
    needs_battery: ClassVar[bool] = False
    needs_reverse: ClassVar[bool] = False
    needs_duty: ClassVar[bool] = False
    odd_in_travel: ClassVar[bool] = False
    resolved: ClassVar[bool] = False
    movers: ClassVar[str] = ""
    needs_belt: ClassVar[bool] = False
    memory_size: ClassVar[float | None] = None
    memory_unit: ClassVar[str] = "-"
    plain: ClassVar[type[Effect] | None] = None
    factors: ClassVar[tuple[float, float, float]] = (1.0, 1.0, 1.0)

    if TYPE_CHECKING:
        # Made without arguments an effect is absent.
        amplitude: Scalar = eqx.field(default=0.0, kw_only=True)
    else:
        amplitude: eqx.AbstractVar[Scalar]
    configurations: tuple[str, ...] = eqx.field(default=(), static=True, kw_only=True)

    def __init_subclass__(cls, **keywords: Any) -> None:
        super().__init_subclass__(**keywords)
        if "name" not in vars(cls):
            cls.name = re.sub(r"(?<!^)(?=[A-Z])", "_", cls.__name__).lower()
        # Stated beside the class attributes, it is the default of the field.
        if isinstance(stated := vars(cls).get("configurations"), tuple):
            cls.__annotations__ = {**inspect.get_annotations(cls), "configurations": tuple[str, ...]}
            cls.configurations = eqx.field(default=stated, static=True, kw_only=True)

    def for_equations(self) -> Effect:
        """The same of the class that it differs from by its priors alone."""
        if (plain := type(self).plain) is None:
            return self
        return plain(**{f.name: getattr(self, f.name) for f in dataclasses.fields(self) if f.init})

    @classmethod
    def family(cls) -> str:
        """Its equation and its driver, in words: `loss torque that changes with speed`."""
        what = f"reading of {cls.channel}".replace("_", " ") if cls.channel else EQUATION[cls.balance]
        return f"{what} that changes with {cls.driver}" if cls.driver else f"{what} that is the same share everywhere"

    @property
    def unlike(self) -> bool:
        """Whether the sides of a robot that has it, its amplitude concrete, differ."""
        return self.driver == THE_SIDE and bool(np.any(np.asarray(self.amplitude)))

    @property
    def acts_everywhere(self) -> bool:
        """Whether it acts in every configuration of any robot."""
        return not self.movers and not self.configurations

    def acts(self, robot: Robot, signals: Signals) -> Scalar:
        """1 in configurations on which it acts, else 0 [-]: those that it names, else those with its `movers`."""
        if self.configurations:
            named = {robot.configurations.index(n) for n in self.configurations if n in robot.configurations}
            return sum((jnp.where(signals.configuration == k, 1.0, 0.0) for k in sorted(named)), jnp.zeros(()))
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

    def initial(self, robot: Robot, angle: Scalar) -> Scalar:
        """Its memory where a history begins with the output at an angle [rad]: as at rest."""
        return jnp.zeros_like(angle)

    def recall(self, robot: Robot, signals: Signals) -> Scalar:
        """Its memory: of the run so far where one is kept (`drive`, `track`), else settled."""
        return signals.memory[self.name] if self.name in signals.memory else self.settled(robot, signals)

    def step_longest(self, robot: Robot, conditions: Conditions) -> Scalar:
        """Longest integration step that resolves an effect with a memory [s].

        An integrator chooses its steps by what happens in the run; for the derivative at amplitude 0 to be
        right it has to see also what would happen.
        """
        return math.inf


def made(kind: type[Effect], name: str) -> type[Effect]:
    """A class that a function has made, with its name; pickle finds it by that in `Made` of its module."""
    kind.__name__, kind.__qualname__ = name, f"Made.{name}"
    return kind


def defined_in(module: ModuleType) -> tuple[type[Effect], ...]:
    """The effects that a module defines, in its order; classes that lack a `term` are none."""
    own = [v for v in vars(module).values() if inspect.isclass(v) and v.__module__ == module.__name__]
    return tuple(v for v in own if issubclass(v, Effect) and not inspect.isabstract(v))
