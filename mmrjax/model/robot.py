"""The robot: its drive, its configurations and its effects, one pytree."""

from __future__ import annotations

import dataclasses
from collections.abc import Collection, Iterable, Iterator, Mapping
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from mmrjax.model import channels, params
from mmrjax.model.channels import Channel
from mmrjax.model.chassis import Chassis
from mmrjax.model.driver import Controller, Driver
from mmrjax.model.gearmotor import Gearbox, Motor
from mmrjax.model.paper_tables import RADIUS_PULLEY
from mmrjax.model.params import Index, Scalar, as_float
from mmrjax.model.power import Battery
from mmrjax.model.quantities import HEAT, WARMING, Names
from mmrjax.model.rig import Rig
from mmrjax.model.shaft import Shaft
from mmrjax.undercarriage.running_gear import RunningGear

if TYPE_CHECKING:
    from mmrjax.effects import Effect


#: Load of the drives in one configuration: a vehicle's chassis, or a shaft on a bench.
Load = Chassis | Shaft


class Configurations(eqx.Module):
    """Loads by name, in a fixed order. Conditions hold an index.

    Attributes:
        names: names in order.
        members: the loads, either all vehicles or all shafts.
        chosen: the load of the current configuration, within equations of one run (`Robot.within`).
    """

    names: Names = eqx.field(static=True)
    members: tuple[Any, ...]  # Load
    chosen: Any = None  # Load | None

    def __init__(self, by_name: Mapping[str, Load]) -> None:
        self.names, self.members, self.chosen = tuple(by_name), tuple(by_name.values()), None

    def index(self, name: str) -> int:
        """Position of a configuration.

        Raises:
            KeyError: no such configuration. The message lists the robot's configurations.
        """
        if name not in self.names:
            raise KeyError(f"no configuration {name}; the robot has {', '.join(self.names)}")
        return self.names.index(name)

    def __getitem__(self, name: str) -> Any:
        return self.members[self.index(name)]

    def __contains__(self, name: object) -> bool:
        return name in self.names

    def __iter__(self) -> Iterator[str]:
        return iter(self.names)

    def __len__(self) -> int:
        return len(self.names)

    def items(self) -> Iterator[tuple[str, Any]]:
        """Names and loads, in order."""
        return zip(self.names, self.members, strict=True)

    @property
    def tracked(self) -> np.ndarray:
        """True for each load on tracks, outside of JAX."""
        return np.array([float(load.on_tracks) > 0.5 for load in self.members])


