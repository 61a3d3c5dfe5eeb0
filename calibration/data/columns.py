"""Columns of tables of runs: which a robot's table has, which it may lack, and the units that their names state."""

from __future__ import annotations

import dataclasses
import difflib
from collections.abc import Collection, Mapping
from typing import TYPE_CHECKING

from calibration.data.input_errors import BadData
from mmrjax.model import channels, quantities
from mmrjax.model.channels import Channel
from mmrjax.model.quantities import BY_COLUMN, RPM, Quantity

if TYPE_CHECKING:
    from mmrjax.model.rig import Instrument
    from mmrjax.model.robot import Robot

#: Column of what is imposed (`rig.IMPOSED`), and the SI value of its unit.
SUPPLY, SPEED, CURRENT = "supply_voltage_V", "motor_speed_rpm", "motor_current_A"
IMPOSED = {"voltage": (SUPPLY, 1.0), "motor_speed": (SPEED, RPM), "motor_current": (CURRENT, 1.0)}
#: Conditions that the packaged robot's tables state, by column.
CONDITIONS = {c: BY_COLUMN[c] for c in (SUPPLY, "total_mass_kg", "payload_kg", "slope_deg")}
TIME = {"time_s": BY_COLUMN["time_s"]}
#: Rows of all runs of a log from which on readings of fewer are used (`thinning`).
ROWS = 4000
#: What a time history may state of its motors' driver: the share of the supply's voltage that they get, negative
#: backward; and how they are driven: by that share, or not, their terminals shorted or their circuit open.
DUTY = {"duty": BY_COLUMN["duty"]}
DRIVEN = ("voltage", "brake", "coast")
#: The motors' circuit in each of these modes, see `Conditions.open`.
CIRCUITS = dict(zip(DRIVEN, (0.0, -1.0, 1.0), strict=True))
DRIVING = ("duty", "mode")
#: What a table may state of a robot whose sides are driven apart: the shares of the supply's voltage that the motors
#: of either side get; and where it heads at the start, from uphill, positive to the left.
SIDES = {c: BY_COLUMN[c] for c in ("duty_left", "duty_right")}
#: The same in volts, which are read as those shares (`sides.of_volts`).
VOLTS = {c: BY_COLUMN[c] for c in ("voltage_left_V", "voltage_right_V")}
#: The same where speeds are imposed.
SPEEDS = tuple(channels.find(f"motor_speed_{side}").column for side in channels.SIDES)
HEADING = {"heading_deg": BY_COLUMN["heading_deg"]}
#: Angles of a tracked robot's levers, 0 along the wheelbase outward, positive up, 180 folded.
LEVERS = {c: BY_COLUMN[c] for c in ("levers_front_deg", "levers_rear_deg")}
#: Torque of a brake on the output of each drive, positive against forward rotation.
LOAD = "load_torque_Nm"
#: Place of a row in the sequence in which runs were made; without it that of the row in the file.
ORDER = {"order": BY_COLUMN["order"]}
#: Columns that say when a row was measured; a table without either was measured in the order of its rows.
WHEN = ("time_s", "order")
WORDS = ("configuration", "surface", "run_id", "mode")
#: Columns that every table of the packaged robot has to have, and those that one without measurements may lack.
REQUIRED, OWN = ("configuration", *CONDITIONS), ("total_mass_kg",)
#: What a column that a table may lack is then.
DEFAULTS = {"slope_deg": 0.0, "payload_kg": 0.0, SUPPLY: 0.0}
#: Conditions that act on a vehicle alone, and on a load on a shaft alone.
ON_GROUND, ON_SHAFT = ("total_mass_kg", "payload_kg", "slope_deg"), (LOAD,)

#: How alike the names of two columns are at least for one to be meant by the other.
ALIKE = 0.6

#: Conditions whose columns state a unit, in the order in which spellings of them are looked for.
_WITH_UNITS = {**CONDITIONS, **TIME, **DUTY, **SIDES, **VOLTS, **HEADING, **LEVERS, LOAD: BY_COLUMN[LOAD]}


def ranges() -> dict[str, tuple[float, float]]:
    """Least and greatest value of every number column."""
    read = [q for c in channels.EVERY for q in (c, c.deviation)]
    return {q.column: q.range for q in (*_WITH_UNITS.values(), *read, *ORDER.values())}


def _of_channel(channel: Channel) -> dict[str, Quantity]:
    return {q.column: q for q in (channel, channel.deviation)}


