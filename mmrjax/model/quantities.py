"""Table of labels and conditions of a run, one row each, and the spelling of units. Importable without jax.

A quantity has a name, units, a range, a rule for its sign and places where it may stand. `LABELS` name rows, `SET` is
set before a run, and `channels.EVERY` are shown by instruments. Columns of tables and profiles, fields of
`Conditions`, options, pages and `explain` read these rows, so a new condition needs a row here and a field of
`Conditions`.
"""

from __future__ import annotations

import dataclasses
import math
import re
from collections.abc import Iterable, Mapping

DEG = math.pi / 180  # rad
RPM = math.pi / 30  # rad/s
MM = 1e-3  # m

#: Unit of a slope in per cent, the tangent of its angle.
PERCENT = "percent"
#: Signs that are turned: by travel in the other direction, and by a turn to the other side.
TRAVEL, TURN = "travel", "turn"
#: Units as people write them, where a column's name has another spelling.
WRITTEN = {
    "°": "deg", "v": "V", "volt": "V", "volts": "V", "a": "A", "amp": "A", "amps": "A", "ma": "mA", "mv": "mV",
    "gram": "g", "grams": "g", "°c": "C", "1/min": "rpm", "u/min": "rpm",
    "r/min": "rpm", "min-1": "rpm", "°/s": "deg/s", "nmm": "mNm", "n·mm": "mNm",
}  # fmt: skip


def unit_in_column(unit: str) -> str:
    """Returns a unit as a column's name ends with it: `km_h` for `km/h`."""
    unit = WRITTEN.get(unit.lower(), unit)
    return unit.replace("/", "_").replace("%", PERCENT).replace("·", "")


def unit_at_end(text: str, known: Iterable[str]) -> str | None:
    """Returns the unit among `known` that a column's name ends with, such as kNm of `torque_kNm` and `Torque [kN·m]`;
    None if there is none."""
    end = re.split(r"[\[(\s]", text.rstrip("])"))[-1]
    found = [unit for unit in known if unit and re.search(rf"(?:^|[^A-Za-z]){unit}$", unit_in_column(end))]
    return max(found, key=len, default=None)


@dataclasses.dataclass(frozen=True)
class Quantity:
    """A number with its unit, its range and the rule for its sign.

    Attributes:
        name: noun; with the unit, the name of its column.
        unit: of its column; factor: the SI value of one such unit.
        label: words of reports.
        range: least and greatest value [unit].
        unit_si: spelling of the SI unit, if it differs from `unit`; else empty.
        other_units: further units that are accepted, with the SI value of each.
        percent: True if a slope in per cent is accepted too.
        stem: start of the names of its columns, if it differs from `name`.
        sign: what turns its sign: `TRAVEL` or `TURN`; empty: nothing does.
        in_profiles: True if a mission's profile may state it.
    """

    name: str
    unit: str
    factor: float
    label: str
    range: tuple[float, float]
    unit_si: str = dataclasses.field(default="", kw_only=True)
    other_units: tuple[tuple[str, float], ...] = dataclasses.field(default=(), kw_only=True)
    percent: bool = dataclasses.field(default=False, kw_only=True)
    stem: str = dataclasses.field(default="", kw_only=True)
    sign: str = dataclasses.field(default="", kw_only=True)
    in_profiles: bool = dataclasses.field(default=False, kw_only=True)

    @property
    def key(self) -> str:
        """Name of the field of Python that holds it."""
        return self.name

    @property
    def column(self) -> str:
        """Name of its column in tables, with the unit."""
        return self._column(unit_in_column(self.unit))

    @property
    def unit_shown(self) -> str:
        """Its unit as people write it: C is a coulomb, °C a temperature."""
        return self.unit_si if self.unit_si and self.factor == 1.0 else self.unit

    @property
    def units(self) -> Mapping[str, float]:
        """Value of one unit in the unit of its column, by its spelling, that of the column first."""
        written = ((self.unit, self.factor), *self.other_units)
        return {unit_in_column(unit): size / self.factor for unit, size in written}

    def columns(self) -> dict[str, str]:
        """Names of the columns that may hold it, each with the unit at its end."""
        units = [*self.units, *([PERCENT] if self.percent else [])]
        return {self._column(unit): unit for unit in units}

    def _column(self, unit: str) -> str:
        stem = self.stem or self.name
        return f"{stem}_{unit}" if unit else stem

    def value(self, written: float, unit: str) -> float:
        """Returns a value written in `unit`, in the unit of the column."""
        if self.percent and unit == PERCENT:
            return math.degrees(math.atan(written / 100))
        return written * self.units[unit]

    def limits(self, unit: str) -> tuple[float, float]:
        """Returns the least and greatest allowed value in `unit`."""
        low, high = self.range
        if self.percent and unit == PERCENT:
            return 100 * math.tan(math.radians(low)), 100 * math.tan(math.radians(high))
        return low / self.units[unit], high / self.units[unit]


