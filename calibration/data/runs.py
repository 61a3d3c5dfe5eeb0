"""Runs from outside: tables of operating points as CSV with units in the column names, checked cell by cell."""

from __future__ import annotations

import csv
import dataclasses
import difflib
import hashlib
import math
from importlib import resources
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from calibration.data.errors import BadConfiguration, BadData, DoorError, choices, number
from mmrjax.tables import CONFIGURATIONS, SURFACES, adhesion_ratio

if TYPE_CHECKING:
    from mmrjax.conditions import Conditions

#: Condition columns with the least and greatest value allowed.
CONDITIONS: dict[str, tuple[float, float]] = {
    "supply_voltage_V": (0.0, 100.0),
    "total_mass_kg": (0.1, 500.0),
    "payload_kg": (0.0, 300.0),
    "slope_deg": (-45.0, 45.0),
}
#: Measured columns, in the order of `mmrjax.signals.Reading`.
MEASURED: dict[str, tuple[float, float]] = {
    "total_current_A": (-200.0, 200.0),
    "motor_speed_rpm": (-30_000.0, 30_000.0),
    "speed_mm_s": (-10_000.0, 10_000.0),
}
CHANNELS = ("total_current", "motor_speed", "speed")
#: Standard deviations of the measured columns; positive.
DEVIATIONS: dict[str, tuple[float, float]] = {
    "total_current_sd_A": (0.0, 100.0),
    "motor_speed_sd_rpm": (0.0, 10_000.0),
    "speed_sd_mm_s": (0.0, 5_000.0),
}
TIME: dict[str, tuple[float, float]] = {"time_s": (0.0, 1e6)}
WORDS = ("configuration", "surface", "run_id")

INPUT_COLUMNS = ("configuration", *CONDITIONS, *MEASURED)
KNOWN_COLUMNS = (*INPUT_COLUMNS, *DEVIATIONS, "surface", "run_id", "time_s")

RPM = math.pi / 30  # rad/s
MM = 1e-3  # m

#: Tables that come with the package.
PACKAGED = {"measured": "measured.csv", "simulated_by_paper": "simulated_by_paper.csv"}


@dataclasses.dataclass(frozen=True)
class Runs:
    """A table of runs, one row each (or one row a sample, with `time_s` among the columns).

    Attributes:
        source: where it came from, for messages.
        columns: name → array of shape (rows,); numbers in the unit of the name, words as str.
        unknown: columns of the file that this program does not know, kept out.
        digest: SHA-256 of the file, empty for a table that came from none.
    """

    source: str
    columns: dict[str, np.ndarray]
    unknown: tuple[str, ...] = ()
    digest: str = ""

    def __len__(self) -> int:
        return len(self.columns["configuration"])

    def __getitem__(self, column: str) -> np.ndarray:
        return self.columns[column]

    def has(self, column: str) -> bool:
        """Whether the table has this column."""
        return column in self.columns

    def where(self, rows: np.ndarray) -> Runs:
        """The rows that a mask or an index selects."""
        return dataclasses.replace(self, columns={k: v[rows] for k, v in self.columns.items()})

    def measured(self) -> np.ndarray:
        """Measured current [A], motor speed [rad/s] and speed [m/s], shape (rows, 3)."""
        return np.stack([self["total_current_A"], self["motor_speed_rpm"] * RPM, self["speed_mm_s"] * MM], 1)

    def command(self, **conditions: float) -> Conditions:
        """The conditions as one batched `Conditions` of shape (rows,), SI units.

        The mass is the stated `total_mass_kg` where the table has that column, else the robot's own mass
        and the payload. `conditions` set what no column says (`battery`, `discharge`).
        """

        wheeled = np.asarray(self["configuration"] == CONFIGURATIONS[1], float)
        adhesion = np.ones(len(self))
        if self.has("surface"):
            adhesion = np.array([adhesion_ratio(s, w > 0.5) for s, w in zip(self["surface"], wheeled, strict=True)])
        return Conditions(
            voltage=self["supply_voltage_V"],
            slope_deg=self["slope_deg"],
            payload=self["payload_kg"],
            configuration=wheeled,
            adhesion=adhesion,
            total_mass=self["total_mass_kg"] if self.has("total_mass_kg") else None,
            **conditions,
        )


def read(source: str | Path, *, measured: bool = True) -> Runs:
    """Read a packaged table by its name, or a CSV file.

    Args:
        source: `measured`, `simulated_by_paper`, or a path.
        measured: whether the measured columns are required; without them `total_mass_kg` may be missing too.

    Raises:
        BadData: no such file, nothing in it, a missing, misspelt or repeated column, a row of another
            length, or a cell that is no number, not finite or out of range; said with file, row (counted
            from 1 below the header), column, value and what is allowed.
    """
    if str(source) in PACKAGED:
        with resources.as_file(resources.files("calibration") / "data" / PACKAGED[str(source)]) as path:
            return _read(path, str(source), measured)
    path = Path(source)
    if not path.exists():
        raise BadData(f"{source}: no such file and no packaged table; packaged: {', '.join(PACKAGED)}")
    return _read(path, path.name or str(source), measured)


