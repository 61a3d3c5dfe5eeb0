"""Runs from outside: tables of operating points as CSV with units in the column names, checked cell by cell."""

from __future__ import annotations

import dataclasses
import difflib
import hashlib
import math
import re
from collections.abc import Iterator, Mapping, Sequence
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np

from calibration.data import clock, contradictions, delimited, input_files, instruments, sides, surfaces
from calibration.data.columns import (
    CONDITIONS,
    DEFAULTS,
    DRIVEN,
    DUTY,
    HEADING,
    LOAD,
    SIDES,
    SPEED,
    SPEEDS,
    SUPPLY,
    TIME,
    VOLTS,
    WHEN,
    WORDS,
    Layout,
    Meaning,
)
from calibration.data.input_errors import BadConfiguration, BadData, InputError, choices, number, parsed
from calibration.data.table import Runs, driven_on
from mmrjax.errors import counted
from mmrjax.model import channels, quantities
from mmrjax.model.channels import Channel
from mmrjax.model.quantities import MM, RPM
from mmrjax.model.rig import Instrument
from mmrjax.model.robot import NO_BRAKE, Robot

__all__ = ["CONDITIONS", "MM", "RPM", "Runs", "read", "single"]


#: Tables that come with the package.
PACKAGED = {"measured": "measured.csv", "simulated_by_paper": "simulated_by_paper.csv"}
#: How far beyond zero a reading's noise may carry it: in sds that are stated, and as a share of the channel's rms.
SIGN_SDS, SIGN_SHARE = 4.0, 0.05


def read(
    source: str | Path,
    *,
    measured: bool = True,
    battery: bool = False,
    robot: Robot | None = None,
    of_turns: bool = False,
) -> Runs:
    """Read a packaged table by its name, or a CSV file.

    Args:
        source: `measured`, `simulated_by_paper`, or a path.
        measured: whether at least one channel is required; without any `total_mass_kg` may be missing too.
        battery: whether the runs are on the on-board battery, whose voltage no table states: its column is left out,
            or empty.
        robot: that the table is of; it says which columns are needed, and which channels it has. None: the packaged
            one; the table then has every other channel too of which it has a column.
        of_turns: whether a table of turns has every channel of either side, and of the yaw, of which it has a column.

    Raises:
        BadData: no such file, nothing in it, no channel, a missing, misspelt or repeated column, a row of another
            length, or a cell that is no number, not finite or out of range; said with file, row (counted
            from 1 below the header), column, value and what is allowed.
    """
    layout, how = Layout.of(robot), {"inferred": robot is None, "of_turns": of_turns}
    if str(source) in PACKAGED:
        with resources.as_file(resources.files("calibration") / "data" / PACKAGED[str(source)]) as path:
            runs = _read(path, str(source), measured, battery, layout, **how)
    else:
        path = Path(source)
        if not path.exists():
            raise BadData(f"{source}: no such file and no packaged table; packaged: {', '.join(PACKAGED)}")
        runs = _read(
            path, path.name or str(source), measured, battery, layout, inferred=robot is None, of_turns=of_turns
        )
    if robot is not None:
        contradictions.check(runs, robot)
    return runs


def _read(
    path: Path, name: str, measured: bool, battery: bool, layout: Layout, *, inferred: bool, of_turns: bool
) -> Runs:
    content = input_files.table(path, name)
    text, encoded = delimited.text(name, content)
    rows, notes = delimited.cells(name, delimited.below_comments([x for x in text.splitlines() if x.strip()]))
    if not rows:
        expected = ", ".join((*layout.required(measured=True, battery=False), *layout.measured_columns))
        raise BadData(f"{name}: the file is empty; expected a header with {expected}")
    header, layout, capitals = _header(name, rows[0], layout, inferred=inferred, of_turns=of_turns)
    meanings = layout.meanings(name, header)
    _check_header(name, header, meanings, measured, battery, layout)
    if measured and not inferred:
        _check_time(name, header, meanings, layout)
    rows, below = _rows_of_cells(name, header, meanings, rows)
    columns, changed = _columns(name, meanings, rows, layout, battery)
    notes = (*notes, *below, *sides.of_volts(name, columns, battery))
    layout, unsigned = _with_instruments(columns, layout, measured)
    _complete(name, columns, len(rows), layout)
    if battery and layout.imposed == "voltage":
        columns[SUPPLY] = np.full(len(rows), np.nan)
    elif measured and not set(TIME) <= set(columns):  # a history may stop, and go on forwards against its motors
        columns, rows, left_out = _driven_rows(name, columns, rows, layout)
        notes = (*notes, *left_out)
    if not any(column in columns for column in WHEN):
        columns["order"] = np.arange(1.0, len(rows) + 1)
    unknown = tuple(c for c, meaning in zip(header, meanings, strict=True) if meaning is None)
    extras = {c: _extra([row[header.index(c)] for row in rows]) for c in unknown}
    notes = (*encoded, *notes, *capitals, *changed, *(_lacks(name, columns, layout) if measured else ()))
    notes = (*notes, *(_shows_magnitude(name, i) for i in unsigned), *_drives(name, columns, layout))
    headings = {m.column: m.shown for m in meanings if m is not None}
    return Runs(name, columns, unknown, hashlib.sha256(content).hexdigest(), extras, layout, notes, headings)


