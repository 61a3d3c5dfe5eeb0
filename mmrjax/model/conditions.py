"""The conditions of runs: inputs that are set before a robot starts."""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from dataclasses import replace
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from mmrjax.compile.compiling import is_double
from mmrjax.errors import UsageError
from mmrjax.model.quantities import CONDITIONS
from mmrjax.model.robot import Robot

#: Numbers of the runs.
Values = Float[Array, "..."]

Number = float | Sequence[float] | np.ndarray | Array

#: Conditions that can be stated for each side.
OF_SIDES = ("duty_left", "duty_right", "open_left", "open_right", "motor_speed_left", "motor_speed_right")
#: Conditions that may be true or false.
SWITCHES = ("battery", "open", "open_left", "open_right", "held")
#: Conditions that free a robot to turn if they are stated.
OF_TURNS = (*OF_SIDES, "heading_deg")
#: Conditions that every run has.
NUMBERS = ("voltage", "slope_deg", "payload", "battery", "discharge", "adhesion", "order", "duty", "open")


class NamedConfigurations(eqx.Module):
    """Configurations by name: a pytree, so that conditions by name pass `jax.jit` and `jax.vmap`.

    Attributes:
        index: index of the name of each run among `names`.
        names: distinct ones.
    """

    index: Int[Array, "..."] | np.ndarray
    names: tuple[str, ...] = eqx.field(static=True)

    @staticmethod
    def of(words: np.ndarray) -> NamedConfigurations:
        """Encodes an array of names."""
        # one name for all runs, as `Conditions` broadcasts it, is looked up once
        unrepeated = np.asarray(words[tuple(slice(1) if stride == 0 else slice(None) for stride in words.strides)])
        index = np.full(unrepeated.shape, -1, np.int32)
        names = list[str]()
        while (unmatched := index < 0).any():
            names.append(str(unrepeated[unmatched][0]))
            index[unrepeated == names[-1]] = len(names) - 1
        return NamedConfigurations(np.broadcast_to(index, words.shape), tuple(names))

    @property
    def shape(self) -> tuple[int, ...]:
        """Shape of the batch."""
        return self.index.shape

    def among(self, names: Sequence[str]) -> Any:
        """Position of each run's name in a sequence of names.

        Raises:
            KeyError: a run has a name that is not in the sequence, or any name if the conditions are traced.
        """
        positions = np.array([names.index(name) if name in names else -1 for name in self.names], int)
        traced = isinstance(self.index, jax.core.Tracer)
        for k in np.flatnonzero(positions < 0):
            if traced or (np.asarray(self.index) == k).any():
                raise KeyError(self.names[k])
        return jnp.asarray(positions)[self.index] if traced else np.asarray(positions[np.asarray(self.index)])


