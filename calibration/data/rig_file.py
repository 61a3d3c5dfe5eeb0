"""Entries of a robot file that describe a rig: its loads, imposed quantity, channels, columns and instruments."""

from __future__ import annotations

import dataclasses
import difflib
import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from calibration.data import Json, Names
from calibration.data.columns import Layout
from calibration.data.input_errors import (
    BadConfiguration,
    allowed_words,
    is_number,
    stated_as,
    stated_names,
    stated_word,
)
from calibration.data.writing import toml_value
from mmrjax.model import channels, params
from mmrjax.model.paper_robots import DYNAMIC_SHARE
from mmrjax.model.rig import BETWEEN, IMPOSED, STARTS, Instrument, Rig
from mmrjax.model.robot import Robot
from mmrjax.model.signals import GRAVITY

#: Word for a robot without a base.
NONE = "none"
#: Keys and tables of a robot file that state the rig.
KEYS = ("imposed", "channels", "start", "between_rows", "columns", "instruments", "surfaces")
#: Quantities that may be imposed, by their short names: `current` for `motor_current`.
SHORT = {word.removeprefix("motor_"): word for word in IMPOSED}
#: Kinds of configurations.
LOADS = ("shaft", "linear", "vehicle")

#: Keys of a linear unit: unit and meaning. It has a lead or a drum.
LINEAR = {
    "mass_kg": "mass that it moves",
    "lead_mm": "travel of one turn of the output",
    "drum_radius_mm": "radius of the drum or pulley, instead of the lead",
    "force_coulomb_N": "dry friction of guide and screw",
    "force_viscous_N_s_m": "viscous friction of guide and screw",
    "force_constant_N": "constant force against forward travel",
    "incline_deg": "slope that forward travel climbs, positive uphill",
    "inertia": "inertia of parts that turn with the output, without the mass [kg·m^2]",
}
_TRAVEL = ("lead_mm", "drum_radius_mm")
_LEAST = {"mass_kg", *_TRAVEL}  # must be greater than 0

#: Default values of a robot without a base, each with its reason. It has no limits and no other losses
#: (`robots.blank`).
DEFAULTS: dict[str, tuple[float, str]] = {
    "motor.inertia": (0.0, "not stated: only the load's inertia counts; histories from rest need the motor's"),
    "battery.current_other": (0.0, "not stated: no other consumers on the battery"),
}
#: Time constant L / R assumed if the inductance is not stated [s]. Small motors have 0.05 to 1 ms.
WINDING = 2e-4
#: The same without a voltage in the log. An imposed current then follows its column at once. Its lateness is in the
#: rig's delay.
WINDING_AT_ONCE = 1e-6
WINDING_WHY = f"not stated: assumed, {1e3 * WINDING:g} ms of the resistance"
#: The same for a vehicle, below its configuration.
VEHICLE: dict[str, tuple[float, str]] = {
    "track.loss_coulomb": (0.0, "not stated: wheels have no loss except rolling resistance"),
    "track.loss_viscous": (0.0, "not stated: no loss that rises with speed"),
    "track.guide_friction": (0.0, "not stated: no guide friction"),
    "track.guide_share": (0.0, "not stated: pulleys or wheels carry all of the weight"),
    "ground.friction.speed_static": (
        0.02,
        "not stated: assumed; a contact creeps at up to this speed while it grips",
    ),
    "ground.friction.speed_dynamic": (0.2, "not stated: assumed, ten times speed_static"),
    "turning.width": (0.0, "not stated: only a robot that turns needs it"),
    "turning.lateral": (1.0, "not stated: assumed equal to friction along the travel"),
    "turning.rule": (1.0, "not stated: assumed, friction opposite to the sliding velocity"),
    "turning.inertia": (0.0, "not stated: only a robot that turns needs it"),
}
#: Further required parameters of a vehicle that states its width and can therefore turn.
WIDTH, WHEELBASE = "turning.width", "running_gear.wheelbase"
#: Parameters whose default value is an example, and the reason.
CENTRE, CENTRE_WHY = "running_gear.centre_height", "not stated: an example value; it shifts load in turns"
#: Parameters of VEHICLE that tracked vehicles must state.
_OF_TRACKS = ("track.loss_coulomb",)
DYNAMIC = "ground.friction.dynamic"
#: Default mass of the wheels, as disks, as a share of the vehicle's mass. Simulations over time need an inertia of
#: the shaft. This one is small compared with the mass.
WHEELS = 0.05
#: Reasons for default values of a vehicle that follow from other stated values.
FOLLOWS = {
    DYNAMIC: f"not stated: assumed, {DYNAMIC_SHARE:g} of static",
    "inertia": f"not stated: assumed, disk wheels with {100 * WHEELS:g} % of the mass",
}