def _read(path: Path, name: str, measured: bool) -> Runs:
    try:
        content = path.read_bytes()
        text = content.decode("utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        raise BadData(f"{name}: cannot be read as a UTF-8 text file ({error})") from error
    rows = [row for row in csv.reader(text.splitlines()) if any(cell.strip() for cell in row)]
    if not rows:
        raise BadData(f"{name}: the file is empty; expected a header with {', '.join(INPUT_COLUMNS)}")
    header = [cell.strip() for cell in rows[0]]
    if len(header) == 1 and ";" in header[0]:
        raise BadData(f"{name}: columns are separated by semicolons; expected commas, and points in numbers")
    required = (
        INPUT_COLUMNS if measured else tuple(c for c in INPUT_COLUMNS if c not in MEASURED and c != "total_mass_kg")
    )
    _check_header(name, header, required)
    if len(rows) == 1:
        raise BadData(f"{name}: a header and no rows; expected at least one run")
    for k, row in enumerate(rows[1:], 1):
        if len(row) != len(header):
            raise BadData(f"{name} row {k}: got {len(row)} cells; the header has {len(header)} columns")
    columns: dict[str, np.ndarray] = {}
    for j, column in enumerate(header):
        if column in KNOWN_COLUMNS:
            cells = [row[j].strip() for row in rows[1:]]
            columns[column] = np.array([_cell(f"{name} row {k}", column, cell) for k, cell in enumerate(cells, 1)])
    _check_mass(name, columns)
    unknown = tuple(c for c in header if c not in KNOWN_COLUMNS)
    return Runs(name, columns, unknown, hashlib.sha256(content).hexdigest())


def _check_header(name: str, header: list[str], required: tuple[str, ...]) -> None:
    repeated = sorted({c for c in header if header.count(c) > 1})
    if repeated:
        raise BadData(f"{name}: column {repeated[0]} stands {header.count(repeated[0])} times; expected once")
    missing = [c for c in required if c not in header]
    for column in missing:
        close = difflib.get_close_matches(column, [c for c in header if c not in KNOWN_COLUMNS], 1, 0.6)
        got = f"; is {close[0]} meant?" if close else ""
        raise BadData(f"{name}: column {column} is missing{got} (required: {', '.join(required)})")
    for column in (c for c in header if c not in KNOWN_COLUMNS):
        free = [c for c in KNOWN_COLUMNS if c not in header]
        close = difflib.get_close_matches(column, free, 1, 0.85)
        if close:
            raise BadData(f"{name}: unknown column {column}; did you mean {close[0]}? rename or remove it")


def _cell(where: str, column: str, cell: str, kind: type[DoorError] = BadData) -> Any:
    def refuse(allowed: str) -> DoorError:
        return kind(f"{where}, {column}: got {cell or 'an empty cell'}; expected {allowed}")

    if column in WORDS:
        known = {"configuration": CONFIGURATIONS, "surface": tuple(SURFACES)}.get(column)
        if known is not None and cell not in known:
            raise refuse(f"one of these; {choices(cell, known)}")
        return cell
    low, high = (CONDITIONS | MEASURED | DEVIATIONS | TIME)[column]
    positive = column in DEVIATIONS or column == "supply_voltage_V"
    allowed = f"{'more than ' if positive else ''}{number(low)} to {number(high)}"
    try:
        value = float(cell)
    except ValueError:
        raise refuse(f"a number, {allowed}") from None
    if not math.isfinite(value) or not low <= value <= high or (positive and value == low):
        raise refuse(allowed)
    return value


def _check_mass(name: str, columns: dict[str, np.ndarray]) -> None:
    if "total_mass_kg" not in columns:
        return
    for row, (total, payload) in enumerate(zip(columns["total_mass_kg"], columns["payload_kg"], strict=True), 1):
        if total <= payload:
            raise BadData(_too_light(f"{name} row {row}", total, payload))


def _too_light(where: str, total: float, payload: float) -> str:
    included = f"more than the payload of {number(payload)} kg that it includes"
    return f"{where}, total_mass_kg: got {number(total)}; expected {included}"


def single(cells: dict[str, Any]) -> Runs:
    """One run from options given by column name, each checked as a cell of a file would be.

    Raises:
        BadConfiguration: an option that is out of range, not finite or an unknown word.
    """
    texts = {column: number(value) if isinstance(value, float) else str(value) for column, value in cells.items()}
    columns = {column: np.array([_cell("option", column, t, BadConfiguration)]) for column, t in texts.items()}
    if "total_mass_kg" in cells and cells["total_mass_kg"] <= cells["payload_kg"]:
        raise BadConfiguration(_too_light("option", cells["total_mass_kg"], cells["payload_kg"]))
    columns = {c: np.array([cells[c]]) if isinstance(cells[c], float) else v for c, v in columns.items()}
    return Runs("the options", columns)
