"""Configurations of a robot from the tables of its file: which there are, and what each starts from."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Iterator, Mapping
from typing import Any

import equinox as eqx

from calibration.data.errors import BadConfiguration, choices
from mmrjax import params
from mmrjax.chassis import Chassis
from mmrjax.robot import Configurations, Robot

#: What a configuration moves on, and its `on_tracks`.
MOVERS = {"tracks": 1.0, "wheels": 0.0}
#: Names that a configuration cannot have: the other keys of a robot file.
TAKEN = ("schema", "base", "sides", "configurations", "battery", "motor", "gearbox", "effects")
_EXAMPLE = 'configurations = ["rover"]'


def configured(robot: Robot, content: dict[str, Any], where: str) -> Robot:
    """`robot` with the configurations that the file's content states, in its order.

    Takes `configurations` and every configuration's `like` and `movers` out of `content`; what is left are
    parameters. Without `configurations` the robot keeps its own.

    Args:
        robot: the base; `like` names one of its configurations.
        where: opens the message of an error.

    Raises:
        BadConfiguration: no list of names, a name twice or one that cannot be, a table that is no configuration's, an
            unknown `like` or `movers`, both of them or neither, or a parameter without default that is not stated.
    """
    names = _names(content.pop("configurations", list(robot.configurations)), where)
    for name, table in content.items():
        if name not in (*names, *TAKEN) and isinstance(table, dict) and {"like", "movers"} & set(table):
            raise BadConfiguration(
                f"{where}, {name}: not among the configurations, {', '.join(names)}; add it to configurations = [...]"
            )
    return dataclasses.replace(
        robot, configurations=Configurations({name: _chassis(robot, name, content, where) for name in names})
    )


def _names(stated: Any, where: str) -> list[str]:
    where = f"{where}, configurations"
    if not isinstance(stated, list) or not stated or not all(isinstance(name, str) for name in stated):
        raise BadConfiguration(f"{where}: got {stated!r}; expected a list of names, at least one, as {_EXAMPLE}")
    for name in stated:
        if stated.count(name) > 1:
            raise BadConfiguration(f"{where}: {name} stands {stated.count(name)} times; name each once")
        if name in TAKEN:
            raise BadConfiguration(f"{where}: {name} is the name of something else in a robot file; choose another")
        if not re.fullmatch(r"[A-Za-z0-9_-]+", name):
            raise BadConfiguration(
                f"{where}: got {name!r}; expected letters, digits, underscores and hyphens, as {_EXAMPLE}"
            )
    return stated


def _chassis(robot: Robot, name: str, content: Mapping[str, Any], where: str) -> Chassis:
    """What a configuration starts from, before the parameters that its table states."""
    table, where = content.get(name, {}), f"{where}, {name}"
    if not isinstance(table, dict):
        raise BadConfiguration(f"{where}: got {table!r}; expected a table [{name}]")
    like, movers = table.pop("like", None), table.pop("movers", None)
    have = robot.configurations
    if like is not None and movers is not None:
        raise BadConfiguration(f"{where}: states both like and movers; state one of them")
    if like is not None:
        if like not in have.names:
            raise BadConfiguration(f"{where}.like: got {like}; {choices(str(like), have)}")
        return have[like]
    if movers is not None:
        if movers not in MOVERS:
            raise BadConfiguration(f"{where}.movers: got {movers}; {choices(str(movers), MOVERS)}")
        return _blank(have.members[0], MOVERS[movers], table, where)
    if name in have:
        return have[name]
    raise BadConfiguration(
        f'{where}: the base has no such configuration; state like = "{have.names[0]}" (one of {", ".join(have)}), or '
        'movers = "tracks" or "wheels" and its parameters'
    )


def _blank(pattern: Chassis, on_tracks: float, table: Mapping[str, Any], where: str) -> Chassis:
    """A chassis with defaults where its fields have them; the table has to state all others."""
    defaults = dict(_defaults(pattern))
    missing = [name for name, default in defaults.items() if default is None and not _states(table, name)]
    if missing:
        raise BadConfiguration(
            f"{where}: movers without like starts from nothing; {', '.join(missing)} "
            f"{'are' if len(missing) > 1 else 'is'} missing"
        )
    known = {name: params.as_float(default) for name, default in defaults.items() if default is not None}
    return params.replace(dataclasses.replace(pattern, on_tracks=on_tracks), known)


def _defaults(component: eqx.Module, prefix: str = "") -> Iterator[tuple[str, float | None]]:
    """Default of every parameter below a component, None where it has none."""
    for field in dataclasses.fields(component):
        value = getattr(component, field.name)
        if "spec" in field.metadata:
            yield f"{prefix}{field.name}", None if field.default is dataclasses.MISSING else float(field.default)
        elif isinstance(value, eqx.Module):
            yield from _defaults(value, f"{prefix}{field.name}.")


def _states(table: Mapping[str, Any], name: str) -> bool:
    """Whether a table states a parameter by its dotted name."""
    head, _, rest = name.partition(".")
    if not rest:
        return head in table
    return isinstance(table.get(head), dict) and _states(table[head], rest)