def linear_to_shaft(table: Json, name: str, where: str, sds: dict[str, float], sides: float) -> None:
    """Converts the table of a linear unit, and its standard deviations, into the table of a shaft for one of its
    drives.

    Travel per radian r is lead / 2π or the radius of the drum. With n drives, each drive has

        J = J_0 + m r² / n,  M_0 = F_0 r / n.  K = b r² / n,  M_c = (F_c + m g sin α) r / n.

    The standard deviations are first order for independent inputs. Exact inputs give exact values.

    Args:
        table: table of the configuration `name`, without `load`.
        where: beginning of the error message.
        sds: stated standard deviations, by dotted name.
        sides: number of drives that move it together.

    Raises:
        BadConfiguration: a key is unknown, a value is no number, the mass is missing, lead and drum are both given or
            both missing, or one of these is not positive.
    """
    for key in table:
        stated_word(key, LINEAR, f"{where}.{key}", "no such key of a linear unit")
    values = {key: _linear_value(table, key, where) for key in table}
    travels = [key for key in _TRAVEL if key in values]
    if len(travels) != 1:
        raise BadConfiguration(
            f"{where}: got {' and '.join(travels) or 'neither lead_mm nor drum_radius_mm'}; expected one of the two"
        )
    if "mass_kg" not in values:
        raise BadConfiguration(f"{where}.mass_kg: missing; expected the mass that it moves [kg]")
    table.clear()
    table.update(_shaft_of_linear_unit(values, sides))
    inputs = {key: sds.pop(f"{name}.{key}") for key in values if f"{name}.{key}" in sds}
    exact = {key for key, sd in inputs.items() if sd == 0}
    for result in table:
        shaft_values = {
            key
            for key in values
            if _shaft_of_linear_unit({**values, key: 1.01 * values[key] + 1e-6}, sides)[result] != table[result]
        }
        if shaft_values and shaft_values <= exact:
            sds[f"{name}.{result}"] = 0.0
            continue
        steps = [
            _shaft_of_linear_unit({**values, key: values[key] + sd}, sides)[result] - table[result]
            for key, sd in inputs.items()
        ]
        sd = math.hypot(*steps)
        if sd > 0:
            sds[f"{name}.{result}"] = float(f"{sd:.12g}")


def _linear_value(table: Mapping[str, Any], key: str, where: str) -> float:
    value = table[key]
    if not is_number(value) or not math.isfinite(value) or (key in _LEAST and value <= 0):
        expected = "a number above 0" if key in _LEAST else "a number"
        raise BadConfiguration(f"{where}.{key}: got {value!r}; expected {expected} ({LINEAR[key]})")
    return float(value)


def _shaft_of_linear_unit(at: Mapping[str, float], sides: float) -> dict[str, float]:
    travel = (at["lead_mm"] / (2 * math.pi) if "lead_mm" in at else at["drum_radius_mm"]) * 1e-3
    weight = at["mass_kg"] * GRAVITY * math.sin(math.radians(at.get("incline_deg", 0.0)))
    return {
        "inertia": at.get("inertia", 0.0) + at["mass_kg"] * travel**2 / sides,
        "loss_coulomb": at.get("force_coulomb_N", 0.0) * travel / sides,
        "loss_viscous": at.get("force_viscous_N_s_m", 0.0) * travel**2 / sides,
        "torque_constant": (at.get("force_constant_N", 0.0) + weight) * travel / sides,
        "radius": travel,
    }


