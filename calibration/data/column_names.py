"""Checks of the names of a table's columns, of the units that they state, and of their cells."""

from __future__ import annotations

import difflib
import math
import re
from collections.abc import Collection, Sequence
from dataclasses import replace

import numpy as np

from calibration.data import Names, configuration_tables
from calibration.data.columns import (
    CURRENT,
    DRIVEN,
    DUTY,
    HEADING,
    SIDES,
    SPEED,
    SUPPLY,
    TIME,
    VOLTS,
    WORDS,
    Column,
    Layout,
)
from calibration.data.input_errors import BadData, allowed_words
from calibration.data.named_arrays import (
    NamedArrays,
    Raw,
    cell_number,
    column_numbers,
    column_texts,
    missing_readings,
)
from mmrjax.model import channels, quantities
from mmrjax.model.robot import Robot

#: Ratio to the largest allowed value from which another unit is probable.
FAR = 2.0
#: Tolerance beyond a limit for a rounded value, and for a value with a rounded factor, as shares of the limit.
ROUNDED, ROUNDED_FACTOR = 1e-6, 5e-4
#: Entries that people write for a missing reading.
NOTHING = ("n.a.", "-", "--", "?", "x", "inf", "-inf")
_WITH_UNIT = re.compile(r"([+-]?\d*\.?\d+(?:[eE][+-]?\d+)?)\s*([^\d\s.,].*)")


def convert_column(meaning: Column, raw: Raw, layout: Layout) -> tuple[np.ndarray, np.ndarray]:
    """Values of a column in its unit (NaN without a reading), and True for each rejected cell.

    All cells are read at once, because a log may have a million rows. `refused_cell_sentence` explains one of them.
    """
    if meaning.column in WORDS:
        words = column_texts(raw)
        wrong = [word for word in dict.fromkeys(words) if _allowed_words(meaning.column, word, layout)]
        return np.array(words), np.isin(words, wrong)
    numbers, (low, high) = column_numbers(raw), meaning.limits()
    tolerance = ROUNDED_FACTOR if meaning.factor != 1.0 else ROUNDED
    above = numbers > low if meaning.column in layout.deviation_columns else numbers >= low - tolerance * abs(low)
    refused = ~(above & (numbers <= high + tolerance * abs(high)))
    if meaning.column != layout.imposed_column and meaning.column in _may_be_empty(layout):
        refused[refused] = ~missing_readings(raw, np.flatnonzero(refused))
    np.clip(numbers, low, high, out=numbers)
    if meaning.as_named:
        return numbers, refused
    if meaning.quantity.percent and meaning.unit == quantities.PERCENT:  # not proportional
        return np.array([meaning.value(x) for x in numbers.tolist()]), refused
    return numbers * meaning.factor * meaning.quantity.units[meaning.unit], refused


def _may_be_empty(layout: Layout) -> Names:
    """Columns whose cells may be empty."""
    return (*layout.measured_columns, *layout.deviation_columns, *DUTY)


def _allowed_words(column: str, word: str, layout: Layout) -> str:
    """Allowed words, for the error message about a wrong one. Empty if the word is allowed."""
    if column == "surface":
        return configuration_tables.allowed_labels(word, layout)
    if column == "mode" and word not in DRIVEN:
        return f"one of these; {allowed_words(word, DRIVEN)}"
    if column == "configuration" and not word:
        return "the name of one of the robot's configurations"
    return ""


def refused_cell_sentence(where: str, meaning: Column, cell: str, layout: Layout, *, hints: bool = True) -> str:
    """Sentence that explains why `convert_column` rejects a cell.

    Args:
        where: beginning of the sentence.
        hints: True to guess the intended unit.
    """
    column, hint = meaning.column, ""
    if column in WORDS:
        allowed = _allowed_words(column, cell, layout)
    else:
        low, high = meaning.limits()
        hint = _hint_about_cell(meaning, cell, hints, _may_be_empty(layout))
        more_than = "more than " if column in layout.deviation_columns else ""
        number = "a number, " if math.isnan(cell_number(cell)) and cell.lower() != "nan" else ""
        allowed = f"{number}{more_than}{low:g} to {high:g}"
    return f"{where}, {meaning.shown}: got {cell or 'an empty cell'}; {hint}expected {allowed}"