def _header(
    name: str, first: list[str], layout: Layout, *, inferred: bool, of_turns: bool
) -> tuple[list[str], Layout, tuple[str, ...]]:
    """Names of the columns, the layout with the channels that they show, and notes on names that differ in case."""
    named = [column or f"column {k}" for k, column in enumerate(first, 1)]
    header, notes = _in_case(name, named, layout, inferred)
    repeated = sorted({c for c in header if header.count(c) > 1})
    if repeated:
        raise BadData(f"{name}: column {repeated[0]} stands {header.count(repeated[0])} times; expected once")
    if inferred:
        layout = _with_channels(name, header, layout, channels.EVERY)
    if of_turns and {*layout.sides, *VOLTS, *HEADING} & {m.column for m in layout.meanings(name, header) if m}:
        layout = _with_channels(name, header, layout, channels.OF_TURNS)
    return header, layout, tuple(notes)


def _rows_of_cells(
    name: str, header: list[str], meanings: list[Meaning | None], rows: list[list[str]]
) -> tuple[list[list[str]], tuple[str, ...]]:
    """Rows below the header without a row of units, each as long as the header, and a note on that row."""
    notes: tuple[str, ...] = ()
    if below := _row_of_units(name, meanings, rows[1:2]):
        rows = [rows[0], *rows[2:]]
        notes = (f"{name}: the row below the header states units; rows are counted from the next",)
    _check_units(name, meanings, below)
    if len(rows) == 1:
        raise BadData(f"{name}: a header and no rows; expected at least one run")
    for k, row in enumerate(rows[1:], 1):
        if len(row) != len(header):
            raise BadData(
                f"{name} row {k}: got {counted(len(row), 'cell')}; the header has {counted(len(header), 'column')}"
            )
    return rows[1:], notes


def _columns(
    name: str, meanings: list[Meaning | None], rows: list[list[str]], layout: Layout, battery: bool
) -> tuple[dict[str, np.ndarray], tuple[str, ...]]:
    """Values of the columns that mean something, and notes on cells that are read as something else."""
    columns: dict[str, np.ndarray] = {}
    bad: list[tuple[int, int, str]] = []
    notes: tuple[str, ...] = ()
    for j, meaning in enumerate(meanings):
        if meaning is None:
            continue
        cells = [row[j] for row in rows]
        if meaning.column == "configuration":
            cells, more = _configurations_in_case(name, cells, layout)
            notes = (*notes, *more)
        if meaning.column in TIME:
            each = next((i for i, m in enumerate(meanings) if m is not None and m.column == "run_id"), None)
            runs = ["" if each is None else row[each] for row in rows]
            cells, note = clock.from_the_first(name, meaning, cells, runs)
            notes = (*notes, *([note] if note else []))
        if battery and meaning.column == SUPPLY and layout.imposed == "voltage":
            _refuse_stated(name, cells)
        elif meaning.column in layout.idle:
            _refuse_idle(name, meaning, cells, layout)
        else:
            values, doubted = _column(meaning, cells, layout)
            for place in np.flatnonzero(doubted).tolist():
                try:
                    values[place] = _cell(f"{name} row {place + 1}", meaning, cells[place], layout)
                except BadData as error:
                    bad.append((place + 1, j, str(error)))
            columns[meaning.column] = values
    if bad:
        raise BadData(_listed(name, [message for _, _, message in sorted(bad)]))
    return columns, notes


def _with_instruments(
    columns: Mapping[str, np.ndarray], layout: Layout, measured: bool
) -> tuple[Layout, tuple[Instrument, ...]]:
    """The layout with the instruments that the readings tell, and those of them that show magnitude alone."""
    inferred = instruments.infer_instruments(layout.instruments, columns)
    stated = {i.channel for i in inferred}
    unsigned = tuple(i for i in sides.magnitudes(columns, layout) if measured and i.channel not in stated)
    return dataclasses.replace(layout, instruments=(*inferred, *unsigned)), unsigned


def _complete(name: str, columns: dict[str, np.ndarray], rows: int, layout: Layout) -> None:
    """Fill columns that a table may leave out, and refuse values that contradict each other."""
    _fill(name, columns, rows, layout)
    _check_driving(name, columns)
    _check_sides(name, columns, layout)
    _check_mass(name, columns)
    _check_deviations(name, columns, layout.channels)