def vehicle_defaults(on_tracks: bool, table: Mapping[str, Any], sides: float) -> dict[str, float]:
    """Default values of a vehicle in a robot file without a base.

    Args:
        table: table of the vehicle in the file.
        sides: number of drives that move it together.
    """

    def stated_value(*keys: str) -> float:
        entry: Any = table
        for key in keys:
            entry = entry.get(key) if isinstance(entry, Mapping) else None
        return float(entry) if is_number(entry) else 0.0  # a value that is no number is rejected later

    defaults = {name: value for name, (value, _) in VEHICLE.items() if not (on_tracks and name in _OF_TRACKS)}
    wheels = 0.5 * WHEELS * stated_value("mass") * stated_value("radius") ** 2 / sides
    return defaults | {DYNAMIC: DYNAMIC_SHARE * stated_value(*DYNAMIC.split(".")[:-1], "static"), "inertia": wheels}


def parse_rig(content: Json, where: str, loads: Sequence[str], *, travels: bool, inherits: bool) -> Rig:
    """Rig that a robot file describes. Its keys (`KEYS`) are removed from `content`.

    Args:
        content: content of the file.
        where: beginning of the error message.
        loads: names of the configurations.
        travels: true if the travel of the loads can be measured.
        inherits: true if the robot has a base.

    Raises:
        BadConfiguration: a word, channel or column is unknown, a channel is imposed, or an instrument belongs to a
            channel that the rig does not have.
    """
    imposed_name = content.pop("imposed", IMPOSED[0])
    imposed = stated_word(
        SHORT.get(imposed_name, imposed_name) if isinstance(imposed_name, str) else imposed_name,
        IMPOSED,
        f"{where}, imposed",
    )
    start = stated_word(content.pop("start", STARTS[0]), STARTS, f"{where}, start")
    between = stated_word(content.pop("between_rows", BETWEEN[0]), BETWEEN, f"{where}, between_rows")
    usual = [name for name in channels.USUAL if travels or name != "speed"]
    names = _parse_channels(content.pop("channels", [n for n in usual if n != imposed]), f"{where}, channels")
    if idle := {imposed, f"{imposed}_left", f"{imposed}_right"} & set(names):
        raise BadConfiguration(
            f"{where}, channels: {min(idle)} is imposed, so it cannot be a reading; remove it, or set imposed = "
            f'"{next(word for word in IMPOSED if word != imposed)}"'
        )
    return Rig(
        imposed=imposed,
        channels=names,
        instruments=_parse_instruments(content.pop("instruments", {}), names, where),
        columns=_parse_columns(content.pop("columns", {}), where),
        start=start,
        between_rows=between,
        surfaces=_parse_surfaces(content.pop("surfaces", {}), loads, where),
        inherits=inherits,
    )


def _parse_channels(stated: Any, where: str) -> Names:
    channel_names = channels.channel_names(channels.EVERY)
    stated_names(stated, where, f"a list of channels, at least one of {', '.join(channel_names)}")
    for name in stated:
        stated_word(name, channel_names, where)
        if stated.count(name) > 1:
            raise BadConfiguration(f"{where}: {name} is repeated; expected each channel once")
    return tuple(name for name in channel_names if name in stated)


def _parse_surfaces(stated: Any, loads: Sequence[str], where: str) -> tuple[tuple[str, str], ...]:
    table_place = f"{where}, surfaces"
    for name, other in stated_as(stated, dict, table_place, "a table [surfaces]").items():
        for word in (name, other):
            stated_word(word, loads, f"{table_place}.{name}")
    return tuple(stated.items())


#: Word for an instrument property that is inferred from its table.
FREE = "free"