@dataclasses.dataclass(frozen=True)
class Condition(Quantity):
    """A quantity that is set from outside before a run starts.

    Attributes:
        field: field of `Conditions`; empty if there is none.
        heading: of its column on pages, empty if no page shows it; shown: format of a number there.
        in_tables: True if a table of runs may state it, under its own column.
        imposed: kinds of `rig.IMPOSED` whose tables may; empty: all of them.
        acts: load on which it acts: `GROUND` or `SHAFT`; `VEHICLE`: on the ground too, and no other load has it;
            empty: any.
        usual: its value in a table that does not state it; None: none stands for it.
    """

    field: str = ""
    heading: str = dataclasses.field(default="", kw_only=True)
    shown: str = dataclasses.field(default="{:g}", kw_only=True)
    in_tables: bool = dataclasses.field(default=False, kw_only=True)
    imposed: tuple[str, ...] = dataclasses.field(default=(), kw_only=True)
    acts: str = dataclasses.field(default="", kw_only=True)
    usual: float | None = dataclasses.field(default=None, kw_only=True)

    @property
    def key(self) -> str:
        """Its field of `Conditions`, or its name if it has none."""
        return self.field or self.name


@dataclasses.dataclass(frozen=True)
class Label(Quantity):
    """A word that tables of runs state of a row."""

    def __init__(self, name: str, label: str) -> None:
        """Makes a quantity without a unit and a range."""
        super().__init__(name, "", 1.0, label, (-math.inf, math.inf))


#: Words of a row of a table.
LABELS: tuple[Label, ...] = (
    Label("configuration", "name of the robot's configuration"),
    Label("surface", "name of the ground"),
    Label("run_id", "name of the run, of which a row is a sample"),
    Label("mode", "mode of the motors' driver: voltage, brake or coast"),
)

#: Loads on which a condition acts.
GROUND, SHAFT, VEHICLE = "ground", "shaft", "vehicle"
_MILLIVOLT, _MILLIAMPERE = (("mV", 1e-3),), (("mA", 1e-3),)
_GRAM, _RADIAN = (("g", 1e-3),), (("rad", 1.0),)
_TIMES = (("ms", 1e-3), ("us", 1e-6), ("ns", 1e-9), ("min", 60.0), ("h", 3600.0))
_TORQUES = (("mNm", 1e-3), ("kNm", 1e3))
_SHARES = ((PERCENT, 1e-2),)
_VOLTS, _SHARE, _SWITCH = (-100.0, 100.0), (-1.0, 1.0), (-1.0, 1.0)
_BY_VOLTAGE = ("voltage",)
_RATIO, _RADIANS_PER_SECOND = (1e-3, 100.0), (-1e4, 1e4)