@dataclasses.dataclass(frozen=True)
class Meaning:
    """What a column of a file means.

    Attributes:
        column: as this program calls it; shown: as the file does.
        quantity: what it holds; None for a word, or a number without a unit.
        unit: of its name; factor: from its cells to that unit.
    """

    column: str
    shown: str
    quantity: Quantity | None = None
    unit: str = ""
    factor: float = 1.0

    @property
    def as_named(self) -> bool:
        """Whether its cells are in the unit of `column`."""
        return self.factor == 1.0 and (self.quantity is None or self.unit == next(iter(self.quantity.units)))

    def value(self, written: float) -> float:
        """A cell's number in the unit of `column`."""
        written = written * self.factor
        return written if self.quantity is None else self.quantity.value(written, self.unit)

    def limits(self) -> tuple[float, float]:
        """Least and greatest number that a cell may hold."""
        if self.as_named or self.quantity is None:
            return ranges()[self.column]
        low, high = (x / self.factor for x in self.quantity.limits(self.unit))
        return (low, high) if self.factor > 0 else (high, low)


@dataclasses.dataclass(frozen=True)
class Layout:
    """What a robot's tables of runs hold.

    Attributes:
        imposed: on its motors, one of `rig.IMPOSED`.
        has_ground: whether a ground carries it, see `Robot.has_ground`.
        weight: whether a weight or a constant torque acts on it, which may drive its motors either way.
        inherits: whether what its file leaves open is a packaged robot's.
        configurations: its names.
        instruments: of channels, where more is known than that they are there.
        mapped: (column as this program calls it, column of the file, factor from its unit).
        channels: that its readings are of, in the order of arrays.
    """

    imposed: str = "voltage"
    has_ground: bool = True
    weight: bool = False
    inherits: bool = True
    configurations: tuple[str, ...] = ()
    instruments: tuple[Instrument, ...] = ()
    mapped: tuple[tuple[str, str, float], ...] = ()
    channels: tuple[Channel, ...] = dataclasses.field(default_factory=channels.usual)

    @classmethod
    def of(cls, robot: Robot | None) -> Layout:
        """That of a robot's tables; of None the packaged robot's."""
        if robot is None:
            return cls()
        rig = robot.rig
        loads = robot.configurations.members
        weight = any(float(x) != 0 for load in loads for x in (load.torque_constant, load.torque_gravity))
        names = robot.configurations.names
        return cls(
            rig.imposed, robot.has_ground, weight, rig.inherits, names, rig.instruments, rig.columns, robot.channels
        )

    @property
    def table8(self) -> bool:
        """Whether it is driven as the paper's robot is, so that the conditions of Table 8 are conditions of it."""
        return self.inherits and self.has_ground and self.imposed == "voltage"

    @property
    def complete(self) -> bool:
        """Whether tables have to state every condition; else what they leave open is as it mostly is."""
        return self.table8

    @property
    def crosses_zero(self) -> bool:
        """Whether readings may cross zero, so that errors are percent of a channel's size and not of the reading."""
        return not self.table8 or not set(channels.OF_TURNS).isdisjoint(self.channels)

    @property
    def idle(self) -> tuple[str, ...]:
        """Columns of conditions that do not act on its load."""
        return ON_SHAFT if self.has_ground else (*ON_GROUND, *LEVERS, "surface")

    @property
    def imposed_column(self) -> str:
        """Column of what is imposed."""
        return IMPOSED[self.imposed][0]

    @property
    def sides(self) -> tuple[str, ...]:
        """Columns that say what drives the left and the right side of a robot that turns; none of one that cannot."""
        imposed = {"voltage": tuple(SIDES), "motor_speed": SPEEDS}.get(self.imposed, ())
        return imposed if self.has_ground else ()

    @property
    def axes(self) -> tuple[str, ...]:
        """Columns of the conditions that a run of it has, what is imposed first."""
        return (self.imposed_column, *(c for c in ON_GROUND if c not in self.idle))

    @property
    def measured_columns(self) -> tuple[str, ...]:
        """Columns of the channels, in the order of arrays."""
        return tuple(c.column for c in self.channels)

    @property
    def deviation_columns(self) -> tuple[str, ...]:
        """Columns of the channels' sds, in the order of arrays."""
        return tuple(c.sd_column for c in self.channels)

    def magnitude(self, channel: str) -> bool:
        """Whether the instrument of a channel shows its magnitude alone."""
        return any(i.channel == channel and i.signed is False for i in self.instruments)

    def variance(self, channel: str) -> float:
        """Of the error by the step of a channel's instrument [SI²]."""
        return sum(i.variance for i in self.instruments if i.channel == channel)

    def known(self) -> tuple[str, ...]:
        """Every column that means something."""
        driven: tuple[str, ...] = DRIVING if self.imposed == "voltage" else ()
        if self.sides:
            driven = (*driven, *self.sides, *(VOLTS if self.imposed == "voltage" else ()), *HEADING)
        driven = (*driven, *(LEVERS if self.has_ground else ON_SHAFT))
        named = ("configuration", *self.axes, SUPPLY, *self.measured_columns, *self.deviation_columns, "surface")
        return tuple(dict.fromkeys(c for c in (*named, "run_id", "time_s", *driven, *ORDER) if c not in self.idle))

    def required(self, *, measured: bool, battery: bool) -> tuple[str, ...]:
        """Columns that a table has to have, besides channels."""
        if self.complete:
            own = (() if measured else OWN) + ((SUPPLY,) if battery else ())
            return tuple(c for c in REQUIRED if c not in own)
        imposed = () if battery and self.imposed == "voltage" else (self.imposed_column,)
        return (("configuration",) if len(self.configurations) != 1 else ()) + imposed

    def quantities(self) -> dict[str, Quantity]:
        """What each number column holds, by its name."""
        found: dict[str, Quantity] = {**_WITH_UNITS}
        for channel in channels.EVERY:
            if channel in self.channels or channel.column in (self.imposed_column, *self.sides):
                found |= _of_channel(channel)
        known = (*self.known(), *ON_GROUND, *ON_SHAFT)
        return {column: quantity for column, quantity in found.items() if column in known}

    def meanings(self, source: str, header: list[str]) -> list[Meaning | None]:
        """What each column of a file means, None where nothing; names may state another unit.

        Raises:
            BadData: two columns of one meaning.
        """
        by_name = self._by_name()
        theirs = {column: (mine, factor) for mine, column, factor in self.mapped if column in header}
        taken = {_standard(by_name, mine) for mine, _ in theirs.values()}
        found: list[Meaning | None] = []
        for column in header:
            if column in theirs:
                mine, factor = theirs[column]
                meant = by_name.get(mine)
                if meant is None and mine in _of_every_channel():  # one that is not read
                    found.append(None)
                    continue
                if meant is None:
                    raise BadData(
                        f"{source}: the robot's file reads {mine} from column {column}; this program has no column "
                        f"{mine} for it (known: {', '.join(self.known())})"
                    )
                found.append(dataclasses.replace(meant, shown=column, factor=factor))
            else:
                meant = by_name.get(column)
                found.append(None if meant is None or meant.column in taken else meant)
        for k, meaning in enumerate(found):
            twin = next((m for m in found[:k] if m and meaning and m.column == meaning.column), None)
            if meaning and twin and meaning.shown != twin.shown:
                raise BadData(f"{source}: columns {twin.shown} and {meaning.shown} state the same; keep one of them")
        return found

    def _by_name(self) -> Mapping[str, Meaning]:
        """Every name of a column, in any unit, with what it means."""
        known = (*self.known(), *ON_GROUND, *ON_SHAFT)
        held = self.quantities()
        found = {
            name: Meaning(column, name, quantity, unit)
            for column, quantity in held.items()
            for name, unit in quantity.columns().items()
        }
        for column in known:  # its own name, whatever the unit
            quantity = held.get(column)
            own = None if quantity is None else next(iter(quantity.units))
            found[column] = Meaning(column, column, quantity, own or "")
        return found

    def spellings(self) -> tuple[str, ...]:
        """Every name that a column of a file may have and that means something, in any unit."""
        return (*self._by_name(), *(column for _, column, _ in self.mapped))

    def nearest(self, name: str, stated: Collection[str]) -> str:
        """The column, in the unit of `name`, that a column without a role is most like: by its name, else as the only
        condition in its unit; empty where it is like none.

        Args:
            stated: columns that the table has, which are left out.
        """
        none = {*stated, *self.idle, *self.deviation_columns, *TIME}
        lacking = {column: quantity for column, quantity in self.quantities().items() if column not in none}
        spelled = {s: (column, unit) for column, q in lacking.items() for s, unit in q.columns().items()}
        unit = quantities.at_the_end(name, {unit for _, unit in spelled.values()})
        pool = [s for s, (column, own) in spelled.items() if own == unit or (unit is None and s == column)]
        close = difflib.get_close_matches(name.casefold(), [s.casefold() for s in pool], 1, ALIKE)
        if close:
            return next(s for s in pool if s.casefold() == close[0])
        alone = [s for s in pool if unit and spelled[s][0] not in self.measured_columns]
        return alone[0] if len(alone) == 1 else ""

    def expected(self, column: str) -> str:
        """The column, and where the robot's file says that it is read from."""
        theirs = next((their for mine, their, _ in self.mapped if _standard(self._by_name(), mine) == column), None)
        return column if theirs is None else f"{column} (in the robot's file: {theirs})"


def _of_every_channel() -> set[str]:
    """Names of columns of every channel, in any unit."""
    every = (quantity for channel in channels.EVERY for quantity in _of_channel(channel).values())
    return {name for quantity in every for name in quantity.columns()}


def _standard(by_name: Mapping[str, Meaning], name: str) -> str:
    return by_name[name].column if name in by_name else name
