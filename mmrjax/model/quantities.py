"""The table of quantities: everything that has a name, a unit and a range. Importable without jax.

`TABLE` has one row for each label, condition, channel, output and requirement, grouped by place of use.
Columns of tables and profiles, options, results, stores, pages and `explain` read these rows. A new channel is one
row, a new condition a row and a field of `Conditions`, a new output a row and the function that computes it.
"""

from __future__ import annotations

import dataclasses
import functools
import math
import re
from collections.abc import Callable, Iterable, Mapping
from dataclasses import replace
from typing import Any

#: Names in order, such as those of effects or columns.
Names = tuple[str, ...]

DEG = math.pi / 180  # rad
RPM = math.pi / 30  # rad/s
MM = 1e-3  # m

#: Units of each dimension that a column may state, with the SI value of each.
DIMENSIONS: tuple[Mapping[str, float], ...] = (
    {"V": 1.0, "mV": 1e-3},
    {"A": 1.0, "mA": 1e-3},
    {"kg": 1.0, "g": 1e-3},
    {"Nm": 1.0, "mNm": 1e-3, "kNm": 1e3},
    {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9, "min": 60.0, "h": 3600.0},
    {"deg": DEG, "rad": 1.0, "turns": 2 * math.pi},
    {"rpm": RPM, "rad/s": 1.0, "turns/s": 2 * math.pi, "deg/s": DEG},
    {"mm/s": MM, "m/s": 1.0, "km/h": 1 / 3.6, "cm/s": 1e-2, "m/min": 1 / 60},
    {"mm": MM, "m": 1.0, "cm": 1e-2, "um": 1e-6},
)
#: Units without another one; C is a coulomb, and a degree Celsius where the row writes °C.
ALONE = {
    **dict.fromkeys(("", "-", "C", "°C", "N·m", "N", "W", "J", "rad/s^2"), 1.0), "Wh": 3600.0, "Wh/m": 3600.0,
}  # fmt: skip
SIZES: dict[str, float] = {unit: size for units in (*DIMENSIONS, ALONE) for unit, size in units.items()}
#: Unit of a share in per cent, and of a slope: the tangent of its angle.
PERCENT = "percent"
#: Signs that are turned: by travel in the other direction, and by a turn to the other side.
TRAVEL, TURN = "travel", "turn"
#: Sides of a robot that turns, in the order of every axis of 2.
SIDES = ("left", "right")
#: Units as people write them, where a column's name has another spelling. Energy per metre has its metre in its name.
WRITTEN = {
    "°": "deg", "v": "V", "volt": "V", "volts": "V", "a": "A", "amp": "A", "amps": "A", "ma": "mA", "mv": "mV",
    "gram": "g", "grams": "g", "°c": "C", "1/min": "rpm", "u/min": "rpm", "wh/m": "Wh", "-": "",
    "r/min": "rpm", "min-1": "rpm", "°/s": "deg/s", "nmm": "mNm", "n·mm": "mNm",
}  # fmt: skip


_SPELLED = {unit.lower(): unit for unit in SIZES}


def unit_in_column(unit: str) -> str:
    """Returns a unit as a column's name ends with it: `km_h` for `km/h`, `rpm` for `RPM`, `Nm` for `N-m`."""
    unit = WRITTEN.get(unit.lower(), unit)
    if torque := re.fullmatch(r"([mk]?)[Nn][ ._*·-]?m", unit):
        unit = f"{torque[1]}Nm"
    elif unit not in SIZES and len(unit) > 1 and not unit.startswith("M"):  # a capital M may be mega
        unit = _SPELLED.get(unit.lower(), unit)
    return unit.replace("/", "_").replace("%", PERCENT).replace("·", "")


def unit_at_end(text: str, allowed: Iterable[str]) -> str | None:
    """Unit among `allowed` at the end of a column's name, such as kNm of `torque_kNm`, `Torque [kN·m]`, or None."""
    ending = re.split(r"[\[(\s]", text.rstrip("])"))[-1]
    letters = re.split(r"[^A-Za-z/]", ending)[-1]
    letters_unit = unit_in_column(letters) if len(letters) > 1 else ""
    ending = unit_in_column(ending)
    matches = [u for u in allowed if u and (u == letters_unit or re.search(rf"(?:^|[^A-Za-z]){u}$", ending))]
    return max(matches, key=len, default=None)


