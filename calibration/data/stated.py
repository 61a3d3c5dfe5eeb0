"""Numbers with their uncertainty: `5.95 ± 5 %`, `0.82 ± 0.02`, or `12 ± 0` if exact. Numbers of templates are
examples.
"""

from __future__ import annotations

import functools
import math
import re
from importlib import resources

from calibration.data import Json
from calibration.data.input_errors import BadConfiguration, parse_number

FORM = 'expected a number, or one with its standard deviation as "0.61 ± 0.03" or "0.61 ± 5 %"'
_SIGNS = r"(?:±|\+/-|\+-)"
#: Comment on a line with an example number.
EXAMPLE = "example: yours"
#: Smallest sd of an example number that was not replaced, as a share of the number. It belongs to another robot, and
#: robots differ by factors.
EXAMPLE_SHARE = 3.0
#: The same for an example number of 0: multiple of its sd.
EXAMPLE_ZERO = 10.0
HEADER = re.compile(r"(?:# )?\[([\w.]+)\]$")


def stated_number(text: str, where: str) -> tuple[float, float]:
    """Value and standard deviation of `value ± sd` or `value ± x %`, in the value's unit.

    Args:
        where: beginning of the error message.

    Raises:
        BadConfiguration: the form is different, there is no number, or the sd is negative.
    """
    parts = re.split(_SIGNS, text)
    try:
        value, sd = parts
        mean, size = parse_number(value), parse_number(sd.strip().removesuffix("%"))
    except ValueError:
        raise BadConfiguration(f"{where}: got {text!r}; {FORM}") from None
    if not math.isfinite(mean):
        raise BadConfiguration(f"{where}: got {text!r}; {FORM}")
    if not (math.isfinite(size) and size >= 0):
        raise BadConfiguration(f"{where}: got {text!r}; the standard deviation must be 0 (exact) or more; {FORM}")
    if sd.strip().endswith("%"):
        if mean == 0 and size > 0:
            raise BadConfiguration(
                f"{where}: got {text!r}; a percentage of 0 is 0, so give the standard deviation itself; {FORM}"
            )
        size *= abs(mean) / 100
    return mean, float(f"{size:.12g}")  # without rounding errors of the percentage


def split_values_and_sds(table: Json, where: str, prefix: str = "") -> dict[str, float]:
    """Replaces each `value ± sd` of a table and its subtables by the value. Returns the sds by dotted name.

    Raises:
        BadConfiguration: for the same reasons as `stated_number`.
    """
    sds: dict[str, float] = {}
    for key, value in table.items():
        name = f"{prefix}{key}"
        if isinstance(value, dict):
            sds |= split_values_and_sds(value, where, f"{name}.")
        elif isinstance(value, str) and re.search(_SIGNS, value) is not None:
            table[key], sds[name] = stated_number(value, f"{where}, {name}")
    return sds


def is_example(line: str) -> bool:
    """True if a line of a rig file is marked as an example and still has a template's number."""
    return EXAMPLE in line and _number_of_line(line) in _template_numbers()


def has_template_number(line: str) -> bool:
    """True if a line has the name and number of a template's example, marked or not. 0 and 1 do not count."""
    number = _number_of_line(line)
    return number is not None and number[1] not in (0.0, 1.0) and number in _template_numbers()


def example_numbers(text: str) -> dict[str, str]:
    """Names and units of the numbers that are still those of an example, such as `motor.resistance`: `[ohm]`."""
    examples, table = {}, ""
    for line in text.splitlines():
        if not line.startswith("#") and (header := HEADER.match(line)):
            table = f"{header[1]}."
        if is_example(line) and (key := re.match(r"(\w+) = .*?# (\[[^\]]*\])?", line)):
            examples[f"{table}{key[1]}"] = key[2] or ""
    return examples


def example_sd(value: float, sd: float) -> float:
    """Sd of an example number that was not replaced. Exact numbers stay exact."""
    smallest_sd = EXAMPLE_SHARE * abs(value) or EXAMPLE_ZERO * sd
    return max(sd, float(f"{smallest_sd:.12g}")) if sd else 0.0


@functools.cache
def _template_numbers() -> frozenset[tuple[str, float] | None]:
    texts = [file.read_text("utf-8") for file in resources.files("calibration.data").joinpath("rigs").iterdir()]
    return frozenset(_number_of_line(line) for text in texts for line in text.splitlines() if EXAMPLE in line) - {
        None
    }


def _number_of_line(line: str) -> tuple[str, float] | None:
    """Name and number in a line. None for other lines and comments."""
    match = re.match(r'(\w+) = "?([-+.\deE]+)', line)
    return None if match is None else (match[1], float(match[2]))
