"""A robot's drive as the actuator of one joint, its driving wheel or shaft. The parts of its law are expressions."""

from __future__ import annotations

import dataclasses
import functools
import inspect
from collections.abc import Callable, Iterator
from typing import Any

import jax.numpy as jnp

from calibration.data import Names
from calibration.data.input_errors import BadConfiguration, stated_word
from calibration.data.robot_file import RobotFile
from mmrjax.effects import Effect
from mmrjax.model import balances, contact, params
from mmrjax.model.channels import EVERY
from mmrjax.model.driver import Controller
from mmrjax.model.robot import Robot
from mmrjax.model.signals import Signals
from mmrjax.numerics.elementary import value_and_slope
from sweeps.export.expressions import ZERO, Symbol, names_in, trace_function

#: Balances of a joint. Terms in other balances belong to the load or to an instrument.
INSIDE = ("supply", "electrical", "inductance", "motor", "gearbox", "track", "inertia")
#: A current limit of the driver of this size means no limit [A].
UNLIMITED = 1000.0
#: Variables of the law and their signals. Torques of the output are `load` and, at the wheel, `pull`.
VARIABLES = {
    "current": "current",
    "voltage": "voltage",
    "motor_speed": "speed_motor",
    "wheel_speed": "speed_wheel",
    "way": "direction",
    "angle": "angle",
}
#: Surroundings of an exported joint: an external supply, one configuration.
_STILL = {"battery": 0.0, "discharge": 0.0, "order": 0.0, "configuration": 0}


@dataclasses.dataclass(frozen=True)
class Part:
    """One equation of the law.

    Attributes:
        name: name of the part.
        balance: balance that it enters, or its role.
        unit: unit of its value.
        equation, meaning: equation and meaning in words, from a docstring.
        value: value as an expression.
        slope: its derivative with respect to the variable `by`.
        rate, rate_slope: rate of its memory, and the derivative of the rate with respect to the memory.
        effect: name of its effect. Empty: part of the base robot.
    """

    name: str
    balance: str
    unit: str
    equation: str
    meaning: str
    value: Symbol
    by: str = ""
    slope: Symbol = ZERO
    rate: Symbol | None = None
    rate_slope: Symbol = ZERO
    effect: str = ""


