"""Table of runs: columns by name, readings in SI, and the conditions of its rows."""

from __future__ import annotations

import re
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from calibration.data import Columns, Names, named_arrays
from calibration.data.columns import (
    CIRCUITS,
    CONDITIONS,
    DRIVEN,
    DUTY,
    HEADING,
    IMPOSED,
    LEVERS,
    LOAD,
    SUPPLY,
    TIME,
    WHEN,
    Layout,
)
from calibration.data.input_errors import BadData, allowed_words
from mmrjax.model import channels, quantities
from mmrjax.model.channels import Channel
from mmrjax.model.conditions import Conditions
from mmrjax.model.paper_tables import SURFACES, adhesion_ratio, lateral_ratio
from mmrjax.model.robot import Robot


def configuration_on_surface(configuration: str, surface: str) -> str:
    """Name of a configuration on a surface."""
    return f"{configuration}-{re.sub(r'[^0-9A-Za-z_]+', '_', surface)}"


def rows_of_scaled_adhesion(robot: Robot, configurations: np.ndarray, labels: np.ndarray) -> np.ndarray:
    """True for rows whose adhesion is the robot's times the ratio of Table 5, shape (rows,)."""
    pairs = list(zip(configurations.tolist(), labels.tolist(), strict=True))
    labelled = SURFACES if robot.rig.scales_adhesion else ()
    of_table5 = {
        (name, label): label in labelled and configuration_on_surface(name, label) not in robot.configurations
        for name, label in set(pairs)
    }
    return np.array([of_table5[pair] for pair in pairs], bool)