def _driven_rows(
    name: str, columns: dict[str, np.ndarray], rows: list[list[str]], layout: Layout
) -> tuple[dict[str, np.ndarray], list[list[str]], tuple[str, ...]]:
    """Settled runs in which something drives the motors, and a note on the others."""
    driven, note = _driven(name, columns, layout)
    if note:
        columns = {column: values[driven] for column, values in columns.items()}
        rows = [rows[k] for k in np.flatnonzero(driven)]
    if {*layout.sides, *HEADING} & set(columns):
        _check_level(name, columns)
    if not set(layout.sides) & set(columns):
        _check_signs(name, columns, layout)
    return columns, rows, (note,) if note else ()


def _shows_magnitude(name: str, instrument: Instrument) -> str:
    return (
        f"{name}: {channels.find(instrument.channel).column} is positive where its side is driven backward; it is "
        "taken to show magnitude alone, and magnitudes are compared"
    )


#: Bad cells that a message lists, at most.
LISTED = 8


def _listed(name: str, said: list[str]) -> str:
    """What is wrong with a file's cells, the first row's first; what to do about it once."""
    first, *others = said
    if not others:
        return first
    more, known = list[str](), {first.partition(";")[2]}
    for sentence in others[: LISTED - 1]:
        what, _, cure = sentence.removeprefix(f"{name} ").partition(";")
        more.append(what if cure in known else f"{what};{cure}")
        known.add(cure)
    rest = f"; and {len(said) - LISTED} more" if len(said) > LISTED else ""
    return f"{first}; also {'; '.join(more)}{rest}"


def _in_case(name: str, header: list[str], layout: Layout, inferred: bool) -> tuple[list[str], tuple[str, ...]]:
    """A header with the capitals of the columns' names, and sentences on what was read so."""
    known = dataclasses.replace(layout, channels=channels.EVERY) if inferred else layout
    spelled: dict[str, set[str]] = {}
    for column in known.spellings():
        spelled.setdefault(column.casefold(), set()).add(column)
    found, said = [], []
    for column in header:
        meant = spelled.get(column.casefold(), set())
        if column not in meant and len(meant) == 1 and not meant & set(header):
            (right,) = meant
            said.append(f"{name}: column {column} is read as {right}")
            column = right
        found.append(column)
    return found, tuple(said)


def _configurations_in_case(name: str, cells: list[str], layout: Layout) -> tuple[list[str], list[str]]:
    """Names of configurations with the capitals of the robot's, and sentences on what was read so."""
    meant = {c.casefold(): c for c in layout.configurations}
    if len(meant) < len(layout.configurations):  # told apart by their capitals alone
        return cells, []
    odd = {c: meant[c.casefold()] for c in cells if c not in layout.configurations and c.casefold() in meant}
    said = [f"{name}: configuration {c} is read as {right}" for c, right in odd.items()]
    return [odd.get(c, c) for c in cells], said


def _lacks(name: str, columns: dict[str, np.ndarray], layout: Layout) -> Iterator[str]:
    """Sentences on channels and readings that a table lacks, on copies of rows and on names of several."""
    for channel in layout.channels:
        if channel.column not in columns:
            if layout.complete:
                yield f"{name}: no column {channel.column}; nothing is known of its channel"
            continue
        empty = np.flatnonzero(np.isnan(columns[channel.column]))
        if empty.size:
            count = f"{empty.size} of {len(columns[channel.column])}"
            yield (
                f"{name}: {count} cells of {channel.column} are empty, the first in row {empty[0] + 1}; they weigh "
                "nothing"
            )
    alike: dict[tuple[Any, ...], list[int]] = {}
    settled = [] if set(TIME) & set(columns) else [c for c in columns if c not in ("run_id", *WHEN)]
    told = [columns[column].tolist() for column in settled]
    for row, cells in enumerate(zip(*told, strict=True), 1):
        alike.setdefault(cells, []).append(row)
    if copied := [rows for rows in alike.values() if len(rows) > 1]:
        others = f", and so {len(copied) - 1} more" if len(copied) > 1 else ""
        yield (
            f"{name}: rows {' and '.join(map(str, copied[0][:2]))} have the same conditions and readings{others}; "
            "they count as repeats; remove copies, which make results look surer than they are"
        )
    if "run_id" in columns and not set(TIME) & set(columns):
        runs, times = np.unique(columns["run_id"], return_counts=True)
        several = times > 1
        if several.any():
            run = runs[np.argmax(several)]
            rows = (np.flatnonzero(columns["run_id"] == run) + 1).tolist()
            which = f"{', '.join(map(str, rows[:5]))}{' and more' if len(rows) > 5 else ''}"
            others = f", and so {several.sum() - 1} more" if several.sum() > 1 else ""
            yield (
                f"{name}: run_id {run} stands in rows {which}{others}; without {', '.join(TIME)} every row is a run "
                "of its own"
            )