@dataclasses.dataclass(frozen=True)
class DriveJoint:
    """A drive as the actuator of a joint.

    Attributes:
        file: the robot and the content of its file.
        configuration: name of the configuration.
        robot: robot with only this configuration and the effects inside the joint.
        inside, outside: effects that enter the balances of a joint, and the others.
        idle: names of effects that do not act on this configuration.
        parts: equations of the law in their order.
    """

    file: RobotFile
    configuration: str
    robot: Robot
    inside: tuple[Effect, ...]
    outside: tuple[Effect, ...]
    idle: Names
    parts: tuple[Part, ...]

    @property
    def load(self) -> Any:
        """The load of its configuration."""
        return self.robot.configurations[self.configuration]

    @property
    def name(self) -> str:
        """Name of the robot, as a name that Python, C and XML allow."""
        stem = self.file.name.rpartition("/")[2].removesuffix(".toml")
        word = "".join(c if c.isalnum() and c.isascii() else "_" for c in stem)
        return word if word.isidentifier() else f"robot_{word}"

    @property
    def limit(self) -> float | None:
        """Current limit of the driver per motor [A]. None: no limit."""
        limit = float(self.robot.driver.current_limit)
        return limit if limit < UNLIMITED else None

    @property
    def remembering(self) -> tuple[Part, ...]:
        """Parts that have a memory, in order."""
        return tuple(p for p in self.parts if p.rate is not None)

    @property
    def loose(self) -> bool:
        """True if the load turns apart from the motor, by a backlash or an elastic joint."""
        return self.robot.loose

    @property
    def controller(self) -> Controller | None:
        """Controller of the motor."""
        return self.robot.controller

    @property
    def accelerates(self) -> bool:
        """True if a loss depends on the torque at gearbox or wheel, which is reduced by the acceleration of the
        parts before it."""
        gear = () if self.loose else self.of("gearbox")
        lossy = not self.loose and float(self.robot.gearbox.efficiency_load) != 1
        return lossy or any(p.by for p in (*gear, *self.of("track")))

    @property
    def controller_states(self) -> Names:
        """Names of the controller's states."""
        return tuple("duty" if name == "command" else name for name in self.robot.controller_states)

    @property
    def states(self) -> Names:
        """Names of the actuator's state: current, memories, controller, motor side, and the speed one step before."""
        motor_side = ("gap", "rotor_speed") * self.loose
        memories = (p.name for p in self.remembering)
        return ("current", *memories, *self.controller_states, *motor_side, *(("speed",) * self.accelerates))

    @property
    def steady(self) -> DriveJoint:
        """The same joint in steady travel under a voltage, without the controller and with a rigid gearbox."""

        def driven(robot: Robot) -> Robot:
            motor, controller = robot.motor, robot.controller
            if controller is not None and motor.voltage_limit is None:
                motor = dataclasses.replace(motor, voltage_limit=float(controller.supply_voltage * controller.limit))
            rig = dataclasses.replace(robot.rig, imposed="voltage", loose=False)
            return dataclasses.replace(robot, motor=motor, rig=rig, controller=None)

        file = dataclasses.replace(self.file, robot=driven(self.file.robot))
        return dataclasses.replace(self, file=file, robot=driven(self.robot))

    def of(self, balance: str) -> tuple[Part, ...]:
        """Parts of a balance, in order."""
        return tuple(p for p in self.parts if p.balance == balance)

    def with_robot(self, robot: Robot) -> DriveJoint:
        """The same joint for a robot with other numbers. Its parts are expressions of names and do not change."""
        return dataclasses.replace(self, robot=robot, inside=robot.effects)

    def parameters(self) -> dict[str, params.Parameter]:
        """Parameters that the law depends on, by dotted name."""
        by_name = params.parameters_by_name(self.robot)
        symbol_names = [n for part in self.parts for n in names_in(*_symbols_of_part(part))]
        further = ["gearbox.ratio", "motor.inertia", "gearbox.efficiency_load"]
        further += ["driver.current_limit"] * (self.limit is not None)
        further += [f"{self.configuration}.inertia"] * (self.accelerates or self.loose)
        further += [f"{self.configuration}.{n}" for n in ("backlash", "stiffness", "damping")] * self.loose
        further += [n for n in by_name if n.startswith("controller.")]
        return {n: by_name[n] for n in dict.fromkeys((*further, *symbol_names)) if n in by_name}

    def surroundings(self) -> Names:
        """Signals of the joint's surroundings that the law depends on, such as the normal load."""
        symbol_names = [
            n for part in self.parts for n in names_in(*_symbols_of_part(part)) if n.startswith("surroundings.")
        ]
        return tuple(dict.fromkeys(symbol_names))


def _symbols_of_part(part: Part) -> list[Symbol]:
    return [part.value, part.slope, part.rate_slope, *([] if part.rate is None else [part.rate])]


def joint_of_robot(file: RobotFile, configuration: str | None = None) -> DriveJoint:
    """Drive of a robot as the actuator of one joint.

    Args:
        configuration: name of the configuration. None: the robot's first.

    Raises:
        BadConfiguration: the configuration does not exist, the drive is not one joint or not driven by voltage, or
            the equation of an effect has no closed form.
    """
    robot = file.robot
    name = robot.configurations.names[0] if configuration is None else configuration
    wrong = f"got {name}; the robot has no such configuration"
    stated_word(name, robot.configurations, "--configuration", wrong)
    if robot.unlike:
        raise BadConfiguration(
            f"{file.name}: {', '.join(robot.unlike)} makes the sides differ; export a file for each side "
            "without this effect"
        )
    if robot.controller is not None and not robot.controller.supply_voltage:
        raise BadConfiguration(f"{file.name}, controller.supply_voltage: missing; add it [V]")
    if robot.rig.imposed != "voltage" and robot.controller is None:
        imposed_words = robot.rig.imposed.replace("_", " ")
        raise BadConfiguration(
            f"{file.name}, [rig] imposed: got {robot.rig.imposed}; expected voltage or a goal. With an imposed "
            f"{imposed_words}, runs do not show the winding"
        )
    if lacking := [n for n in ("motor.resistance", "motor.torque_constant") if n in robot.rig.unknown]:
        raise BadConfiguration(f"{file.name}: {', '.join(lacking)} is missing; the drive law needs it; add it")
    members: Any = {name: robot.configurations[name]}
    one = dataclasses.replace(robot, configurations=members)
    moving = Signals(configuration=0, on_tracks=jnp.asarray(one.configurations.members[0].on_tracks))
    acting = tuple(e for e in robot.effects if e.acts_everywhere or bool(e.acts(one, moving)))
    idle = tuple(e.name for e in robot.effects if e not in acting)
    effects_inside = tuple(
        e for e in acting if e.balance in INSIDE and not e.needs_battery and e.balance not in robot.lacks
    )
    outside = tuple(e for e in acting if e not in effects_inside)
    one = dataclasses.replace(one, effects=effects_inside)
    joint = DriveJoint(file, name, one, effects_inside, outside, idle, ())
    return dataclasses.replace(joint, parts=tuple(_trace_parts(joint)))


