"""Templates of rig files, filled in with numbers of a model or data sheet."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Mapping
from importlib import resources

from calibration.data.stated import HEADER

#: Kinds of rig, in words.
KINDS = {
    "bench": "a motor with gearbox that drives a shaft: brake, disk, worm, winch",
    "dyno": "a motor on a dynamometer: a brake whose torque is set and measured",
    "pendulum": "a servo with an arm under gravity",
    "servo": "a servo driven by PWM, with its angle logged",
    "linear": "a carriage on a screw, a belt or a rope",
    "carriage": "a carriage on an amplifier that controls the current, with its position logged",
    "wheeled": "a robot on wheels",
    "tracked": "a robot on tracks",
}
#: Name of the load's table in dotted names, which the template's own name replaces.
LOAD = "load"


@dataclasses.dataclass(frozen=True)
class StatedNumber:
    """A number for a line of a rig file.

    Attributes:
        value: value in `unit`.
        source: file and element that state it.
        width: text after ±, empty if there is none.
    """

    value: float
    unit: str
    source: str
    width: str = ""

    @property
    def text(self) -> str:
        """Number as text for the file. A relative sd of 0 is omitted."""
        number = repr(self.value if isinstance(self.value, int) else float(f"{self.value:.12g}"))
        exact = not self.width or (self.value == 0 and self.width.endswith("%"))
        return number if exact else f'"{number} ± {self.width}"'


def rig_template(kind: str) -> str:
    """Template for a kind of rig."""
    return resources.files("calibration.data").joinpath("rigs", f"{kind}.toml").read_text(encoding="utf-8")


def fill_rig_template(kind: str, numbers: Mapping[str, StatedNumber], heading: str) -> str:
    """Template of a kind of rig, filled in with numbers.

    Numbers without a line in the template are added at the end of their table.

    Args:
        numbers: numbers by dotted name, with `load.` for the table of the load.
        heading: sentence for the first line.
    """
    lines = rig_template(kind).splitlines()
    load_line = next(k for k, line in enumerate(lines) if line.startswith("load = "))
    load = lines[load_line - 1].strip("[]")
    for name, number in numbers.items():
        table, _, key = re.sub(rf"^{LOAD}\.", f"{load}.", name).rpartition(".")
        line = f"{key} = {number.text}  # [{number.unit}] {_one_line(number.source)}"
        if table and f"[{table}]" not in lines:
            lines += ["", f"[{table}]"]
        start = lines.index(f"[{table}]") + 1 if table else 0
        end = next((k for k in range(start, len(lines)) if HEADER.match(lines[k])), len(lines))
        key_lines = [k for k in range(start, end) if re.match(rf"(# )?{key} = ", lines[k])]
        if key_lines:
            lines[key_lines[0]] = line
            continue
        while end > start and (not lines[end - 1] or lines[end - 1].startswith("#")):
            end -= 1  # comments below belong to the next table
        lines.insert(end, line)
    return "\n".join([f"# {_one_line(heading)}", *lines]) + "\n"


def _one_line(text: str) -> str:
    """Text on one line, because line breaks in names of a model would end a comment."""
    return "".join(letter if letter.isprintable() else " " for letter in text)
