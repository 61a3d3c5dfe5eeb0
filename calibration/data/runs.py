"""Runs from files or memory: a table of operating points or samples, from its source to checked columns.

A reader returns the raw columns of its source by name (`NamedArrays`). `runs_of_arrays` gives each column its
meaning, checks the values and returns `Runs`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np

from calibration.data import (
    Columns,
    Json,
    Mapped,
    Names,
    clock,
    column_names,
    contradictions,
    delimited,
    inferred_facts,
    presets_file,
    row_checks,
)
from calibration.data.columns import CONDITIONS, DUTY, SUPPLY, TIME, WHEN, Column, Layout
from calibration.data.input_errors import BadConfiguration, BadData
from calibration.data.named_arrays import NamedArrays, Raw, column_numbers, column_texts, missing_readings
from calibration.data.sources import opening, reading
from calibration.data.sources.columnar import EXPECTED
from calibration.data.table import Runs
from calibration.data.unused_readings import drop_computed_torques, without_held, without_unread
from mmrjax.model.quantities import MM, RPM
from mmrjax.model.rig import STARTS
from mmrjax.model.robot import NO_BRAKE, Robot

__all__ = ["CONDITIONS", "DUTY", "MM", "RPM", "WHEN", "Runs", "read_runs", "runs_of_arrays", "single_run"]


#: Tables that come with the package.
PACKAGED = {"measured": "measured.csv", "simulated_by_paper": "simulated_by_paper.csv"}
#: Most rejected cells that a message names.
LISTED = 8


def read_runs(
    source: Any,
    robot: Robot | None = None,
    *,
    columns: str | Path | Mapping[str, Any] | None = None,
    measured: bool = True,
    battery: bool = False,
    of_turns: bool = False,
) -> Runs:
    """Reads runs from a packaged table, a file, or a table in memory.

    Args:
        source: `measured`, `simulated_by_paper`, a path, or a table in memory. Files are CSV, Parquet, Feather,
            Arrow, spreadsheets, MATLAB, HDF5, NumPy, JSON, ROS bags, MCAP, ULog, MDF and WPILOG. `::` and a path of
            signals may follow. With a pattern such as `runs/*.csv`, each file is a run. Tables in memory are a pandas
            or polars DataFrame, an Arrow table, an xarray Dataset, a dict of arrays, or a list of records.
        columns: meaning of the source's columns, if their names are not those of this program: a packaged preset
            (`vesc,pole_pairs=7`), a preset file, or a dict such as `{"motor_speed_rpm": "speed"}`. It takes
            precedence over the robot file.
        measured, battery, robot, of_turns: as in `runs_of_arrays`.

    Raises:
        BadData: the file is missing, damaged or in a format that is not read, a signal is missing or of another kind,
            or as in `runs_of_arrays`.
        BadConfiguration: the preset does not exist or has a mistake.
    """
    layout, between = Layout.of(robot), "held" if robot is None else robot.rig.between_rows
    preset = presets_file.NONE
    if isinstance(columns, Mapping):
        preset = presets_file.parse_preset({"columns": dict(columns)}, "the stated table", {})
    elif columns is not None:
        preset = presets_file.find_preset(columns)
    if isinstance(source, str | Path) and str(source) in PACKAGED:
        with resources.as_file(resources.files("calibration") / "data" / PACKAGED[str(source)]) as path:
            arrays, mapped = delimited.read_csv_columns(path, str(source)), layout.mapped
    else:
        if isinstance(source, str) and not source:
            raise BadData(f"the source: got an empty path; expected {EXPECTED}")
        is_plain_file = isinstance(source, str | Path) and not opening.files_of_group(str(source))
        if is_plain_file and not opening.split_source(str(source))[0].exists():
            raise BadData(f"{source}: no such file and no packaged table; packaged: {', '.join(PACKAGED)}")
        arrays, mapped = reading.read_columns(source, layout, preset, between)
    is_known = bool(preset.columns) or any(layout.meanings(arrays.name, list(dict.fromkeys(arrays.header))))
    if not is_known and (name := presets_file.recognise_preset(arrays.header)):
        option = name + "".join(f",{key}=..." for key in presets_file.numbers_to_state(name))
        raise BadData(
            f"{arrays.name}: has no column with a known name, but its columns match the preset {name}; add --columns "
            f'{option}, in Python columns="{option}"'
        )
    return runs_of_arrays(arrays, measured=measured, battery=battery, robot=robot, of_turns=of_turns, mapped=mapped)


def runs_of_arrays(
    arrays: NamedArrays,
    *,
    measured: bool = True,
    battery: bool = False,
    robot: Robot | None = None,
    of_turns: bool = False,
    mapped: Mapped | None = None,
) -> Runs:
    """Runs from named columns of raw values, with all checks.

    Args:
        arrays: columns of the source.
        measured: True to require at least one channel. False: none is required, nor `total_mass_kg`.
        battery: True if the runs are on the on-board battery. The voltage column is then missing or empty.
        robot: robot that defines the required columns and the channels. None: the packaged robot, with every further
            channel that the table has.
        of_turns: True to add a channel for each column of one side or of the yaw rate.
        mapped: columns with other names in the source, as in `Layout.mapped`. None: from the robot file.

    Raises:
        BadData: columns, rows or channels are missing. A column is missing, misspelt, repeated, or in a wrong unit.
            Values contradict each other or the robot. A value is no number, not finite or out of range. The message
            has source, row, column, value and allowed values.
    """
    name, layout = arrays.name, Layout.of(robot)
    if mapped is not None:
        layout = replace(layout, mapped=mapped)
    if not arrays.header:
        expected = ", ".join((*layout.required(measured=True, battery=False), *layout.measured_columns))
        raise BadData(f"{name}: the file is empty; expected a header with {expected}")
    header, layout, spelling_notes = column_names.match_column_names(
        name, arrays.header, layout, inferred=robot is None, of_turns=of_turns
    )
    meanings = layout.meanings(name, header)
    column_names.check_header(name, header, meanings, measured, battery, layout)
    if measured and robot is not None:
        column_names.check_has_time(name, header, meanings, layout)
    column_names.check_units(arrays, meanings)
    if not len(arrays):
        raise BadData(f"{name}: a header without rows; expected at least one run")
    arrays = clock.drop_empty_rows(arrays, meanings)
    columns, cell_notes = _column_values(arrays, meanings, layout, battery)
    unread = {
        c: _values_without_role(raw) for c, m, raw in zip(header, meanings, arrays.values, strict=True) if m is None
    }
    headings = {m.column: m.shown for m in meanings if m is not None}
    runs = Runs(name, columns, tuple(unread), arrays.digest, unread, layout, arrays.notes, headings)
    if measured and robot is not None:
        runs = row_checks.without_time_of_settled_rows(runs, robot)
    runs = row_checks.without_repeated_rows(contradictions.with_duties_of_sides(runs, battery))
    if measured:
        if robot is not None:
            runs = row_checks.split_at_jumps(runs, robot.rig.start == STARTS[0])
        runs = row_checks.without_repeated_readings(runs)
    runs = inferred_facts.infer_instruments(runs)
    if measured:
        runs = contradictions.with_unsigned_currents(runs)
    if not layout.complete:
        runs = row_checks.with_default_columns(runs)
    runs.check_rows(row_checks.contradictions_in_rows(runs))
    if runs.has("duty"):
        runs = runs.with_columns({"duty": np.nan_to_num(runs["duty"])})
    if battery and layout.imposed == "voltage":
        runs = runs.with_columns({SUPPLY: np.full(len(runs), np.nan)})
    elif measured and not runs.sampled:  # histories may stop or roll against the motors
        runs = row_checks.without_idle_rows(runs)
    if not any(map(runs.has, WHEN)):
        runs = runs.with_columns({"order": np.arange(1.0, len(runs) + 1)})
    notes = [*spelling_notes, *cell_notes]
    if measured:
        notes += row_checks.missing_data_notes(runs)
    notes += row_checks.driven_backward_notes(runs)
    if measured and robot is not None:
        notes += column_names.unread_channel_notes(name, robot, unread)
    runs = runs.with_columns({}, *notes)
    if robot is None:
        return runs
    runs = contradictions.check_contradictions(runs, robot)
    return drop_computed_torques(without_held(without_unread(runs, robot)), robot)


def _column_values(
    arrays: NamedArrays, meanings: Sequence[Column | None], layout: Layout, battery: bool
) -> tuple[Columns, Names]:
    """Values of the known columns, and notes on changed cells."""
    columns: Columns = {}
    refused_cells: list[tuple[int, int, Column, Raw]] = []
    notes: list[str] = []
    count = 0
    by_name = {m.column: raw for m, raw in zip(meanings, arrays.values, strict=True) if m is not None}
    for j, (meaning, raw) in enumerate(zip(meanings, arrays.values, strict=True)):
        if meaning is None:
            continue
        cell_notes: Names = ()
        if meaning.column == "configuration":
            raw, cell_notes = _match_configuration_case(arrays.name, column_texts(raw), layout)
        if meaning.column in TIME:
            runs = column_texts(by_name["run_id"]) if "run_id" in by_name else None
            raw, cell_notes = clock.time_since_start(arrays.name, meaning, raw, runs)
        notes += cell_notes
        if (battery and meaning.column == SUPPLY and layout.imposed == "voltage") or meaning.column in layout.idle:
            _reject_readings(arrays, meaning, raw, layout)
            continue
        columns[meaning.column], refused = column_names.convert_column(meaning, raw, layout)
        count += int(refused.sum())
        refused_cells += [(row, j, meaning, raw) for row in np.flatnonzero(refused)[:LISTED].tolist()]
    if refused_cells:
        (row, _, meaning, raw), *others = sorted(refused_cells, key=lambda cell: cell[:2])[:LISTED]
        cell = column_texts(raw[row : row + 1])[0]
        sentence = column_names.refused_cell_sentence(arrays.row(row), meaning, cell, layout)
        also = f"; also {', '.join(f'row {k + 1}, {m.shown}' for k, _, m, _ in others)}" if others else ""
        raise BadData(sentence + also + (f"; and {count - LISTED} more" if count > LISTED else ""))
    return {c: values for c, values in columns.items() if c != "held" or values.any()}, tuple(notes)


def _match_configuration_case(name: str, cells: list[str], layout: Layout) -> tuple[list[str], Names]:
    """Names of configurations with the capitals of the robot file, and notes on changed names."""
    names_by_casefold = {c.casefold(): c for c in layout.configurations}
    if len(names_by_casefold) < len(layout.configurations):  # the names differ only in capitals
        return cells, ()
    renamed = {c: names_by_casefold.get(c.casefold(), c) for c in dict.fromkeys(cells)}
    notes = tuple(f"{name}: configuration {c} is read as {right}" for c, right in renamed.items() if c != right)
    return [renamed[c] for c in cells], notes


def _values_without_role(raw: Raw) -> np.ndarray:
    """Values of a column that the model does not use: numbers if every cell is a number, otherwise words."""
    if isinstance(raw, np.ndarray):
        return raw
    numbers = column_numbers(raw)
    missing_rows = np.flatnonzero(np.isnan(numbers))
    return numbers if missing_readings(raw, missing_rows).all() else np.array(raw)


def _reject_readings(arrays: NamedArrays, meaning: Column, raw: Raw, layout: Layout) -> None:
    """Rejects a supply voltage on a battery, and a condition other than 0 that does not act on the robot's load."""
    is_given = ~missing_readings(raw, np.arange(len(raw)))
    if meaning.column == SUPPLY:
        why = " together with --battery, whose charge sets the voltage; leave the cell empty or remove the column"
    else:
        is_given &= column_numbers(raw) != 0
        why = "; the robot's load is a shaft, on which it does not act. Remove the column, or describe a vehicle"
        if layout.has_ground:
            why = f"; {NO_BRAKE}; give slope_deg or payload_kg, or describe the load as a shaft"
    for row in np.flatnonzero(is_given)[:1].tolist():
        raise BadData(f"{arrays.row(row)}, {meaning.shown}: got {column_texts(raw[row : row + 1])[0]}{why}")


