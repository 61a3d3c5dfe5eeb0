"""Robots as TOML files: a base robot by name and the parameters in which this one differs."""

from __future__ import annotations

import dataclasses
import difflib
import json
import math
import tomllib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import jax.numpy as jnp

from calibration.data.effect_file import Library
from calibration.data.errors import BadConfiguration, choices, number
from mmrjax import effects, nominal, params
from mmrjax.robot import Robot

SCHEMA = "mmrjax.robot/1"


def load(name_or_path: str, library: Library = effects.BY_NAME) -> Robot:
    """A robot by its name (`nominal`, `sm1`, `sm2`) or from a TOML file, with effects of `library`.

    Raises:
        BadConfiguration: no such name or file, or what `read` raises.
    """
    if name_or_path in nominal.ROBOTS:
        return nominal.ROBOTS[name_or_path]()
    path = Path(name_or_path)
    if not path.is_file():
        raise BadConfiguration(
            f"--robot: got {name_or_path}, no such file and no known robot; {choices(name_or_path, nominal.ROBOTS)}"
        )
    return read(path, library)


def read(path: Path, library: Library = effects.BY_NAME) -> Robot:
    """Read a robot file; its effects are looked up in `library` (see `effect_file.library`) and among the curves.

    The file states `schema` (optional), `base` (a robot's name, `nominal` if left out), and tables of
    parameters by dotted name in SI units, e.g. `[motor] resistance = 0.9`; an effect is present when its
    table `[effects.NAME]` is, which may name the `configurations` that it acts on.

    Raises:
        BadConfiguration: not TOML, an unknown key (with the choices), a value that is no number, not
            finite, or outside the field's bounds.
    """
    try:
        content = tomllib.loads(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise BadConfiguration(f"{path.name}: not a readable TOML file ({error})") from error
    schema = content.pop("schema", SCHEMA)
    if schema != SCHEMA:
        raise BadConfiguration(f"{path.name}, schema: got {schema}; expected {SCHEMA}")
    base = content.pop("base", "nominal")
    if base not in nominal.ROBOTS:
        raise BadConfiguration(f"{path.name}, base: got {base}; {choices(str(base), nominal.ROBOTS)}")
    robot = nominal.ROBOTS[base]()
    present = content.get("effects", {})
    if not isinstance(present, dict):
        raise BadConfiguration(f"{path.name}, effects: got {present}; expected tables such as [effects.churning]")
    for name in present:
        if name not in library and name not in effects.UNNAMED:
            raise BadConfiguration(f"{path.name}, effects.{name}: no such effect; {choices(name, library)}")
    tables = {name: table for name, table in present.items() if isinstance(table, dict)}
    acting = {name: table.pop("configurations") for name, table in tables.items() if "configurations" in table}
    robot = with_effects(robot, tuple(present), library, acting, where=path.name)
    return change(robot, dict(_flatten(content)), where=path.name)


def with_effects(
    robot: Robot,
    names: Sequence[str],
    library: Library = effects.BY_NAME,
    configurations: Mapping[str, Any] | None = None,
    where: str = "effects",
) -> Robot:
    """The robot with these effects of `library`, or curves, present, each with amplitude 0.

    Args:
        configurations: by an effect's name, a list of those that it acts on; others keep their class's default.
        where: opens the message of an error.

    Raises:
        BadConfiguration: configurations of an effect that are no list of names, or that the robot does not have.
    """
    known = {**effects.UNNAMED, **library}
    present = []
    for name in names:
        effect = known[name]()
        acting = (configurations or {}).get(name, effect.configurations)
        here = f"{where}, effects.{name}.configurations"
        if not isinstance(acting, list | tuple) or not all(isinstance(c, str) for c in acting):
            raise BadConfiguration(f"{here}: got {acting!r}; expected a list of {', '.join(robot.configurations)}")
        for c in acting:
            if c not in robot.configurations:
                raise BadConfiguration(f"{here}: got {c}; {choices(c, robot.configurations)}")
        present.append(dataclasses.replace(effect, configurations=tuple(acting)))
    return dataclasses.replace(robot, effects=tuple(present))


def change(robot: Robot, values: dict[str, Any], where: str) -> Robot:
    """The robot with parameters replaced, each checked against its field.

    Raises:
        BadConfiguration: as `read`; `where` opens the message.
    """
    known = {p.name: p for p in params.walk(robot)}
    for name, value in values.items():
        if name not in known:
            near = difflib.get_close_matches(name, known, n=5, cutoff=0.4)
            allowed = [n for n in known if n.split(".")[0] == name.split(".")[0]] or list(known)
            raise BadConfiguration(f"{where}, {name}: no such parameter; {choices(name, near or allowed)}")
        spec = known[name].spec
        low, high = spec.bounds
        allowed_text = f"{number(low)} to {number(high)} {spec.unit} ({spec.meaning})"
        if isinstance(value, bool) or not isinstance(value, int | float):
            raise BadConfiguration(f"{where}, {name}: got {value!r}; expected a number, {allowed_text}")
        if not math.isfinite(value) or not low <= value <= high:
            raise BadConfiguration(f"{where}, {name}: got {number(value)}; expected {allowed_text}")
    robot = params.replace(robot, {k: jnp.asarray(v, float) for k, v in values.items()})  # type: ignore[assignment]
    for name, chassis in robot.configurations.items():
        friction = chassis.ground.friction
        if friction.speed_dynamic <= friction.speed_static:
            raise BadConfiguration(
                f"{where}, {name}.ground.friction.speed_dynamic: got {float(friction.speed_dynamic):g}; "
                f"expected more than speed_static, {float(friction.speed_static):g} m/s"
            )
    for effect in robot.effects:
        if effect.name in effects.CURVES and not effect.low < effect.high:  # type: ignore[attr-defined]
            raise BadConfiguration(
                f"{where}, effects.{effect.name}.high: got {float(effect.high):g}; "  # type: ignore[attr-defined]
                f"expected more than low, {float(effect.low):g}"  # type: ignore[attr-defined]
            )
    return robot


def write(robot: Robot, path: Path, *, note: str = "") -> None:
    """Write every parameter of a robot, with unit, meaning and source beside each; `read` gives it back."""
    lines = [f"# {line}" for line in note.splitlines()]
    lines += [f'schema = "{SCHEMA}"', 'base = "nominal"']
    table = ""
    start = {p.name: float(p.value) for p in params.walk(nominal.nominal())}
    acting = {
        f"effects.{e.name}": e.configurations for e in robot.effects if e.configurations or type(e)().configurations
    }
    for parameter in params.walk(robot):
        head, _, key = parameter.name.rpartition(".")
        if head != table:
            lines += ["", f"[{head}]"]
            if head in acting:
                lines.append(f"configurations = {json.dumps(acting[head])}  # on which it acts")
            table = head
        spec, value = parameter.spec, float(parameter.value)
        was = start.get(parameter.name, 0.0)
        origin = spec.source if value == was else f"nominal {was:g}: {spec.source}"
        lines.append(f"{key} = {value!r}  # [{spec.unit}] {spec.meaning}; {origin}")
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")


def _flatten(content: dict[str, Any], prefix: str = "") -> list[tuple[str, Any]]:
    flat: list[tuple[str, Any]] = []
    for key, value in content.items():
        name = f"{prefix}{key}"
        flat += _flatten(value, f"{name}.") if isinstance(value, dict) else [(name, value)]
    return flat