@dataclass(frozen=True)
class Runs:
    """Table of runs with one row for each run, or for each sample if it has `time_s`.

    Attributes:
        source: where it came from, for messages.
        columns: name → array of shape (rows,). Numbers in the unit of the name, words as str, NaN for missing
            readings.
        unknown: columns of the file that this program does not know.
        digest: SHA-256 of the file, empty for a table in memory.
        extras: cells of `unknown` columns, shape (rows,): numbers, NaN if empty, or words. They have no role and are
            not in `columns`. Only the search for correlations with residuals uses them.
        layout: meaning of its columns for its robot, and its channels.
        notes: sentences on the reading of the file, and on missing data.
        headings: names of the columns in the file, by their names in this program.
        log: the whole log, if these rows are a selection of it (see `thinning`). None: the rows are complete.
    """

    source: str
    columns: Columns
    unknown: Names = ()
    digest: str = ""
    extras: Columns = field(default_factory=dict)
    layout: Layout = field(default_factory=Layout)
    notes: Names = ()
    headings: Mapping[str, str] = field(default_factory=dict)
    log: Runs | None = None

    def __len__(self) -> int:
        return len(next(iter(self.columns.values())))

    def __getitem__(self, column: str) -> np.ndarray:
        return self.columns[column]

    def has(self, column: str) -> bool:
        """True if the table has this column."""
        return column in self.columns

    def with_columns(self, columns: Columns, *notes: str) -> Runs:
        """Table with further or other columns, and further notes."""
        return replace(self, columns={**self.columns, **columns}, notes=(*self.notes, *notes))

    def check_rows(self, checks: Iterable[named_arrays.Check]) -> None:
        """Runs checks of its rows, see `named_arrays.check_rows`."""
        named_arrays.check_rows(self.source, self.columns, checks)

    def without_columns(self, names: Collection[str]) -> Runs:
        """Table without these columns."""
        return replace(self, columns={name: values for name, values in self.columns.items() if name not in names})

    def place(self, first: int, last: int | None = None) -> str:
        """Source and row, or rows, counted from 1, for the beginning of a message."""
        rows = f"row {first + 1}" if last is None else f"rows {first + 1} to {last + 1}"
        return f"{self.source} {rows}"

    def heading(self, column: str) -> str:
        """Name of a column in the file."""
        return self.headings.get(column, column)

    @property
    def turns(self) -> bool:
        """True if its robot is free to turn: its sides are driven independently, or it does not head uphill."""
        return any(self.has(name) for name in (*self.layout.sides, *HEADING))

    @property
    def of_sides(self) -> np.ndarray:
        """Voltage of left and right side [V] (on a battery, duty), or their speed [rpm], shape (2, rows). Negative in
        reverse. For a table with `turns`.
        """
        columns, ones = self.columns, np.ones(len(self))
        side_drives = np.stack([columns.get(name, columns.get("duty", ones)) for name in self.layout.sides])
        supply = columns.get(SUPPLY, ones) if self.layout.imposed == "voltage" else ones
        return side_drives * np.where(np.isnan(supply), 1.0, supply)

    @property
    def commanded(self) -> np.ndarray:
        """The imposed quantity, times the duty if that is the voltage, shape (rows,)."""
        duty = self.columns.get("duty", 1.0) if self.layout.imposed == "voltage" else 1.0
        return self[self.layout.imposed_column] * duty

    @property
    def driven_on(self) -> np.ndarray:
        """True for rows whose stated load torque acts in the direction of the drive, shape (rows,)."""
        return self.columns.get(LOAD, 0.0) * self.commanded < 0

    @property
    def channels(self) -> tuple[Channel, ...]:
        """Channels of its readings, in the order of arrays."""
        return self.layout.channels

    @property
    def present_channels(self) -> tuple[Channel, ...]:
        """Channels for which it has a column."""
        return tuple(c for c in self.channels if self.has(c.column))

    def of(self, robot: Robot) -> Runs:
        """Table with the channels of a robot. Columns of other channels are not used by the model.

        Raises:
            BadData: the table was read for another robot, which lacks a channel of this one.
        """
        if self.channels == robot.channels:
            return self
        robot_columns = {column for c in robot.channels for column in (c.column, c.sd_column)}
        if lost_columns := [column for column in self.unknown if column in robot_columns]:
            raise BadData(
                f"{self.source}, {lost_columns[0]}: the table was read without this channel; read it with "
                "robot=, set to this robot"
            )
        robot_columns |= {self.layout.imposed_column, IMPOSED[robot.rig.imposed][0], *self.layout.sides}
        other_columns = {column for c in channels.EVERY for column in (c.column, c.sd_column)} - robot_columns
        remaining_columns = {name: values for name, values in self.columns.items() if name in other_columns}
        return replace(
            self.without_columns(remaining_columns),
            unknown=(*self.unknown, *remaining_columns),
            extras={**self.extras, **remaining_columns},
            layout=replace(self.layout, channels=robot.channels),
        )

    @property
    def axes(self) -> Names:
        """Columns of the conditions that its runs have, the imposed quantity first."""
        duty = () if self.sampled else DUTY
        usual = (*CONDITIONS, *DUTY, *WHEN)
        others = (c.column for c in quantities.SET if c.in_tables and c.field and c.column not in usual)
        axis_names = (*self.layout.axes, *duty, *self.layout.sides, *HEADING, *LEVERS, *others)
        return tuple(dict.fromkeys(c for c in axis_names if self.has(c)))

    @property
    def pulled(self) -> bool:
        """True if gravity, a constant torque or a load motor may drive the motors."""
        sloped = self.has("slope_deg") and bool(self["slope_deg"].any())
        return self.layout.weight or sloped or bool(self.driven_on.any())

    def turns_round(self, channel: Channel) -> bool:
        """True if a channel's readings have the sign of what drives the motors.

        This is true for speeds, and for currents if nothing else drives the motors. A bridge that reverses the
        voltage also reverses the supply current. In a turn each side has its own sign, and the yaw rate has the sign
        of their difference (`contradictions.check_turns`).
        """
        is_signed = channel.directed and channel.name != "motor_voltage" and not self.layout.magnitude(channel.name)
        if self.turns or not is_signed:
            return False
        is_reversed = self.has("duty") and channel.name == "total_current"
        return channel.zero_at_rest or not (self.pulled or is_reversed)

    @property
    def sampled(self) -> bool:
        """True if the rows are samples of runs."""
        return all(self.has(column) for column in TIME)

    @property
    def whole(self) -> Runs:
        """The log from which its rows were selected, or the table itself."""
        return self if self.log is None else self.log

    @property
    def run_names(self) -> np.ndarray:
        """Run name of each row, shape (rows,). "" in a table without `run_id`."""
        return self["run_id"] if self.has("run_id") else np.zeros(len(self), str)

    def in_order(self, name: str) -> np.ndarray:
        """Rows of the run with a name, in order of time."""
        rows = np.flatnonzero(self.run_names == name)
        return rows[np.argsort(self["time_s"][rows], kind="stable")]

    def rows_by_run(self) -> dict[str, np.ndarray]:
        """Rows of each run, by name, in order of time. Runs are in the order of the file."""
        return {name: self.in_order(name) for name in dict.fromkeys(self.run_names.tolist())}

    def where(self, rows: np.ndarray) -> Runs:
        """Table with the rows that a mask or an index selects."""
        columns, extras = ({k: v[rows] for k, v in cells.items()} for cells in (self.columns, self.extras))
        return replace(self, columns=columns, extras=extras)

    def measured(self) -> np.ndarray:
        """Measured readings [SI], NaN if missing, shape (rows, channels)."""
        return self._stacked(tuple(c.column for c in self.channels))

    def deviations(self) -> np.ndarray:
        """Stated sds of the readings [SI], NaN if not stated, shape (rows, channels)."""
        return self._stacked(tuple(c.sd_column for c in self.channels))

    def _stacked(self, columns: Names) -> np.ndarray:
        empty_column = np.full(len(self), np.nan)
        stacked = [self.columns.get(column, empty_column) for column in columns]
        return np.stack(stacked, 1) * np.asarray([c.factor for c in self.channels])

    def configurations(self, robot: Robot) -> np.ndarray:
        """Index of each row's configuration in `robot`, shape (rows,).

        It is the configuration for the row's surface (`configuration_on_surface`) if the robot has
        one, otherwise the stated configuration.

        Raises:
            InputError: the robot lacks a configuration. The message lists those that it has.
        """
        names, first_rows, inverse = np.unique(
            self.configurations_named(robot), return_index=True, return_inverse=True
        )
        for name, row in zip(names.tolist(), first_rows, strict=True):
            if name not in robot.configurations:
                raise BadData(
                    f"{self.place(row)}, configuration: got {name}; expected one of these; "
                    f"{allowed_words(name, robot.configurations)}"
                )
        return np.array([robot.configurations.index(name) for name in names.tolist()], int)[inverse]

    def configurations_named(self, robot: Robot) -> np.ndarray:
        """Names of `configurations`. Configurations that the robot lacks keep the table's name."""
        configurations = self["configuration"]
        if not self.has("surface"):
            return configurations
        pairs = list(zip(configurations.tolist(), self["surface"].tolist(), strict=True))
        name_on_surface = {pair: configuration_on_surface(*pair) for pair in set(pairs)}
        return np.array([name_on_surface[p] if name_on_surface[p] in robot.configurations else p[0] for p in pairs])

    def conditions(self, robot: Robot, *, battery: float = 0.0, discharge: float = 0.0) -> Conditions:
        """Conditions as one batch of shape (rows,).

        The mass is `total_mass_kg` if the table has that column, otherwise the robot's own mass plus the payload.

        Args:
            robot: has the configurations of the table.
            battery: 1 for the on-board battery.
            discharge: charge already taken from it [C].

        Raises:
            BadData: for the same reasons as `configurations`.
        """
        from mmrjax.model.conditions import Conditions

        configuration_index = self.configurations(robot)
        modes = self["mode"] if self.has("mode") else np.full(len(self), DRIVEN[0])
        adhesion, lateral = np.ones(len(self)), np.ones(len(self))
        if self.has("surface"):
            scaled = rows_of_scaled_adhesion(robot, self["configuration"], self["surface"])
            on_tracks = robot.configurations.tracked[configuration_index][scaled]
            pairs = list(zip(self["surface"][scaled], on_tracks, strict=True))
            adhesion[scaled] = [adhesion_ratio(*pair) for pair in pairs]
            lateral[scaled] = [lateral_ratio(*pair) for pair in pairs]
        column, factor = IMPOSED[robot.rig.imposed]
        imposes_other = robot.rig.imposed != "voltage"
        if imposes_other and not self.has(column):
            raise BadData(f"{self.source}: no {column}, the imposed quantity of the robot's file; add it")
        set_values = {
            c.field: self[c.column] for c in quantities.SET if c.in_tables and c.field and self.has(c.column)
        }
        set_values["duty"] = np.where(modes == DRIVEN[0], set_values.get("duty", 1.0), 0.0)
        sets_motor_speed = imposes_other and not robot.rig.follows_goal
        set_values["voltage"] = np.zeros(len(self)) if battery or sets_motor_speed else self[SUPPLY]
        if robot.rig.follows_goal:
            set_values["goal"] = self[column] * factor
        elif imposes_other:
            set_values[robot.rig.imposed] = self[column] * factor
            for side, name in zip(channels.SIDES, self.layout.sides, strict=False):
                if self.has(name):
                    set_values[f"{robot.rig.imposed}_{side}"] = self[name] * factor
        return Conditions(
            configuration_index,
            battery=battery,
            discharge=discharge,
            adhesion=adhesion,
            adhesion_lateral=lateral if self.turns else None,
            open=[CIRCUITS[mode] for mode in modes] if self.has("mode") else 0.0,
            **set_values,
        )