def _parse_instruments(stated: Any, names: Sequence[str], where: str) -> tuple[Instrument, ...]:
    table_place = f"{where}, instruments"
    instruments = []
    for name, table in stated_as(stated, dict, table_place, f"tables such as [instruments.{names[0]}]").items():
        stated_word(name, names, f"{table_place}.{name}", "the rig has no such channel")
        for key in stated_as(table, dict, f"{table_place}.{name}", f"a table [instruments.{name}]"):
            stated_word(key, ("signed", "quantum"), f"{table_place}.{name}.{key}", "no such key")
        signed, quantum = table.get("signed", True), table.get("quantum", 0.0)
        channel = channels.find_channel(name)
        if not isinstance(signed, bool) and signed != FREE:
            raise BadConfiguration(
                f"{table_place}.{name}.signed: got {signed!r}; expected true, false (shows only the magnitude), or "
                f"{FREE!r} (decided from the table)"
            )
        if quantum != FREE and not (is_number(quantum) and 0 <= quantum < math.inf):
            raise BadConfiguration(
                f"{table_place}.{name}.quantum: got {quantum!r}; expected the resolution of its readings, 0 or more "
                f"{channel.unit}, or {FREE!r} (decided from the table)"
            )
        step = None if quantum == FREE else float(quantum) * channel.factor
        instruments.append(Instrument(name, None if signed == FREE else signed, step))
    return tuple(instruments)


def _parse_columns(stated: Any, where: str) -> tuple[tuple[str, str, float], ...]:
    table_place = f"{where}, columns"
    stated_as(stated, dict, table_place, "a table [columns]")
    layout, entries = Layout(channels=channels.EVERY), []
    spellings = layout.spellings()
    for own_column, logger_column in stated.items():
        if own_column not in spellings:
            names_text = allowed_words(own_column, spellings, shown=layout.known())
            raise BadConfiguration(
                f"{table_place}.{own_column}: no such column of a table; {names_text}; also in other units"
            )
        table = {"column": logger_column} if isinstance(logger_column, str) else logger_column
        if not isinstance(table, dict) or not isinstance(table.get("column"), str) or {*table} - {"column", "factor"}:
            raise BadConfiguration(
                f'{table_place}.{own_column}: got {logger_column!r}; expected {own_column} = "LOGGER COLUMN", or '
                f'{own_column} = {{column = "LOGGER COLUMN", factor = 0.001}}'
            )
        factor = table.get("factor", 1.0)
        if not is_number(factor) or not math.isfinite(factor) or not factor:
            raise BadConfiguration(
                f"{table_place}.{own_column}.factor: got {factor!r}; expected a number that is not 0"
            )
        entries.append((own_column, table["column"], float(factor)))
    return tuple(entries)


def required_parameters(rig: Rig, values: Iterable[tuple[str, Any]]) -> Names:
    """Parameters that a robot file without a base must state: those of its drive and, if it turns, of turning.

    Args:
        values: values of the robot's parameters, by dotted name.
    """
    turns = any(name.endswith(WIDTH) and is_number(value) and value > 0 for name, value in values)
    current = {"total_current", "motor_current", "winding_temperature"} & {*rig.channels, rig.imposed}
    voltage = rig.shows_voltage
    has_temperature = "winding_temperature" in rig.channels
    conditions: tuple[tuple[str, Any], ...] = (
        ("controller.kp", rig.follows_goal),
        ("gearbox.ratio", True),
        ("gearbox.efficiency_load", True),
        ("motor.torque_constant", current or voltage),
        ("motor.resistance", voltage or has_temperature),
        ("motor.resistance_thermal_winding", has_temperature),
        ("motor.resistance_thermal_housing", has_temperature),
        (WHEELBASE, turns),
    )
    return tuple(name for name, is_needed in conditions if is_needed)


