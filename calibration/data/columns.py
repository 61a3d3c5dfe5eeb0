"""Columns of tables of runs, derived from the tables `quantities` and `channels`."""

from __future__ import annotations

import difflib
import functools
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

from calibration.data import Mapped, Names
from calibration.data.input_errors import BadData
from mmrjax.model import channels, quantities
from mmrjax.model.channels import Channel
from mmrjax.model.quantities import BY_COLUMN, GOALS, GROUND, RPM, SHAFT, VEHICLE, Condition, Quantity

if TYPE_CHECKING:
    from mmrjax.model.rig import Instrument
    from mmrjax.model.robot import Robot

#: Column of each imposed quantity (`rig.IMPOSED`), and the SI value of its unit.
SUPPLY, SPEED, CURRENT = "supply_voltage_V", "motor_speed_rpm", "motor_current_A"
IMPOSED = {"voltage": (SUPPLY, 1.0), "motor_speed": (SPEED, RPM), "motor_current": (CURRENT, 1.0)}
IMPOSED |= {c.name: (c.column, c.factor) for c in quantities.SET if c.name in GOALS}
#: Number of rows of a log above which a fit uses only some of them (`thinning`).
ROWS = 4000


def _conditions_of_loads(*loads: str) -> dict[str, Condition]:
    """Conditions that a table may contain for these loads, by column."""
    return {c.column: c for c in quantities.SET if c.in_tables and c.acts in loads}


#: Conditions that act only on vehicles, and only on loads on a shaft.
ON_GROUND, ON_SHAFT = tuple(_conditions_of_loads(GROUND)), tuple(_conditions_of_loads(SHAFT))
#: Conditions in the packaged robot's tables, and default values of optional ones.
CONDITIONS = {SUPPLY: BY_COLUMN[SUPPLY], **_conditions_of_loads(GROUND)}
DEFAULTS = {c.column: c.usual for c in CONDITIONS.values() if c.usual is not None}
TIME = {"time_s": BY_COLUMN["time_s"]}
#: State of the motors' driver in a time history. Duty: share of the supply voltage, negative backward. Mode: driven
#: at that duty, shorted terminals, or open circuit.
DUTY = {"duty": BY_COLUMN["duty"]}
DRIVEN = ("voltage", "brake", "coast")
#: The motors' circuit in each of these modes, see `Conditions.open`.
CIRCUITS = dict(zip(DRIVEN, (0.0, -1.0, 1.0), strict=True))
DRIVING = ("duty", "mode")
#: Duty of each side's motors, for a robot whose sides are driven independently.
SIDES = {c: BY_COLUMN[c] for c in ("duty_left", "duty_right")}
#: The same in volts, converted to shares (`contradictions.with_duties_of_sides`).
VOLTS = {c: BY_COLUMN[c] for c in ("voltage_left_V", "voltage_right_V")}
#: The same where speeds are imposed.
SPEEDS = tuple(channels.find_channel(f"motor_speed_{side}").column for side in channels.SIDES)
HEADING = {"heading_deg": BY_COLUMN["heading_deg"]}
#: Angles of a tracked robot's levers, 0 along the wheelbase outward, positive up, 180 folded.
LEVERS = {c: BY_COLUMN[c] for c in ("levers_front_deg", "levers_rear_deg")}
#: Torque of a brake on the output of each drive, positive against forward rotation.
LOAD = "load_torque_Nm"
#: Columns with the time or order of measurement. Without either, the rows are in the order of measurement.
WHEN = ("time_s", "order")
WORDS = tuple(label.column for label in quantities.LABELS)

#: Least similarity for one column name to count as a misspelling of another.
ALIKE = 0.6


@dataclass(frozen=True)
class Column:
    """A column of a file and the quantity that it holds.

    Attributes:
        shown: name of the column in the file.
        unit: unit of the column.
        factor: factor that converts its cells to that unit.
    """

    quantity: Quantity
    shown: str
    unit: str
    factor: float = 1.0

    @property
    def column(self) -> str:
        """Name of the column in this program."""
        return self.quantity.column

    @property
    def as_named(self) -> bool:
        """True if its cells are in the unit of `column`."""
        return self.factor == 1.0 and self.unit == next(iter(self.quantity.units))

    def value(self, written: float) -> float:
        """Number of a cell in the unit of `column`."""
        return self.quantity.value(written * self.factor, self.unit)

    def limits(self) -> tuple[float, float]:
        """Smallest and largest number that a cell may have."""
        low, high = (x / self.factor for x in self.quantity.limits(self.unit))
        return (low, high) if self.factor > 0 else (high, low)