#: All numbers that can be set for a run.
SET: tuple[Condition, ...] = (
    Condition(
        "supply_voltage", "V", 1.0, "supply voltage", _VOLTS, "voltage", other_units=_MILLIVOLT, heading="U [V]",
        in_tables=True, usual=0.0, in_profiles=True,
    ),
    Condition(
        "motor_speed", "rad/s", 1.0, "motor speed imposed on the shafts", _RADIANS_PER_SECOND, "motor_speed",
        heading="n [rpm]",
    ),
    Condition(
        "motor_current", "A", 1.0, "current imposed on each motor", (-2000.0, 2000.0), "motor_current",
        heading="I [A]", shown="{:.4g}",
    ),
    Condition(
        "total_mass", "kg", 1.0, "total mass of robot and payload", (0.1, 500.0), "total_mass", other_units=_GRAM,
        heading="M [kg]", shown="{:.1f}", in_tables=True, acts=GROUND,
    ),
    Condition(
        "payload", "kg", 1.0, "payload", (0.0, 300.0), "payload", other_units=_GRAM, heading="payload [kg]",
        in_tables=True, acts=GROUND, usual=0.0, in_profiles=True,
    ),
    Condition(
        "slope", "deg", DEG, "slope, positive uphill", (-45.0, 45.0), "slope_deg", other_units=_RADIAN, percent=True,
        heading="slope [°]", in_tables=True, acts=GROUND, usual=0.0, in_profiles=True,
    ),
    Condition(
        "load_torque", "Nm", 1.0, "torque of a brake on the output of each drive, positive against forward rotation",
        (-1e4, 1e4), "load_torque", unit_si="N·m", other_units=_TORQUES, heading="load torque [N·m]", shown="{:.4g}",
        in_tables=True, acts=SHAFT, in_profiles=True,
    ),
    Condition("battery", "", 1.0, "on-board battery instead of the external supply", (0.0, 1.0), "battery"),
    Condition("discharge", "C", 1.0, "charge already taken from the battery", (0.0, 360_000.0), "discharge"),
    Condition("adhesion", "", 1.0, "adhesion as a ratio to the one the robot is stated for", _RATIO, "adhesion"),
    Condition("order", "", 1.0, "place in the sequence of runs", (0.0, 1e9), "order", in_tables=True),
    Condition(
        "duty", "", 1.0, "share of the supply's voltage that the driver gives the motors", _SHARE, "duty",
        other_units=_SHARES, in_tables=True, imposed=_BY_VOLTAGE, in_profiles=True,
    ),
    Condition("open", "", 1.0, "1 where the motors' circuit is open", _SWITCH, "open"),
    Condition(
        "motor_acceleration", "rad/s^2", 1.0, "acceleration of an imposed motor speed", (-1e7, 1e7),
        "motor_acceleration",
    ),
    *(
        Condition(
            f"duty_{side}", "", 1.0, f"share of the supply's voltage at the {side} motor", _SHARE, f"duty_{side}",
            other_units=_SHARES, heading=f"duty {side}", shown="{:.3g}", in_tables=True, imposed=_BY_VOLTAGE,
            acts=VEHICLE, in_profiles=True,
        )
        for side in ("left", "right")
    ),
    *(
        Condition(f"open_{side}", "", 1.0, f"1 where the {side} motor's circuit is open", _SWITCH, f"open_{side}")
        for side in ("left", "right")
    ),
    *(
        Condition(
            f"motor_speed_{side}", "rad/s", 1.0, f"motor speed imposed on the {side} side", _RADIANS_PER_SECOND,
            f"motor_speed_{side}",
        )
        for side in ("left", "right")
    ),
    Condition(
        "heading", "deg", DEG, "heading at the start, from uphill, positive to the left", (-360.0, 360.0),
        "heading_deg", other_units=_RADIAN, heading="heading from uphill [°]", in_tables=True,
        imposed=(*_BY_VOLTAGE, "motor_speed"), acts=VEHICLE,
    ),
    Condition("adhesion_lateral", "", 1.0, "the same as adhesion, across the travel", _RATIO, "adhesion_lateral"),
    *(
        Condition(
            f"levers_{end}", "deg", DEG,
            f"angle of the {end} levers, 0 along the wheelbase outward, positive up, 180 folded", (-180.0, 180.0),
            f"levers_{end}_deg", other_units=_RADIAN, in_tables=True, acts=VEHICLE,
        )
        for end in ("front", "rear")
    ),
    Condition(
        "time", "s", 1.0, "time since the start", (0.0, 1e6), other_units=_TIMES, in_tables=True, in_profiles=True
    ),
    *(
        Condition(
            f"voltage_{side}", "V", 1.0, f"voltage of the {side} motor", _VOLTS, other_units=_MILLIVOLT,
            in_tables=True, imposed=_BY_VOLTAGE, acts=VEHICLE, in_profiles=True,
        )
        for side in ("left", "right")
    ),
    Condition(
        "current_other", "A", 1.0, "current of other consumers on the battery", (0.0, 50.0),
        other_units=_MILLIAMPERE, in_profiles=True,
    ),
)  # fmt: skip

#: Conditions of a run that are numbers, by their fields of `Conditions`.
CONDITIONS: dict[str, Condition] = {c.field: c for c in SET if c.field}
#: All of `SET`, by column.
BY_COLUMN: dict[str, Condition] = {c.column: c for c in SET}


def condition_named(name: str) -> Condition:
    """Returns the condition of a name without its unit: `slope`, `supply_voltage`.

    Raises:
        KeyError: no such quantity.
    """
    return {c.name: c for c in SET}[name]
