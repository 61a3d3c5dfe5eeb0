"""Runs from outside: tables of operating points as CSV with units in the column names, checked cell by cell."""

from __future__ import annotations

import csv
import dataclasses
import difflib
import hashlib
import math
from collections.abc import Mapping
from importlib import resources
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from calibration.data.errors import BadConfiguration, BadData, InputError, choices, number
from mmrjax import channels
from mmrjax.channels import MM, RPM
from mmrjax.tables import SURFACES, adhesion_ratio

if TYPE_CHECKING:
    from mmrjax.conditions import Conditions
    from mmrjax.robot import Robot

#: Condition columns with the least and greatest value allowed.
CONDITIONS: dict[str, tuple[float, float]] = {
    "supply_voltage_V": (-100.0, 100.0),  # negative: backward
    "total_mass_kg": (0.1, 500.0),
    "payload_kg": (0.0, 300.0),
    "slope_deg": (-45.0, 45.0),
}
TIME: dict[str, tuple[float, float]] = {"time_s": (0.0, 1e6)}
#: What a time history may state of its motors' driver: the share of the supply's voltage that they get, negative
#: backward; and how they are driven: by that share, or not, their terminals shorted or their circuit open.
DUTY: dict[str, tuple[float, float]] = {"duty": (-1.0, 1.0)}
DRIVEN = ("voltage", "brake", "coast")
DRIVING = ("duty", "mode")
#: Place of a row in the sequence in which runs were made; without it that of the row in the file.
ORDER: dict[str, tuple[float, float]] = {"order": (0.0, 1e9)}
#: Columns that say when a row was measured; a table without either was measured in the order of its rows.
WHEN = ("time_s", "order")
WORDS = ("configuration", "surface", "run_id", "mode")
#: Columns that every table has to have, and those that a table without measurements may lack.
REQUIRED, OWN = ("configuration", *CONDITIONS), ("total_mass_kg",)

__all__ = ["CONDITIONS", "MM", "RPM", "Runs", "known_columns", "measured_columns", "read", "single"]


def measured_columns() -> tuple[str, ...]:
    """Columns of the channels, in the order of arrays."""
    return tuple(c.column for c in channels.CHANNELS)


def known_columns() -> tuple[str, ...]:
    """Every column that means something in a table of runs."""
    deviations = tuple(c.sd_column for c in channels.CHANNELS)
    return (*REQUIRED, *measured_columns(), *deviations, "surface", "run_id", "time_s", *DRIVING, *ORDER)


def _ranges() -> dict[str, tuple[float, float]]:
    """Least and greatest value of every number column."""
    readings = {c.column: c.range for c in channels.CHANNELS}
    deviations = {c.sd_column: (0.0, c.sd_largest) for c in channels.CHANNELS}
    return {**CONDITIONS, **readings, **deviations, **TIME, **DUTY, **ORDER}


#: Tables that come with the package.
PACKAGED = {"measured": "measured.csv", "simulated_by_paper": "simulated_by_paper.csv"}