def _drives(name: str, columns: dict[str, np.ndarray], layout: Layout) -> Iterator[str]:
    """A sentence on settled rows in which a load torque without a sign drives a shaft that runs backward."""
    on = np.flatnonzero(driven_on(columns, layout))
    if on.size and not set(TIME) & set(columns) and columns[LOAD].min() >= 0:
        more = f", and so in {on.size} rows" if on.size > 1 else ""
        yield (
            f"{name} row {on[0] + 1}, {LOAD}: got {number(columns[LOAD][on[0]])} where the shaft is driven "
            f"backward{more}: it turns the shaft on there; a brake's torque is negative backward"
        )


def _with_channels(name: str, header: list[str], layout: Layout, more: Sequence[Channel]) -> Layout:
    """`layout` with those of some more channels of which a file has a column."""
    meanings = dataclasses.replace(layout, channels=channels.EVERY).meanings(name, header)
    stated = {m.column for m in meanings if m is not None}
    found = tuple(c for c in channels.EVERY if c in layout.channels or (c in more and c.column in stated))
    return dataclasses.replace(layout, channels=found)


def _extra(cells: list[str]) -> np.ndarray:
    """A column without a role: numbers where every cell that has a reading is one, else words."""
    try:
        return np.array([math.nan if cell.lower() in MISSING else parsed(cell) for cell in cells])
    except ValueError:
        return np.array(cells)


def _only(name: str, columns: dict[str, np.ndarray], layout: Layout) -> str:
    """The configuration that a table need not state: the robot's only one, or the one whose surfaces it has."""
    labels = np.unique(columns.get("surface", np.zeros(0, str)))
    found = surfaces.common(layout.configurations, labels)
    if found is None:
        raise BadData(
            f"{name}: column configuration is missing, and the robot has {', '.join(layout.configurations)}"
        )
    return found


def _fill(name: str, columns: dict[str, np.ndarray], rows: int, layout: Layout) -> None:
    """Put in what a table of a rig need not state: its only configuration, and conditions as they mostly are."""
    if layout.complete:
        return
    if "configuration" not in columns and layout.configurations:
        columns["configuration"] = np.full(rows, _only(name, columns, layout))
    if layout.imposed_column == SPEED and set(SPEEDS) <= set(columns):
        columns[SPEED] = np.mean([columns[c] for c in SPEEDS], 0)
    for column, value in DEFAULTS.items():
        columns.setdefault(column, np.full(rows, value))


def _refuse_idle(name: str, meaning: Meaning, cells: list[str], layout: Layout) -> None:
    why = (
        f"{NO_BRAKE}; state slope_deg or payload_kg, or describe the load as a shaft"
        if layout.has_ground
        else "the robot's load is a shaft, on which no slope, payload or mass acts; remove the column, or describe "
        "the load as a vehicle"
    )
    for row, cell in enumerate(cells, 1):
        if cell.strip("0.-") != "":
            raise BadData(f"{name} row {row}, {meaning.shown}: got {cell}; {why}")


def _refuse_stated(name: str, voltages: list[str]) -> None:
    for row, cell in enumerate(voltages, 1):
        if cell:
            raise BadData(
                f"{name} row {row}, supply_voltage_V: got {cell} beside --battery, whose charge sets the voltage; "
                "expected an empty cell, or no such column"
            )


def _check_signs(name: str, columns: dict[str, np.ndarray], layout: Layout) -> None:
    """Refuse readings without a sign where what is imposed drives the robot backward."""
    column = layout.imposed_column
    imposed, unit = columns[column], column.split("_")[-1]
    if layout.imposed == "voltage":
        imposed = imposed * columns.get("duty", 1.0)
    for channel in layout.channels:
        if channel.column not in columns or not channel.directed:
            continue
        readings = columns[channel.column]
        if layout.magnitude(channel.name):
            wrong = np.flatnonzero(readings < 0)
            if wrong.size:
                raise BadData(
                    f"{name} row {wrong[0] + 1}, {channel.column}: got {number(readings[wrong[0]])}; expected no "
                    "negative reading, as the robot's file says that the instrument shows magnitude alone"
                )
            continue
        # Gravity may drive a motor: only up the slope, or on the flat, its current has the sign of its voltage.
        backward = (imposed < 0) & ((columns["slope_deg"] <= 0) | channel.zero_at_rest)
        if not channel.zero_at_rest and (layout.weight or "duty" in columns or driven_on(columns, layout).any()):
            continue  # the load may drive a motor; a bridge that reverses the voltage reverses the supply's current
        doubt = _doubt(columns, channel)
        wrong = np.flatnonzero(backward & (readings > (doubt if layout.crosses_zero else 0.0)))
        forward = (imposed > 0) & (columns["slope_deg"] >= 0) & (not channel.zero_at_rest)
        forward &= channel.name != "motor_voltage"  # which is held against the back-EMF
        against = np.flatnonzero(forward & (readings < -doubt))
        if against.size:
            at = int(against[0])
            alike = "" if channel not in channels.OF_TURNS else f"; a turn has {' and '.join(layout.sides)} too"
            raise BadData(
                f"{name} row {at + 1}, {channel.column}: got {number(readings[at])} at {number(imposed[at])} {unit}; "
                "nothing else drives the motors there, so expected a reading with the sign of what is imposed, the "
                f"same in every row{alike}"
            )
        if wrong.size:
            at = int(wrong[0])
            alone = f"; or signed = false for {channel.name} in the robot's file, if it shows magnitude alone"
            hint = alone if layout.crosses_zero else ""
            raise BadData(
                f"{name} row {at + 1}, {channel.column}: got {number(readings[at])} at "
                f"{number(imposed[at])} {unit}; expected readings with their signs, negative backward{hint}"
            )


