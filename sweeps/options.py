"""Command-line options made from configuration fields, which state their type, default and help."""

from __future__ import annotations

import copy
import inspect
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Annotated, Any

import typer

from calibration.data import Json, Names
from sweeps import config
from sweeps.config import Part
from sweeps.flags import of_unit, option_of_field, schema_facts

_TYPES = {"boolean": bool, "integer": int, "number": float, "string": str, "object": list[str]}
_LISTS = {"number": str, "string": list[str]}  # an axis is one text


def option_help(name: str, fact: Mapping[str, Any]) -> str:
    """Meaning, unit, choices, bounds and default of a field, as a help text has them."""
    _, unit = of_unit(name)
    texts = [str(fact.get("description", name)).rstrip(".")]
    if unit and f"({unit})" not in texts[0]:
        texts[0] += f" ({unit})"
    if "enum" in fact:
        texts[0] += f": {', '.join(map(str, fact['enum']))}"
    texts[0] += "."
    texts += [f"[{text}]" for text in (_bounds(fact), _default(name, fact)) if text]
    return "  ".join(texts).replace("[", "\\[")  # a word in brackets would be markup


def _bounds(fact: Mapping[str, Any]) -> str:
    limits = {**fact.get("items", {}), **fact}
    ends = [f"{limits[key]:.10g}" if key in limits else "" for key in ("minimum", "maximum")]
    if all(ends):
        return " to ".join(ends)
    words = {"minimum": "at least", "exclusiveMinimum": "above", "maximum": "at most", "exclusiveMaximum": "below"}
    return ", ".join(f"{word} {limits[key]:.10g}" for key, word in words.items() if key in limits)


def _default(name: str, fact: Mapping[str, Any]) -> str:
    value = fact.get("usual", fact.get("default"))
    if isinstance(value, bool):
        return "default: " + option_of_field(name, fact).removeprefix("--") if value else ""
    if isinstance(value, list):
        value = ",".join(f"{v:g}" if isinstance(v, float) else str(v) for v in value)
    return (
        "" if value in (None, "", {}) else f"default: {value:g}" if isinstance(value, float) else f"default: {value}"
    )


def option_parameters(kind: type[Part], arguments: Names = ()) -> Iterator[inspect.Parameter]:
    """A parameter of a command's function for each field that can be chosen, None where it is not given.

    Args:
        arguments: fields that are arguments and not options.
    """
    for name, fact in schema_facts(kind).items():
        if "const" in fact:  # one choice is none
            continue
        if name in arguments:
            told: Any = typer.Argument(metavar=fact["metavar"], help=option_help(name, fact))
        else:
            word = option_of_field(name, fact)
            pair = fact.get("type") == "boolean" and fact.get("default") is not False
            names = f"{word}/--no-{word.removeprefix('--')}" if pair else word
            told = typer.Option(names, help=option_help(name, fact), hidden=bool(fact.get("solver")))
        yield inspect.Parameter(
            name, inspect.Parameter.KEYWORD_ONLY, default=None, annotation=Annotated[_type(fact) | None, told]
        )


def _type(fact: Mapping[str, Any]) -> Any:
    if fact.get("format") == "path":
        return Path
    return _LISTS[fact["items"]["type"]] if fact["type"] == "array" else _TYPES[fact["type"]]


def take_options(kind: type[Part], values: Json) -> Json:
    """Takes what was given for the fields of a configuration out of the values of a command, and reads their texts.

    Raises:
        BadConfiguration: an axis or a change that cannot be read.
    """
    return {name: _read(name, fact, values.pop(name, None)) for name, fact in schema_facts(kind).items()}


def _read(name: str, fact: Mapping[str, Any], value: Any) -> Any:
    if value is None:
        return None
    if fact["type"] == "object":
        return config.parse_settings(value)
    if fact["type"] == "array" and fact["items"]["type"] == "number":
        return config.parse_axis(option_of_field(name, fact), value)
    if fact["type"] == "array":
        return (tuple(value) or None) if fact.get("verbatim") else config.split_words(value)
    return str(value) if isinstance(value, Path) else value


def help_all(kinds: tuple[type[Part], ...]) -> Iterator[inspect.Parameter]:
    """The option that shows those of solvers too, where a command has any."""
    hidden = [
        option_of_field(name, fact)
        for kind in kinds
        for name, fact in schema_facts(kind).items()
        if fact.get("solver")
    ]
    if hidden:
        told = typer.Option(
            "--help-all", is_eager=True, callback=_show_all,
            help=f"Show this with {', '.join(hidden)} too, which \\[solver] of --config may state.",
        )  # fmt: skip
        kind = inspect.Parameter.KEYWORD_ONLY
        yield inspect.Parameter("help_all", kind, default=False, annotation=Annotated[bool, told])


def _show_all(context: typer.Context, wanted: bool) -> None:
    if wanted:
        shown = copy.copy(context.command)
        shown.params = [copy.copy(p) for p in shown.params]
        for p in shown.params:
            p.hidden = False  # type: ignore[attr-defined]  # of an option
        typer.echo(shown.get_help(context))
        raise typer.Exit