@dataclasses.dataclass(frozen=True)
class Runs:
    """A table of runs, one row each (or one row a sample, with `time_s` among the columns).

    Attributes:
        source: where it came from, for messages.
        columns: name → array of shape (rows,); numbers in the unit of the name, words as str; NaN for a reading
            that is missing.
        unknown: columns of the file that this program does not know.
        digest: SHA-256 of the file, empty for a table that came from none.
        extras: cells of `unknown` columns, shape (rows,): numbers, NaN where empty, or words; not in `columns`, as
            they have no role, and looked at only for what residuals go with.
    """

    source: str
    columns: dict[str, np.ndarray]
    unknown: tuple[str, ...] = ()
    digest: str = ""
    extras: Mapping[str, np.ndarray] = dataclasses.field(default_factory=dict)

    def __len__(self) -> int:
        return len(self.columns["configuration"])

    def __getitem__(self, column: str) -> np.ndarray:
        return self.columns[column]

    def has(self, column: str) -> bool:
        """Whether the table has this column."""
        return column in self.columns

    @property
    def sampled(self) -> bool:
        """Whether a row is a sample of a run."""
        return all(self.has(column) for column in TIME)

    def where(self, rows: np.ndarray) -> Runs:
        """The rows that a mask or an index selects."""
        columns, extras = ({k: v[rows] for k, v in of.items()} for of in (self.columns, self.extras))
        return dataclasses.replace(self, columns=columns, extras=extras)

    def measured(self) -> np.ndarray:
        """Measured readings [SI], NaN where one is missing, shape (rows, channels)."""
        return self._stacked(tuple(c.column for c in channels.CHANNELS))

    def deviations(self) -> np.ndarray:
        """Stated sds of the readings [SI], NaN where none is stated, shape (rows, channels)."""
        return self._stacked(tuple(c.sd_column for c in channels.CHANNELS))

    def _stacked(self, columns: tuple[str, ...]) -> np.ndarray:
        nothing = np.full(len(self), np.nan)
        found = [self.columns.get(column, nothing) for column in columns]
        return np.stack(found, 1) * np.asarray(channels.factors())

    def missing(self) -> list[str]:
        """A sentence for each channel of which readings are missing."""
        said = []
        for k, channel in enumerate(channels.CHANNELS):
            lost = np.flatnonzero(np.isnan(self.measured()[:, k]))
            if not self.has(channel.column) or lost.size == len(self):
                said.append(f"{channel.column}: no readings; what they would show is not fitted")
            elif lost.size:
                rows = ", ".join(str(r + 1) for r in lost[:8]) + (", ..." if lost.size > 8 else "")
                said.append(f"{channel.column}: {lost.size} of {len(self)} readings are missing (rows {rows})")
        return said

    def configurations(self, robot: Robot) -> np.ndarray:
        """Index of each row's configuration in `robot`, shape (rows,).

        Raises:
            InputError: a configuration that the robot does not have; those that it has are listed.
        """
        which = np.empty(len(self), int)
        for name in np.unique(self["configuration"]):
            rows = self["configuration"] == name
            if name not in robot.configurations:
                first = int(np.flatnonzero(rows)[0]) + 1
                raise BadData(
                    f"{self.source} row {first}, configuration: got {name}; expected one of these; "
                    f"{choices(str(name), robot.configurations)}"
                )
            which[rows] = robot.configurations.index(str(name))
        return which

    def conditions(self, robot: Robot, *, battery: float = 0.0, discharge: float = 0.0) -> Conditions:
        """The conditions as one batch of shape (rows,).

        The mass is the stated `total_mass_kg` where the table has that column, else the robot's own mass
        and the payload.

        Args:
            robot: has the configurations of the table.
            battery: 1 for the on-board battery; discharge: charge already taken from it [C].

        Raises:
            BadData: as `configurations`.
        """
        from mmrjax.conditions import Conditions

        which = self.configurations(robot)
        held = self["mode"] != DRIVEN[0] if self.has("mode") else np.zeros(len(self), bool)
        adhesion = np.ones(len(self))
        if self.has("surface"):
            on_tracks = np.array([float(c.on_tracks) > 0.5 for c in robot.configurations.members])[which]
            adhesion = np.array([adhesion_ratio(s, t) for s, t in zip(self["surface"], on_tracks, strict=True)])
        return Conditions(
            which,
            np.zeros(len(self)) if battery else self["supply_voltage_V"],
            self["slope_deg"],
            self["payload_kg"],
            battery=battery,
            discharge=discharge,
            adhesion=adhesion,
            total_mass=self["total_mass_kg"] if self.has("total_mass_kg") else None,
            order=self["order"] if self.has("order") else 0.0,
            duty=np.where(held, 0.0, self["duty"] if self.has("duty") else 1.0),
            open=self["mode"] == "coast" if self.has("mode") else 0.0,
        )


def read(source: str | Path, *, measured: bool = True, battery: bool = False) -> Runs:
    """Read a packaged table by its name, or a CSV file.

    Args:
        source: `measured`, `simulated_by_paper`, or a path.
        measured: whether at least one channel is required; without any `total_mass_kg` may be missing too.
        battery: whether the runs are on the on-board battery, whose voltage no table states: its column is left out,
            or empty.

    Raises:
        BadData: no such file, nothing in it, no channel, a missing, misspelt or repeated column, a row of another
            length, or a cell that is no number, not finite or out of range; said with file, row (counted
            from 1 below the header), column, value and what is allowed.
    """
    if str(source) in PACKAGED:
        with resources.as_file(resources.files("calibration") / "data" / PACKAGED[str(source)]) as path:
            return _read(path, str(source), measured, battery)
    path = Path(source)
    if not path.exists():
        raise BadData(f"{source}: no such file and no packaged table; packaged: {', '.join(PACKAGED)}")
    return _read(path, path.name or str(source), measured, battery)