@dataclasses.dataclass(frozen=True, eq=False)
class Quantity:
    """A number with its unit, its range and the rule for its sign. A row equals only itself.

    Attributes:
        name: noun. With the unit, the name of its column.
        unit: unit of its column.
        label: words of reports.
        range: least and greatest value [unit].
        factor: the SI value of one unit, if its values are not in SI. By default the unit's.
        resolution: digits after the point in reports [unit].
        written: unit as people write it, if it differs from `unit`.
        percent: True if per cent are accepted too.
        stem: start of the names of its columns, if it differs from `name`.
        sign: what reverses its sign: `TRAVEL`, `TURN`, or nothing (empty).
        in_profiles: True if a mission's profile may state it.
        rests_on: dotted names of the parameters that it depends on. It is unknown if one of them is.
        group: computation that gives it: a module of `mmrjax.derived`, or one of `requirements.GROUPS`.
        ignores: columns of conditions that it does not depend on, because its computation solves for them or sets
            them.
        least: True if a single number in a requirement is a lower limit, False if it is an upper limit.
    """

    name: str
    unit: str
    label: str
    range: tuple[float, float] = (-math.inf, math.inf)
    _: dataclasses.KW_ONLY
    factor: float = math.nan
    resolution: int = 3
    written: str = ""
    percent: bool = False
    stem: str = ""
    sign: str = ""
    in_profiles: bool = False
    rests_on: Names = ()
    group: str = ""
    ignores: Names = ()
    least: bool = False

    def __post_init__(self) -> None:
        self._complete(factor=SIZES[self.unit] if math.isnan(self.factor) else self.factor)

    def _complete(self, **values: Any) -> None:
        """Sets fields whose defaults follow from others."""
        for name, value in values.items():
            object.__setattr__(self, name, value)

    @property
    def key(self) -> str:
        """Name of the field of Python that holds it."""
        return self.name

    @functools.cached_property
    def column(self) -> str:
        """Name of its column in tables, with the unit."""
        return self._column(unit_in_column(self.unit))

    @property
    def unit_shown(self) -> str:
        """Its unit as people write it: C is a coulomb, °C a temperature."""
        return self.written or ("N·m" if self.unit == "Nm" else self.unit)

    @property
    def unit_si(self) -> str:
        """Its SI unit."""
        return self.unit_shown if self.factor == 1.0 else next(u for u, size in self.sizes.items() if size == 1.0)

    @property
    def axes(self) -> Names:
        """Axes of an envelope of use that it depends on."""
        return tuple(axis for axis in AXES if axis not in self.ignores)

    @functools.cached_property
    def sizes(self) -> dict[str, float]:
        """SI value of each unit that its column names may state, its own unit first. Slopes cannot be in percent."""
        dimension: Mapping[str, float] = next((units for units in DIMENSIONS if self.unit in units), {})
        percent_size = {PERCENT: 1e-2} if self.percent and self.unit != "deg" else {}
        return {self.unit: self.factor} | {u: size for u, size in dimension.items() if u != self.unit} | percent_size

    @property
    def other_units(self) -> Names:
        """Further units that its columns may state."""
        return (*[unit for unit in self.sizes if unit not in (self.unit, PERCENT)], *[PERCENT] * self.percent)

    @functools.cached_property
    def units(self) -> dict[str, float]:
        """Value of one unit in the unit of its column, by its spelling, that of the column first."""
        return {unit_in_column(unit): size / self.factor for unit, size in self.sizes.items()}

    def columns(self) -> dict[str, str]:
        """Names of the columns that may hold it, each with the unit at its end."""
        return {self._column(unit): unit for unit in dict.fromkeys((*self.units, *[PERCENT] * self.percent))}

    def _column(self, unit: str) -> str:
        stem = self.stem or self.name
        return f"{stem}_{unit}" if unit else stem

    def value(self, written: float, unit: str) -> float:
        """Returns a value written in `unit`, in the unit of the column."""
        return written * self.units[unit] if unit in self.units else math.degrees(math.atan(written / 100))

    def limits(self, unit: str) -> tuple[float, float]:
        """Returns the least and greatest allowed value in `unit`."""
        low, high = self.range
        if unit not in self.units:
            return 100 * math.tan(math.radians(low)), 100 * math.tan(math.radians(high))
        return low / self.units[unit], high / self.units[unit]


