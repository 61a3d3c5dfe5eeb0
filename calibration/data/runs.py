"""Runs from outside: a table of operating points or samples, from its source to checked columns.

A reader gives the columns of its source by name with raw values (`NamedArrays`). `of_arrays` gives each column its
meaning, checks the values and makes `Runs`. It is the same for every source.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np

from calibration.data import (
    cell_values,
    clock,
    column_names,
    contradictions,
    delimited,
    instruments,
    row_checks,
    sides,
)
from calibration.data.columns import CONDITIONS, DUTY, SUPPLY, TIME, WHEN, Column, Layout
from calibration.data.input_errors import BadConfiguration, BadData, number
from calibration.data.named_arrays import NamedArrays, Raw, missing, numbers, texts
from calibration.data.table import Runs
from mmrjax.model.quantities import MM, RPM
from mmrjax.model.rig import Instrument
from mmrjax.model.robot import NO_BRAKE, Robot

__all__ = ["CONDITIONS", "DUTY", "MM", "RPM", "WHEN", "Runs", "of_arrays", "read", "single"]


#: Tables that come with the package.
PACKAGED = {"measured": "measured.csv", "simulated_by_paper": "simulated_by_paper.csv"}
#: Bad cells that a message lists, at most.
LISTED = 8


def read(
    source: str | Path,
    *,
    measured: bool = True,
    battery: bool = False,
    robot: Robot | None = None,
    of_turns: bool = False,
) -> Runs:
    """Returns the runs of a packaged table, by its name, or of a CSV file.

    Args:
        source: `measured`, `simulated_by_paper`, or a path.
        measured, battery, robot, of_turns: as for `of_arrays`.

    Raises:
        BadData: no such file, a file that is no CSV, a row of another length than the header, or as `of_arrays`.
    """
    if str(source) in PACKAGED:
        with resources.as_file(resources.files("calibration") / "data" / PACKAGED[str(source)]) as path:
            arrays = delimited.arrays(path, str(source))
    else:
        path = Path(source)
        if not path.exists():
            raise BadData(f"{source}: no such file and no packaged table; packaged: {', '.join(PACKAGED)}")
        arrays = delimited.arrays(path, path.name or str(source))
    return of_arrays(arrays, measured=measured, battery=battery, robot=robot, of_turns=of_turns)


def of_arrays(
    arrays: NamedArrays,
    *,
    measured: bool = True,
    battery: bool = False,
    robot: Robot | None = None,
    of_turns: bool = False,
) -> Runs:
    """Returns the runs that named columns of raw values state.

    Args:
        arrays: columns of the source.
        measured: True if at least one channel is required; without any, `total_mass_kg` may be missing too.
        battery: True if the runs are on the on-board battery; the column of the voltage is missing then, or empty.
        robot: defines the columns that are needed, and the channels. None: the packaged robot, with a channel for
            each further column of one.
        of_turns: True to give a table of turns a channel for each of its columns of one side or of the yaw.

    Raises:
        BadData: no columns or rows, no channel, a missing, misspelt or repeated column, or a wrong unit; values that
            contradict each other or the robot; a value that is no number, not finite or out of range. The sentence
            has source, row, column, value and the allowed values.
    """
    inferred = robot is None
    name, layout = arrays.name, Layout.of(robot)
    if not arrays.header:
        expected = ", ".join((*layout.required(measured=True, battery=False), *layout.measured_columns))
        raise BadData(f"{name}: the file is empty; expected a header with {expected}")
    header, layout, capitals = column_names.understood(
        name, arrays.header, layout, inferred=inferred, of_turns=of_turns
    )
    meanings = layout.meanings(name, header)
    column_names.check_header(name, header, meanings, measured, battery, layout)
    if measured and not inferred:
        column_names.check_time(name, header, meanings, layout)
    column_names.check_units(arrays, meanings)
    if not len(arrays):
        raise BadData(f"{name}: a header and no rows; expected at least one run")
    columns, changed = _columns(arrays, meanings, layout, battery)
    notes = (*arrays.notes, *sides.of_volts(name, columns, battery))
    layout, unsigned = _with_instruments(columns, layout, measured)
    row_checks.complete(name, columns, len(arrays), layout)
    kept = np.full(len(arrays), True)
    if battery and layout.imposed == "voltage":
        columns[SUPPLY] = np.full(len(arrays), np.nan)
    elif measured and not set(TIME) <= set(columns):  # a history may stop, and go on forwards against its motors
        columns, kept, left_out = row_checks.driven_rows(name, columns, layout)
        notes = (*notes, *left_out)
    if not any(column in columns for column in WHEN):
        columns["order"] = np.arange(1.0, kept.sum() + 1)
    extras = {c: _extra(raw)[kept] for c, m, raw in zip(header, meanings, arrays.values, strict=True) if m is None}
    notes = (*notes, *capitals, *changed, *(row_checks.lacks(name, columns, layout) if measured else ()))
    notes = (*notes, *(row_checks.shows_magnitude(name, i) for i in unsigned))
    notes = (*notes, *row_checks.drives(name, columns, layout))
    headings = {m.column: m.shown for m in meanings if m is not None}
    runs = Runs(name, columns, tuple(extras), arrays.digest, extras, layout, notes, headings)
    if robot is not None:
        contradictions.check(runs, robot)
    return runs


def _columns(
    arrays: NamedArrays, meanings: Sequence[Column | None], layout: Layout, battery: bool
) -> tuple[dict[str, np.ndarray], tuple[str, ...]]:
    """Values of the columns that mean something, and notes on cells that are read as something else."""
    columns: dict[str, np.ndarray] = {}
    bad: list[tuple[int, int, str]] = []
    notes: list[str] = []
    count = 0
    by_name = {m.column: raw for m, raw in zip(meanings, arrays.values, strict=True) if m is not None}
    for j, (meaning, raw) in enumerate(zip(meanings, arrays.values, strict=True)):
        if meaning is None:
            continue
        if meaning.column == "configuration":
            raw, more = _configurations_in_case(arrays.name, texts(raw), layout)
            notes += more
        if meaning.column in TIME:
            runs = texts(by_name["run_id"]) if "run_id" in by_name else None
            raw, note = clock.from_the_first(arrays.name, meaning, raw, runs)
            notes += [note] if note else []
        if battery and meaning.column == SUPPLY and layout.imposed == "voltage":
            _refuse_stated(arrays, raw)
        elif meaning.column in layout.idle:
            _refuse_idle(arrays, meaning, raw, layout)
        else:
            columns[meaning.column], refused = cell_values.values(meaning, raw, layout)
            wrong = np.flatnonzero(refused).tolist()
            count += len(wrong)
            for k in wrong[:LISTED]:
                said = cell_values.refusal(arrays.row(k), meaning, texts(raw[k : k + 1])[0], layout)
                bad.append((k, j, said))
    if bad:
        raise BadData(_listed(arrays.name, [sentence for _, _, sentence in sorted(bad)], count))
    return columns, tuple(notes)


def _listed(name: str, said: Sequence[str], count: int) -> str:
    """One message on all refused cells, the first row first; each advice stands once.

    Args:
        said: sentences, among them the first `LISTED`; count: number of cells.
    """
    first, *others = said
    if not others:
        return first
    more, known = list[str](), {first.partition(";")[2]}
    for sentence in others[: LISTED - 1]:
        what, _, cure = sentence.removeprefix(f"{name} ").partition(";")
        more.append(what if cure in known else f"{what};{cure}")
        known.add(cure)
    rest = f"; and {count - LISTED} more" if count > LISTED else ""
    return f"{first}; also {'; '.join(more)}{rest}"


def _with_instruments(
    columns: Mapping[str, np.ndarray], layout: Layout, measured: bool
) -> tuple[Layout, tuple[Instrument, ...]]:
    """The layout with the instruments that the readings tell, and those of them that show magnitude alone."""
    inferred = instruments.infer_instruments(layout.instruments, columns)
    stated = {i.channel for i in inferred}
    unsigned = tuple(i for i in sides.magnitudes(columns, layout) if measured and i.channel not in stated)
    return dataclasses.replace(layout, instruments=(*inferred, *unsigned)), unsigned


def _configurations_in_case(name: str, cells: list[str], layout: Layout) -> tuple[list[str], list[str]]:
    """Names of configurations with the capitals of the robot's, and sentences on what was read so."""
    meant = {c.casefold(): c for c in layout.configurations}
    if len(meant) < len(layout.configurations):  # told apart by their capitals alone
        return cells, []
    others = [c for c in dict.fromkeys(cells) if c not in layout.configurations]
    odd = {c: meant[c.casefold()] for c in others if c.casefold() in meant}
    said = [f"{name}: configuration {c} is read as {right}" for c, right in odd.items()]
    return [odd.get(c, c) for c in cells] if odd else cells, said


