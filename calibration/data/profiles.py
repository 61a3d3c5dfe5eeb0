"""Profiles of missions from CSV files, checked cell by cell (docs/reference/profiles.md)."""

from __future__ import annotations

import dataclasses
import itertools
import math
import re
import tomllib
from collections.abc import Callable
from importlib import resources
from pathlib import Path
from typing import NoReturn

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from calibration.data import Columns, Json, Names, column_names, delimited, input_errors, input_files
from calibration.data.columns import LOAD, SUPPLY, Column
from calibration.data.input_errors import (
    BadConfiguration,
    BadData,
    allowed_words,
)
from calibration.data.named_arrays import column_texts
from calibration.data.sources import opening, reading
from mmrjax.missions.mission import Start
from mmrjax.missions.profile import (
    APART,
    MODES,
    MOTOR_SPEED,
    PAIRS,
    SPEED,
    VOLTAGE,
    YAW_RATE,
    Profile,
    profile,
    sides_error,
)
from mmrjax.model import channels, quantities
from mmrjax.model.conditions import Conditions
from mmrjax.model.paper_tables import SURFACES, adhesion_ratio, lateral_ratio
from mmrjax.model.robot import Robot

#: Profiles that come with the package, in `calibration/data/profiles/`.
PACKAGED = ("stair", "stop_and_go", "shuttle", "patrol")
#: Modes in which a controller follows the demand for a channel.
CONTROLLED = tuple(mode for mode in MODES if mode in channels.USUAL)
BETWEEN = ("held", "linear")
#: Largest number of rows, counting all cycles.
LONGEST = 1_000_000
MODE, SURFACE = "mode", "surface"
#: Quantities of columns, by field of `mmrjax.missions.profile.Profile`. Demands are stored in `demand`.
QUANTITIES: dict[str, quantities.Quantity] = {
    quantity.key: quantity
    for quantity in (quantities.BY_COLUMN["time_s"], *quantities.SET, *channels.EVERY)
    if quantity.in_profiles
} | {label.key: label for label in quantities.LABELS if label.key in (MODE, SURFACE)}
#: Columns of demands and their modes. A row has at most one demand.
DEMANDS = {
    **dict.fromkeys(("duty", *PAIRS[0], *PAIRS[1]), MODES[VOLTAGE]),
    **{mode: mode for mode in CONTROLLED},
}
#: Columns that must not be empty in any row.
HELD = ("voltage", "slope_deg", "payload", "load_torque", "current_other")
#: Initial values of a mission that comment lines may set: field of `Start`, least, greatest, and SI value of the
#: unit.
STARTS = {
    "start_speed_mm_s": ("speed", -50_000.0, 50_000.0, 1e-3),
    "start_winding_C": ("temperature_winding", -50.0, 400.0, 1.0),
    "start_housing_C": ("temperature_housing", -50.0, 400.0, 1.0),
}

SETTINGS = ("cycles", "between_rows", *STARTS)


