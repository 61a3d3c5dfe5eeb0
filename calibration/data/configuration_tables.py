"""Configurations from the tables of a robot file and from the surfaces of runs.

Labels of Table 5 scale the adhesion of the paper's robots. Any other surface has its own friction. A surface without
stated friction becomes a separate configuration, named after configuration and label. Its `ground.*` parameters are
free, and all others follow the first configuration (`rig.surfaces`).
"""

from __future__ import annotations

import difflib
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import MISSING, fields, replace
from typing import Any, TypeVar

import equinox as eqx
import numpy as np

from calibration.data import Json, Names, rig_file
from calibration.data.columns import Layout
from calibration.data.input_errors import BadConfiguration, stated_as, stated_names, stated_word
from calibration.data.input_files import flat_table
from calibration.data.table import Runs, configuration_on_surface
from mmrjax.errors import allowed_words
from mmrjax.model import params
from mmrjax.model.chassis import Chassis
from mmrjax.model.contact import Friction, Ground, Track
from mmrjax.model.paper_tables import SURFACES
from mmrjax.model.robot import Configurations, Load, Robot
from mmrjax.model.shaft import Shaft

#: First part of the names of parameters that belong to a surface.
GROUND = "ground."
#: Similarity to a label of Table 5 above which a label counts as misspelt [-].
MISSPELT = 0.75

V = TypeVar("V")


def common_configuration(configurations: Sequence[str], labels: Iterable[str]) -> str | None:
    """The only configuration, or the one with all of these surfaces, otherwise None."""
    if len(configurations) == 1:
        return configurations[0]
    stems = [
        {c[: -len(end)] for c in configurations if c.endswith(end)}
        for end in (configuration_on_surface("", label) for label in labels)
    ]
    stem = set.intersection(*stems) if stems else set()
    return stem.pop() if len(stem) == 1 else None


def allowed_labels(label: str, layout: Layout) -> str:
    """Allowed labels, for the message about a wrong label. Empty if the label is allowed."""
    if not layout.inherits:
        return "" if label else "the name of a surface"
    if label in SURFACES:
        return ""
    similar = difflib.get_close_matches(label, SURFACES, 1, MISSPELT)
    return (
        f"one of these; {allowed_words(label, SURFACES)}" if not label or similar or not layout.configurations else ""
    )


def with_surface_configurations(robot: Robot, runs: Runs) -> Robot:
    """`robot` with a configuration for each surface of the table without a label of Table 5.

    If all surfaces of a configuration have such configurations, these replace it, unless there is only one surface.
    Priors that the robot's file states apply to the new configurations.
    """
    if not runs.has("surface") or not robot.has_ground:
        return robot
    pairs = dict.fromkeys(zip(runs["configuration"].tolist(), runs["surface"].tolist(), strict=True))
    members = dict(robot.configurations.items())
    labelled = SURFACES if robot.rig.scales_adhesion else ()
    leaders: dict[str, str] = {}
    for configuration in dict.fromkeys(c for c, _ in pairs):
        names = {label: configuration_on_surface(configuration, label) for c, label in pairs if c == configuration}
        separate = [name for label, name in names.items() if label not in labelled or name in members]
        existing = [name for name in separate if name in members]
        is_member = configuration in members
        if not separate or (not existing and (len(names) == 1 or not is_member)):
            continue
        is_kept = is_member and len(separate) < len(names)
        template = members[configuration if is_member else existing[0]]
        surface_loads = {name: members.get(name, template) for name in separate}
        if is_member and not is_kept:  # they replace the configuration
            parts = [surface_loads if name == configuration else {name: load} for name, load in members.items()]
            members = {name: load for part in parts for name, load in part.items()}
        else:
            members |= surface_loads
        first = configuration if is_kept else separate[0]
        leaders |= {name: first for name in surface_loads if name != first}
    rig = replace(robot.rig, surfaces=tuple(leaders.items()))
    robot = replace(robot, configurations=Configurations(members), rig=rig)
    priors = values_of_surface_configurations({name: (mean, sd) for name, mean, sd in rig.priors}, robot, runs)
    rig = replace(rig, priors=tuple((name, *value) for name, value in priors.items()))
    return replace(robot, rig=rig)


def values_of_surface_configurations(stated: Mapping[str, V], robot: Robot, runs: Runs) -> dict[str, V]:
    """Values stated by parameter, with replaced configurations renamed to the configurations of their surfaces.

    Args:
        robot: as returned by `with_surface_configurations`.
    """
    return {new: value for name, value in stated.items() for new in names_of_surfaces([name], robot, runs)}