def _doubt(columns: dict[str, np.ndarray], channel: Channel) -> np.ndarray | float:
    """What a reading may lie beyond zero by its noise: SIGN_SDS of its stated sd, or a share of the channel's rms."""
    readings = columns[channel.column]
    share = SIGN_SHARE * float(np.sqrt(np.nanmean(readings**2))) if np.isfinite(readings).any() else 0.0
    return np.fmax(share, SIGN_SDS * np.nan_to_num(columns.get(channel.sd_column, np.zeros(len(readings)))))


def _check_header(
    name: str, header: list[str], meanings: list[Meaning | None], measured: bool, battery: bool, layout: Layout
) -> None:
    stated = {m.column for m in meanings if m is not None}
    strange = [c for c, m in zip(header, meanings, strict=True) if m is None]
    if not layout.complete:  # other channels' columns are not misspelt
        strange = [c for c in strange if c not in {x for k in channels.EVERY for x in (k.column, k.sd_column)}]
    _check_names_of_sides(name, strange, stated, layout)
    required = layout.required(measured=measured, battery=battery)
    if layout.imposed_column == SPEED and stated & set(layout.sides):  # theirs is imposed
        required = tuple(c for c in required if c != SPEED)
        if SPEED in stated:
            raise BadData(f"{name}: column {SPEED} beside {', '.join(layout.sides)}; keep one of them")
    if stated & set(VOLTS):  # of which the supply's is the larger
        required = tuple(c for c in required if c != SUPPLY)
    if not layout.complete and "surface" in stated:  # which says the configuration too, where it has those of one
        required = tuple(c for c in required if c != "configuration")
    for column in (c for c in (*required, *layout.measured_columns) if c not in stated):
        close = difflib.get_close_matches(column, strange, 1, 0.6)
        if column in required or (close and layout.complete):
            got = f"; is {close[0]} meant?" if close else ""
            if column == SUPPLY and {f"motor_{volts}" for volts in VOLTS} <= {*header}:  # which may be readings too
                got = "; what drives the sides may be stated, in the robot's file: [columns] " + ", ".join(
                    f'{volts} = "motor_{volts}"' for volts in VOLTS
                )
            raise BadData(
                f"{name}: column {layout.expected(column)} is missing{got} (required: {', '.join(required)})"
                + ("" if close else _other_names(strange, column))
            )
    if measured and not any(c in stated for c in layout.measured_columns):
        expected = ", ".join(layout.measured_columns)
        other = _other_names(strange, layout.measured_columns[0])
        turning = {c.column: c.name for c in channels.OF_TURNS}
        if found := [c for c in strange if c in turning]:
            names = ", ".join(f'"{turning[c]}"' for c in found)
            other = f"; {', '.join(found)}: state in the robot's file channels = [{names}]"
        raise BadData(f"{name}: no column of a channel; expected at least one of {expected}{other}")
    for column in strange:
        close = difflib.get_close_matches(column, [c for c in layout.known() if c not in stated], 1, 0.85)
        if close:
            raise BadData(f"{name}: unknown column {column}; did you mean {close[0]}? rename or remove it")


def _check_time(name: str, header: list[str], meanings: list[Meaning | None], layout: Layout) -> None:
    """Refuse readings of a log without its time."""
    stated = {m.column: m.shown for m in meanings if m is not None}
    over_time = [stated[c.column] for c in layout.channels if c.column in stated and not c.settled]
    if over_time and stated.keys().isdisjoint(TIME):
        strange = [c for c, m in zip(header, meanings, strict=True) if m is None]
        raise BadData(
            f"{name}: column {layout.expected('time_s')} is missing, and {over_time[0]} is read over time alone; of "
            f"settled runs, remove {over_time[0]}{_other_names(strange, 'time_s')}"
        )


#: Most columns of a table that a message names.
NAMED = 8


def _other_names(strange: list[str], column: str) -> str:
    """How columns that have names of their own are told apart, for a message; empty where there are none."""
    if not strange:
        return ""
    unit = column.rpartition("_")[2]
    guess = next((c for c in strange if re.search(rf"\b{unit}\b", c)), "...")
    shown = ", ".join(strange[:NAMED]) + (", ..." if len(strange) > NAMED else "")
    return (
        f"; other columns: {shown}; if one of them is it, say so in the robot's file, with the factor from its unit: "
        f'[columns] {column} = {{column = "{guess}", factor = 1.0}}'
    )