class Robot(eqx.Module):
    """Battery, one motor and gearbox per side, a load for each configuration, and effects.

    Attributes:
        configurations: loads by name, at least one. Given as a mapping.
        effects: terms beyond the paper's model. An empty tuple gives the paper's model.
        sides: number of motors driven with the same input. Per-side quantities belong to one motor (assumption 3).
        running_gear: running gear of one side, further parameters of the track model.
        driver: driver of the motors.
        rig: imposed inputs and instruments.
        controller: controller of the motors, if the rig imposes a goal.
    """

    battery: Battery
    motor: Motor
    gearbox: Gearbox
    configurations: Configurations = eqx.field(
        converter=lambda value: Configurations(value) if isinstance(value, Mapping) else value
    )
    effects: tuple[Effect, ...] = ()
    sides: Scalar = eqx.field(default=2.0, converter=as_float)
    running_gear: RunningGear = eqx.field(default_factory=RunningGear)
    driver: Driver = eqx.field(default_factory=Driver)
    rig: Rig = eqx.field(default_factory=Rig)
    controller: Controller | None = None

    def __repr__(self) -> str:
        effects = "".join(f", {e.name}" for e in self.effects)
        motors = f"{params.number_text(self.sides)} motors with the same command"
        head = f"Robot: {', '.join(self.configurations)}; {motors}{effects}"
        return f"{head}\n{params.parameter_table(self)}"

    def for_equations(self) -> Robot:
        """Same robot without the fields that only files, priors and reports read."""
        rig = self.rig.for_equations()
        effects = tuple(e.for_equations() for e in self.effects)
        if rig is self.rig and all(a is b for a, b in zip(effects, self.effects, strict=True)):
            return self
        return replace(self, rig=rig, effects=effects)

    @property
    def channels(self) -> tuple[Channel, ...]:
        """Channels that its rig's instruments show, in order."""
        return channels.channels_named(self.rig.channels)

    def showing_turns(self, columns: Collection[str] | None = None) -> Robot:
        """Same robot with instruments for both sides and yaw. With `columns`, only for columns of the table."""
        present = self.rig.channels
        possible = [c for c in channels.OF_TURNS if (c.settled if columns is None else c.column in columns)]
        added = [c.name for c in possible if c.name not in present]
        return replace(self, rig=replace(self.rig, channels=(*present, *added)))

    @property
    def unlike(self) -> Names:
        """Names of its effects that make the sides differ. They have no meaning in runs without data of each side."""
        return tuple(effect.name for effect in self.effects if effect.unlike)

    @property
    def lacks(self) -> frozenset[str]:
        """Balances that its loads lack."""
        return frozenset(self.configurations.members[0].lacks)

    @property
    def has_ground(self) -> bool:
        """True if a ground carries it. Slope, payload and adhesion then act, and its movers can slip."""
        return "ground" not in self.lacks

    def unknown(self, names: Iterable[str]) -> Names:
        """Parameters among `names` (dotted) that neither its file nor its base robot states."""
        return tuple(name for name in names if name in self.rig.unknown)

    def knows(self, names: Iterable[str]) -> bool:
        """True if all of the parameters are known."""
        return not self.unknown(names)

    @property
    def current_continuous(self) -> Scalar:
        """Continuous current of one motor that its winding permits [A], inf if its thermal data are unknown."""
        return self.motor.current_continuous if self.knows(HEAT) else jnp.inf

    def heating(self, power: Scalar, winding: Scalar, housing: Scalar) -> tuple[Scalar, Scalar]:
        """Rates of the temperatures of winding and housing [K/s], as in `Motor.heating`. They are 0 if the motor's
        thermal data are unknown."""
        rates = self.motor.heating(power, winding, housing)
        return rates if self.knows(WARMING) else (jnp.zeros_like(rates[0]), jnp.zeros_like(rates[1]))

    @property
    def shows_travel(self) -> bool:
        """True if the distance is observable: on a ground, or by a channel of its shaft."""
        return self.has_ground or "speed" in self.rig.channels

    @property
    def loose(self) -> bool:
        """True if its load can turn relative to the motor, because of a backlash or an elastic joint."""
        return self.rig.loose

    @property
    def controller_states(self) -> tuple[str, ...]:
        """Fields of `State` that its controller has."""
        return () if self.controller is None else self.controller.states

    def __dir__(self) -> list[str]:  # methods are the program's own
        return [field.name for field in dataclasses.fields(self)]

    @property
    def moves_as_one(self) -> bool:
        """True if shafts and load stop together: no backlash, elastic joint or ground to slip on."""
        return not (self.loose or self.has_ground)

    def chassis(self, configuration: Index) -> Any:
        """The load of the configuration with this index, traceable and batchable."""
        if self.configurations.chosen is not None:
            return self.configurations.chosen
        selected, *others = self.configurations.members
        for k, other in enumerate(others, 1):
            is_selected = jnp.asarray(configuration == k)
            selected = jax.tree.map(lambda a, b: jnp.where(is_selected, b, a), selected, other)  # noqa: B023
        return selected

    def within(self, configuration: Index) -> Robot:
        """Same robot in the configuration with this index. Its load is selected once, here, for all equations."""
        if self.configurations.chosen is not None:
            return self
        configurations = eqx.tree_at(
            lambda c: c.chosen, self.configurations, self.chassis(configuration), is_leaf=lambda x: x is None
        )
        return replace(self, configurations=configurations)

    @property
    def radius_pulley(self) -> Scalar:
        """Pitch radius of the pulleys that carry the belts [m].

        With tracks, it is the rolling radius of the first configuration; without, that of 48 teeth of 5 mm.
        """
        radius: Scalar = jnp.asarray(RADIUS_PULLEY)
        for chassis in reversed(self.configurations.members):
            radius = jnp.where(jnp.asarray(chassis.on_tracks) > 0.5, chassis.radius, radius)
        return radius

    @property
    def remembering(self) -> tuple[Effect, ...]:
        """Its effects with a memory, in order."""
        return tuple(effect for effect in self.effects if effect.memory_size is not None)


#: Reason why a vehicle has no brake torque on its output.
NO_BRAKE = "the robot is a vehicle; a brake acts only on a shaft"


def turn_error(robot: Robot, names: Iterable[str]) -> str | None:
    """Reason why a robot with independently driven sides cannot be computed in these configurations, else None."""
    if not robot.has_ground:
        return "the robot's load is a shaft, which cannot turn on the ground"
    if float(robot.sides) < 2:
        return f"got a robot of {float(robot.sides):g} side; expected sides = 2, one motor on each"
    if robot.rig.imposed == "motor_current":
        return "the robot's file imposes the motors' current, not available for each side"
    lacking = [
        f"{name}.turning.{key} [{unit}]"
        for name in names
        if name in robot.configurations
        for key, unit in (("width", "m"), ("inertia", "kg·m^2"))
        if not float(getattr(robot.configurations[name].turning, key)) > 0
    ]
    return f"the robot's file lacks {', '.join(lacking)}, needed for a turn" if lacking else None