@dataclasses.dataclass(frozen=True, eq=False)
class Condition(Quantity):
    """A quantity that the user sets before a run starts.

    Attributes:
        field: field of `Conditions`, by default its name, or empty.
        heading: heading of its column on pages, empty if no page shows it.
        shown: format of a number there.
        in_tables: True if a table of runs may state it, under its own column.
        imposed: kinds of `rig.IMPOSED` whose tables may. Empty: all of them.
        acts: load on which it acts: `GROUND` or `SHAFT`. `VEHICLE`: on the ground too, and no other load has it.
            Empty: any.
        usual: value for a table without the condition. None: the table must contain it.
    """

    _: dataclasses.KW_ONLY
    field: str | None = None
    heading: str = ""
    shown: str = "{:g}"
    in_tables: bool = False
    imposed: Names = ()
    acts: str = ""
    usual: float | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        self._complete(field=self.name if self.field is None else self.field)

    @property
    def key(self) -> str:
        """Its field of `Conditions`, or its name if it has none."""
        return self.field or self.name

    @functools.cached_property
    def sizes(self) -> dict[str, float]:
        """SI value of each unit that its columns may state. Only its own unit if no file may hold it."""
        return super().sizes if self.in_tables or self.in_profiles else {self.unit: self.factor}


@dataclasses.dataclass(frozen=True, eq=False)
class Channel(Quantity):
    """A quantity that an instrument can show.

    Attributes:
        sd_largest: largest sd that a table may hold [unit].
        sd_share: assumed standard deviation as a share of the reading, if no other is known [-].
        word: short name that `--noise` takes, by default its name.
        signal: reading of an ideal instrument [SI]: the field of `Signals`, by default of its name, or a function of
            robot and signals.
        zero_at_rest: True if it shows 0 until the robot moves.
        sign: what turns it: the travel, or a turn. An angle counts on from its last value.
        settled, over_time: True if settled runs and histories can show it.
        zero_error: standard deviation of the instrument's zero [SI], 0 for counters and clocks, which have none.
        side: 0 or 1 for a channel of the left or right side. None: a channel of both together.
        where: place of the measurement, if the label does not give it.
    """

    sd_largest: float = math.inf
    sd_share: float = 0.01
    _: dataclasses.KW_ONLY
    word: str = ""
    signal: str | Callable[..., Any] = ""
    resolution: int = 1
    zero_at_rest: bool = False
    sign: str = TRAVEL
    settled: bool = True
    over_time: bool = True
    zero_error: float = 0.0
    side: int | None = None
    where: str = ""

    def __post_init__(self) -> None:
        super().__post_init__()
        self._complete(word=self.word or self.name, signal=self.signal or self.name)

    def read(self, robot: Any, signals: Any) -> Any:
        """Reading of an ideal instrument [SI]."""
        return getattr(signals, self.signal) if isinstance(self.signal, str) else self.signal(robot, signals)

    @property
    def directed(self) -> bool:
        """True if its sign is that of the motion."""
        return bool(self.sign)

    @functools.cached_property
    def deviation(self) -> Quantity:
        """Standard deviation of its readings, as a column of tables."""
        label = f"standard deviation of {self.label}"
        return Quantity(f"{self.stem or self.name}_sd", self.unit, label, (0.0, self.sd_largest))

    @property
    def sd_column(self) -> str:
        """Name of the column of its standard deviation."""
        return self.deviation.column

    @property
    def misses_zero(self) -> bool:
        """True if its instrument may have a zero error. The zero of a temperature is a convention."""
        return self.zero_error > 0 and self.directed

    def of_side(self, side: int) -> Channel:
        """The same channel of one side."""
        side_name, side_label = f"{self.name}_{SIDES[side]}", f"{self.label}, {SIDES[side]}"
        return replace(self, name=side_name, label=side_label, word=side_name, side=side, in_profiles=False)

    def __reduce__(self) -> tuple[Callable[[str], Channel], tuple[str]]:
        """Pickles the channel by its name, so that tables and results can go to other processes."""
        return channel_of_name, (self.name,)