#: Function of a robot with the joint's effects and its signals.
LawFunction = Callable[[Robot, Signals], Any]


class _ExpressionTracer:
    """Traces functions of a robot and its signals into expressions of their names."""

    def __init__(self, joint: DriveJoint) -> None:
        self.joint, self.at_wheel = joint, True
        self.parameters = [p.name for p in params.walk_parameters(joint.robot)]
        self.memories = [e.name for e in joint.robot.remembering]
        reserved_names = {*VARIABLES.values(), "memory", "temperature", "load_torque"}
        self.around = [f.name for f in dataclasses.fields(Signals) if f.name not in reserved_names]
        self.names = [
            *self.parameters,
            *VARIABLES,
            "load",
            "pull",
            *(f"memory.{n}" for n in self.memories),
            *(f"surroundings.{n}" for n in self.around),
        ]

    def __call__(self, function: LawFunction, what: str, balance: str, by: str = "") -> Symbol:
        """Expression of a function of robot and signals, or of its derivative with respect to the variable `by`."""
        self.at_wheel = balance != "gearbox"

        def value(*numbers: Any) -> Any:
            return function(*self._given(dict(zip(self.names, numbers, strict=True))))

        def slope(*numbers: Any) -> Any:
            k = self.names.index(by)
            function = lambda x: jnp.asarray(value(*numbers[:k], x, *numbers[k + 1 :]))  # noqa: E731
            return value_and_slope(function, numbers[k])[1]

        return trace_function(slope if by else value, self.names, what)

    def _given(self, known: dict[str, Any]) -> tuple[Robot, Signals]:
        robot = params.replace(self.joint.robot, {n: known[n] for n in self.parameters})
        (load,) = robot.configurations.members
        robot = robot.within(0)
        around: dict[str, Any] = {n: _STILL.get(n, known[f"surroundings.{n}"]) for n in self.around}
        around |= {field: known[name] for name, field in VARIABLES.items()}
        around.update(
            on_tracks=load.on_tracks,
            direction_travel=known["way"],
            speed_output=known["wheel_speed"],
            speed_theoretical=load.radius * known["wheel_speed"],
            speed=load.radius * known["wheel_speed"],
            total_current=robot.sides * known["current"],
            duty=1.0,
            share_drawn=1.0,
            voltage_source=known["voltage"],
            voltage_back=robot.motor.voltage_back(known["motor_speed"]),
            torque_electromagnetic=robot.motor.torque_electromagnetic(known["current"]),
            # The gearbox reads the sum of both, which is the load at its output.
            traction=known["pull"] / load.radius if self.at_wheel else jnp.zeros(()),
            torque_track_loss=known["load"],
            torque_load=known["load"],
            torque_carried=known["load"],
            memory={n: known[f"memory.{n}"] for n in self.memories},
        )
        return robot, Signals(**around)