def _hint_about_cell(meaning: Column, cell: str, units: bool, readings: Names) -> str:
    """Guess at what a rejected cell means, ending in a semicolon. Empty without a guess."""
    if cell.lower() in NOTHING:
        return "leave the cell empty if there is no reading; " if meaning.column in readings else ""
    quantity, column_unit = meaning.quantity, meaning.unit
    if not units or meaning.factor != 1.0:
        return ""
    columns_by_unit = {unit: column for column, unit in quantity.columns().items()}
    unit_text = column_unit or "shares of 1"
    value = cell_number(cell)
    match = _WITH_UNIT.fullmatch(cell) if math.isnan(value) else None
    if match is not None:  # a unit is written next to the number
        unit = quantities.unit_in_column(match[2])
        if unit == column_unit:
            return f"write {match[1]}, since the unit is in the column's name; "
        if unit in columns_by_unit:
            return f"write numbers without units, in {unit_text}, or name the column {columns_by_unit[unit]}; "
        return f"write only the number{f', in {column_unit}' if column_unit else ''}; "
    if not abs(value) > FAR * max(map(abs, quantity.limits(column_unit))):
        return ""
    if meaning.column in DUTY:
        return "is the command scaled? divide it by its maximum, in a log with [columns] duty = {column, factor}; "
    for unit, column in columns_by_unit.items():
        low, high = quantity.limits(unit)
        if unit != column_unit and low <= value <= high:
            return f"is it in {unit or 'shares of 1'}? then name the column {column}; "
    return ""


#: Most columns of a table that a message names.
NAMED = 8
#: Other words for the sides.
_SIDE = {"l": "left", "lh": "left", "lft": "left", "port": "left", "r": "right", "rh": "right", "starboard": "right"}


def match_column_names(
    name: str, header: Sequence[str], layout: Layout, *, inferred: bool, of_turns: bool
) -> tuple[list[str], Layout, Names]:
    """Names of the columns in this program's spelling, the layout with their channels, and notes.

    A note reports each name that differs in case.

    Raises:
        BadData: a name occurs twice.
    """
    full_layout = replace(layout, channels=channels.EVERY)
    spellings: dict[str, set[str]] = {}
    for column in (full_layout if inferred else layout).spellings():
        spellings.setdefault(column.casefold(), set()).add(column)
    matched_names, notes = [], []
    for column in header:
        possible = spellings.get(column.casefold(), set())
        if column not in possible and len(possible) == 1 and not possible & set(header):
            (spelling,) = possible
            notes.append(f"{name}: column {column} is read as {spelling}")
            column = spelling
        matched_names.append(column)
    repeated = min((c for c in matched_names if matched_names.count(c) > 1), default=None)
    if repeated is not None:
        raise BadData(f"{name}: column {repeated} is present {matched_names.count(repeated)} times; expected once")
    if inferred or of_turns:
        present_columns = {m.column for m in full_layout.meanings(name, matched_names) if m is not None}
        has_turns = of_turns and {*layout.sides, *VOLTS, *HEADING} & present_columns
        further_channels = channels.EVERY if inferred else channels.OF_TURNS if has_turns else ()
        read_channels = (
            c
            for c in channels.EVERY
            if c in layout.channels or (c in further_channels and c.column in present_columns)
        )
        layout = replace(layout, channels=tuple(read_channels))
    return matched_names, layout, tuple(notes)