@dataclasses.dataclass(frozen=True)
class ProfileTable:
    """A mission profile as read from its file.

    Attributes:
        source: name of the file or of the packaged profile, for messages.
        time: times of the rows [s].
        modes: mode of each row, one of `MODES`.
        demand: demanded motor speed [rad/s] or speed [m/s], shape (rows,).
        values: fields of `mmrjax.missions.profile.Profile` in the file, by name, shape (rows,).
        surface: surface of Table 5 in each row, None if the file states none.
        linear, cycles: as in `mmrjax.missions.profile.Profile`.
        digest: SHA-256 of the file.
        begins: fields of `Start` that the file states [SI, °C]: rolling speed, temperatures of winding and housing.
        notes: sentences on how the file was read.
    """

    source: str
    time: np.ndarray
    modes: Names
    demand: np.ndarray
    values: Columns
    surface: Names | None
    linear: bool
    cycles: int
    digest: str
    begins: dict[str, float] = dataclasses.field(default_factory=dict)
    notes: Names = ()

    @property
    def start(self) -> Start | None:
        """State in which the mission begins. None: at rest at ambient temperature."""
        return Start(**self.begins) if self.begins else None

    @property
    def segment_count(self) -> int:
        """Number of segments of one cycle."""
        return len(self.time) - 1

    @property
    def duration(self) -> float:
        """Duration of the whole mission [s]."""
        return self.cycles * float(self.time[-1] - self.time[0])

    @property
    def turns(self) -> bool:
        """True if it drives the sides independently."""
        return any(name in self.values for name in APART)

    @property
    def stated(self) -> Names:
        """Names that its conditions have in tables of runs."""
        names = {"voltage": SUPPLY, "slope_deg": "slope_deg", "payload": "payload_kg", "load_torque": LOAD}
        return (
            *(column for name, column in names.items() if name in self.values),
            *([SURFACE] if self.surface else []),
        )

    def demanded(self, segment: np.ndarray, elapsed: np.ndarray, per_speed: float) -> np.ndarray:
        """Demanded ground speed [m/s], computed from a demanded motor speed if necessary. NaN without a demand.

        Args:
            segment: index of the segment in one cycle, from 0.
            elapsed: time since the segment began [s], shape as `segment`.
            per_speed: ratio of motor speed to ground speed [rad/m].
        """
        before, after = self.demand[segment], self.demand[segment + 1]
        share = elapsed / np.diff(self.time)[segment] if self.linear else 0.0
        mode = np.array(self.modes)[segment]
        value = (before + (after - before) * share) / np.where(mode == MODES[MOTOR_SPEED], per_speed, 1.0)
        return np.where(np.isin(mode, CONTROLLED), value, np.nan)

    def check_supply(self, battery: bool) -> None:
        """Rejects a profile that contradicts the supply of the run.

        Raises:
            BadConfiguration: the profile states a voltage, but the battery feeds the motors.
        """
        alternatives = {
            "voltage_left": "voltage_left_V; give duty_left and duty_right instead",
            "voltage": "supply_voltage_V; use one of the two",
        }
        for field, cure in alternatives.items():
            if battery and field in self.values:
                raise BadConfiguration(f"--battery cannot be combined with {self.source}, which gives {cure}")

    def profile(self, robot: Robot, conditions: Conditions) -> Profile:
        """Profile in the form that simulations use, for a batch of runs.

        Args:
            robot: robot that follows it.
            conditions: conditions of shape (runs,), configurations as indices.

        Returns:
            Fields of shape (rows,). If it states surfaces, `adhesion` has the shape (runs, rows).
        """
        simulated_profile = profile(
            self.time,
            self.modes,
            demand=self.demand,
            linear=self.linear,
            cycles=self.cycles,
            **self.values,
        )
        if self.surface is None:
            return simulated_profile
        is_tracked = robot.configurations.tracked[np.asarray(conditions.configuration)].astype(int)

        def ratio_by_surface(ratio: Callable[[str, bool], float]) -> Array:
            assert self.surface is not None
            return jnp.asarray(
                np.array([[ratio(s, kind) for s in self.surface] for kind in (False, True)])[is_tracked]
            )

        lateral = ratio_by_surface(lateral_ratio) if self.turns else None
        return dataclasses.replace(
            simulated_profile, adhesion=ratio_by_surface(adhesion_ratio), adhesion_lateral=lateral
        )


def read_profile(source: str | Path) -> ProfileTable:
    """Packaged profile with a name, or profile from a file in any table format.

    Raises:
        BadData: there is no such file, it has fewer than two rows, a column or unit is unknown, misspelt or repeated,
            or time does not increase. Also if a cell is no number, not finite or out of range, or a required cell is
            empty. Also if a row has two demands or none, or a mode, surface or setting is unknown. The message has
            file, row (counted from 1 below the header), column, value and allowed values.
    """
    if str(source) in PACKAGED:
        with resources.as_file(resources.files("calibration") / "data" / "profiles" / f"{source}.csv") as path:
            return _profile_of_file(path, "", str(source))
    path, signal_path = opening.split_source(str(source))
    if not path.exists():
        raise BadData(f"{source}: no such file and no packaged profile; {allowed_words(str(source), PACKAGED)}")
    return _profile_of_file(path, signal_path, path.name or str(source))