#: How people call the sides.
_SIDE = {"l": "left", "lh": "left", "lft": "left", "port": "left", "r": "right", "rh": "right", "starboard": "right"}


def _check_names_of_sides(name: str, strange: list[str], stated: set[str], layout: Layout) -> None:
    """Refuse columns that name a side in other words, or elsewhere in the column's name."""

    def words(column: str) -> list[str]:
        return sorted(_SIDE.get(word.casefold(), word.casefold()) for word in column.split("_"))

    known = {tuple(words(c)): c for c in layout.known() if set(channels.SIDES) & set(words(c))}
    for column in strange:
        meant = known.get(tuple(words(column)))
        if meant is not None and meant not in stated:
            raise BadData(
                f"{name}: column {column}: the sides are called left and right; name it {meant}, or state [columns] "
                f'{meant} = "{column}" in the robot\'s file'
            )
        side = next((side for side in channels.SIDES if side in words(column)), None)
        turns = set(SIDES) <= set(known.values()) and not stated.isdisjoint(c.column for c in channels.OF_TURNS)
        if side and turns and not stated & {*SIDES, *VOLTS} and column.endswith("V"):
            raise BadData(
                f"{name}: column {column}: if it is the voltage that drives the {side} side, name it "
                f'voltage_{side}_V, or state [columns] voltage_{side}_V = "{column}" in the robot\'s file'
            )


def _row_of_units(name: str, meanings: Sequence[Meaning | None], first: Sequence[Sequence[str]]) -> list[str]:
    """Units in the first row below the header, by column, empty where it states none; no list where it is a run.

    Raises:
        BadData: one among units that is none of its column's.
    """
    cells = [quantities.spelled(cell.strip("[]()")) for row in first for cell in row]
    known = [() if m is None or m.quantity is None else tuple(m.quantity.columns().values()) for m in meanings]
    if len(cells) != len(meanings) or not any(c and c in each for c, each in zip(cells, known, strict=True)):
        return []
    if any(math.isfinite(delimited.number(cell)) for cell in first[0]):
        return []
    for cell, meaning, each in zip(cells, meanings, known, strict=True):
        if meaning is not None and each and cell.strip("-") and cell not in each:
            allowed = ", ".join(filter(None, each))
            raise BadData(
                f"{name}, {meaning.shown}: got {cell} in the row of units below the header; "
                f"expected {f'one of {allowed}' if allowed else 'none'}; correct it, or remove that row"
            )
    return [cell if cell in each else "" for cell, each in zip(cells, known, strict=True)]


def _check_units(name: str, meanings: Sequence[Meaning | None], below: Sequence[str]) -> None:
    """Refuse a column whose own name, or the row of units, states another unit than it is read in."""
    for j, meaning in enumerate(meanings):
        if meaning is None or meaning.quantity is None or abs(meaning.factor) != 1.0:
            continue
        named = {unit: column for column, unit in meaning.quantity.columns().items()}
        for stated, where in (
            (quantities.at_the_end(meaning.shown, named), "in its name"),
            (below[j] if below else "", "in the row below the header"),
        ):
            if stated and stated != meaning.unit:
                mapped = meaning.shown not in (meaning.column, named[meaning.unit])
                remedy = f'state [columns] {named[stated]} = "{meaning.shown}" in the robot\'s file'
                raise BadData(
                    f"{name}: column {meaning.shown} states {stated} {where}, and is read in "
                    f"{meaning.unit or 'shares of 1'}; "
                    f"{remedy if mapped else f'name it {named[stated]}'}, or correct the unit"
                )


def _column(meaning: Meaning, cells: Sequence[str], layout: Layout) -> tuple[np.ndarray, np.ndarray]:
    """Values of a column's cells, read all at once since a log may have a million rows; and True for cells that may
    be wrong, which `_cell` has to read."""
    if meaning.column in WORDS:
        return np.array(cells), np.isin(cells, [c for c in dict.fromkeys(cells) if not _sound(meaning, c, layout)])
    empty = np.zeros(len(cells), bool)
    if _may_be_empty(meaning.column, layout):
        empty = np.array([cell.lower() in MISSING for cell in cells])
    found, (low, high) = np.full(len(cells), math.nan), meaning.limits()
    for k in np.flatnonzero(~empty).tolist():
        try:
            found[k] = parsed(cells[k])
        except ValueError:  # which stays doubted
            continue
    above = found > low if meaning.column in layout.deviation_columns else found >= low
    doubted = ~empty & ~(above & (found <= high))
    values = found if meaning.as_named else np.array([meaning.value(x) for x in found.tolist()])
    return values, doubted


