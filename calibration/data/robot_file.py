"""Robots as TOML files: a base robot by name, with changed or added parameters and effects."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import jax.numpy as jnp

from calibration.data import Json, Names, input_files, rig_file, stated
from calibration.data.configuration_tables import loads_from_tables, resolve_likes
from calibration.data.effect_file import Library
from calibration.data.input_errors import (
    BadConfiguration,
    allowed_words,
    is_number,
    stated_as,
    stated_names,
    stated_word,
)
from calibration.data.writing import toml_value, write_text
from mmrjax import effects
from mmrjax.compile.compiling import in_double
from mmrjax.effects.base import scaled_effect
from mmrjax.errors import list_some, printable
from mmrjax.model import paper_robots, params, power
from mmrjax.model.driver import DECAYS, Controller
from mmrjax.model.quantities import GOALS
from mmrjax.model.robot import Configurations, Robot
from mmrjax.model.shaft import Shaft

SCHEMA = "mmrjax.robot/2"


def allowed_setting(name: str) -> str:
    """Allowed values of a setting, as text."""
    allowed, unit, _ = SETTINGS[name]
    if isinstance(allowed[0], bool | str):
        return " or ".join(str(x).lower() for x in allowed)
    return f"{allowed[0]:g} to {allowed[-1]:g} {unit}".rstrip()


#: Values of a robot that a fit cannot free: counts, makers' ratings, switches and choices. Each has its allowed
#: values (a range, limits, or all of them), unit and meaning. Proposed experiments stay within the ratings.
SETTINGS: dict[str, tuple[Any, str, str]] = {
    "sides": (range(1, 13), "", "motors with the same command"),
    "battery.cells": (range(1, 101), "", "cells of the battery in series"),
    "motor.voltage_limit": ((0.1, 1000.0), "V", "highest supply voltage; not stated: the highest in the table"),
    "motor.speed_limit": ((1.0, 1e5), "rad/s", "permissible speed of the motor"),
    "motor.temperature_limit": ((30.0, 400.0), "°C", "permissible temperature of the winding"),
    "gearbox.speed_limit": ((1.0, 1e5), "rad/s", "permissible speed at the gearbox input"),
    "gearbox.torque_limit": (
        (1e-3, 1e5),
        "N·m",
        "permissible continuous torque at the driving wheel; GP32C: 3 x 25/12",
    ),
    "battery.voltage_charge": ((0.5, 10.0), "V", "highest voltage of a cell during charging; Section 3.3"),
    "battery.voltage_cutoff": ((0.0, 10.0), "V", "lowest voltage of a cell under load; assumed, not in the paper"),
    "battery.delay_cutoff": ((0.0, 1e3), "s", "permitted time of a cell below its cut-off; assumed"),
    "battery.current_limit": ((1e-3, 1e4), "A", "largest discharge current of a cell; not stated: no limit"),
    "battery.current_charge": ((0.0, 1e4), "A", "largest charging current of a cell; not stated: no limit"),
    "controller.rate": (
        (0.0, 1e5),
        "Hz",
        "rate of the controller's samples, the first in a run's first row; 0: continuous",
    ),
    "controller.samples_late": ((0.0, 1.0), "-", "number of samples, 0 or 1, after which its duty acts"),
    "controller.supply_voltage": (
        (0.0, 1000.0),
        "V",
        "supply voltage of the driver, for tables without that column; 0: not used",
    ),
    "battery.capacity_curve": ((1.0, 1e6), "C", "capacity of the cell to which curvature and slope belong"),
    "gearbox.mesh_theory": (
        (True, False),
        "",
        "efficiency 2 - 1/η (gear mesh theory) when the load drives the motor, else η",
    ),
    "driver.returns_current": (
        (True, False),
        "",
        "supply and driver accept regenerative current (otherwise a diode blocks it)",
    ),
    "driver.decay": (
        DECAYS,
        "",
        "between pulses the driver shorts the motors (slow decay) or lets them coast (fast decay)",
    ),
}


#: Key in an effect's table that scales the library's priors and limits to the rig.
FACTORS = "scaled"

#: Parabola of a cell's no-load voltage. If a capacity is stated too, it applies to a cell of that capacity.
CURVE = {"battery.curvature", "battery.slope"}


@dataclass(frozen=True)
class RobotFile:
    """A robot and the origin of its numbers.

    Attributes:
        robot: the robot, including changes from elsewhere such as the command line.
        source: path of its file, or name of a packaged robot.
        stated: names of the parameters in the file. The keys of a linear unit become parameters of its shaft.
        linear: configurations that the file describes as linear units.
        text: text of the file.
        remarks: sentences about the robot for users of its numbers.
    """

    robot: Robot
    source: str
    stated: frozenset[str] = frozenset()
    linear: frozenset[str] = frozenset()
    text: str = ""
    remarks: Names = ()

    @property
    def name(self) -> str:
        """Name of the robot, or name of its file."""
        return Path(self.source).name


@in_double
def load_robot(name_or_path: str, library: Library = effects.BY_NAME) -> Robot:
    """Robot with a packaged name, or from a robot file.

    Args:
        name_or_path: `nominal`, `sm1`, `sm2`, or a TOML file that `calibrate`, `loop` or `rig new` wrote.
        library: effects by name that the file may use.

    Raises:
        BadConfiguration: no such name or file, or an invalid value in the file.
    """
    return find_robot_file(name_or_path, library).robot


def read_robot(path: Path, library: Library = effects.BY_NAME) -> Robot:
    """Robot from a file, as in `parse_robot_file` but without the origin of its numbers."""
    return parse_robot_file(path, library).robot


def find_robot_file(name_or_path: str, library: Library = effects.BY_NAME) -> RobotFile:
    """Robot with a packaged name (`nominal`, `sm1`, `sm2`) or from a file, and the origin of its numbers.

    Raises:
        BadConfiguration: there is no such name or file, or as in `parse_robot_file`.
    """
    if name_or_path in paper_robots.ROBOTS:
        return RobotFile(paper_robots.ROBOTS[name_or_path](), name_or_path)
    path = Path(name_or_path)
    if not path.is_file():
        raise BadConfiguration(
            f"--robot: got {name_or_path}, no such file and no known robot; "
            f"{allowed_words(name_or_path, paper_robots.ROBOTS)}"
        )
    return parse_robot_file(path, library)


def parse_robot_file(path: Path, library: Library = effects.BY_NAME) -> RobotFile:
    """Robot and origin of its numbers, from a file. Its effects are looked up in `library` and among the curves.

    The file states, all optional:
        schema: version of the file format.
        base: name of the robot that it starts from, `nominal` if left out. `none` starts from nothing.
        imposed, channels, start, columns, instruments: how it is driven and measured, see `rig_file`.
        sides: number of motors. `battery.cells`: cells in series.
        configurations: names of the robot's configurations, in order. Default: those of the base, or all tables.
            A configuration that is not in the base states `like`, the base's configuration that it starts from.
            Otherwise it states `movers` (`tracks` or `wheels`) or `load` (see `rig_file.LOADS`), and every parameter
            without default.
        parameters: parameters in SI units, in tables by dotted name, e.g. `[motor] resistance = 0.9`, or with the sd
            of their prior, `"0.9 ± 5 %"`. The sd is wider as long as the number is that of a template. Also SETTINGS.
        effects: an effect is present if the file has its table `[effects.NAME]`. The table may name the
            `configurations` that the effect acts on, and scale its priors and limits by `scaled` (see
            `effects.base.scaled_effect`).

    Raises:
        BadConfiguration: the text is not TOML. A key is unknown (the message lists the choices). A value is no
            number, not finite, or outside its field's bounds. Also for the reasons of `loads_from_tables` and
            `add_effects`.
    """
    where = path.name
    text = input_files.toml_text(path, where)
    content = input_files.toml_content(text, where)
    if not content:
        raise BadConfiguration(
            f'{where}: is empty; expected parameter tables such as [motor], or base = "nominal" for the packaged '
            "robot"
        )
    schema = content.pop("schema", SCHEMA)
    if schema != SCHEMA:
        raise BadConfiguration(f"{where}, schema: got {schema}; expected {SCHEMA}")
    base = stated_word(content.pop("base", "nominal"), (*paper_robots.ROBOTS, rig_file.NONE), f"{where}, base")
    robot, sds, linear = _robot_before_parameters(
        None if base == rig_file.NONE else paper_robots.ROBOTS[base](), content, where, stated.example_numbers(text)
    )
    present = stated_as(content.get("effects", {}), dict, f"{where}, effects", "tables such as [effects.churning]")
    configurations_by_effect: Json = {}
    scaled: dict[str, type[effects.Effect]] = {}
    for name, table in present.items():
        if name not in {**effects.BESIDE, **library}:
            raise BadConfiguration(f"{where}, effects.{name}: no such effect; {allowed_words(name, library)}")
        if isinstance(table, dict) and "configurations" in table:
            configurations_by_effect[name] = table.pop("configurations")
        if isinstance(table, dict) and FACTORS in table:
            scaled[name] = _scaled_effect(library, name, table.pop(FACTORS), f"{where}, effects.{name}.{FACTORS}")
    robot = add_effects(robot, tuple(present), {**library, **scaled}, configurations_by_effect, where)
    parameters = input_files.flat_table(content)
    robot = rig_file.with_priors(change_robot(robot, parameters, where), sds, where)
    remarks = battery_remarks(robot, parameters, where)
    return RobotFile(robot, str(path), frozenset(parameters), linear, text, remarks)


def _robot_before_parameters(
    base: Robot | None, content: Json, where: str, examples: Collection[str]
) -> tuple[Robot, dict[str, float], frozenset[str]]:
    """Robot of a file before its parameters are applied, their standard deviations, and its linear units.

    Args:
        base: base robot. None: there is no base.
        content: content of the file. Keys other than parameters are removed from it.
        examples: names of numbers that still have the template's value.
    """
    if base is None:
        resolve_likes(content, where)
    tables = {key: value for key, value in content.items() if key not in rig_file.KEYS and isinstance(value, dict)}
    sds = stated.split_values_and_sds(tables, where)
    values = input_files.flat_table(tables)
    sds |= {name: stated.example_sd(values[name], sds[name]) for name in sds.keys() & set(examples)}
    loads, travels, linear, lacking = loads_from_tables(base, content, sds, where)
    rig = rig_file.parse_rig(content, where, list(loads), travels=travels, inherits=base is not None)
    if "controller" in content and not rig.follows_goal:
        raise BadConfiguration(
            f"{where}, controller: cannot be combined with imposed = {toml_value(rig.imposed)}; a controller needs "
            f"an imposed goal: {', '.join(GOALS)}"
        )
    controller = Controller() if rig.follows_goal else None
    if base is not None:
        robot = replace(base, configurations=Configurations(loads), rig=rig, controller=controller)
        return robot, sds, linear
    robot = replace(paper_robots.blank_robot(Configurations(loads), rig=rig), controller=controller)
    parameters, values = params.parameters_by_name(robot), input_files.flat_table(content)
    defaults = {name: value for name, (value, _) in rig_file.DEFAULTS.items()}
    resistance = values.get("motor.resistance", float(robot.motor.resistance))
    if isinstance(resistance, int | float):
        time_constant = rig_file.WINDING if rig.shows_voltage else rig_file.WINDING_AT_ONCE
        defaults["motor.inductance"] = time_constant * resistance
    robot = params.replace(robot, {name: params.as_float(value) for name, value in defaults.items()})
    for name in values:
        if "." not in name and name not in SETTINGS:
            raise BadConfiguration(f"{where}, {name}: no such parameter; {_parameter_choices(name, parameters)}")
    missing = [name for name in rig_file.required_parameters(rig, values) if name not in values]
    if not travels and "speed" in rig.channels:
        missing += [f"{name}.radius" for name in loads if f"{name}.radius" not in values]
    rig_file.reject_missing([*missing, *lacking], parameters, where, values)
    return robot, sds, linear


def _scaled_effect(library: Library, name: str, factors: Any, where: str) -> type[effects.Effect]:
    """Effect whose priors and limits are scaled to the rig, as its file states.

    Raises:
        BadConfiguration: the scale is not three positive numbers, or the effect has no prior.
    """
    effect = {**effects.OF_TURNS, **effects.OF_CHANNELS, **library}.get(name)
    if effect is None:
        raise BadConfiguration(f"{where}: a curve or wave has no prior for its size; remove the key")
    is_list = isinstance(factors, list) and len(factors) == 3
    if not is_list or not all(is_number(x) and 0 < x < math.inf for x in factors):
        raise BadConfiguration(
            f"{where}: got {factors!r}; expected three factors above 0 on the library's values: [sd of the "
            "amplitude, shape, limits of the amplitude]"
        )
    return scaled_effect(effect, (float(factors[0]), float(factors[1]), float(factors[2])))


def add_effects(
    robot: Robot,
    names: Sequence[str],
    library: Library = effects.BY_NAME,
    configurations: Json | None = None,
    where: str = "effects",
) -> Robot:
    """Robot with these effects of `library`, or curves, each with amplitude 0.

    Args:
        configurations: effect → list of the configurations in which it acts. Default: as in its class.
        where: beginning of the error message.

    Raises:
        BadConfiguration: the configurations of an effect are no list of names, or the robot lacks one.
    """
    acting_effects = []
    for name in names:
        effect = {**effects.BESIDE, **library}[name]()
        place = f"{where}, effects.{name}.configurations"
        acting = (configurations or {}).get(name, effect.configurations)
        acting = stated_names(acting, place, f"a list of {', '.join(robot.configurations)}", least=0)
        for c in acting:
            stated_word(c, robot.configurations, place)
        acting_effects.append(replace(effect, configurations=acting))
    return replace(robot, effects=tuple(acting_effects))


def change_robot(robot: Robot, values: Mapping[str, Any], where: str) -> Robot:
    """Robot with changed parameters and SETTINGS, each of them checked.

    Args:
        values: new values by dotted name [SI].
        where: beginning of the error message.

    Raises:
        BadConfiguration: for the same reasons as `parse_robot_file`.
    """
    new_values = dict(values)
    settings = {name: _check_setting(where, name, new_values.pop(name)) for name in SETTINGS if name in new_values}
    if CURVE & new_values.keys() and "battery.capacity" in new_values:  # scaled to one cell, unless stated otherwise
        settings.setdefault("battery.capacity_curve", new_values["battery.capacity"])
    parameters = params.parameters_by_name(robot)
    refused: dict[str, list[str]] = {}
    for name, value in new_values.items():
        if why := _refusal_reason(name, value, parameters):
            refused.setdefault(why, []).append(name)
    if refused:
        sentences = [f"{list_some(names, 80)}: {why}" for why, names in refused.items()]
        if len(sentences) > 1:  # without the allowed names, one message holds all of them
            sentences = [sentence.partition(" allowed: ")[0] for sentence in sentences]
        raise BadConfiguration(f"{where}, {'; also '.join(sentences)}")
    robot = params.replace(robot, {name: jnp.asarray(value, float) for name, value in new_values.items()})
    priors = tuple((name, float(new_values.get(name, mean)), sd) for name, mean, sd in robot.rig.priors)
    rig = replace(robot.rig, priors=priors)  # centred on the new values
    robot = replace(robot, sides=settings.pop("sides", robot.sides), rig=rig)
    for name, value in settings.items():
        part, _, key = name.partition(".")
        robot = replace(robot, **{part: replace(getattr(robot, part), **{key: value})})
    _check_pairs(robot, where)
    return _add_required_states(robot, where)


def battery_remarks(robot: Robot, changed: Collection[str], where: str) -> Names:
    """Sentences on allowed but unlikely values of the battery, if a file or an option states them.

    Args:
        changed: names of the stated values.
        where: beginning of the sentences.
    """
    remarks = {}
    if "battery.voltage_cutoff" in changed:
        remarks["voltage_cutoff"] = power.cutoff_remark(robot.battery)
    if not (CURVE | {"battery.capacity_curve"}).isdisjoint(changed):
        remarks["curvature"] = power.curve_remark(robot.battery)
    return tuple(f"{where}, battery.{name}: {remark}" for name, remark in remarks.items() if remark)


def _refusal_reason(name: str, value: Any, known: Mapping[str, params.Parameter]) -> str:
    """Reason why a parameter value is rejected, empty if it is allowed."""
    if name not in known:
        return f"no such parameter; {_parameter_choices(name, known)}"
    spec = known[name].spec
    low, high = spec.bounds
    allowed = f"{low:g} to {high:g} {spec.unit} ({spec.meaning})"
    if not is_number(value):
        form = ', alone or with its standard deviation as "0.61 ± 0.03"' if isinstance(value, str) else ""
        return f"got {value!r}; expected a number, {allowed}{form}"
    if name == "gearbox.ratio" and 0 < value < 1:
        return f"got {value:g}; expected motor turns per output turn, at least 1; is {1 / value:g} meant?"
    if not math.isfinite(value) or not low <= value <= high:
        return f"got {value:g}; expected {allowed}"
    return ""


def _add_required_states(robot: Robot, where: str) -> Robot:
    """Robot with the states that its values require: two bodies for a compliant load, a lagged duty."""
    two_bodies = {name: load for name, load in robot.configurations.items() if load.has_two_bodies}
    for name, load in two_bodies.items():
        if not (float(robot.motor.inertia) > 0 and float(load.inertia) > 0):
            key, unit = ("backlash", "rad") if load.backlash > 0 else ("stiffness", "N·m/rad")
            raise BadConfiguration(
                f"{where}, {name}.{key}: got {float(getattr(load, key)):g} {unit}; motor and load can then move "
                f"relative to each other, so motor.inertia and {name}.inertia must be above 0"
            )
    controller = robot.controller
    if controller is not None:
        controller = replace(controller, lags=float(controller.lag) > 0)
        if controller.rate and controller.lags:
            raise BadConfiguration(
                f"{where}, controller.lag: got {float(controller.lag):g} s with rate = {controller.rate:g}; a held "
                "duty has no lag: leave one of them out"
            )
        if controller.samples_late not in (0, bool(controller.rate)):
            raise BadConfiguration(
                f"{where}, controller.samples_late: got {controller.samples_late:g} with rate = "
                f"{controller.rate:g}; expected 0, or with a rate 1"
            )
    return replace(robot, rig=replace(robot.rig, loose=bool(two_bodies)), controller=controller)


def _check_setting(where: str, name: str, value: Any) -> Any:
    """Checks and returns a count, a rating, a switch or a choice of a robot file."""
    allowed, _, meaning = SETTINGS[name]
    kind, text, number = type(allowed[0]), repr(value), ""
    if kind in (bool, str):
        is_allowed = isinstance(value, kind) and value in allowed
    else:
        number = "a whole number, " if kind is int else "a number, "
        is_allowed = is_number(value) and allowed[0] <= value <= allowed[-1] and value == kind(value)
        text = f"{value:g}" if kind is float and is_number(value) else text
    if not is_allowed:
        raise BadConfiguration(f"{where}, {name}: got {text}; expected {number}{allowed_setting(name)} ({meaning})")
    return kind(value)


def _parameter_choices(name: str, known: Collection[str]) -> str:
    """Parts and parameters to choose from, for the message about an unknown parameter."""
    head, parts = name.partition(".")[0], dict.fromkeys(n.partition(".")[0] for n in known)
    if head in parts:
        return allowed_words(name, [n for n in known if n.startswith(f"{head}.")])
    keys = ("base", "sides", "configurations", *rig_file.KEYS)
    return allowed_words(name, (*known, *keys), listed=(*parts, *keys))


def _check_pairs(robot: Robot, where: str) -> None:
    if robot.battery.voltage_cutoff >= robot.battery.voltage_charge:
        raise BadConfiguration(
            f"{where}, battery.voltage_cutoff: got {robot.battery.voltage_cutoff:g}; expected less than "
            f"voltage_charge, {robot.battery.voltage_charge:g} V"
        )
    if fault := power.cutoff_error(robot.battery):
        raise BadConfiguration(f"{where}, battery.voltage_cutoff: {fault}")
    for name, load in robot.configurations.items():
        if isinstance(load, Shaft):
            continue
        friction = load.ground.friction
        if friction.speed_dynamic <= friction.speed_static:
            raise BadConfiguration(
                f"{where}, {name}.ground.friction.speed_dynamic: got {float(friction.speed_dynamic):g}; "
                f"expected more than speed_static, {float(friction.speed_static):g} m/s"
            )
    for effect in robot.effects:
        values = params.values_by_name(effect)
        if effect.name in effects.UNNAMED and "low" in values and not values["low"] < values["high"]:
            raise BadConfiguration(
                f"{where}, effects.{effect.name}.high: got {values['high']:g}; expected more than low, "
                f"{values['low']:g}"
            )


def write_robot(robot: Robot, path: Path, *, note: str = "") -> None:
    """Writes a robot to a file, with unit, meaning and source of each number. `read_robot` restores it.

    For a robot without a base, parameters that it does not state are left out.
    """
    inherits, base_robot = robot.rig.inherits, paper_robots.nominal()
    if not inherits:
        defaults = {name: jnp.asarray(value) for name, (value, _) in rig_file.DEFAULTS.items()}
        base_robot = params.replace(paper_robots.blank_robot(robot.configurations), defaults)
    tables: dict[str, list[str]] = {"battery": [], "motor": [], "gearbox": []}
    if inherits or robot.battery.cells != base_robot.battery.cells:
        tables["battery"].append(f"cells = {robot.battery.cells}  # in series")
    head, rig_tables = rig_file.rig_lines(robot.rig)
    if (
        inherits
        and robot.has_ground
        and all(getattr(robot.rig, key) == getattr(base_robot.rig, key) for key in rig_file.KEYS)
    ):
        head, rig_tables = [], {}
    for name, load in robot.configurations.items():
        moves = "tracks" if float(load.on_tracks) > 0.5 else "wheels"
        tables[name] = ['load = "shaft"' if isinstance(load, Shaft) else f'movers = "{moves}"']
    for effect in robot.effects:
        table = tables[f"effects.{effect.name}"] = []
        if effect.configurations or type(effect)().configurations:
            table.append(f"configurations = {toml_value(effect.configurations)}  # in which it acts")
        if type(effect).plain is not None:
            table.append(f"{FACTORS} = {list(type(effect).factors)}  # sd, shape, limits: times the library's")
    for title, line in _lines_of_parameters(robot, base_robot):
        tables.setdefault(title, []).append(line)
    for title, line in _setting_lines(robot, base_robot, {name for name, lines in tables.items() if lines}):
        tables.setdefault(title, []).append(line)
    lines = [f"# {printable(line)}" for line in note.splitlines()]
    lines += [f'schema = "{SCHEMA}"', f'base = "{"nominal" if inherits else rig_file.NONE}"']
    lines += [f"sides = {int(robot.sides)}  # motors with the same command", *head]
    lines.append(f"configurations = {toml_value(list(robot.configurations))}")
    for title, table in {**tables, **rig_tables}.items():
        if inherits or table or title in robot.configurations:
            lines += ["", f"[{title}]", *table]
    write_text(path, "\n".join(lines) + "\n")


def _lines_of_parameters(robot: Robot, base_robot: Robot) -> Iterator[tuple[str, str]]:
    """Table and line of each parameter that a file must state because it differs from the base robot."""
    inherits, base_values = robot.rig.inherits, params.values_by_name(base_robot)
    required = {*rig_file.required_parameters(robot.rig, params.values_by_name(robot))}
    required |= {*base_robot.rig.unknown} - {*robot.rig.unknown}
    required |= frozenset() if inherits else robot.rig.stated
    sds = {(name, mean): sd for name, mean, sd in robot.rig.priors}
    stated_prefixes = (*(f"{name}." for name in robot.configurations), "effects.")
    for parameter in params.walk_parameters(robot):
        name, spec, value = parameter.name, parameter.spec, float(parameter.value)
        table, _, key = name.rpartition(".")
        if table.startswith("rig."):  # the start of a table's runs is no property of the robot
            continue
        base_value = base_values.get(name, 0.0 if table.startswith("effects.") else None)
        is_needed = value != base_value or name in required or name.startswith(stated_prefixes)
        if not is_needed and (not inherits or table == "rig"):
            continue
        origin = ""
        if inherits and base_value is not None:
            origin = f"; {spec.source}" if value == base_value else f"; nominal {base_value:g}: {spec.source}"
        text, sd = repr(value), sds.get((name, value))  # unless the prior's centre was changed
        if sd is not None:
            text = f'"{value!r} ± {sd!r}"'
        yield table, f"{key} = {text}  # [{spec.unit}] {spec.meaning}{origin}"


def _setting_lines(robot: Robot, base_robot: Robot, tables: set[str]) -> Iterator[tuple[str, str]]:
    """Table and line of each rating, switch and choice that differs from those of the base robot.

    Args:
        tables: tables that already have an entry.
    """
    for name, (allowed, unit, meaning) in SETTINGS.items():
        part, _, key = name.partition(".")
        if isinstance(allowed, range):
            continue
        setting, base_setting = (getattr(getattr(owner, part), key, None) for owner in (robot, base_robot))
        is_needed = setting != base_setting or (robot.rig.inherits and not isinstance(allowed[0], str))
        is_needed |= key == "capacity_curve" and part in tables  # otherwise it would follow from the capacity
        if setting is None or not is_needed:
            continue
        tables = tables | {part}
        comment = f"[{unit}] {meaning if robot.rig.inherits else meaning.partition(';')[0]}" if unit else meaning
        yield part, f"{key} = {toml_value(setting)}  # {comment}"