def channel_of_name(name: str) -> Channel:
    """The row of a channel."""
    return next(c for c in channel_rows() if c.name == name)


def _winding_temperature(robot: Any, signals: Any) -> Any:
    """Winding temperature [°C]: the present one if it is followed, else after long running at this current."""
    if signals.temperature is not None:
        return signals.temperature
    return robot.motor.temperature_settled(signals.current)


#: Loads on which a condition acts.
GROUND, SHAFT, VEHICLE = "ground", "shaft", "vehicle"
#: Parameters of the robot that a quantity may depend on. `CURRENT`: the current at an imposed speed. `VOLTAGE`: the
#: voltage at an imposed speed or current. `HEAT`: the winding temperature after long running. `WARMING`: over time.
CURRENT = ("motor.torque_constant",)
VOLTAGE = ("motor.resistance", *CURRENT)
HEAT = (*VOLTAGE, "motor.resistance_thermal_winding", "motor.resistance_thermal_housing")
WARMING = (*HEAT, "motor.time_constant_winding", "motor.time_constant_housing")
#: Axes of an envelope of use, which each of its points states.
AXES = ("payload_kg", "slope_deg", "charge", "ambient_C")
PAYLOAD, SLOPE, CHARGE, AMBIENT = AXES
#: Sinks of energy, in the order of the drive chain: name and description.
SINKS: dict[str, str] = {
    "battery": "heat in the battery's cells",
    "other": "other consumers on the battery",
    "driver": "driver and wiring: open bridge, diode, and drops",
    "winding": "heat in windings, leads and brushes",
    "motor": "friction of the motors",
    "gearbox": "losses of the gearboxes",
    "track": "losses of tracks and guides",
    "sliding": "sliding over the ground",
    "rolling": "rolling resistance",
    "lift": "lifting robot and payload (comes back downhill)",
}
#: Goals of a controller that a rig may impose.
GOALS = ("goal_angle", "goal_speed", "goal_current")
# Limits of voltages and speeds exclude what no motor has. What a rig can reach follows from its file (`rig_facts`).
_VOLTS, _SHARE, _ANY_ANGLE = (-10_000.0, 10_000.0), (-1.0, 1.0), (-1e6, 1e6)
_RATIO, _RADIANS_PER_SECOND, _RPMS = (1e-3, 100.0), (-1e5, 1e5), (-1e6, 1e6)
_SPEEDS, _PLACES, _TORQUES = (-10_000.0, 10_000.0), (-1e7, 1e7), (-1e4, 1e4)
_BY_VOLTAGE = ("voltage",)
_CURRENT = Channel(
    "motor_current", "A", "motor current", (-2000.0, 2000.0), 100.0, 0.02, signal="current", zero_error=0.05,
    resolution=3, rests_on=CURRENT, where="in the leads of one motor",
)  # fmt: skip
_SPEED = Channel(
    "motor_speed", "rpm", "motor speed", _RPMS, 10_000.0, 0.005, signal="speed_motor", in_profiles=True,
    zero_at_rest=True,
)  # fmt: skip
_VOLTAGE = Channel(
    "motor_voltage", "V", "motor voltage", _VOLTS, 100.0, signal="voltage", zero_error=0.1, resolution=2,
    rests_on=VOLTAGE,
)  # fmt: skip
_DERIVED = "mmrjax.derived."