def _may_be_empty(column: str, layout: Layout) -> bool:
    """True for a column whose cells may have no reading."""
    return column != layout.imposed_column and column in (
        *layout.measured_columns, *layout.deviation_columns, *DUTY,
    )  # fmt: skip


def _sound(meaning: Meaning, cell: str, layout: Layout) -> bool:
    """True for a cell that is not refused."""
    try:
        _cell("", meaning, cell, layout)
    except BadData:
        return False
    return True


def _cell(where: str, meaning: Meaning, cell: str, layout: Layout, kind: type[InputError] = BadData) -> Any:
    column = meaning.column

    def refuse(allowed: str, hint: str = "") -> InputError:
        return kind(f"{where}, {meaning.shown}: got {cell or 'an empty cell'}; {hint}expected {allowed}")

    if column in WORDS:
        if column == "surface" and (message := surfaces.refused(cell, layout)):
            raise refuse(message)
        if column == "mode" and cell not in DRIVEN:
            raise refuse(f"one of these; {choices(cell, DRIVEN)}")
        if column == "configuration" and not cell:
            raise refuse("the name of one of the robot's configurations")
        return cell
    deviations = layout.deviation_columns
    readings = (*layout.measured_columns, *deviations, *DUTY)
    if cell.lower() in MISSING and _may_be_empty(column, layout):
        return math.nan
    low, high = meaning.limits()
    positive = column in deviations
    hint = _hint(meaning, cell, readings)
    allowed = f"{'more than ' if positive else ''}{number(low)} to {number(high)}"
    try:
        value = parsed(cell)
    except ValueError:
        raise refuse(f"a number, {allowed}", hint) from None
    beyond = ROUNDED_FACTOR if meaning.factor != 1.0 else ROUNDED
    if not low - beyond * abs(low) <= value <= high + beyond * abs(high) or (positive and value <= low):
        raise refuse(allowed, hint)
    value = min(max(value, low), high)
    return value if meaning.as_named else meaning.value(value)


#: From how many times the largest value that is allowed another unit is supposed.
FAR = 2.0
#: How far a value may be beyond a limit because it is written with few digits, and because a factor from its unit is,
#: as shares of the limit.
ROUNDED, ROUNDED_FACTOR = 1e-6, 5e-4
#: What programs write where there is no reading, as an empty cell.
MISSING = ("", "nan", "na", "n/a", "#n/a", "<na>", "none", "null")
#: What people write there.
NOTHING = ("n.a.", "-", "--", "?", "x", "inf", "-inf")
_WITH_UNIT = re.compile(r"([+-]?\d*\.?\d+(?:[eE][+-]?\d+)?)\s*([^\d\s.,].*)")


def _hint(meaning: Meaning, cell: str, readings: tuple[str, ...]) -> str:
    """What a cell that is refused probably means, with a semicolon behind it; empty where nothing is known."""
    if cell.lower() in NOTHING:
        return "leave the cell empty where there is no reading; " if meaning.column in readings else ""
    quantity, mine = meaning.quantity, meaning.unit
    if quantity is None or meaning.factor != 1.0:
        return ""
    named = {unit: column for column, unit in quantity.columns().items()}
    try:
        value = parsed(cell)
    except ValueError:
        found = _WITH_UNIT.fullmatch(cell)
        return "" if found is None else _unit_hint(found[1], found[2], mine, named)
    far = abs(value) > FAR * max(map(abs, quantity.limits(mine)))
    if far and meaning.column in DUTY:
        return "a command of another size? divide by its largest, of a log by [columns] duty = {column, factor}; "
    for unit, column in named.items():
        low, high = quantity.limits(unit)
        if far and unit != mine and low <= value <= high:
            return f"is it in {unit or 'shares of 1'}? then name the column {column}; "
    return ""


def _unit_hint(value: str, written: str, mine: str, named: Mapping[str, str]) -> str:
    """What to do with a unit beside a number; `mine`: the column's own, `named`: columns by their units."""
    unit = quantities.spelled(written)
    if unit == mine:
        return f"write {value}, the unit stands in the column's name; "
    if unit in named:
        return f"write numbers alone, in {mine or 'shares of 1'}, or name the column {named[unit]}; "
    return f"write the number alone{f', in {mine}' if mine else ''}; "


def _check_driving(name: str, columns: dict[str, np.ndarray]) -> None:
    if "mode" in columns and not set(TIME) <= set(columns):  # settled runs are driven
        raise BadData(f"{name}: column mode is for time histories; add {', '.join(TIME)}, or remove it")
    if "duty" not in columns:
        return
    modes = columns.get("mode", np.full(len(columns["duty"]), DRIVEN[0]))
    for row, (duty, mode) in enumerate(zip(columns["duty"], modes, strict=True), 1):
        if mode == DRIVEN[0] and math.isnan(duty):
            raise BadData(f"{name} row {row}, duty: got an empty cell; expected a number, -1 to 1")
        if mode != DRIVEN[0] and not math.isnan(duty) and duty != 0:
            raise BadData(f"{name} row {row}, duty: got {number(duty)} in mode {mode}; expected 0 or an empty cell")
    columns["duty"] = np.nan_to_num(columns["duty"])


