"""Base classes of effects: an equation that enters one balance with one linear amplitude.

Further bases repeat with the angle of a shaft, or bend a bristle. `scaled_effect` changes priors and limits for
other sizes of rig.
"""

from __future__ import annotations

import abc
import dataclasses
import functools
import inspect
import math
import re
from collections.abc import Mapping
from types import ModuleType
from typing import TYPE_CHECKING, Any, ClassVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from mmrjax.model import params, power
from mmrjax.model.conditions import Conditions
from mmrjax.model.params import Index, Parameter, Scalar, parameter
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
        factors: ratios of its priors to the library's, see `effects.base.scaled_effect`.
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


#: Classes of effects by the names of the effects.
EffectClasses = dict[str, type[Effect]]


def name_class(kind: type[Effect], name: str) -> type[Effect]:
    """Names a class made by a function. Pickle finds it by that name in `Made` of its module."""
    kind.__name__, kind.__qualname__ = name, f"Made.{name}"
    return kind


def effects_of_module(module: ModuleType) -> tuple[type[Effect], ...]:
    """The effects that a module defines, in its order. Classes without a `term` are left out."""
    classes = [v for v in vars(module).values() if inspect.isclass(v) and v.__module__ == module.__name__]
    return tuple(v for v in classes if issubclass(v, Effect) and not inspect.isabstract(v))


STEPS = 12  # integration steps per period: derivatives at amplitude 0 are then accurate to 1e-5


def phase_parameter() -> Scalar:
    """The phase of a wave, a field of every periodic effect."""
    return parameter(
        0.0, "rad", "phase φ of the wave at the start of the run", (-4.0, 4.0),
        "position of the parts at the start: arbitrary", sd=2.0,
    )  # fmt: skip


class Periodic(Effect):
    """term = a w(signals) sin(ψ + φ), with ψ' = k ω_m and k the order per radian of the motor's shaft.

    The memory is the phase ψ [rad]. Without a memory (`steady`) the wave has its mean, zero.
    """

    transient = True
    memory_size = 100.0
    memory_unit = "rad"

    phase: eqx.AbstractVar[Scalar]

    @abc.abstractmethod
    def order(self, robot: Robot, configuration: Index) -> Scalar:
        """Radians of the wave per radian of the motor's shaft k [-]."""

    def rate(self, robot: Robot, signals: Signals) -> Scalar:
        return self.order(robot, signals.configuration) * signals.speed_motor

    def settled(self, robot: Robot, signals: Signals) -> Scalar:
        """0: a phase has no settled value. `wave` then returns its mean."""
        return jnp.zeros_like(signals.speed_motor)

    def wave(self, signals: Signals) -> Scalar:
        """sin(ψ + φ), or 0 if no phase is followed [-]."""
        if self.name not in signals.memory:
            return jnp.zeros_like(signals.speed_motor)
        return jnp.sin(signals.memory[self.name] + self.phase)

    def step_longest(self, robot: Robot, conditions: Conditions) -> Scalar:
        """A twelfth of the period at the no-load speed [s]."""
        source = power.voltage_source(
            robot.battery, conditions.voltage, conditions.battery, 0.0, conditions.discharge
        )
        rate = self.order(robot, conditions.configuration) * source / robot.motor.torque_constant
        return 2 * jnp.pi / STEPS / jnp.maximum(jnp.abs(rate), 1.0)


def breakaway_parameter() -> Scalar:
    """The breakaway angle θ_s of a bristle, a field of every effect with one."""
    return parameter(
        0.02, "rad", "angle θ_s of the driven shaft until the contacts slide", (1e-4, 2.0),
        "1 mm of belt, a degree of a geared shaft", relative_sd=0.5,
    )  # fmt: skip


class Bristle(Effect):
    """A term in the bend z of a bristle at the driven shaft: θ_s z' = ω_k - |ω_k| z, z(0) = 0, settled z = sign ω_k.

    Dahl, A solid friction model (1968), with exponent 1. The first order of Canudas de Wit, Olsson, Åström and
    Lischinsky (1995) with a steady curve that does not depend on speed. The memory is z [-].
    """

    memory_size = 1.0
    memory_unit = "-"

    angle_breakaway: eqx.AbstractVar[Scalar]

    def settled(self, robot: Robot, signals: Signals) -> Scalar:
        return signals.direction

    def rate(self, robot: Robot, signals: Signals) -> Scalar:
        speed = signals.speed_wheel
        return speed * (1 - signals.direction * signals.memory[self.name]) / self.angle_breakaway


#: Factors of a class: for the sd of its amplitude, its shape parameter, and the limits of its amplitude.
Factors = tuple[float, float, float]


def amplitude_of(effect: Effect) -> Parameter:
    """The amplitude of an effect."""
    return next(p for p in params.walk_parameters(effect) if p.spec.amplitude)


def free_shape_parameter(effect: Effect) -> Parameter | None:
    """The shape parameter that a fit frees: the first phase or scale after the amplitude, None without one."""
    for p in params.walk_parameters(effect):
        if not p.spec.amplitude and (p.name == "phase" or (p.spec.relative_sd and float(p.value) > 0)):
            return p
    return None


@functools.lru_cache(maxsize=4096)
def scaled_effect(kind: type[Effect], factors: Factors) -> type[Effect]:
    """A class of the same effect with the amplitude's sd and limits and the shape multiplied by factors.

    Equal factors return the same class.
    """
    sd_factor, shape_factor, limit_factor = factors
    effect = kind()
    fields = {amplitude_of(effect).name: _field(amplitude_of(effect), sd_factor, limit_factor)}
    if (shape := free_shape_parameter(effect)) is not None and shape_factor != 1.0:
        fields[shape.name] = _field(shape, shape_factor, shape_factor)
    namespace: Mapping[str, object] = {
        "__annotations__": {**dict.fromkeys(fields, "Scalar"), "factors": ClassVar[Factors]},
        "__module__": kind.__module__,
        "__doc__": kind.__doc__,
        "__reduce__": _reduced,
        "name": kind.name,
        "plain": kind,
        "factors": factors,
        **fields,
    }
    return type(kind.__name__, (kind,), dict(namespace))


def _field(parameter: Parameter, factor: float, limits: float) -> Any:
    spec = parameter.spec
    low, high = spec.bounds
    return params.parameter(
        factor * float(parameter.value), spec.unit, spec.meaning, (low * limits, high * limits), spec.source,
        relative_sd=spec.relative_sd, sd=None if spec.sd is None else spec.sd * factor, amplitude=spec.amplitude,
    )  # fmt: skip


def _reduced(effect: Effect) -> tuple[Any, ...]:
    values = {f.name: getattr(effect, f.name) for f in dataclasses.fields(effect) if f.init}
    kind = type(effect)
    return restore_effect, (kind.plain, kind.factors, values)


def restore_effect(kind: type[Effect], factors: Factors, values: Mapping[str, Any]) -> Effect:
    """Restores an effect from its pickled values, because its class cannot be found by name."""
    return scaled_effect(kind, factors)(**values)