def _extra(raw: Raw) -> np.ndarray:
    """A column without a role: numbers where every cell that has a reading is one, else words."""
    if isinstance(raw, np.ndarray):
        return raw
    found = numbers(raw)
    lost = np.flatnonzero(np.isnan(found))
    return found if missing(raw, lost).all() else np.array(raw)


def _refuse_idle(arrays: NamedArrays, meaning: Column, raw: Raw, layout: Layout) -> None:
    """Refuses a condition that does not act on the robot's load, unless it is 0 or not stated."""
    why = (
        f"{NO_BRAKE}; state slope_deg or payload_kg, or describe the load as a shaft"
        if layout.has_ground
        else "the robot's load is a shaft, on which no slope, payload or mass acts; remove the column, or describe "
        "the load as a vehicle"
    )
    if isinstance(raw, np.ndarray):
        acts = np.flatnonzero(np.nan_to_num(raw.astype(float)) != 0)[:1].tolist()
    else:
        acts = [row for row, cell in enumerate(raw) if cell.strip("0.-") != ""][:1]
    for row in acts:
        raise BadData(f"{arrays.row(row)}, {meaning.shown}: got {texts(raw[row : row + 1])[0]}; {why}")


def _refuse_stated(arrays: NamedArrays, voltages: Raw) -> None:
    """Refuses voltages of a supply next to a battery."""
    if isinstance(voltages, np.ndarray):
        stated = np.flatnonzero(~np.isnan(voltages.astype(float)))[:1].tolist()
    else:
        stated = [row for row, cell in enumerate(voltages) if cell][:1]
    for row in stated:
        raise BadData(
            f"{arrays.row(row)}, supply_voltage_V: got {texts(voltages[row : row + 1])[0]} beside --battery, whose "
            "charge sets the voltage; expected an empty cell, or no such column"
        )