def _trace_parts(joint: DriveJoint) -> Iterator[Part]:
    """Equations of the base, then those of the effects, each in the order of its balance."""
    bare = lambda robot: dataclasses.replace(robot, effects=())  # noqa: E731

    speed_at_rest = float(joint.load.speed_still) / float(joint.load.radius)
    friction = (
        "M_t = M_t0 sign ω + K_ft ω, and friction by the normal load"
        if joint.robot.has_ground
        else "M_t = M_0 sign ω + K ω"
    )
    part = functools.partial(_trace_part, _ExpressionTracer(joint))
    yield part(
        "direction", "way", "-", "x (3 - x²) / 2, x = ω/ω_0 within ±1",
        f"smooth sign of the speed, within ω_0 = {speed_at_rest:.3g} rad/s of rest",
        lambda r, s: contact.smooth_sign(s.speed_wheel, speed_at_rest),
    )  # fmt: skip
    yield part(
        "back_emf", "back", "V", "E = C_m ω_m", "voltage that the turning motor induces",
        lambda r, s: r.motor.voltage_back(s.speed_motor),
    )  # fmt: skip
    yield part(
        "winding", "electrical", "V", "U_R = R_rot I", "voltage across the winding",
        lambda r, s: r.motor.voltage_winding(s.current), "current",
    )  # fmt: skip
    yield part("inductance", "inductance", "H", "L_d", "inductance of the winding", lambda r, s: r.motor.inductance)
    yield part(
        "motor_torque", "torque", "N·m", "M = C_m I", "torque that the current makes",
        lambda r, s: r.motor.torque_electromagnetic(s.current),
    )  # fmt: skip
    yield part(
        "motor_friction", "motor", "N·m", "M_f = M_df0 sign ω + K_fd ω", "friction of the motor, at its shaft",
        lambda r, s: r.motor.torque_loss(s.speed_motor, s.direction),
    )  # fmt: skip
    yield part(
        "gear_idle", "idle", "N·m", "M_i = M_rf0 sign ω + K_fr ω", "idle friction of the gearbox, at its input",
        lambda r, s: r.gearbox.torque_idle(s.speed_motor, s.direction),
    )  # fmt: skip
    yield part(
        "gear_efficiency", "efficiency", "-", "η_rm where power flows to the wheel, 1/η_b where it flows back",
        "transmitted share of torque, `load`: torque at its input",
        lambda r, s: r.gearbox.efficiency_flow(s.torque_load, s.direction),
    )  # fmt: skip
    yield part(
        "output_friction", "track", "N·m", friction,
        "friction between the gearbox and the wheel's rim, at the wheel",
        lambda r, s: balances.track(bare(r), r.chassis(0), s).torque_track_loss, "pull",
    )  # fmt: skip
    variable = {"supply": "current", "electrical": "current", "gearbox": "load", "track": "pull"}
    for effect in joint.inside:
        alone = lambda r, e=effect: tuple(x for x in r.effects if x.name == e.name)  # noqa: E731
        value = lambda r, s, e=effect, alone=alone: balances.effects_sum(  # noqa: E731
            dataclasses.replace(r, effects=alone(r)), s, e.balance
        )
        rate = None
        if effect.memory_size is not None:
            rate = lambda r, s, alone=alone: alone(r)[0].rate(r, s)  # noqa: E731
        equation, *further = (inspect.getdoc(type(effect).plain or type(effect)) or effect.name).split("\n\n")
        meaning = further[0] if further and not further[0].startswith("Source") else ""
        yield part(
            effect.name, effect.balance, balances.BALANCES[effect.balance][0], " ".join(equation.split()),
            " ".join(meaning.split()), value, variable.get(effect.balance, ""), rate, effect.name,
        )  # fmt: skip


def _trace_part(
    trace: _ExpressionTracer, name: str, balance: str, unit: str, equation: str, meaning: str,
    function: LawFunction, by: str = "", rate: LawFunction | None = None, effect: str = "",
) -> Part:  # fmt: skip
    value = trace(function, name, balance)
    depends = by in names_in(value)
    part = Part(name, balance, unit, equation, meaning, value, by if depends else "", effect=effect)
    if depends:
        part = dataclasses.replace(part, slope=trace(function, name, balance, by))
    if rate is not None:
        slope = trace(rate, name, balance, f"memory.{name}")
        part = dataclasses.replace(part, rate=trace(rate, name, balance), rate_slope=slope)
    return part


def channels_of(joint: DriveJoint) -> tuple[Any, ...]:
    """Channels of the robot's instruments that settled runs show, in the order of their table.

    A rig without any, such as a servo with only an angle sensor, is compared by current and speed of the motor.
    """
    settled = [c for c in EVERY if c.settled]
    own_channels = tuple(c for c in settled if c.name in joint.file.robot.rig.channels)
    return own_channels or tuple(c for c in settled if c.name in ("motor_current", "motor_speed"))