def names_of_surfaces(names: Iterable[str], robot: Robot, runs: Runs) -> list[str]:
    """Names of parameters, with replaced configurations renamed to the configurations of their surfaces.

    A parameter of the ground becomes one parameter for each surface. Any other becomes that of the first surface.
    """
    new_names: list[str] = []
    for name in names:
        configuration, _, key = name.partition(".")
        rows = runs["configuration"] == configuration if runs.has("surface") else np.zeros(0, bool)
        if configuration in robot.configurations or not rows.any():
            new_names.append(name)
            continue
        surface_names = dict.fromkeys(configuration_on_surface(configuration, s) for s in runs["surface"][rows])
        existing = [n for n in surface_names if n in robot.configurations]
        new_names += [f"{n}.{key}" for n in existing[: None if key.startswith((GROUND, "*")) else 1]]
    return new_names


#: Kinds of movers, and the `on_tracks` of each.
MOVERS = {"tracks": 1.0, "wheels": 0.0}
#: Names that a configuration cannot have, because robot files use them as keys.
TAKEN = (
    "schema",
    "base",
    "sides",
    "configurations",
    "battery",
    "motor",
    "gearbox",
    "running_gear",
    "driver",
    "rig",
    "controller",
    "effects",
    *rig_file.KEYS,
)
_KINDS = ("load", "like", "movers")
_EXAMPLE = 'configurations = ["rover"]'


def loads_from_tables(
    base: Robot | None, content: Json, sds: dict[str, float], where: str
) -> tuple[dict[str, Load], bool, frozenset[str], list[str]]:
    """Loads that a robot file states, in its order.

    It removes `configurations`, and each configuration's `load`, `like` and `movers`, from `content`, and replaces
    linear units by shafts. The remaining keys are parameters. Without `configurations`, a robot has the
    configurations of its base. Without a base, each table is a configuration.

    Args:
        base: base robot, whose configurations `like` may name. None: there is no base.
        content: content of the file.
        sds: stated standard deviations, by dotted name.
        where: beginning of the error message.

    Returns:
        Loads by name, in order, before the parameters that the file states are applied. True if the loads travel, as
        vehicles and linear units do. Names of linear units. Required parameters that the file does not state.

    Raises:
        BadConfiguration: `configurations` is no list of names, or has a repeated or reserved name. A table belongs to
            no configuration. `load`, `like` or `movers` is unknown, contradicts another key, or all are missing. The
            file has both shafts and vehicles. A robot with a base lacks a required parameter.
    """
    load_names = [n for n, table in content.items() if n not in TAKEN and isinstance(table, dict)]
    default_names = load_names if base is None else list(base.configurations)
    if not default_names and "configurations" not in content:
        raise BadConfiguration(
            f"{where}: no load is defined; add a table such as [bench] with load = one of {', '.join(rig_file.LOADS)}"
        )
    names = _configuration_names(content.pop("configurations", default_names), f"{where}, configurations")
    for name in load_names:
        if name not in names and set(_KINDS) & set(content[name]):
            base_hint = f', or set base = "{rig_file.NONE}" for a rig that is described completely in this file'
            raise BadConfiguration(
                f"{where}, {name}: not one of the configurations {', '.join(names)}; add it to configurations = "
                f"[...]{'' if base is None else base_hint}"
            )
    # An invalid number of drives is rejected later.
    sides = content.get("sides", 1.0 if base is None else float(base.sides))
    sides = float(sides) if isinstance(sides, int | float) and sides >= 1 else 1.0
    loads: dict[str, Load] = {}
    missing: list[str] = []
    linear: set[str] = set()
    for name in names:
        table_place = f"{where}, {name}"
        table = stated_as(content.get(name, {}), dict, table_place, f"a table [{name}]")
        kind, lacking = _load_kind(table, table_place), list[str]()
        if kind == "linear":
            rig_file.linear_to_shaft(table, name, table_place, sds, sides)
            linear.add(name)
        if kind != "vehicle":
            loads[name] = Shaft(inertia=0.0, loss_coulomb=0.0)
            lacking = _missing_parameters(loads[name], table)
        elif base is None:
            loads[name], lacking = _blank_vehicle(table, table_place, sides)
        else:
            loads[name] = _chassis_of_base(base, name, table, table_place)
        if base is not None:
            _reject_incomplete(f"{table_place}: without a base, the load must be described completely", lacking)
        missing += [f"{name}.{key}" for key in lacking]
    shafts = [name for name, load in loads.items() if isinstance(load, Shaft)]
    vehicles = [name for name in names if name not in shafts]
    if shafts and vehicles:
        raise BadConfiguration(
            f"{where}: {shafts[0]} is a shaft and {vehicles[0]} a vehicle; a file can describe only one kind; use "
            "two files"
        )
    return loads, not shafts or bool(linear), frozenset(linear), missing


def resolve_likes(content: Json, where: str) -> None:
    """Replaces each `like` of a file without a base by the table that it names.

    Raises:
        BadConfiguration: a `like` names no other table, or a table that has a `like` itself.
    """
    tables = {n: dict(table) for n, table in content.items() if n not in TAKEN and isinstance(table, dict)}
    complete = [name for name, table in tables.items() if "like" not in table]
    for name, table in tables.items():
        if "like" in table:
            like = stated_word(table.pop("like"), complete, f"{where}, {name}.like")
            content[name] = _merge_tables(tables[like], table)


