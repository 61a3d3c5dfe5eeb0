"""Base class of effects: one equation that enters one balance with one linear amplitude."""

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
from mmrjax.model.quantities import Names
from mmrjax.model.robot import Robot
from mmrjax.model.signals import Signals

#: Quantity that the balances of one equation sum up, in words; balances with equal words change the readings equally.
EQUATION = {
    **dict.fromkeys(("duty", "supply", "electrical"), "voltage drop"),
    **dict.fromkeys(("motor", "gearbox", "track"), "loss torque"),
    "ground": "resistance to travel",
    **dict.fromkeys(("lateral", "yaw"), "resistance to turning"),
    "slip": "slip",
    "mass": "mass",
    "inertia": "inertia",
    "inductance": "inductance",
    "sensor": "reading",
}
#: Driver of an effect that differs between the sides: a robot that has it does not travel straight on its own.
THE_SIDE = "the side"


def amplitude(unit: str, meaning: str, bounds: tuple[float, float], source: str, *, sd: float) -> Any:
    """Declares the amplitude of an effect, 0 (absent) by default. See `params.Spec` for the arguments."""
    return parameter(0.0, unit, meaning, bounds, source, sd=sd, amplitude=True)


class Effect(eqx.Module):
    """A term that the paper's model lacks.

    A subclass states its equation and source in its docstring. It declares its `amplitude` (see the function of
    that name) and further shape parameters, and defines `term`. Class attributes that differ from their
    defaults are stated as `dissipative = True`:

    Attributes:
        name: its name in files and reports. By default made from the class name, `MassError` as `mass_error`.
        balance: the balance it enters, one of `balances.BALANCES`, whose unit its term has. Has no default. A
            positive term is a loss: a voltage drop, a loss torque, a resisting force, a loss of speed. In `mass`,
            `inertia` and `inductance` it adds. In `sensor` it adds to the reading of `channel`, which may be a
            magnitude.
        driver: the quantity that its term changes with: `speed`, `current`, `load`, ..., `direction` for the
            direction of rotation, `the side` if it differs between the sides. Effects of one equation with one driver
            are a family: forms of a law that data may not distinguish. Empty if the term is a constant share.
        rests_on: dotted names of robot parameters that its term is proportional to, as hints if its amplitude is
            implausibly large.
        dissipative: True if a positive amplitude can only remove power. In `slip` the power of the demand, which
            equals the traction in steady travel.
        channel: only for `sensor`: the channel that it changes, one of `channels.EVERY`.
        transient: True if steady travel does not show it, so that only histories can.
        settles_to: name of the effect that looks the same in steady travel. Only histories distinguish the two.
        needs_battery: True if it acts only with the on-board battery. Runs on an external supply do not show it.
        needs_reverse: True if runs in one direction cannot distinguish it from a parameter of the robot. Such a table
            does not show it.
        needs_duty: True if it acts only at a duty below 1.
        odd_in_travel: True if it keeps its sign in space and not in the frame of travel, as a wrong slope does. For a
            robot that travels backward, its amplitude changes sign in the frame of travel.
        resolved: True if the track model computes the phenomenon itself.
        movers: `tracks` or `wheels` if it acts only on configurations of that kind.
        needs_belt: True if it belongs to a belt, which a load on a shaft does not have.
        memory_size: size of its memory, for an effect whose term depends on the past of the run (a
            temperature, a phase). None: no memory. A run starts with memory 0.
        memory_unit: unit of its memory.
        plain: for a class with its own priors, the class of the library that it is made from.
        factors: ratios of its priors to the library's, see `effects.scaled`.
        configurations: names of the configurations that it acts on. Empty: all, or those with its `movers`. A
            field: the class states the default, and a robot file may state `configurations = ["4W2T"]`.

    An effect with a memory defines `rate`, and `settled` for the fidelities that keep no memory.
    """

    name: ClassVar[str]
    balance: ClassVar[str]
    driver: ClassVar[str] = ""
    rests_on: ClassVar[Names] = ()
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
        # Without arguments an effect is absent.
        amplitude: Scalar = eqx.field(default=0.0, kw_only=True)
    else:
        amplitude: eqx.AbstractVar[Scalar]
    configurations: Names = eqx.field(default=(), static=True, kw_only=True)

    def __init_subclass__(cls, **keywords: Any) -> None:
        super().__init_subclass__(**keywords)
        if "name" not in vars(cls):
            cls.name = re.sub(r"(?<!^)(?=[A-Z])", "_", cls.__name__).lower()
        # Stated next to the class attributes, it is the default of the field.
        if isinstance(configurations := vars(cls).get("configurations"), tuple):
            cls.__annotations__ = {**inspect.get_annotations(cls), "configurations": Names}
            cls.configurations = eqx.field(default=configurations, static=True, kw_only=True)

    def for_equations(self) -> Effect:
        """Same effect as a class of the library, without its own priors."""
        if (plain := type(self).plain) is None:
            return self
        return plain(**{f.name: getattr(self, f.name) for f in dataclasses.fields(self) if f.init})

    @classmethod
    def family(cls) -> str:
        """Equation and driver in words: `loss torque that changes with speed`."""
        subject = f"reading of {cls.channel}".replace("_", " ") if cls.channel else EQUATION[cls.balance]
        return (
            f"{subject} that changes with {cls.driver}"
            if cls.driver
            else f"{subject} that is the same share everywhere"
        )

    @property
    def unlike(self) -> bool:
        """True if it makes the sides of a robot differ. Needs a concrete amplitude."""
        return self.driver == THE_SIDE and bool(np.any(np.asarray(self.amplitude)))

    @property
    def acts_everywhere(self) -> bool:
        """True if it acts in every configuration of any robot."""
        return not self.movers and not self.configurations

    def acts(self, robot: Robot, signals: Signals) -> Scalar:
        """1 in configurations that it acts on, else 0 [-]: the named ones, else those with its `movers`."""
        if self.configurations:
            configuration_indices = {
                robot.configurations.index(n) for n in self.configurations if n in robot.configurations
            }
            return sum(
                (jnp.where(signals.configuration == k, 1.0, 0.0) for k in sorted(configuration_indices)),
                jnp.zeros(()),
            )
        return signals.on_tracks if self.movers == "tracks" else 1 - signals.on_tracks

    @abc.abstractmethod
    def term(self, robot: Robot, signals: Signals) -> Scalar:
        """The term [unit of its balance], linear in `amplitude`. May read all signals computed before it."""

    def rate(self, robot: Robot, signals: Signals) -> Scalar:
        """Rate of change of its memory [unit of the memory / s]. May read every signal."""
        raise NotImplementedError(f"{self.name} has a memory but defines no rate")

    def settled(self, robot: Robot, signals: Signals) -> Scalar:
        """Its memory after long steady travel. May read all signals computed before its balance."""
        raise NotImplementedError(f"{self.name} has a memory but defines no settled value")

    def initial(self, robot: Robot, angle: Scalar) -> Scalar:
        """Its memory at the start of a history, with the output at an angle [rad]: the value at rest."""
        return jnp.zeros_like(angle)

    def recall(self, robot: Robot, signals: Signals) -> Scalar:
        """Its memory: the value followed along the run (`drive`, `track`), else the settled value."""
        return signals.memory[self.name] if self.name in signals.memory else self.settled(robot, signals)

    def step_longest(self, robot: Robot, conditions: Conditions) -> Scalar:
        """Longest integration step that resolves an effect with a memory [s].

        An integrator chooses its steps from the solution. This limit keeps the derivative at amplitude 0 correct,
        where the solution does not show the effect.
        """
        return math.inf


def name_class(kind: type[Effect], name: str) -> type[Effect]:
    """Names a class made by a function. Pickle finds it by that name in `Made` of its module."""
    kind.__name__, kind.__qualname__ = name, f"Made.{name}"
    return kind


def effects_of_module(module: ModuleType) -> tuple[type[Effect], ...]:
    """The effects that a module defines, in its order. Classes without a `term` are left out."""
    classes = [v for v in vars(module).values() if inspect.isclass(v) and v.__module__ == module.__name__]
    return tuple(v for v in classes if issubclass(v, Effect) and not inspect.isabstract(v))