def single_run(cells: Json, layout: Layout | None) -> Runs:
    """One run from command options, by column name, each checked like a cell of a file. On a battery it has no
    voltage.

    Args:
        layout: layout of the robot's tables. None: of the packaged robot.

    Raises:
        BadConfiguration: an option is out of range or not finite, or is an unknown word.
    """
    layout = layout or Layout()
    quantities = layout.quantities()
    columns: Columns = {}
    for column, value in cells.items():
        meaning = Column(quantities[column], column, next(iter(quantities[column].units)))
        text = f"{value:g}" if isinstance(value, float) else str(value)
        converted, refused = column_names.convert_column(meaning, [text], layout)
        if refused.any():
            raise BadConfiguration(column_names.refused_cell_sentence("option", meaning, text, layout, hints=False))
        columns[column] = np.array([value]) if isinstance(value, float) else converted  # with all digits
    if layout.imposed == "voltage":
        columns.setdefault(SUPPLY, np.array([math.nan]))
    if "total_mass_kg" in cells and cells["total_mass_kg"] <= cells["payload_kg"]:
        total_text = f"option, total_mass_kg: got {cells['total_mass_kg']:g}"
        raise BadConfiguration(total_text + row_checks.too_light(cells["payload_kg"]))
    return Runs("the options", columns, layout=layout)