def _profile_of_file(path: Path, signal_path: str, name: str) -> ProfileTable:
    comments: list[str] = []
    if opening.format_of(path, name) is None:
        text, _ = delimited.decode_text(name, input_files.csv_bytes(path, name))
        lines = filter(None, map(str.strip, text.splitlines()))
        comments = list(itertools.takewhile(lambda line: line.startswith("#"), lines))
    settings = _header_settings(name, comments)
    table = reading.read_whole_table(path, signal_path)
    if not table.header:
        raise BadData(f"{name}: the file is empty; expected a header that includes time_s, followed by data rows")
    columns = _profile_columns(name, table.header)
    column_names.check_units(table, list(columns.values()))
    if len(table) < 2:
        row_text = "one row" if len(table) else "a header and no rows"
        raise BadData(f"{name}: got {row_text}; expected at least two rows, the last of which ends the mission")
    texts = {field: column_texts(raw) for field, raw in zip(columns, table.values, strict=True)}
    for field in (*HELD, SURFACE):
        if field in texts and not settings["linear"]:  # no segment follows the last row
            texts[field][-1] = texts[field][-1] or texts[field][-2]
    cells = _CellReader(name, columns, texts, settings["linear"])
    time = cells.values("time")
    for row in (np.flatnonzero(np.diff(time) <= 0)[:1] + 1).tolist():
        cells.refuse("time", row, f"more than {cells.text('time', row - 1)} of the row before")
    if why := sides_error(list(columns), MODES[SPEED] in columns, cells.called):
        raise BadData(f"{name}: {why}")
    modes, driven = _modes_and_demands(cells)
    demand = driven.pop("demand")
    values = {field: cells.values(field) for field in HELD if field in columns} | driven
    if len(time) * settings["cycles"] > LONGEST:
        raise BadData(f"{name}: got {len(time)} rows times {settings['cycles']} cycles; expected at most {LONGEST}")
    for row, label in enumerate(texts.get(SURFACE, [])):
        if label not in SURFACES:
            cells.refuse(SURFACE, row, f"one of these; {allowed_words(label, SURFACES)}")
    surfaces = tuple(texts[SURFACE]) if SURFACE in texts else None
    return ProfileTable(
        name, time, modes, demand, values, surfaces, digest=table.digest, notes=table.notes, **settings
    )


def _header_settings(name: str, comments: list[str]) -> Json:
    """Settings in the comment lines at the top, such as `cycles = 40` or `between_rows = "linear"`: `linear`,
    `cycles` and `begins` of `ProfileTable`. Other comment lines are ignored.
    """
    header_settings: Json = {}
    for line in comments:
        text = line.lstrip("#").strip()
        if not re.match(r"[\w-]+\s*=", text):
            continue
        try:
            settings = tomllib.loads(text)
        except (ValueError, RecursionError) as error:
            raise BadData(f"{name}: got the line # {text}; expected TOML such as # cycles = 40 ({error})") from error
        for key, value in settings.items():
            if key in header_settings:
                raise BadData(f"{name}: {key} is set twice; expected once")
            header_settings[key] = value
    try:
        for key in header_settings:
            input_errors.stated_word(key, SETTINGS, name, f"got the setting {key}")
        begins = {
            field: unit_size * input_errors.stated_number(header_settings[key], f"{name}, {key}", low, high)
            for key, (field, low, high, unit_size) in STARTS.items()
            if key in header_settings
        }
        cycles = input_errors.stated_count(header_settings.get("cycles", 1), f"{name}, cycles", 1, LONGEST)
        between = input_errors.stated_word(
            header_settings.get("between_rows", BETWEEN[0]), BETWEEN, f"{name}, between_rows"
        )
    except BadConfiguration as error:  # of a file of data
        raise BadData(str(error)) from error
    return {"cycles": cycles, "linear": between == "linear", "begins": begins}