def _read(path: Path, name: str, measured: bool, battery: bool) -> Runs:
    try:
        content = path.read_bytes()
        text = content.decode("utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        raise BadData(f"{name}: cannot be read as a UTF-8 text file ({error})") from error
    rows = [row for row in csv.reader(text.splitlines()) if any(cell.strip() for cell in row)]
    if not rows:
        expected = ", ".join((*REQUIRED, *measured_columns()))
        raise BadData(f"{name}: the file is empty; expected a header with {expected}")
    header = [cell.strip() for cell in rows[0]]
    if len(header) == 1 and ";" in header[0]:
        raise BadData(f"{name}: columns are separated by semicolons; expected commas, and points in numbers")
    _check_header(name, header, measured, battery)
    if len(rows) == 1:
        raise BadData(f"{name}: a header and no rows; expected at least one run")
    for k, row in enumerate(rows[1:], 1):
        if len(row) != len(header):
            raise BadData(f"{name} row {k}: got {len(row)} cells; the header has {len(header)} columns")
    columns: dict[str, np.ndarray] = {}
    for j, column in enumerate(header):
        if column in known_columns():
            cells = [row[j].strip() for row in rows[1:]]
            if battery and column == "supply_voltage_V":
                _refuse_stated(name, cells)
                continue
            columns[column] = np.array([_cell(f"{name} row {k}", column, cell) for k, cell in enumerate(cells, 1)])
    _check_driving(name, columns)
    _check_mass(name, columns)
    _check_deviations(name, columns)
    if battery:
        columns["supply_voltage_V"] = np.full(len(rows) - 1, np.nan)
    elif measured and not set(TIME) <= set(columns):  # a history may stop, and go on forwards against its motors
        _check_signs(name, columns)
    if not any(column in columns for column in WHEN):
        columns["order"] = np.arange(1.0, len(rows))
    unknown = tuple(c for c in header if c not in known_columns())
    extras = {c: _extra([row[header.index(c)].strip() for row in rows[1:]]) for c in unknown}
    return Runs(name, columns, unknown, hashlib.sha256(content).hexdigest(), extras)


def _extra(cells: list[str]) -> np.ndarray:
    """A column without a role: numbers where every cell that is not empty is one, else words."""
    try:
        return np.array([float(cell) if cell else math.nan for cell in cells])
    except ValueError:
        return np.array(cells)


def _refuse_stated(name: str, voltages: list[str]) -> None:
    for row, cell in enumerate(voltages, 1):
        if cell:
            raise BadData(
                f"{name} row {row}, supply_voltage_V: got {cell} beside --battery, whose charge sets the voltage; "
                "expected an empty cell, or no such column"
            )


def _check_signs(name: str, columns: dict[str, np.ndarray]) -> None:
    """Refuse readings without a sign where the supply drives the robot backward, and rows without a voltage."""
    voltage = columns["supply_voltage_V"]
    if (voltage == 0).any():
        row = int(np.flatnonzero(voltage == 0)[0]) + 1
        raise BadData(f"{name} row {row}, supply_voltage_V: got 0; expected a voltage, in a table of readings")
    for channel in channels.CHANNELS:
        if channel.column not in columns:
            continue
        # Gravity may drive a motor: only up the slope, or on the flat, its current has the sign of its voltage.
        backward = (voltage < 0) & ((columns["slope_deg"] <= 0) | channel.zero_at_rest)
        wrong = np.flatnonzero(backward & (columns[channel.column] > 0))
        if wrong.size:
            at = int(wrong[0])
            raise BadData(
                f"{name} row {at + 1}, {channel.column}: got {number(columns[channel.column][at])} at "
                f"{number(voltage[at])} V; expected readings with their signs, negative backward"
            )


def _check_header(name: str, header: list[str], measured: bool, battery: bool) -> None:
    repeated = sorted({c for c in header if header.count(c) > 1})
    if repeated:
        raise BadData(f"{name}: column {repeated[0]} stands {header.count(repeated[0])} times; expected once")
    known = known_columns()
    strange = [c for c in header if c not in known]
    own = (() if measured else OWN) + (("supply_voltage_V",) if battery else ())
    required = tuple(c for c in REQUIRED if c not in own)
    for column in (c for c in (*required, *measured_columns()) if c not in header):
        close = difflib.get_close_matches(column, strange, 1, 0.6)
        if column in required or close:
            got = f"; is {close[0]} meant?" if close else ""
            raise BadData(f"{name}: column {column} is missing{got} (required: {', '.join(required)})")
    if measured and not any(c in header for c in measured_columns()):
        raise BadData(f"{name}: no column of a channel; expected at least one of {', '.join(measured_columns())}")
    for column in strange:
        close = difflib.get_close_matches(column, [c for c in known if c not in header], 1, 0.85)
        if close:
            raise BadData(f"{name}: unknown column {column}; did you mean {close[0]}? rename or remove it")


def _cell(where: str, column: str, cell: str, kind: type[InputError] = BadData) -> Any:
    def refuse(allowed: str) -> InputError:
        return kind(f"{where}, {column}: got {cell or 'an empty cell'}; expected {allowed}")

    if column in WORDS:
        if column == "surface" and cell not in SURFACES:
            raise refuse(f"one of these; {choices(cell, SURFACES)}")
        if column == "mode" and cell not in DRIVEN:
            raise refuse(f"one of these; {choices(cell, DRIVEN)}")
        if column == "configuration" and not cell:
            raise refuse("the name of one of the robot's configurations")
        return cell
    deviations = [c.sd_column for c in channels.CHANNELS]
    if not cell and column in (*measured_columns(), *deviations, *DUTY):
        return math.nan
    low, high = _ranges()[column]
    positive = column in deviations
    allowed = f"{'more than ' if positive else ''}{number(low)} to {number(high)}"
    try:
        value = float(cell)
    except ValueError:
        raise refuse(f"a number, {allowed}") from None
    if not math.isfinite(value) or not low <= value <= high or (positive and value == low):
        raise refuse(allowed)
    return value


def _check_driving(name: str, columns: dict[str, np.ndarray]) -> None:
    for column in (c for c in DRIVING if c in columns and not set(TIME) <= set(columns)):
        raise BadData(f"{name}: column {column} is for time histories; add {', '.join(TIME)}, or remove it")
    if "duty" not in columns:
        return
    modes = columns.get("mode", np.full(len(columns["duty"]), DRIVEN[0]))
    for row, (duty, mode) in enumerate(zip(columns["duty"], modes, strict=True), 1):
        if mode == DRIVEN[0] and math.isnan(duty):
            raise BadData(f"{name} row {row}, duty: got an empty cell; expected a number, -1 to 1")
        if mode != DRIVEN[0] and not math.isnan(duty) and duty != 0:
            raise BadData(f"{name} row {row}, duty: got {number(duty)} in mode {mode}; expected 0 or an empty cell")
    columns["duty"] = np.nan_to_num(columns["duty"])


def _check_mass(name: str, columns: dict[str, np.ndarray]) -> None:
    if "total_mass_kg" not in columns:
        return
    for row, (total, payload) in enumerate(zip(columns["total_mass_kg"], columns["payload_kg"], strict=True), 1):
        if total <= payload:
            raise BadData(_too_light(f"{name} row {row}", total, payload))


def _check_deviations(name: str, columns: dict[str, np.ndarray]) -> None:
    for channel in channels.CHANNELS:
        if channel.column in columns and channel.sd_column in columns:
            lost = np.isfinite(columns[channel.column]) & ~np.isfinite(columns[channel.sd_column])
            if lost.any():
                raise BadData(
                    f"{name} row {int(np.flatnonzero(lost)[0]) + 1}, {channel.sd_column}: got an empty cell beside a "
                    f"reading; expected its sd, more than 0 {channel.unit}"
                )


def _too_light(where: str, total: float, payload: float) -> str:
    included = f"more than the payload of {number(payload)} kg that it includes"
    return f"{where}, total_mass_kg: got {number(total)}; expected {included}"


def single(cells: dict[str, Any]) -> Runs:
    """One run from options by column name, each checked as a cell of a file would be; without a voltage on a battery.

    Raises:
        BadConfiguration: an option that is out of range, not finite or an unknown word.
    """
    texts = {column: number(value) if isinstance(value, float) else str(value) for column, value in cells.items()}
    columns = {column: np.array([_cell("option", column, t, BadConfiguration)]) for column, t in texts.items()}
    columns.setdefault("supply_voltage_V", np.array([math.nan]))
    if "total_mass_kg" in cells and cells["total_mass_kg"] <= cells["payload_kg"]:
        raise BadConfiguration(_too_light("option", cells["total_mass_kg"], cells["payload_kg"]))
    columns = {c: np.array([cells[c]]) if isinstance(cells.get(c), float) else v for c, v in columns.items()}
    return Runs("the options", columns)
