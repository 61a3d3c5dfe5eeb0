"""Values of a column's cells, and a sentence for each cell that is refused."""

from __future__ import annotations

import re
from collections.abc import Mapping

import numpy as np

from calibration.data import Names, surfaces
from calibration.data.columns import DRIVEN, DUTY, WORDS, Column, Layout
from calibration.data.input_errors import allowed_words, bound_text, parse_number
from calibration.data.named_arrays import Raw, column_numbers, column_texts, missing_readings
from mmrjax.model import quantities

#: Ratio to the largest allowed value from which another unit is probable.
FAR = 2.0
#: Rounding of a value with few digits, and of one with a factor of few digits, that may carry it beyond a limit, as
#: shares of the limit.
ROUNDED, ROUNDED_FACTOR = 1e-6, 5e-4
#: Entries of people for a missing reading.
NOTHING = ("n.a.", "-", "--", "?", "x", "inf", "-inf")
_WITH_UNIT = re.compile(r"([+-]?\d*\.?\d+(?:[eE][+-]?\d+)?)\s*([^\d\s.,].*)")


def convert_column(meaning: Column, raw: Raw, layout: Layout) -> tuple[np.ndarray, np.ndarray]:
    """Returns a column's values in its unit, NaN where there is no reading, and True for each cell to be refused.

    All cells are read at once, since a log may have a million rows; `refused_cell_sentence` makes the sentence about
    one of them.
    """
    if meaning.column in WORDS:
        words = column_texts(raw)
        wrong = [word for word in dict.fromkeys(words) if _allowed_words(meaning.column, word, layout)]
        return np.array(words), np.isin(words, wrong)
    found, (low, high) = column_numbers(raw), meaning.limits()
    beyond = ROUNDED_FACTOR if meaning.factor != 1.0 else ROUNDED
    above = found > low if meaning.column in layout.deviation_columns else found >= low - beyond * abs(low)
    refused = ~(above & (found <= high + beyond * abs(high)))
    if _may_be_empty(meaning.column, layout):
        refused[refused] = ~missing_readings(raw, np.flatnonzero(refused))
    np.clip(found, low, high, out=found)
    return found if meaning.as_named else _in_its_unit(meaning, found), refused


def _in_its_unit(meaning: Column, written: np.ndarray) -> np.ndarray:
    """Numbers of cells in the unit of the column, as `Column.value` of each."""
    if meaning.quantity.percent and meaning.unit == quantities.PERCENT:  # not proportional
        return np.array([meaning.value(x) for x in written.tolist()])
    return written * meaning.factor * meaning.quantity.units[meaning.unit]


def _may_be_empty(column: str, layout: Layout) -> bool:
    """True for a column whose cells may have no reading."""
    return column != layout.imposed_column and column in (
        *layout.measured_columns, *layout.deviation_columns, *DUTY,
    )  # fmt: skip


def _allowed_words(column: str, word: str, layout: Layout) -> str:
    """Allowed words for the message about a word; empty if the word is allowed itself."""
    if column == "surface":
        return surfaces.allowed_labels(word, layout)
    if column == "mode" and word not in DRIVEN:
        return f"one of these; {allowed_words(word, DRIVEN)}"
    if column == "configuration" and not word:
        return "the name of one of the robot's configurations"
    return ""


def refused_cell_sentence(where: str, meaning: Column, cell: str, layout: Layout, *, hints: bool = True) -> str:
    """Returns the sentence about a cell that `convert_column` refuses.

    Args:
        where: opens it; hints: True to guess the unit that was meant.
    """
    column, hint = meaning.column, ""
    if column in WORDS:
        allowed = _allowed_words(column, cell, layout)
    else:
        low, high = meaning.limits()
        hint = _hint(meaning, cell, hints, (*layout.measured_columns, *layout.deviation_columns, *DUTY))
        more = "more than " if column in layout.deviation_columns else ""
        allowed = f"{more}{bound_text(low)} to {bound_text(high)}"
        try:
            parse_number(cell)
        except ValueError:
            allowed = f"a number, {allowed}"
    return f"{where}, {meaning.shown}: got {cell or 'an empty cell'}; {hint}expected {allowed}"


def _hint(meaning: Column, cell: str, units: bool, readings: Names) -> str:
    """Guess at the meaning of a refused cell, with a semicolon at its end; empty without a guess."""
    if cell.lower() in NOTHING:
        return "leave the cell empty where there is no reading; " if meaning.column in readings else ""
    quantity, mine = meaning.quantity, meaning.unit
    if not units or meaning.factor != 1.0:
        return ""
    named = {unit: column for column, unit in quantity.columns().items()}
    try:
        value = parse_number(cell)
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
    """Advice on a unit next to a number; `mine`: the column's own unit, `named`: columns by their units."""
    unit = quantities.unit_in_column(written)
    if unit == mine:
        return f"write {value}, as the column's name has the unit; "
    if unit in named:
        return f"write numbers alone, in {mine or 'shares of 1'}, or name the column {named[unit]}; "
    return f"write the number alone{f', in {mine}' if mine else ''}; "
