"""Command-line options from configuration fields, which state type, default and help."""

from __future__ import annotations

import copy
import inspect
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Annotated, Any

import typer
from pydantic import BaseModel

from calibration.data import Json
from calibration.data.input_errors import BadConfiguration, parse_number

#: Units at the end of field names, longest first, and their notation.
UNITS = {
    "rad_s": "rad/s",
    "m_s": "m/s",
    "s": "s",
    "V": "V",
    "A": "A",
    "Nm": "N·m",
    "rpm": "rpm",
    "kg": "kg",
    "deg": "deg",
    "mm": "mm",
    "mAh": "mAh",
}


def schema_facts(config_kind: type[BaseModel]) -> dict[str, Json]:
    """Schema of each field of a configuration: its own fields, then those of its parts."""
    schema = config_kind.model_json_schema()["properties"]
    field_names = [
        name
        for part in config_kind.__mro__
        if issubclass(part, BaseModel)
        for name in vars(part).get("__annotations__", {})
    ]
    facts = {}
    for name in dict.fromkeys(n for n in field_names if n in schema):
        option_schema = schema[name]
        value_schema: Json = next((a for a in option_schema.get("anyOf", ()) if a.get("type") != "null"), {})
        facts[name] = {**value_schema, **option_schema}
    return facts


def option_of_field(name: str, fact: Json) -> str:
    """Command-line option for a field of the configuration, for example `--discharge` for `discharge_mAh`."""
    stem, _ = split_unit(name)
    return str(fact.get("flag") or "--" + stem.replace("_", "-"))


def split_unit(name: str) -> tuple[str, str]:
    """Name of a field without its unit, and the unit (empty if it has none)."""
    return next(
        ((name.removesuffix(f"_{end}"), unit) for end, unit in UNITS.items() if name.endswith(f"_{end}")), (name, "")
    )


def options_of_fields(config_kind: type[BaseModel]) -> dict[str, str]:
    """The option of each field."""
    return {name: option_of_field(name, fact) for name, fact in schema_facts(config_kind).items()}


_TYPES = {"boolean": bool, "integer": int, "number": float, "string": str, "object": list[str]}
_LISTS = {"number": str, "string": list[str]}  # an axis is a single text


def option_help(name: str, fact: Json) -> str:
    """Help text of a field: meaning, unit, choices, bounds and default."""
    _, unit = split_unit(name)
    texts = [str(fact.get("description", name)).rstrip(".")]
    if unit and f"({unit})" not in texts[0]:
        texts[0] += f" ({unit})"
    if "enum" in fact:
        texts[0] += f": {', '.join(map(str, fact['enum']))}"
    texts[0] += "."
    texts += [f"[{text}]" for text in (_bounds_text(fact), _default_text(name, fact)) if text]
    return "  ".join(texts).replace("[", "\\[")  # a word in brackets would be markup


def _bounds_text(fact: Json) -> str:
    limits = {**fact.get("items", {}), **fact}
    ends = [f"{limits[key]:.10g}" if key in limits else "" for key in ("minimum", "maximum")]
    if all(ends):
        return " to ".join(ends)
    words = {"minimum": "at least", "exclusiveMinimum": "above", "maximum": "at most", "exclusiveMaximum": "below"}
    return ", ".join(f"{word} {limits[key]:.10g}" for key, word in words.items() if key in limits)


def _default_text(name: str, fact: Json) -> str:
    value = fact.get("usual", fact.get("default"))
    if isinstance(value, bool):
        return "default: " + option_of_field(name, fact).removeprefix("--") if value else ""
    if isinstance(value, list):
        value = ",".join(f"{v:g}" if isinstance(v, float) else str(v) for v in value)
    return (
        "" if value in (None, "", {}) else f"default: {value:g}" if isinstance(value, float) else f"default: {value}"
    )