@dataclass(frozen=True)
class Layout:
    """Properties of a robot that determine the columns of its tables.

    Attributes:
        imposed: quantity imposed on the motors, one of `rig.IMPOSED`.
        has_ground: True if a ground carries the robot, see `Robot.has_ground`.
        weight: True if a weight or a constant torque acts on the robot and may drive its motors in either direction.
        inherits: True if values that the robot file does not state come from a packaged robot.
        configurations: names of the configurations.
        instruments: known properties of instruments.
        mapped: for each renamed column: its name in this program, its name in the file, and the factor from its unit.
        channels: channels of the readings, in the order of the arrays.
        supply: driver voltage of a controller, for tables without that column [V]. 0: tables have the column.
    """

    imposed: str = "voltage"
    has_ground: bool = True
    weight: bool = False
    inherits: bool = True
    configurations: Names = ()
    instruments: tuple[Instrument, ...] = ()
    mapped: Mapped = ()
    channels: tuple[Channel, ...] = field(default_factory=channels.usual_channels)
    supply: float = 0.0

    @classmethod
    def of(cls, robot: Robot | None) -> Layout:
        """Layout of a robot. None: of the packaged robot."""
        if robot is None:
            return cls()
        rig = robot.rig
        loads = robot.configurations.members
        weight = any(float(x) != 0 for load in loads for x in (load.torque_constant, load.torque_gravity))
        names = robot.configurations.names
        supply = 0.0 if robot.controller is None else robot.controller.supply_voltage
        return cls(
            rig.imposed, robot.has_ground, weight, rig.inherits, names, rig.instruments, rig.columns, robot.channels,
            supply,
        )  # fmt: skip

    @property
    def complete(self) -> bool:
        """True if the robot is driven like the paper's robot, so that the conditions of Table 8 apply and tables must
        contain every condition. Otherwise a missing condition has its usual value.
        """
        return self.inherits and self.has_ground and self.imposed == "voltage"

    @property
    def crosses_zero(self) -> bool:
        """True if readings may cross zero. Errors are then relative to the channel's size instead of the reading."""
        return not self.complete or not set(channels.OF_TURNS).isdisjoint(self.channels)

    @functools.cached_property
    def idle(self) -> Names:
        """Columns of conditions that do not act on the robot's load."""
        return ON_SHAFT if self.has_ground else (*_conditions_of_loads(GROUND, VEHICLE), "surface")

    @property
    def imposed_column(self) -> str:
        """Column of the imposed quantity."""
        return IMPOSED[self.imposed][0]

    @property
    def sides(self) -> Names:
        """Columns of the commands of the left and right side. Empty if the robot cannot turn."""
        side_columns = {"voltage": tuple(SIDES), "motor_speed": SPEEDS}.get(self.imposed, ())
        return side_columns if self.has_ground else ()

    @property
    def axes(self) -> Names:
        """Columns of the conditions of a run. The imposed quantity is first."""
        return (self.imposed_column, *(c for c in ON_GROUND if c not in self.idle))

    @property
    def measured_columns(self) -> Names:
        """Columns of the channels, in the order of arrays."""
        return tuple(c.column for c in self.channels)

    @property
    def deviation_columns(self) -> Names:
        """Columns of the channels' sds, in the order of arrays."""
        return tuple(c.sd_column for c in self.channels)

    def magnitude(self, channel: str) -> bool:
        """True if a channel's instrument shows only the magnitude."""
        return any(i.channel == channel and i.signed is False for i in self.instruments)

    def variance(self, channel: str) -> float:
        """Variance of the quantisation error of a channel's instrument [SI²]."""
        return sum(i.variance for i in self.instruments if i.channel == channel)

    def known(self) -> Names:
        """Every column that has a meaning."""
        reading_columns = (SUPPLY, *self.measured_columns, *self.deviation_columns)
        labels = [word for word in WORDS if word != "mode" or self.imposed in ("voltage", *GOALS)]
        set_columns = [c.column for c in quantities.SET if c.in_tables and self.imposed in (c.imposed or IMPOSED)]
        column_names = ("configuration", *self.axes, *reading_columns, *labels, "time_s", *self.sides, *set_columns)
        return tuple(dict.fromkeys(c for c in column_names if c not in self.idle))

    def required(self, *, measured: bool, battery: bool) -> Names:
        """Columns that a table must have besides channels."""
        if self.complete:
            optional = (() if measured else ("total_mass_kg",)) + ((SUPPLY,) if battery else ())
            return tuple(c for c in ("configuration", *CONDITIONS) if c not in optional)
        columns: Names = () if battery and self.imposed == "voltage" else (self.imposed_column,)
        columns += (SUPPLY,) if self.imposed in GOALS and not self.supply else ()
        return (("configuration",) if len(self.configurations) != 1 else ()) + columns

    def quantities(self) -> dict[str, Quantity]:
        """Quantity of each column, including conditions that do not act on the load."""
        present_channels = [
            c for c in channels.EVERY if c in self.channels or c.column in (self.imposed_column, *self.sides)
        ]
        candidates = (*quantities.LABELS, *quantities.SET, *(q for c in present_channels for q in (c, c.deviation)))
        known_columns = {*self.known(), *ON_GROUND, *ON_SHAFT}
        return {q.column: q for q in candidates if q.column in known_columns}

    def meanings(self, source: str, header: list[str]) -> list[Column | None]:
        """Quantity of each column of a file, None for an unknown column. A name may state any unit of its quantity.

        Raises:
            BadData: two columns hold the same quantity.
        """
        by_name = self._by_name
        mapped = {column: (name, factor) for name, column, factor in self.mapped if column in header}
        unread = {name for c in channels.EVERY for q in (c, c.deviation) for name in q.columns()} if mapped else set()
        mapped_columns = {by_name[name].column for name, _ in mapped.values() if name in by_name}
        meanings: list[Column | None] = []
        for column in header:
            if column not in mapped:
                meant = by_name.get(column)
                meanings.append(None if meant is None or meant.column in mapped_columns else meant)
                continue
            name, factor = mapped[column]
            meant = by_name.get(name)
            if meant is None and name not in unread:
                raise BadData(
                    f"{source}: the robot's file reads {name} from column {column}; mmrjax has no column "
                    f"{name} (known: {', '.join(self.known())})"
                )
            meanings.append(None if meant is None else replace(meant, shown=column, factor=factor))
        meaning_by_column: dict[str, Column] = {}
        for meaning in filter(None, meanings):
            first = meaning_by_column.setdefault(meaning.column, meaning)
            if meaning.shown != first.shown:
                raise BadData(
                    f"{source}: columns {first.shown} and {meaning.shown} have the same meaning; keep one of them"
                )
        return meanings

    @functools.cached_property
    def _by_name(self) -> Mapping[str, Column]:
        """Every possible column name, in any unit, with its quantity."""
        return {
            name: Column(quantity, name, unit)
            for quantity in self.quantities().values()
            for name, unit in quantity.columns().items()
        }

    def spellings(self) -> Names:
        """Every possible name of a known column, in any unit."""
        return (*self._by_name, *(column for _, column, _ in self.mapped))

    def nearest(self, name: str, stated: Collection[str]) -> str:
        """Known column most similar to the unknown column `name`, in its unit.

        It has a similar name or is the only condition in that unit. Empty if there is none.

        Args:
            stated: columns that the table already has, which are left out.
        """
        ignored = {*stated, *self.idle, *self.deviation_columns, *WHEN, *WORDS, "held"}
        column_and_unit = {
            s: (column, unit)
            for column, q in self.quantities().items()
            if column not in ignored
            for s, unit in q.columns().items()
        }
        unit = quantities.unit_at_end(name, {unit for _, unit in column_and_unit.values()})
        pool = [
            s
            for s, (column, spelled_unit) in column_and_unit.items()
            if spelled_unit == unit or (unit is None and s == column)
        ]
        close = difflib.get_close_matches(name.casefold(), [s.casefold() for s in pool], 1, ALIKE)
        if close:
            return next(s for s in pool if s.casefold() == close[0])
        names_in_unit = [s for s in pool if unit and column_and_unit[s][0] not in self.measured_columns]
        return names_in_unit[0] if len(names_in_unit) == 1 else ""

    def expected(self, column: str) -> str:
        """Name of the column, and its name in the source if the robot file states one."""
        for name, source_column, _ in self.mapped:
            if name == column or (name in self._by_name and self._by_name[name].column == column):
                return f"{column} (in the robot's file: {source_column})"
        return column