def check_header(
    name: str, header: list[str], meanings: list[Column | None], measured: bool, battery: bool, layout: Layout
) -> None:
    """Rejects a header that lacks a column, or has a misspelt one.

    Raises:
        BadData: a required column or every channel is missing, or a name is close to a known one.
    """
    present = {m.column for m in meanings if m is not None}
    strange = [c for c, m in zip(header, meanings, strict=True) if m is None]
    if not layout.complete:  # names of other channels are not misspellings
        strange = [c for c in strange if c not in {x for k in channels.EVERY for x in (k.column, k.sd_column)}]
    _check_names_of_sides(name, strange, present, layout)
    implied = set()  # required columns that follow from others
    if layout.imposed_column == SPEED and present & set(layout.sides):  # the sides' speeds are imposed
        implied.add(SPEED)
        if SPEED in present:
            raise BadData(f"{name}: column {SPEED} in addition to {', '.join(layout.sides)}; keep one of them")
    if present & set(VOLTS):  # the supply's voltage is the larger one
        implied.add(SUPPLY)
    if not layout.complete and "surface" in present:  # its labels may belong to one configuration
        implied.add("configuration")
    required = [c for c in layout.required(measured=measured, battery=battery) if c not in implied]
    for column in (c for c in (*required, *layout.measured_columns) if c not in present):
        similar = difflib.get_close_matches(column, strange, 1, 0.6)
        if column in required or (similar and layout.complete):
            suggestion = f"; did you mean {similar[0]}?" if similar else ""
            if column == SUPPLY and {f"motor_{volts}" for volts in VOLTS} <= {*header}:  # they may be readings too
                suggestion = "; the columns that drive the sides can be named under [columns]: " + ", ".join(
                    f'{volts} = "motor_{volts}"' for volts in VOLTS
                )
            elif column == SUPPLY and CURRENT in present and not similar:
                suggestion = f'; record it, or set imposed = "motor_current" if {CURRENT} is commanded'
            advice = "" if similar else _advice_on_unknown_columns(strange, column)
            raise BadData(
                f"{name}: column {layout.expected(column)} is missing{suggestion} (required: {', '.join(required)})"
                f"{advice}"
            )
    if measured and present.isdisjoint(layout.measured_columns):
        readings_advice = _advice_on_unknown_columns(strange, layout.measured_columns[0])
        turning_channels = {c.column: c.name for c in channels.OF_TURNS if c.column in strange}
        if turning_channels:
            names = ", ".join(f'"{channel}"' for channel in turning_channels.values())
            readings_advice = f"; {', '.join(turning_channels)}: set channels = [{names}] in the robot's file"
        expected = ", ".join(layout.measured_columns)
        raise BadData(f"{name}: no column with readings; expected at least one of {expected}{readings_advice}")
    for column in strange:
        similar = difflib.get_close_matches(column, [c for c in layout.known() if c not in present], 1, 0.85)
        if similar:
            raise BadData(f"{name}: unknown column {column}; did you mean {similar[0]}? rename or remove it")


def unread_channel_notes(name: str, robot: Robot, unread: Collection[str]) -> Names:
    """Notes on columns that the robot file assigns to a channel that it does not list.

    Args:
        unread: columns of the table without a meaning.
    """
    notes = []
    for column, source_column, _ in robot.rig.columns:
        channel = next((c for c in channels.EVERY if column in c.columns()), None)
        if source_column in unread and channel is not None:
            braked = channel.name == "output_torque" and not robot.has_ground
            cure = ", or assign the column to load_torque_Nm if a brake sets this torque" * braked
            notes.append(
                f"{name}, {source_column}: not read, because the robot file assigns it to {column}, and "
                f'"channels" does not list {channel.name}. Add it there{cure}'
            )
    return tuple(notes)