def _check_sides(name: str, columns: dict[str, np.ndarray], layout: Layout) -> None:
    stated = [c for c in layout.sides if c in columns]
    if len(stated) == 1:
        (other,) = set(layout.sides) - set(stated)
        raise BadData(f"{name}: column {other} is missing beside {stated[0]}; state what drives both sides")
    if stated and set(columns) & {"duty", "mode"}:
        beside = min(set(columns) & {"duty", "mode"})
        raise BadData(f"{name}: column {beside} beside {stated[0]}, which says how either side is driven; keep one")


#: Share of the largest reading of a speed below which a motor that nothing drives stands.
STILL = 0.02


def _driven(name: str, columns: dict[str, np.ndarray], layout: Layout) -> tuple[np.ndarray, str]:
    """True for rows of settled runs in which something drives the motors; a sentence on the other rows.

    Raises:
        BadData: no row is driven, or a speed is read where nothing drives the motors.
    """
    sides = [c for c in layout.sides if c in columns]
    column = layout.imposed_column
    size = np.max(np.abs([columns[c] for c in sides]), 0) if sides else np.abs(columns[column])
    if layout.imposed == "voltage":
        size = size * np.abs(columns[SUPPLY] if sides else columns.get("duty", 1.0))
    idle = np.flatnonzero(size == 0)
    if not idle.size:
        return size != 0, ""
    stated = (column, *sides, *(["duty"] if "duty" in columns else []))
    zero = " and ".join(c for c in stated if not columns[c][idle].any())
    for channel in (c for c in layout.channels if c.zero_at_rest and c.column in columns):
        readings = np.nan_to_num(columns[channel.column])
        moving = idle[np.abs(readings[idle]) > STILL * np.max(np.abs(readings))]
        if moving.size and moving.size < len(readings):
            raise BadData(
                f"{name} row {moving[0] + 1}, {channel.column}: got {number(readings[moving[0]])} where "
                f"{zero} is 0; expected what drives it, or remove the row"
            )
    if idle.size == len(size):
        raise BadData(
            f"{name}: {zero} is 0 in every row, so nothing drives the motors; expected rows that are driven"
        )
    which = f"row {idle[0] + 1} is" if idle.size == 1 else f"{idle.size} rows, the first row {idle[0] + 1}, are"
    return size != 0, (
        f"{name}: {which} left out, as nothing drives the motors ({zero or column} 0); rows are counted without them"
    )


def _check_level(name: str, columns: dict[str, np.ndarray]) -> None:
    """Refuse readings of turns on a slope, of which none is settled."""
    slope = columns["slope_deg"]
    if slope.any():
        row = int(np.flatnonzero(slope)[0])
        more = f", and so in {np.count_nonzero(slope)} of {len(slope)} rows" if np.count_nonzero(slope) > 1 else ""
        raise BadData(
            f"{name} row {row + 1}, slope_deg: got {number(slope[row])} in a table of settled turns{more}; on a "
            "slope the heading changes all the time, so that no turn is settled there: expected 0; remove such rows "
            "(simulate --left, --right and --slope with --model drive follows one over time)"
        )


def _check_mass(name: str, columns: dict[str, np.ndarray]) -> None:
    if "total_mass_kg" not in columns:
        return
    for row, (total, payload) in enumerate(zip(columns["total_mass_kg"], columns["payload_kg"], strict=True), 1):
        if total <= payload:
            raise BadData(_too_light(f"{name} row {row}", total, payload))


def _check_deviations(name: str, columns: dict[str, np.ndarray], shown: tuple[Channel, ...]) -> None:
    for channel in shown:
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


def single(cells: dict[str, Any], layout: Layout | None = None) -> Runs:
    """One run from options by column name, each checked as a cell of a file would be; without a voltage on a battery.

    Args:
        layout: of the robot's tables; None: of the packaged one's.

    Raises:
        BadConfiguration: an option that is out of range, not finite or an unknown word.
    """
    layout = Layout() if layout is None else layout
    texts = {column: number(value) if isinstance(value, float) else str(value) for column, value in cells.items()}
    columns = {
        column: np.array([_cell("option", Meaning(column, column), t, layout, BadConfiguration)])
        for column, t in texts.items()
    }
    if layout.imposed == "voltage":
        columns.setdefault(SUPPLY, np.array([math.nan]))
    if "total_mass_kg" in cells and cells["total_mass_kg"] <= cells["payload_kg"]:
        raise BadConfiguration(_too_light("option", cells["total_mass_kg"], cells["payload_kg"]))
    columns = {c: np.array([cells[c]]) if isinstance(cells.get(c), float) else v for c, v in columns.items()}
    return Runs("the options", columns, layout=layout)
