"""Names of configuration fields as options of the command line."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from pydantic import BaseModel

from calibration.data import Json

#: Units that names of fields end with, the longest first, and as they are written.
UNITS = {
    "rad_s": "rad/s",
    "m_s": "m/s",
    "s": "s",
    "V": "V",
    "rpm": "rpm",
    "kg": "kg",
    "deg": "deg",
    "mm": "mm",
    "mAh": "mAh",
}


def schema_facts(kind: type[BaseModel]) -> dict[str, Json]:
    """Schema of each field of a configuration, in the order of its parts, its own first."""
    schema = kind.model_json_schema()["properties"]
    own = [
        name for part in kind.__mro__ if issubclass(part, BaseModel) for name in vars(part).get("__annotations__", {})
    ]
    found = {}
    for name in dict.fromkeys(n for n in own if n in schema):
        stated = schema[name]
        given: Json = next((a for a in stated.get("anyOf", ()) if a.get("type") != "null"), {})
        found[name] = {**given, **stated}
    return found


def option_of_field(name: str, fact: Mapping[str, Any]) -> str:
    """The option of a field: `--discharge` of `discharge_mAh`."""
    stem, _ = of_unit(name)
    return str(fact.get("flag") or "--" + stem.replace("_", "-"))


def of_unit(name: str) -> tuple[str, str]:
    """A field's name without its unit, and that, empty where it has none."""
    return next(
        ((name.removesuffix(f"_{end}"), unit) for end, unit in UNITS.items() if name.endswith(f"_{end}")), (name, "")
    )


def options_of_fields(kind: type[BaseModel]) -> dict[str, str]:
    """The option of each field."""
    return {name: option_of_field(name, fact) for name, fact in schema_facts(kind).items()}
