"""Numbers with their uncertainty: `5.95 ± 5 %`, `0.82 ± 0.02`. `12 ± 0` is exact."""

from __future__ import annotations

import math
import re

from calibration.data import Json
from calibration.data.input_errors import BadConfiguration, parse_number

FORM = 'expected a number, or one with its standard deviation as "0.61 ± 0.03" or "0.61 ± 5 %"'
_SIGNS = r"(?:±|\+/-|\+-)"


def stated_number(text: str, where: str) -> tuple[float, float]:
    """Value and standard deviation of `value ± sd` or `value ± x %`, in the value's unit.

    Args:
        where: opens the message of an error.

    Raises:
        BadConfiguration: another form, no number, or an sd below 0.
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
                f"{where}: got {text!r}; 0 has no percentage: state the standard deviation; {FORM}"
            )
        size *= abs(mean) / 100
    return mean, float(f"{size:.12g}")  # a percentage leaves digits of rounding


def taken_apart(table: Json, where: str, prefix: str = "") -> dict[str, float]:
    """Replaces each `value ± sd` of a table and its subtables by the value. Returns the sds by dotted name.

    Raises:
        BadConfiguration: as `stated_number`.
    """
    sds: dict[str, float] = {}
    for key, value in table.items():
        name = f"{prefix}{key}"
        if isinstance(value, dict):
            sds |= taken_apart(value, where, f"{name}.")
        elif isinstance(value, str) and re.search(_SIGNS, value) is not None:
            table[key], sds[name] = stated_number(value, f"{where}, {name}")
    return sds