def reject_missing(
    missing: Sequence[str], known: Mapping[str, params.Parameter], where: str, given: Iterable[str]
) -> None:
    """Rejects a robot file without a base that does not state all required parameters.

    Args:
        missing: names of the missing parameters.
        known: names of all parameters of the robot.
        given: names that the file states, one of which may be misspelt.

    Raises:
        BadConfiguration: a parameter is missing. One sentence lists all of them.
    """
    if missing:
        names_with_units = ", ".join(f"{name} [{known[name].spec.unit}]" for name in missing)
        verb = "is" if len(missing) == 1 else "are"
        strange = [name for name in given if name not in known]
        near = [(x, name) for name in missing for x in difflib.get_close_matches(name, strange, 1, 0.85)]
        misspelt = "".join(f"; is {x} meant to be {name}?" for x, name in near)
        raise BadConfiguration(
            f'{where}: {names_with_units} {verb} missing; a robot with base = "none" needs every parameter '
            f"(mmrjax rig new writes them){misspelt}"
        )


def with_priors(robot: Robot, sds: Mapping[str, float], where: str) -> Robot:
    """The robot with a prior for each value whose sd its file states, centred on the value.

    Args:
        sds: standard deviations by dotted name [SI].
        where: name of the file for messages.

    Raises:
        BadConfiguration: an sd is given for something that is not a parameter.
    """
    parameters = params.parameters_by_name(robot)
    for name in sds:
        if name not in parameters:
            raise BadConfiguration(f"{where}, {name}: only parameters may have a ±; give the number without it")
    priors = tuple((name, float(p.value), sds[name]) for name, p in parameters.items() if name in sds)
    return dataclasses.replace(robot, rig=dataclasses.replace(robot.rig, priors=priors))


def recentre_priors(robot: Robot, values: Mapping[str, float]) -> Robot:
    """Robot whose stated priors are centred on new parameter values, with unchanged widths."""
    if not set(values) & {name for name, _, _ in robot.rig.priors}:
        return robot
    priors = tuple((name, float(values.get(name, mean)), sd) for name, mean, sd in robot.rig.priors)
    return dataclasses.replace(robot, rig=dataclasses.replace(robot.rig, priors=priors))


def rig_lines(rig: Rig) -> tuple[list[str], dict[str, list[str]]]:
    """Lines of a robot file that describe a rig: the first lines, then those of each table."""
    head = [
        f'imposed = "{rig.imposed}"  # what sets the drives, one of {", ".join(IMPOSED)}',
        f"channels = {toml_value(list(rig.channels))}  # what its instruments show",
        f'start = "{rig.start}"  # start of time histories: rest, measured or free',
        f'between_rows = "{rig.between_rows}"  # imposed quantity between rows of time histories: held or linear',
    ]
    tables: dict[str, list[str]] = {}
    if rig.columns:
        tables["columns"] = [
            f"{own_column} = {toml_value(logger_column)}"
            if factor == 1
            else f"{own_column} = {{column = {toml_value(logger_column)}, factor = {factor!r}}}"
            for own_column, logger_column, factor in rig.columns
        ]
    if rig.surfaces:
        tables["surfaces"] = ["# these differ only in their ground"]
        tables["surfaces"] += [f"{toml_value(name)} = {toml_value(other)}" for name, other in rig.surfaces]
    for instrument in rig.instruments:
        channel = channels.find_channel(instrument.channel)
        size = f'"{FREE}"' if instrument.quantum is None else repr(instrument.quantum / channel.factor)
        step = [f"quantum = {size}  # [{channel.unit}] step of its readings"]
        tables[f"instruments.{channel.name}"] = [
            f"signed = {toml_value(FREE if instrument.signed is None else instrument.signed)}",
            *([] if instrument.quantum == 0 else step),
        ]
    return head, tables


def value_text(name: str, value: float, rig: Rig) -> str:
    """Value of a parameter as written in a file, with ± if its prior is stated and the value is unchanged."""
    for prior_name, mean, sd in rig.priors:
        if prior_name == name and mean == value:
            return f'"{value!r} ± {sd!r}"'
    return repr(value)


def is_default_rig(rig: Rig) -> bool:
    """True if a rig is driven and measured like a robot whose file states no rig."""
    usual = Rig()
    return all(getattr(rig, key) == getattr(usual, key) for key in KEYS)