#: All quantities by place of use. Labels are words in a row of a table, conditions are set for a run. Channels belong
#: to all robots or to those that turn. Outputs belong to a run, to several operating points (`mmrjax.derived`), or to
#: missions. Histories and settled turns have further columns. Requirements limit the last group.
TABLE: dict[str, tuple[Quantity, ...]] = {
    "label": (
        Quantity("configuration", "", "name of the robot's configuration"),
        Quantity("surface", "", "name of the ground"),
        Quantity("run_id", "", "name of the run, of which a row is a sample"),
        Quantity("mode", "", "mode of the motors' driver: voltage, brake or coast"),
    ),
    "condition": (
        Condition(
            "supply_voltage", "V", "supply voltage", _VOLTS, field="voltage", heading="U [V]", in_tables=True,
            usual=0.0, in_profiles=True,
        ),
        Condition(
            "motor_speed", "rad/s", "motor speed imposed on the shafts", _RADIANS_PER_SECOND, heading="n [rpm]",
        ),
        Condition(
            "motor_current", "A", "current imposed on each motor", (-2000.0, 2000.0), heading="I [A]", shown="{:.4g}",
        ),
        Condition("goal", "", "goal of the controller [SI]", _ANY_ANGLE),
        *(
            Condition(
                name, unit, f"{what} that the controller follows", reach, field="", in_tables=True,
                imposed=(name,), heading=f"goal [{unit}]", shown="{:.4g}",
            )
            for name, unit, what, reach in zip(
                GOALS,
                ("deg", "rpm", "A"),
                ("angle of the output", "speed of the output", "current of each motor"),
                (_ANY_ANGLE, _RPMS, (-2000.0, 2000.0)),
                strict=True,
            )
        ),
        Condition(
            "total_mass", "kg", "total mass of robot and payload", (0.1, 500.0), heading="M [kg]", shown="{:.1f}",
            in_tables=True, acts=GROUND,
        ),
        Condition(
            "payload", "kg", "payload", (0.0, 300.0), heading="payload [kg]", in_tables=True, acts=GROUND, usual=0.0,
            in_profiles=True,
        ),
        Condition(
            "slope", "deg", "slope, positive uphill", (-45.0, 45.0), field="slope_deg", percent=True,
            heading="slope [°]", in_tables=True, acts=GROUND, usual=0.0, in_profiles=True,
        ),
        Condition(
            "load_torque", "Nm", "torque of a brake on the output of each drive, positive against forward rotation",
            _TORQUES, heading="load torque [N·m]", shown="{:.4g}", in_tables=True, acts=SHAFT, in_profiles=True,
        ),
        Condition(
            "held", "", "1 where a clamp holds the output", (0.0, 1.0), heading="held",
            in_tables=True, imposed=("voltage", "motor_current"), acts=SHAFT,
        ),
        Condition("battery", "", "on-board battery instead of the external supply", (0.0, 1.0)),
        Condition("discharge", "C", "charge already taken from the battery", (0.0, 360_000.0)),
        Condition("adhesion", "", "adhesion relative to that in the robot's file", _RATIO),
        Condition("order", "", "place in the sequence of runs", (0.0, 1e9), in_tables=True),
        Condition(
            "duty", "", "share of the supply's voltage at the motors", _SHARE, percent=True,
            in_tables=True, imposed=_BY_VOLTAGE, in_profiles=True,
        ),
        Condition("open", "", "1 if the motors' circuit is open", _SHARE),
        Condition("motor_acceleration", "rad/s^2", "acceleration of an imposed motor speed", (-1e7, 1e7)),
        *(
            Condition(
                f"duty_{side}", "", f"share of the supply's voltage at the {side} motor", _SHARE, percent=True,
                heading=f"duty {side}", shown="{:.3g}", in_tables=True, imposed=_BY_VOLTAGE, acts=VEHICLE,
                in_profiles=True,
            )
            for side in SIDES
        ),
        *(Condition(f"open_{side}", "", f"1 where the {side} motor's circuit is open", _SHARE) for side in SIDES),
        *(
            Condition(f"motor_speed_{s}", "rad/s", f"motor speed imposed on the {s} side", _RADIANS_PER_SECOND)
            for s in SIDES
        ),
        Condition(
            "heading", "deg", "heading at the start, from uphill, positive to the left", (-360.0, 360.0),
            field="heading_deg", heading="heading from uphill [°]", in_tables=True,
            imposed=(*_BY_VOLTAGE, "motor_speed"), acts=VEHICLE,
        ),
        Condition("adhesion_lateral", "", "lateral adhesion relative to that in the robot's file", _RATIO),
        *(
            Condition(
                f"levers_{end}", "deg",
                f"angle of the {end} levers, 0 along the wheelbase outward, positive up, 180 folded", (-180.0, 180.0),
                field=f"levers_{end}_deg", in_tables=True, acts=VEHICLE,
            )
            for end in ("front", "rear")
        ),
        Condition("time", "s", "time since the start", (0.0, 1e6), field="", in_tables=True, in_profiles=True),
        *(
            Condition(
                f"voltage_{side}", "V", f"voltage of the {side} motor", _VOLTS, field="", in_tables=True,
                imposed=_BY_VOLTAGE, acts=VEHICLE, in_profiles=True,
            )
            for side in SIDES
        ),
        Condition(
            "current_other", "A", "current of other consumers on the battery", (0.0, 50.0), field="",
            in_profiles=True,
        ),
    ),
    "channel": (
        Channel(
            "total_current", "A", "total current", (-2000.0, 2000.0), 100.0, 0.02, word="current", resolution=3,
            rests_on=CURRENT, where="drawn from the supply by all motors; with a duty, its share of their current",
        ),
        _SPEED,
        Channel("speed", "mm/s", "speed", _SPEEDS, 5_000.0, in_profiles=True, zero_at_rest=True),
        _CURRENT,
        Channel(
            "output_speed", "rpm", "output speed", _RPMS, 10_000.0, 0.005, signal="speed_output", resolution=2,
            zero_at_rest=True,
        ),
        Channel(
            "output_angle", "deg", "output angle", _ANY_ANGLE, 360.0, signal="angle", resolution=2, zero_at_rest=True,
            sign="", settled=False,
        ),
        Channel(
            "position", "mm", "position", _PLACES, 1e4, resolution=2, zero_at_rest=True, sign="", settled=False,
            signal=lambda robot, signals: robot.chassis(signals.configuration).radius * signals.angle,
        ),
        _VOLTAGE,
        Channel(
            "output_torque", "Nm", "output torque", _TORQUES, 1e3, signal="torque_output", zero_error=0.05,
            resolution=4,
        ),
        Channel(
            "winding_temperature", "C", "winding temperature", (-50.0, 500.0), 100.0, 0.02, word="temperature",
            signal=_winding_temperature, rests_on=HEAT, zero_error=2.0, written="°C", over_time=False, sign="",
        ),
    ),
    "channel of a turn": (
        *(channel.of_side(side) for channel in (_CURRENT, _SPEED, _VOLTAGE) for side in (0, 1)),
        Channel(
            "yaw_rate", "rad/s", "yaw rate", (-100.0, 100.0), 10.0, 0.02, sign=TURN, in_profiles=True,
            zero_error=0.01, resolution=3, zero_at_rest=True,
        ),
        Channel(
            "lateral_speed", "mm/s", "lateral speed", _SPEEDS, 5_000.0, 0.02, signal="speed_lateral",
            zero_at_rest=True,
        ),
        Channel(
            "yaw", "deg", "yaw angle from uphill", _ANY_ANGLE, 360.0, signal="heading", resolution=2, sign="",
            settled=False,
        ),
        *(
            Channel(f"place_{x}", "mm", label, _PLACES, 1e4, stem=x, zero_at_rest=True, sign="", settled=False)
            for x, label in (("x", "place uphill"), ("y", "place to the left"))
        ),
    ),
    "run": (
        Quantity("theoretical_speed", "mm/s", "theoretical speed", resolution=1),
        Quantity("slip", "-", "slip", resolution=4),
        Quantity("voltage", "V", "voltage at the motors", resolution=2, rests_on=VOLTAGE),
        Quantity("adhesion_used", "-", "adhesion used"),
        Quantity("traction", "N", "traction", resolution=1),
        Quantity("power_supply", "W", "supply power", resolution=1, rests_on=VOLTAGE),
        Quantity("power_motor", "W", "motor power", resolution=1),
        Quantity("power_gear", "W", "gearbox power", resolution=1),
        Quantity("power_ground", "W", "ground power", resolution=1),
        Quantity("power_lift", "W", "lifting power", resolution=1),
        Quantity("efficiency_motor", "-", "motor efficiency", rests_on=VOLTAGE),
        Quantity("efficiency_gear", "-", "gearbox efficiency"),
        Quantity("efficiency_chassis", "-", "chassis efficiency"),
        Quantity("winding_settled", "°C", "winding, long running", resolution=1, rests_on=HEAT),
        Quantity("voltage_cell", "V", "cell voltage"),
    ),
    "derived": (
        Quantity(
            "steepest_slope", "deg", "steepest slope held", factor=1.0, group=f"{_DERIVED}steepest_slope",
            resolution=2, ignores=(SLOPE,),
        ),
        Quantity(
            "peak_current", "A", "peak starting current, all motors", group=f"{_DERIVED}start_figures",
            resolution=2, rests_on=CURRENT,
        ),
        Quantity("time_to_speed", "s", "time to 95 % of speed", group=f"{_DERIVED}start_figures"),
        Quantity(
            "energy_start", "J", "electrical energy of the start", group=f"{_DERIVED}start_figures", resolution=2,
            rests_on=VOLTAGE,
        ),
        Quantity("pitch", "deg", "pitch at rest, nose up", group=f"{_DERIVED}pitch_and_step", resolution=2),
        Quantity(
            "highest_step", "mm", "highest step of the posture", group=f"{_DERIVED}pitch_and_step", resolution=1,
        ),
        Quantity("best_step", "mm", "highest step in any posture", group=f"{_DERIVED}pitch_and_step", resolution=1),
        Quantity("turning_radius", "mm", "turning radius", group=f"{_DERIVED}turning_figures", resolution=1),
    ),
    "mission": (
        Quantity("duration", "s", "duration", resolution=1),
        Quantity("distance", "m", "distance travelled, either way", resolution=2),
        Quantity("displacement", "m", "displacement, forward minus backward", resolution=2),
        Quantity("energy", "Wh", "energy"),
        Quantity("energy_per_metre", "Wh/m", "energy per metre", resolution=5),
        Quantity("energy_drawn", "Wh", "energy drawn"),
        Quantity("energy_returned", "Wh", "energy returned"),
        Quantity("rms_current", "A", "rms current, all motors"),
        Quantity("peak_current", "A", "peak current, all motors", resolution=2),
        Quantity("rms_torque", "N·m", "rms torque, one gearbox output"),
        Quantity("peak_torque", "N·m", "peak torque, one gearbox output"),
        Quantity("peak_speed", "mm/s", "peak speed", resolution=1),
        Quantity("peak_motor_speed", "rpm", "peak motor speed", resolution=1),
        Quantity("winding_peak", "°C", "hottest winding", resolution=1, rests_on=WARMING),
        Quantity("cell_low", "V", "lowest cell voltage"),
        Quantity("state_of_charge", "-", "state of charge at the end", resolution=4),
        Quantity("winding_end", "°C", "winding at the end", resolution=1, rests_on=WARMING),
        Quantity("housing_end", "°C", "housing at the end", resolution=1, rests_on=WARMING),
        Quantity("endurance", "s", "endurance at this duty", resolution=0),
        Quantity("range", "m", "range at this duty", resolution=0),
        *(Quantity(f"energy_to_{sink}", "Wh", f"energy to: {meaning}") for sink, meaning in SINKS.items()),
        Quantity("energy_stored", "Wh", "rise of the energy in motion"),
        Quantity("unaccounted_share", "-", "energy error of the integration, of the energy converted", resolution=9),
    ),
    "mission of sides": (
        Quantity("turned", "deg", "turned by, positive to the left", resolution=1),
        Quantity("place_x", "m", "moved uphill, or ahead of the start", resolution=2),
        Quantity("place_y", "m", "moved to the left of the start", resolution=2),
        Quantity("peak_yaw_rate", "rad/s", "peak yaw rate"),
        *(Quantity(f"rms_current_{side}", "A", f"rms current, {side} motor") for side in SIDES),
        *(Quantity(f"peak_current_{side}", "A", f"peak current, {side} motor", resolution=2) for side in SIDES),
        *(Quantity(f"winding_peak_{side}", "°C", f"hottest winding, {side}", resolution=1) for side in SIDES),
    ),
    "history": (
        Quantity("winding_temperature", "°C", "winding, at that time", rests_on=WARMING),
        Quantity("housing_temperature", "°C", "housing, at that time", rests_on=WARMING),
        Quantity("permissible_time", "s", "time this current may flow, from ambient temperature", rests_on=WARMING),
    ),
    "turn": (
        Quantity(
            "turning_radius", "mm", "radius of the circle, positive to the left; inf: straight",
        ),
        Quantity("centre_x", "mm", "instantaneous centre of rotation ahead of the centre of mass"),
        Quantity("centre_y", "mm", "instantaneous centre of rotation to the left of the centre of mass"),
        Quantity("effective_width", "mm", "effective track width (V_teor,right - V_teor,left) / yaw rate"),
        *(Quantity(f"power_{s}", "W", f"electrical power of the {s} motor", rests_on=VOLTAGE) for s in SIDES),
        *(
            Quantity(f"winding_{s}", "°C", f"winding temperature of the {s} motor after long running", rests_on=HEAT)
            for s in SIDES
        ),
    ),
    "requirement": (
        Quantity("speed", "m/s", "speed", group="travel", least=True),
        Quantity("speed_end_of_charge", "m/s", "speed at the end of charge", group="travel", least=True),
        Quantity("slope", "deg", "steepest slope held", factor=1.0, group="slope", least=True, ignores=(SLOPE,)),
        Quantity("payload", "kg", "largest payload", group="payload", least=True, ignores=(PAYLOAD,)),
        Quantity("mass", "kg", "mass without payload", group="mass", ignores=AXES),
        Quantity("endurance", "min", "endurance", group="endurance", least=True, ignores=(CHARGE,)),
        Quantity("winding", "°C", "winding after long running", group="travel"),
        Quantity("gearbox", "N·m", "torque of a gearbox", group="travel"),
        Quantity("gearbox_speed", "rpm", "speed at the gearbox input", group="travel"),
        Quantity("motor_speed", "rpm", "speed of the motors", group="travel"),
        Quantity("current", "A", "current of all motors", group="travel"),
        Quantity("energy_per_metre", "Wh/m", "energy per metre", group="travel"),
        Quantity("turn_in_place", "rad/s", "yaw rate on the spot", group="turn", least=True, ignores=(SLOPE,)),
        Quantity("turning_radius", "mm", "turning radius around a braked side", group="turn", ignores=(SLOPE,)),
        Quantity(
            "side_slope", "deg", "steepest slope travelled across", factor=1.0, group="across", least=True,
            ignores=AXES[1:],
        ),
        Quantity("step", "mm", "highest step", group="posture", least=True, ignores=AXES[1:]),
        Quantity("stairs_rise", "mm", "highest rise of stairs", group="posture", least=True, ignores=AXES[1:]),
        Quantity("gap", "mm", "widest gap", group="posture", least=True, ignores=AXES[1:]),
        Quantity("length", "mm", "length with levers folded", group="posture", ignores=AXES),
        Quantity("height", "mm", "height with levers folded", group="posture", ignores=AXES),
    ),
}  # fmt: skip


def channel_rows() -> tuple[Channel, ...]:
    """All channels, those of straight travel first."""
    return tuple(q for place in ("channel", "channel of a turn") for q in TABLE[place] if isinstance(q, Channel))


#: Words of a row of a table, and all numbers that can be set for a run.
LABELS = TABLE["label"]
SET: tuple[Condition, ...] = tuple(q for q in TABLE["condition"] if isinstance(q, Condition))
#: Conditions of a run that are numbers, by their fields of `Conditions`.
CONDITIONS: dict[str, Condition] = {c.field: c for c in SET if c.field}
#: All of `SET`, by column.
BY_COLUMN: dict[str, Condition] = {c.column: c for c in SET}