def _profile_columns(name: str, header: Names) -> dict[str, Column]:
    """Column of each field in the file.

    Raises:
        BadData: a column or unit is unknown, a field occurs twice, or time is missing.
    """
    fields = {
        column: (field, Column(quantity, column, unit))
        for field, quantity in QUANTITIES.items()
        for column, unit in quantity.columns().items()
    }
    usual = [next(iter(quantity.columns())) for quantity in QUANTITIES.values()]
    columns: dict[str, Column] = {}
    for column in header:
        if column not in fields:
            raise BadData(f"{name}: unknown column {column}; {allowed_words(column, fields, 3, usual)}")
        field, meaning = fields[column]
        first_name = columns.setdefault(field, meaning).shown
        if header.count(column) > 1 or first_name != column:
            column_words = f"column {column} twice" if column == first_name else f"columns {first_name} and {column}"
            raise BadData(f"{name}: got {column_words}; expected one of them")
    if "time" not in columns:
        raise BadData(f"{name}: column time_s is missing; other columns: {', '.join(usual)}")
    return columns


@dataclasses.dataclass(frozen=True)
class _CellReader:
    """Cells of a file by field, and the column and unit of each field."""

    source: str
    columns: dict[str, Column]
    texts: dict[str, list[str]]
    linear: bool

    def called(self, field: str) -> str:
        """Column of a field in the file, or else its usual column."""
        return self.columns[field].shown if field in self.columns else next(iter(QUANTITIES[field].columns()))

    def text(self, field: str, row: int) -> str:
        """The cell of a field, empty if the file has no such column."""
        return self.texts[field][row] if field in self.texts else ""

    def refuse(self, field: str, row: int, allowed: str) -> NoReturn:
        cell_text = self.text(field, row) or "an empty cell"
        raise BadData(
            f"{self.source} row {row + 1}, {self.columns[field].shown}: got {cell_text}; expected {allowed}"
        )

    def value(self, field: str, row: int) -> float:
        """Number in a cell, in the unit that `Profile` uses."""
        meaning = self.columns[field]
        low, high = meaning.limits()
        allowed = f"{low:g} to {high:g}"
        try:
            number = float(self.text(field, row))
        except ValueError:
            self.refuse(field, row, f"a number, {allowed}")
        if not math.isfinite(number) or not low <= number <= high:
            self.refuse(field, row, allowed)
        return meaning.value(number) * (
            meaning.quantity.factor if isinstance(meaning.quantity, channels.Channel) else 1.0
        )

    def values(self, field: str) -> np.ndarray:
        """Numbers of a required column."""
        return np.array([self.value(field, row) for row in range(len(self.texts[field]))])