def single(cells: dict[str, Any], layout: Layout | None = None) -> Runs:
    """Returns one run from options by column name, each checked as a cell of a file; on a battery without a voltage.

    Args:
        layout: of the robot's tables; None: of the packaged one's.

    Raises:
        BadConfiguration: an option that is out of range, not finite or an unknown word.
    """
    layout = Layout() if layout is None else layout
    rows = layout.quantities()
    columns: dict[str, np.ndarray] = {}
    for column, value in cells.items():
        quantity = rows[column]
        meaning = Column(quantity, column, next(iter(quantity.units)))
        text = number(value) if isinstance(value, float) else str(value)
        columns[column], refused = cell_values.values(meaning, [text], layout)
        if refused.any():
            raise BadConfiguration(cell_values.refusal("option", meaning, text, layout, hints=False))
    if layout.imposed == "voltage":
        columns.setdefault(SUPPLY, np.array([math.nan]))
    if "total_mass_kg" in cells and cells["total_mass_kg"] <= cells["payload_kg"]:
        raise BadConfiguration(row_checks.too_light("option", cells["total_mass_kg"], cells["payload_kg"]))
    columns = {c: np.array([cells[c]]) if isinstance(cells.get(c), float) else v for c, v in columns.items()}
    return Runs("the options", columns, layout=layout)
