"""Entries of a robot file that describe a rig: its loads, imposed quantity, channels, columns and instruments."""

from __future__ import annotations

import difflib
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Any

from calibration.data import Json, Names, presets_file
from calibration.data.input_errors import (
    BadConfiguration,
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
_POSITIVE = {"mass_kg", *_TRAVEL}  # must be greater than 0

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
        BadConfiguration: a key is unknown, a value is no number, or the mass is missing. Also if lead and drum are
            both given or both missing, or mass, lead or drum is not positive.
    """
    for key, value in table.items():
        stated_word(key, LINEAR, f"{where}.{key}", "no such key of a linear unit")
        if not is_number(value) or not math.isfinite(value) or (key in _POSITIVE and value <= 0):
            expected = "a number above 0" if key in _POSITIVE else "a number"
            raise BadConfiguration(f"{where}.{key}: got {value!r}; expected {expected} ({LINEAR[key]})")
    values = {key: float(value) for key, value in table.items()}
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

    def change(result: str, key: str, step: float) -> float:
        return _shaft_of_linear_unit({**values, key: values[key] + step}, sides)[result] - float(table[result])

    for result in table:
        influences = {key for key in values if change(result, key, 0.01 * values[key] + 1e-6)}
        sd = math.hypot(*(change(result, key, sd) for key, sd in inputs.items()))
        if influences and all(inputs.get(key) == 0 for key in influences):
            sds[f"{name}.{result}"] = 0.0
        elif sd > 0:
            sds[f"{name}.{result}"] = float(f"{sd:.12g}")


def _shaft_of_linear_unit(values: Mapping[str, float], sides: float) -> dict[str, float]:
    travel = (values["lead_mm"] / (2 * math.pi) if "lead_mm" in values else values["drum_radius_mm"]) * 1e-3
    weight = values["mass_kg"] * GRAVITY * math.sin(math.radians(values.get("incline_deg", 0.0)))
    return {
        "inertia": values.get("inertia", 0.0) + values["mass_kg"] * travel**2 / sides,
        "loss_coulomb": values.get("force_coulomb_N", 0.0) * travel / sides,
        "loss_viscous": values.get("force_viscous_N_s_m", 0.0) * travel**2 / sides,
        "torque_constant": (values.get("force_constant_N", 0.0) + weight) * travel / sides,
        "radius": travel,
    }


def vehicle_defaults(on_tracks: bool, values: Mapping[str, Any], sides: float) -> dict[str, float]:
    """Default values of a vehicle in a robot file without a base.

    Args:
        values: values that its table states, by dotted name. One that is no number is rejected later.
        sides: number of drives that move it together.
    """
    mass, radius, static = (
        float(values[key]) if is_number(values.get(key)) else 0.0
        for key in ("mass", "radius", "ground.friction.static")
    )
    defaults = {name: value for name, (value, _) in VEHICLE.items() if not (on_tracks and name in _OF_TRACKS)}
    return defaults | {DYNAMIC: DYNAMIC_SHARE * static, "inertia": 0.5 * WHEELS * mass * radius**2 / sides}


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

    def pop_word(key: str, words: Sequence[str]) -> str:
        value = content.pop(key, words[0])
        if key == "imposed" and isinstance(value, str):
            value = SHORT.get(value, value)
        return stated_word(value, words, f"{where}, {key}")

    imposed = pop_word("imposed", IMPOSED)
    start = pop_word("start", STARTS)
    between = pop_word("between_rows", BETWEEN)
    default_channels = [name for name in channels.USUAL if name != imposed and (travels or name != "speed")]
    place = f"{where}, channels"
    all_channels = channels.channel_names(channels.EVERY)
    expected = f"a list of channels, at least one of {', '.join(all_channels)}"
    stated_channels = stated_names(content.pop("channels", default_channels), place, expected)
    for name in stated_channels:
        stated_word(name, all_channels, place)
        if stated_channels.count(name) > 1:
            raise BadConfiguration(f"{place}: {name} is repeated; expected each channel once")
    names = tuple(name for name in all_channels if name in stated_channels)
    if imposed_channels := {imposed, f"{imposed}_left", f"{imposed}_right"} & set(names):
        raise BadConfiguration(
            f"{place}: {min(imposed_channels)} is imposed, so it cannot be a reading; remove it, or set imposed = "
            f'"{next(word for word in IMPOSED if word != imposed)}"'
        )
    columns = stated_as(content.pop("columns", {}), dict, f"{where}, columns", "a table [columns]")
    surfaces = stated_as(content.pop("surfaces", {}), dict, f"{where}, surfaces", "a table [surfaces]")
    for name, other in surfaces.items():
        for load in (name, other):
            stated_word(load, loads, f"{where}, surfaces.{name}")
    return Rig(
        imposed=imposed,
        channels=names,
        instruments=_parse_instruments(content.pop("instruments", {}), names, f"{where}, instruments"),
        columns=tuple(
            (c.column, c.source_columns[0], c.factor)
            for c in presets_file.parse_columns(columns, where, ("column", "factor"))
        ),
        start=start,
        between_rows=between,
        surfaces=tuple(surfaces.items()),
        inherits=inherits,
    )


#: Word for an instrument property that is inferred from its table.
FREE = "free"


def _parse_instruments(stated: Any, names: Sequence[str], where: str) -> tuple[Instrument, ...]:
    instruments = []
    for name, table in stated_as(stated, dict, where, f"tables such as [instruments.{names[0]}]").items():
        place = f"{where}.{name}"
        stated_word(name, names, place, "the rig has no such channel")
        for key in stated_as(table, dict, place, f"a table [instruments.{name}]"):
            stated_word(key, ("signed", "quantum"), f"{place}.{key}", "no such key")
        signed, quantum = table.get("signed", True), table.get("quantum", 0.0)
        channel = channels.find_channel(name)
        if not isinstance(signed, bool) and signed != FREE:
            raise BadConfiguration(
                f"{place}.signed: got {signed!r}; expected true, false (shows only the magnitude), or {FREE!r} "
                "(decided from the table)"
            )
        if quantum != FREE and not (is_number(quantum) and 0 <= quantum < math.inf):
            raise BadConfiguration(
                f"{place}.quantum: got {quantum!r}; expected the resolution of its readings, 0 or more "
                f"{channel.unit}, or {FREE!r} (decided from the table)"
            )
        quantum_si = None if quantum == FREE else float(quantum) * channel.factor
        instruments.append(Instrument(name, None if signed == FREE else signed, quantum_si))
    return tuple(instruments)


def required_parameters(rig: Rig, values: Mapping[str, Any]) -> Names:
    """Parameters that a robot file without a base must state: those of its drive and, if it turns, of turning.

    Args:
        values: values of the robot's parameters, by dotted name.
    """
    turns = any(name.endswith(WIDTH) and is_number(value) and value > 0 for name, value in values.items())
    current = {"total_current", "motor_current", "winding_temperature"} & {*rig.channels, rig.imposed}
    has_temperature = "winding_temperature" in rig.channels
    is_needed = {
        "controller.kp": rig.follows_goal,
        "gearbox.ratio": True,
        "gearbox.efficiency_load": True,
        "motor.torque_constant": current or rig.shows_voltage,
        "motor.resistance": rig.shows_voltage or has_temperature,
        "motor.resistance_thermal_winding": has_temperature,
        "motor.resistance_thermal_housing": has_temperature,
        WHEELBASE: turns,
    }
    return tuple(name for name, needed in is_needed.items() if needed)


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
        unknown = [name for name in given if name not in known]
        likely = [
            (given_name, name) for name in missing for given_name in difflib.get_close_matches(name, unknown, 1, 0.85)
        ]
        misspelt = "".join(f"; is {given_name} meant to be {name}?" for given_name, name in likely)
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
    return replace(robot, rig=replace(robot.rig, priors=priors))


def rig_lines(rig: Rig) -> tuple[list[str], dict[str, list[str]]]:
    """Lines of a robot file that describe a rig: the first lines, then those of each table."""
    head = [
        f'imposed = "{rig.imposed}"  # what sets the drives, one of {", ".join(IMPOSED)}',
        f"channels = {toml_value(list(rig.channels))}  # what its instruments show",
        f'start = "{rig.start}"  # start of time histories: rest, measured or free',
        f'between_rows = "{rig.between_rows}"  # imposed quantity between rows of time histories: held or linear',
    ]
    tables: dict[str, list[str]] = {}
    for column, source_column, factor in rig.columns:
        entry = toml_value(source_column)
        if factor != 1:
            entry = f"{{column = {entry}, factor = {factor!r}}}"
        tables.setdefault("columns", []).append(f"{column} = {entry}")
    for name, other in rig.surfaces:
        lines = tables.setdefault("surfaces", ["# these differ only in their ground"])
        lines.append(f"{toml_value(name)} = {toml_value(other)}")
    for instrument in rig.instruments:
        channel = channels.find_channel(instrument.channel)
        lines = tables[f"instruments.{channel.name}"] = [
            f"signed = {toml_value(FREE if instrument.signed is None else instrument.signed)}"
        ]
        if instrument.quantum != 0:
            quantum = FREE if instrument.quantum is None else instrument.quantum / channel.factor
            lines.append(f"quantum = {toml_value(quantum)}  # [{channel.unit}] step of its readings")
    return head, tables