def _merge_tables(below: Json, above: Json) -> Json:
    """Two tables merged into one. Entries of `above` take precedence."""
    merged = below | above
    for key, value in below.items():
        if isinstance(value, dict) and isinstance(merged[key], dict):
            merged[key] = _merge_tables(value, merged[key])
    return merged


def _load_kind(table: Json, where: str) -> str:
    """Kind of load that a table states, a vehicle by default."""
    if "load" not in table:
        return "vehicle"
    load = stated_word(table.pop("load"), rig_file.LOADS, f"{where}.load")
    for key in ("like", "movers"):
        if load != "vehicle" and key in table:
            raise BadConfiguration(f"{where}: load = {load!r} and {key} contradict each other; keep one")
    if load == "vehicle" and "like" not in table:
        table.setdefault("movers", "wheels")
    return load


def _blank_vehicle(table: Json, where: str, sides: float) -> tuple[Chassis, list[str]]:
    """Vehicle before the parameters of its table are applied, and the required parameters that the table lacks."""
    if "movers" not in table:
        raise BadConfiguration(
            f"{where}: the kind of load is missing; set load = one of {', '.join(rig_file.LOADS)}, or movers = "
            f"one of {', '.join(MOVERS)}"
        )
    on_tracks = _parse_movers(table.pop("movers"), where)
    blank = Chassis(
        track=Track(loss_coulomb=0.0, loss_viscous=0.0, guide_share=0.0),
        ground=Ground(Friction(static=0.0, dynamic=0.0), rolling_resistance=0.0),
        on_tracks=on_tracks,
        mass=0.0,
        radius=0.0,
        inertia=0.0,
    )
    values = flat_table(table)
    defaults = rig_file.vehicle_defaults(on_tracks > 0.5, values, sides)
    missing = [p.name for p in params.walk_parameters(blank) if p.name not in {**defaults, **values}]
    return params.replace(blank, {name: params.as_float(value) for name, value in defaults.items()}), missing


def _parse_movers(stated: Any, where: str) -> float:
    return MOVERS[stated_word(stated, MOVERS, f"{where}.movers")]


def _reject_incomplete(beginning: str, missing: list[str]) -> None:
    if missing:
        verb = "are" if len(missing) > 1 else "is"
        raise BadConfiguration(f"{beginning}; {', '.join(missing)} {verb} missing")


def _configuration_names(stated: Any, where: str) -> Names:
    names = stated_names(stated, where, f"a list of at least one name, such as {_EXAMPLE}")
    for name in names:
        if names.count(name) > 1:
            raise BadConfiguration(f"{where}: {name} is listed {names.count(name)} times; name each once")
        if name in TAKEN:
            raise BadConfiguration(f"{where}: {name} has another meaning in robot files; choose a different name")
        if not re.fullmatch(r"[A-Za-z0-9_-]+", name):
            raise BadConfiguration(
                f"{where}: got {name!r}; expected letters, digits, underscores and hyphens, as {_EXAMPLE}"
            )
    return names


def _chassis_of_base(robot: Robot, name: str, table: Json, where: str) -> Chassis:
    """Configuration of a robot with a base, before the parameters of its table are applied."""
    like, movers = table.pop("like", None), table.pop("movers", None)
    configurations = robot.configurations
    if like is not None and movers is not None:
        raise BadConfiguration(f"{where}: like and movers contradict each other; give one of them")
    if like is not None:
        return configurations[stated_word(like, configurations.names, f"{where}.like")]
    if movers is not None:
        template = replace(configurations.members[0], on_tracks=_parse_movers(movers, where))
        _reject_incomplete(
            f"{where}: with movers instead of like, the configuration must be described completely",
            _missing_parameters(template, table),
        )
        return params.replace(
            template, {n: params.as_float(x) for n, x in _parameter_defaults(template) if x is not None}
        )
    if name in configurations:
        return configurations[name]
    raise BadConfiguration(
        f'{where}: the base has no such configuration; set like = "{configurations.names[0]}" (one of '
        f'{", ".join(configurations)}), or movers = "tracks" or "wheels" and its parameters'
    )


def _missing_parameters(component: eqx.Module, table: Json) -> list[str]:
    """Parameters of a component without a default that its table lacks."""
    values = flat_table(table)
    return [name for name, default in _parameter_defaults(component) if default is None and name not in values]


def _parameter_defaults(component: eqx.Module, prefix: str = "") -> Iterator[tuple[str, float | None]]:
    """Default of every parameter of a component, or None."""
    for field in fields(component):
        value = getattr(component, field.name)
        if "spec" in field.metadata:
            yield f"{prefix}{field.name}", None if field.default is MISSING else float(field.default)
        elif isinstance(value, eqx.Module):
            yield from _parameter_defaults(value, f"{prefix}{field.name}.")