class Conditions(eqx.Module):
    """The conditions of one run or of a batch. All fields broadcast to one shape.

    Attributes:
        configuration: index of the robot's configuration. Until `resolved` it may be a name (`NamedConfigurations`).
        voltage: voltage of the external supply [V]. Not used with `battery`.
        slope_deg: slope angle, positive uphill [deg].
        payload: additional load mass m_c [kg].
        battery: 0 external supply (Source Mode 2), 1 on-board battery (Source Mode 1), eq. (8).
        discharge: charge C_b already taken from the battery [C].
        adhesion: adhesion of this surface, as a ratio to that of the surface the robot's friction is stated for [-].
        total_mass: weighed mass of robot and payload [kg]. None: the robot's own mass plus the payload.
        order: place in the sequence of runs. Drifts from run to run depend on it [-].
        duty: share of the supply voltage that the driver applies to the motors, negative in reverse [-]. None: 1.
        open: 1 if the motors' circuit is open, so that they coast, -1 if the driver shorts it, so that they brake at
            any duty.
        motor_speed: speed imposed on the motor shafts [rad/s]. The voltage follows. None: the voltage is imposed.
        motor_acceleration: acceleration of an imposed speed [rad/s²]. None: 0.
        motor_current: current imposed on each motor [A]. The voltage follows. None: the current follows.
        begin: index of the history's beginning in `Rig.begins`. None: it starts from rest.
        duty_left, duty_right: as `duty`, for each side. None: `duty`. Stating any condition of a side makes the robot
            free to turn.
        open_left, open_right: as `open`, for each side. None: `open`.
        motor_speed_left, motor_speed_right: as `motor_speed`, for each side. None: `motor_speed`.
        heading_deg: heading at the start, from uphill, positive to the left [deg]. None: 0. It also frees the robot
            to turn.
        adhesion_lateral: as `adhesion`, across the travel. None: `adhesion`.
        levers_front_deg, levers_rear_deg: lever angles, 0 along the wheelbase outward, positive up, 180 folded [deg].
            None: those of the running gear, folded as it states.
        load_torque: torque of a brake or load motor on the output of each drive [N·m]: positive against forward
            rotation, in both directions of rotation. Only for a load on a shaft. None: 0.
        goal: goal of the robot's controller: angle [rad] or speed [rad/s] of the output, or current of each motor
            [A], as the rig imposes. None: it is not controlled.
        held: 1 where a clamp holds the output of each drive at rest. `output_torque` is then what the clamp carries.
            Only for a load on a shaft at an imposed voltage or current, in settled runs. None: 0.
    """

    configuration: Any  # Int[Array, "..."] | Named
    voltage: Values
    slope_deg: Values
    payload: Values
    battery: Values
    discharge: Values
    adhesion: Values
    total_mass: Values | None
    order: Values
    duty: Values
    open: Values
    motor_speed: Values | None
    motor_acceleration: Values | None
    motor_current: Values | None
    begin: Int[Array, "..."] | None
    duty_left: Values | None
    duty_right: Values | None
    open_left: Values | None
    open_right: Values | None
    motor_speed_left: Values | None
    motor_speed_right: Values | None
    heading_deg: Values | None
    adhesion_lateral: Values | None
    levers_front_deg: Values | None
    levers_rear_deg: Values | None
    load_torque: Values | None
    goal: Values | None
    held: Values | None

    def __init__(
        self,
        configuration: str | int | Sequence[str] | np.ndarray | Array | NamedConfigurations = 0,
        voltage: Number = 33.0,
        slope_deg: Number = 0.0,
        payload: Number = 0.0,
        battery: Number | bool = 0.0,
        discharge: Number = 0.0,
        adhesion: Number = 1.0,
        total_mass: Number | None = None,
        order: Number = 0.0,
        duty: Number | None = None,
        open: Number | bool = 0.0,
        motor_speed: Number | None = None,
        motor_acceleration: Number | None = None,
        begin: Number | None = None,
        motor_current: Number | None = None,
        duty_left: Number | None = None,
        duty_right: Number | None = None,
        open_left: Number | bool | None = None,
        open_right: Number | bool | None = None,
        motor_speed_left: Number | None = None,
        motor_speed_right: Number | None = None,
        heading_deg: Number | None = None,
        adhesion_lateral: Number | None = None,
        levers_front_deg: Number | None = None,
        levers_rear_deg: Number | None = None,
        load_torque: Number | None = None,
        held: Number | bool | None = None,
        goal: Number | None = None,
    ) -> None:
        # arrays come from other conditions or a table; users write a number or a few
        if not isinstance(duty, np.ndarray | jax.Array | None) and None not in (duty_left, duty_right):
            raise UsageError(sides_contradiction(("duty", *OF_SIDES[:2])))
        duty = 1.0 if duty is None else duty
        arguments: dict[str, Any] = locals()
        condition_values = {
            name: arguments[name] for name in CONDITIONS if arguments[name] is not None or name in NUMBERS
        }
        configurations: Any = configuration
        if not isinstance(configuration, jax.Array | NamedConfigurations):
            words = np.asarray(configuration)
            configurations = NamedConfigurations.of(words) if words.dtype.kind == "U" else configuration
        if not isinstance(configurations, NamedConfigurations):
            configurations = _number_array("configuration", configurations, int)
        numbers = {name: _number_array(name, x) for name, x in condition_values.items()}
        shapes = {name: x.shape for name, x in {"configuration": configurations, **numbers}.items()}
        try:
            shape = np.broadcast_shapes(*shapes.values())
        except ValueError:
            shape_list = ", ".join(f"{name} {s}" for name, s in shapes.items() if s)
            raise ValueError(f"Conditions: shapes do not broadcast to one another: {shape_list}") from None
        self.configuration = jax.tree.map(lambda x: _broadcast_array(x, shape), configurations)
        self.begin = None if begin is None else _broadcast_array(_number_array("begin", begin, int), shape)
        # an equal number for all runs is stored once: most fields of a large batch are 0 or 1
        shared: dict[float, Array] = {}
        for name in CONDITIONS:
            if isinstance(value := condition_values.get(name), float):
                if value not in shared:
                    shared[value] = _broadcast_array(numbers[name], shape)
                setattr(self, name, shared[value])
            else:
                setattr(self, name, None if value is None else _broadcast_array(numbers[name], shape))

    @property
    def shape(self) -> tuple[int, ...]:
        """Shape of the batch, () for one run."""
        return self.voltage.shape

    @property
    def voltage_follows(self) -> bool:
        """True if the motor voltage follows from an imposed speed or current."""
        return self.motor_speed is not None or self.motor_current is not None

    @property
    def polarity(self) -> Array:
        """Sign of a duty that drives forward, ±1: the sign of the supply voltage, 1 on the battery."""
        return jnp.where((jnp.asarray(self.battery) < 0.5) & (jnp.asarray(self.voltage) < 0), -1.0, 1.0)

    @property
    def states_levers(self) -> bool:
        """True if lever angles are stated. The robot then rests on the contacts that they leave."""
        return self.levers_front_deg is not None or self.levers_rear_deg is not None

    @property
    def turns(self) -> bool:
        """True if the sides are driven apart or the heading is not uphill. The robot is then free to turn."""
        return any(getattr(self, name) is not None for name in OF_TURNS)

    def straight(self) -> Conditions:
        """Same conditions without any that belong to one side, heading uphill."""
        unset: dict[str, Any] = dict.fromkeys(OF_TURNS)
        return replace(self, **unset)

    def of_sides(self) -> Conditions:
        """Conditions of left and right side, with a leading axis of 2."""

        def side(name: str) -> Conditions:
            side_values = {key: getattr(self, f"{key}_{name}") for key in ("duty", "open", "motor_speed")}
            fields: dict[str, Any] = dict.fromkeys(OF_SIDES)
            return replace(self, **fields | {k: x for k, x in side_values.items() if x is not None})

        return jax.tree.map(lambda left, right: jnp.stack([left, right]), side("left"), side("right"))

    @property
    def slope(self) -> Float[Array, "..."]:
        """Slope angle α, positive uphill [rad]."""
        return self.slope_deg * (math.pi / 180)

    def resolved(self, robot: Robot) -> Conditions:
        """Same conditions with configuration names replaced by their indices in `robot`.

        Raises:
            KeyError: a name is no configuration of the robot. The message lists the robot's configurations.
        """
        if not isinstance(self.configuration, NamedConfigurations):
            return self
        try:
            configuration = self.configuration.among(robot.configurations.names)
        except KeyError as error:
            robot.configurations.index(error.args[0])  # raises a KeyError that lists the valid names
            raise
        return replace(self, configuration=configuration)