def _modes_and_demands(cells: _CellReader) -> tuple[Names, Columns]:
    """Mode of each row, and by field of `Profile` its demand and the stated duties, voltages and yaw rates.

    If values are linear between rows, a demand of another mode ends the ramp that leads to its row. Otherwise a
    second demand is an error.
    """
    modes: list[str] = []
    voltage_fields = [f for f in DEMANDS if DEMANDS[f] == MODES[VOLTAGE] and f in cells.columns]
    with_yaw_rate = YAW_RATE in cells.columns
    defaults = {field: float(field == "duty") for field in (*voltage_fields, "demand", *[YAW_RATE] * with_yaw_rate)}
    rows = len(cells.texts["time"])
    values_by_field = {field: np.full(rows, value) for field, value in defaults.items()}
    for row in range(rows):
        mode_before = modes[-1] if modes else ""
        filled = [field for field in DEMANDS if cells.text(field, row)]
        ramp_ends = [field for field in filled if cells.linear and mode_before == DEMANDS[field]]
        mode = _mode_of_row(cells, row, mode_before, [f for f in filled if f not in ramp_ends] or filled)
        demands = [field for field in filled if DEMANDS[field] == mode]
        others = [field for field in filled if field not in (*demands, *ramp_ends)]
        _check_demands(cells, row, row < rows - 1 or cells.linear, mode_before, mode, demands, others)
        modes.append(mode)
        for field, values in values_by_field.items() if row and cells.linear else ():  # usual end of a ramp
            is_demanded = mode == MODES[VOLTAGE] if field in voltage_fields else mode in CONTROLLED
            values[row] = defaults[field] if is_demanded else values[row - 1]
        for field in (*ramp_ends, *demands):
            values_by_field["demand" if field in CONTROLLED else field][row] = cells.value(field, row)
        speed, has_yaw_rate = MODES[SPEED], bool(cells.text(YAW_RATE, row))
        if has_yaw_rate and mode != speed and not (cells.linear and mode_before == speed):
            cells.refuse(YAW_RATE, row, f"an empty cell: a yaw rate needs a demanded speed, not mode {mode}")
        if with_yaw_rate and not has_yaw_rate and mode == speed and (cells.linear or row < rows - 1):
            cells.refuse(YAW_RATE, row, "the demanded yaw rate, 0 for straight travel")
        if has_yaw_rate:
            values_by_field[YAW_RATE][row] = cells.value(YAW_RATE, row)
    return tuple(modes), values_by_field


def _mode_of_row(cells: _CellReader, row: int, mode_before: str, filled: list[str]) -> str:
    """Mode of a row, as stated or as implied by its demand. If no row has a demand, the motors are off."""
    mode = cells.text(MODE, row)
    if mode and mode not in MODES:
        cells.refuse(MODE, row, f"one of these; {allowed_words(mode, MODES)}")
    demand_columns = [cells.columns[field].shown for field in DEMANDS if field in cells.columns]
    mode = mode or (DEMANDS[filled[0]] if filled else "" if demand_columns else MODES[VOLTAGE])
    if not mode and row == len(cells.texts["time"]) - 1:
        mode = mode_before
    if not mode:
        raise BadData(
            f"{cells.source} row {row + 1}: got no demand; expected a value in one of {', '.join(demand_columns)}, "
            "or brake or coast in the column mode"
        )
    return mode


def _check_demands(
    cells: _CellReader,
    row: int,
    is_required: bool,
    mode_before: str,
    mode: str,
    demands: list[str],
    others: list[str],
) -> None:
    """Rejects a row with two demands or none, and a ramp between different kinds of demand.

    Args:
        is_required: False if no segment follows the row.
    """
    place = f"{cells.source} row {row + 1}"
    if others:
        other = cells.columns[demands[0]].shown if demands and not cells.text(MODE, row) else f"mode {mode}"
        raise BadData(
            f"{place}, {cells.columns[others[0]].shown}: got {cells.text(others[0], row)} in addition to {other}; "
            "expected one demand per row"
        )
    for field in next((pair for pair in PAIRS if pair[0] in cells.columns), ()):
        if mode == MODES[VOLTAGE] and field not in demands and is_required:
            cells.refuse(field, row, "a value for each side")
    if mode not in CONTROLLED:
        return
    if mode not in cells.columns:
        raise BadData(
            f"{place}, mode: got {mode}; expected a column with that demand, such as "
            f"{next(iter(QUANTITIES[mode].columns()))}"
        )
    if not demands and is_required:
        cells.refuse(mode, row, f"the demand of mode {mode}")
    if cells.linear and mode_before in CONTROLLED and mode_before != mode:
        raise BadData(
            f"{place}: goes from a demanded {mode_before} to a demanded {mode} although between_rows is linear; "
            "expected one kind of demand, or a braking or coasting row between"
        )
