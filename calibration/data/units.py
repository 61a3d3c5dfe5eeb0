"""Units that column names end with, and how a value in one becomes a value in the unit of the standard column."""

from __future__ import annotations

import dataclasses
import math
import re
from collections.abc import Iterable, Mapping

from mmrjax import channels

#: SI value of one unit, by its spelling at the end of a column's name.
TIME = {"s": 1.0, "ms": 1e-3, "min": 60.0, "h": 3600.0}
VOLTAGE = {"V": 1.0, "mV": 1e-3}
CURRENT = {"A": 1.0, "mA": 1e-3}
MASS = {"kg": 1.0, "g": 1e-3}
SHARE = {"": 1.0, "percent": 1e-2}
#: Of an angle, in degrees; per cent of slope are those of its tangent.
ANGLE = {"deg": 1.0, "rad": 180 / math.pi}
PERCENT = "percent"
#: Units as people write them beside numbers, where a column's name has another spelling.
WRITTEN = {
    "°": "deg", "v": "V", "volt": "V", "volts": "V", "a": "A", "amp": "A", "amps": "A", "ma": "mA", "mv": "mV",
    "gram": "g", "grams": "g", "°c": "C", "1/min": "rpm", "u/min": "rpm",
    "r/min": "rpm", "min-1": "rpm", "°/s": "deg/s", "nmm": "mNm", "n·mm": "mNm",
}  # fmt: skip


def of_channel(name: str) -> dict[str, float]:
    """SI values of the units of a channel, the one of its standard column first: `mm_s`, `m_s`, `km_h`, ..."""
    channel = channels.find(name)
    return {spelled(unit): factor for unit, factor in ((channel.unit, channel.factor), *channel.other_units)}


def spelled(unit: str) -> str:
    """A unit as the end of a column's name: `km/h` is `km_h`."""
    unit = WRITTEN.get(unit.lower(), unit)
    return unit.replace("/", "_").replace("%", PERCENT).replace("·", "")


def at_the_end(text: str, known: Iterable[str]) -> str | None:
    """The one of `known` units that a column's name ends with, `torque_kNm` or `Torque [kN·m]`; None of none."""
    end = re.split(r"[\[(\s]", text.rstrip("])"))[-1]
    found = [unit for unit in known if unit and re.search(rf"(?:^|[^A-Za-z]){unit}$", spelled(end))]
    return max(found, key=len, default=None)


@dataclasses.dataclass(frozen=True)
class Quantity:
    """What a column can hold.

    Attributes:
        name: of the column without its unit.
        units: value of one unit, in the unit that a reader works in (`factor` 1), by its spelling.
        range: least and largest value allowed, in the unit that a reader works in.
        slope: whether per cent of a slope are understood too.
    """

    name: str
    units: Mapping[str, float]
    range: tuple[float, float]
    slope: bool = False

    def columns(self) -> dict[str, str]:
        """Names of the columns that hold it, each with the unit at its end."""
        units = [*self.units, *([PERCENT] if self.slope else [])]
        return {f"{self.name}_{unit}" if unit else self.name: unit for unit in units}

    def value(self, written: float, unit: str) -> float:
        """What is written in `unit`, in the unit that a reader works in."""
        if self.slope and unit == PERCENT:
            return math.degrees(math.atan(written / 100))
        return written * self.units[unit]

    def limits(self, unit: str) -> tuple[float, float]:
        """Least and largest value allowed, in `unit`."""
        low, high = self.range
        if self.slope and unit == PERCENT:
            return 100 * math.tan(math.radians(low)), 100 * math.tan(math.radians(high))
        return low / self.units[unit], high / self.units[unit]