def check_has_time(name: str, header: list[str], meanings: list[Column | None], layout: Layout) -> None:
    """Rejects readings of a log without a time column."""
    shown_names = {m.column: m.shown for m in meanings if m is not None}
    sampled_columns = [shown_names[c.column] for c in layout.channels if c.column in shown_names and not c.settled]
    if sampled_columns and shown_names.keys().isdisjoint(TIME):
        strange = [c for c, m in zip(header, meanings, strict=True) if m is None]
        raise BadData(
            f"{name}: column {layout.expected('time_s')} is missing, and {sampled_columns[0]} can be used only in a "
            f"time history; if these are settled runs, remove {sampled_columns[0]}"
            f"{_advice_on_unknown_columns(strange, 'time_s')}"
        )


def _advice_on_unknown_columns(strange: list[str], column: str) -> str:
    """Advice on columns with unknown names, for an error message. Empty if there are none."""
    if not strange:
        return ""
    unit = column.rpartition("_")[2]
    guess = next((c for c in strange if re.search(rf"\b{unit}\b", c)), "...")
    names_text = ", ".join(strange[:NAMED]) + (", ..." if len(strange) > NAMED else "")
    return (
        f"; other columns: {names_text}; if one has these values, name it in the robot's file, with its unit's "
        f'factor: [columns] {column} = {{column = "{guess}", factor = 1.0}} (mmrjax inspect proposes such lines)'
    )


def _check_names_of_sides(name: str, strange: list[str], stated: set[str], layout: Layout) -> None:
    """Rejects columns that name a side by another word, or in another part of the name."""

    def sorted_words(column: str) -> tuple[str, ...]:
        return tuple(sorted(_SIDE.get(word.casefold(), word.casefold()) for word in column.split("_")))

    column_by_words = {sorted_words(c): c for c in layout.known() if {*channels.SIDES} & {*sorted_words(c)}}
    has_turn_readings = {*SIDES} <= {*column_by_words.values()} and not stated.isdisjoint(
        c.column for c in channels.OF_TURNS
    )
    for column in strange:
        meant = column_by_words.get(sorted_words(column))
        if meant is not None and meant not in stated:
            raise BadData(
                f"{name}: column {column}: the sides are called left and right; rename it to {meant}, or set "
                f'[columns] {meant} = "{column}" in the robot\'s file'
            )
        side = next((side for side in channels.SIDES if side in sorted_words(column)), None)
        if side and has_turn_readings and not stated & {*SIDES, *VOLTS} and column.endswith("V"):
            raise BadData(
                f"{name}: column {column}: if it is the voltage of the {side} side, rename it to "
                f'voltage_{side}_V, or set [columns] voltage_{side}_V = "{column}" in the robot\'s file'
            )


def check_units(arrays: NamedArrays, meanings: Sequence[Column | None]) -> None:
    """Rejects a column whose name or source states a unit other than the one in which it is read."""
    places = ("in its name", f"in {arrays.units_from}")
    for stated_unit, meaning in zip(arrays.units or [""] * len(meanings), meanings, strict=True):
        if meaning is None or abs(meaning.factor) != 1.0:  # a factor states the unit
            continue
        by_unit = {unit: column for column, unit in meaning.quantity.columns().items()}
        source_unit = "" if meaning.column in WORDS else stated_unit
        if source_unit and source_unit not in by_unit:
            allowed = ", ".join(filter(None, by_unit))
            raise BadData(
                f"{arrays.name}, {meaning.shown}: got {source_unit} in {arrays.units_from}; "
                f"expected {f'one of {allowed}' if allowed else 'none'}; correct or remove it"
            )
        for unit, place in zip((quantities.unit_at_end(meaning.shown, by_unit), source_unit), places, strict=True):
            if unit and unit != meaning.unit:
                remedy = f"name it {by_unit[unit]}"
                if meaning.shown not in (meaning.column, by_unit[meaning.unit]):
                    remedy = f'state [columns] {by_unit[unit]} = "{meaning.shown}" in the robot\'s file'
                raise BadData(
                    f"{arrays.name}: column {meaning.shown} states {unit} {place}, and is read in "
                    f"{meaning.unit or 'shares of 1'}; {remedy}, or correct the unit"
                )