def option_parameters(config_kinds: Iterable[type[BaseModel]], common: Sequence[str]) -> Iterator[inspect.Parameter]:
    """A function parameter for each field of a command that can be chosen, with default None.

    The `common` options come first. `--help` hides the others.
    """
    facts = {name: fact for kind in config_kinds for name, fact in schema_facts(kind).items() if "const" not in fact}
    words = {name: option_of_field(name, fact).removeprefix("--") for name, fact in facts.items()}
    position = {word: place for place, word in enumerate(common)}
    for name in sorted(facts, key=lambda name: position.get(words[name], len(position))):
        fact, word = facts[name], words[name]
        default = None
        annotation = _option_type(fact) | None
        if fact.get("argument"):
            declaration: Any = typer.Argument(metavar=fact.get("metavar"), help=option_help(name, fact))
            if "default" not in fact:
                default = inspect.Parameter.empty
                annotation = _option_type(fact)
        else:
            has_negation = fact.get("type") == "boolean" and fact.get("default") is not False
            names = f"--{word}/--no-{word}" if has_negation else f"--{word}"
            declaration = typer.Option(names, help=option_help(name, fact), hidden=word not in position)
        keyword = inspect.Parameter.KEYWORD_ONLY
        yield inspect.Parameter(name, keyword, default=default, annotation=Annotated[annotation, declaration])


def _option_type(fact: Json) -> Any:
    if fact.get("format") == "path":
        return Path
    return _LISTS[fact["items"]["type"]] if fact["type"] == "array" else _TYPES[fact["type"]]


def take_options(config_kind: type[BaseModel], values: Json) -> Json:
    """Removes the options of a configuration from a command's values and parses them.

    Raises:
        BadConfiguration: an axis or a change cannot be parsed.
    """
    return {
        name: _parse_option(name, schema, values.pop(name, None))
        for name, schema in schema_facts(config_kind).items()
    }


def _parse_option(name: str, fact: Json, value: Any) -> Any:
    if value is None or value == []:
        return None
    if fact["type"] == "object":
        return parse_settings(value)
    if fact["type"] == "array" and fact["items"]["type"] == "number":
        return parse_axis(option_of_field(name, fact), value)
    if fact["type"] == "array":
        return (
            tuple(value)
            if fact.get("verbatim")
            else tuple(w.strip() for o in value for w in o.split(",") if w.strip())
        )
    return str(value) if isinstance(value, Path) else value


def help_all() -> inspect.Parameter:
    """The option that shows every option of a command."""
    option = typer.Option("--help-all", is_eager=True, callback=_show_full_help, help="Show all options and exit.")
    return inspect.Parameter(
        "help_all", inspect.Parameter.KEYWORD_ONLY, default=False, annotation=Annotated[bool, option]
    )


def _show_full_help(context: typer.Context, is_wanted: bool) -> None:
    if is_wanted:
        command = copy.copy(context.command)
        command.params = [copy.copy(p) for p in command.params]
        for p in command.params:
            p.hidden = False  # type: ignore[attr-defined]  # of an option
        typer.echo(command.get_help(context))
        raise typer.Exit


def parse_settings(options: list[str]) -> dict[str, bool | float]:
    """The `--set NAME=VALUE` options as a table.

    Raises:
        BadConfiguration: the equals sign is missing, or the value is no number and not true or false.
    """
    table: dict[str, bool | float] = {}
    for option in options:
        name, _, value = option.partition("=")
        try:
            word = value.strip()
            table[name.strip()] = word == "true" if word in ("true", "false") else parse_number(word)
        except ValueError:
            raise BadConfiguration(
                f"--set: got {option}; expected NAME=VALUE with a number, such as motor.resistance=0.9"
            ) from None
    return table


def parse_axis(option: str, text: str) -> tuple[float, ...]:
    """Values of a grid axis: `0,5,10`, or `0:20:0.5` for first, last and step, or both mixed.

    Raises:
        BadConfiguration: the text has neither form.
    """
    values: list[float] = []
    for part in text.split(","):
        try:
            numbers = [parse_number(n) for n in part.split(":")]
            if len(numbers) == 1:
                values += numbers
                continue
            first, last, step = numbers
            if (last - first) * step < 0:
                raise BadConfiguration(
                    f"{option}: got {part}, which ends before it begins; expected first:last:step, such as 0:20:0.5"
                )
            count = (last - first) / step
            if not 0 <= count < 1e6:
                raise ValueError
            values += [first + k * step for k in range(round(count - 0.5 + 1e-9) + 1)]
        except (ValueError, ZeroDivisionError, OverflowError):
            raise BadConfiguration(
                f"{option}: got {part or 'nothing'}; expected numbers such as 0,5,10 or first:last:step such as "
                "0:20:0.5"
            ) from None
    return tuple(values)