def sides_contradiction(stated: Collection[str]) -> str:
    """Error message if conditions of these names contradict each other, else an empty string.

    They do if only one side's motor speed is imposed, or if a side's duty is stated together with that of both.
    """
    if {"duty", *OF_SIDES[:2]} <= {*stated}:
        return f"duty cannot be combined with {' and '.join(OF_SIDES[:2])}; give one of the two"
    left, right = (name in stated for name in OF_SIDES[-2:])
    if left == right or "motor_speed" in stated:
        return ""
    stated_fields, lacking = OF_SIDES[-2:] if left else OF_SIDES[:-3:-1]
    return f"{stated_fields} needs {lacking} too; give both"


def _number_array(name: str, x: Any, kind: type = float) -> Any:
    """Array of numbers of that kind. NumPy input stays NumPy's, so that no JAX operation is compiled for it.

    Raises:
        UsageError: words, dates, complex numbers, masked numbers, truth values of a quantity, or parts of a whole
            number.
    """
    if isinstance(x, jax.Array):
        return jnp.asarray(x, kind)
    number = np.asarray(x)
    if np.ma.is_masked(x):
        raise UsageError(f"Conditions: {name}: got masked numbers; expected numbers, or rows without the masked ones")
    is_integer = kind is float or number.dtype.kind in "biu" or (number.dtype.kind == "f" and not (number % 1).any())
    if number.dtype.kind not in ("biuf" if name in SWITCHES else "iuf") or not is_integer:
        expected = "numbers" if kind is float else "whole numbers" + ", or names" * (name == "configuration")
        raise UsageError(f"Conditions: {name}: got {x!r}; expected {expected}")
    return number.astype(kind)


def _broadcast_array(x: Any, shape: tuple[int, ...]) -> Any:
    """Array of that shape. NumPy input stays NumPy's if JAX computes in single precision, to keep its digits."""
    if isinstance(x, jax.Array):
        return jnp.broadcast_to(x, shape)
    return jax.device_put(np.broadcast_to(x, shape)) if is_double() else np.broadcast_to(x, shape)
