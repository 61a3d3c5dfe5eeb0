"""Values of a column's cells, and a sentence for each cell that is refused."""

from __future__ import annotations

import re
from collections.abc import Mapping

import numpy as np

from calibration.data import surfaces
from calibration.data.columns import DRIVEN, DUTY, WORDS, Layout, Meaning
from calibration.data.input_errors import choices, number, parsed
from calibration.data.named_arrays import Raw, missing, numbers, texts
from mmrjax.model import quantities

#: From how many times the largest value that is allowed another unit is supposed.
FAR = 2.0
#: How far a value may be beyond a limit because it is written with few digits, and because a factor from its unit is,
#: as shares of the limit.
ROUNDED, ROUNDED_FACTOR = 1e-6, 5e-4
#: What people write there.
NOTHING = ("n.a.", "-", "--", "?", "x", "inf", "-inf")
_WITH_UNIT = re.compile(r"([+-]?\d*\.?\d+(?:[eE][+-]?\d+)?)\s*([^\d\s.,].*)")


def values(meaning: Meaning, raw: Raw, layout: Layout) -> tuple[np.ndarray, np.ndarray]:
    """Returns a column's values in its unit, NaN where there is no reading, and True for each cell to be refused.

    All cells are read at once, since a log may have a million rows; `refusal` makes the sentence about one of them.
    """
    if meaning.column in WORDS:
        words = texts(raw)
        wrong = [word for word in dict.fromkeys(words) if _allowed_words(meaning.column, word, layout)]
        return np.array(words), np.isin(words, wrong)
    found, (low, high) = numbers(raw), meaning.limits()
    beyond = ROUNDED_FACTOR if meaning.factor != 1.0 else ROUNDED
    above = found > low if meaning.column in layout.deviation_columns else found >= low - beyond * abs(low)
    refused = ~(above & (found <= high + beyond * abs(high)))
    if _may_be_empty(meaning.column, layout):
        refused[refused] = ~missing(raw, np.flatnonzero(refused))
    np.clip(found, low, high, out=found)
    return found if meaning.as_named else _in_its_unit(meaning, found), refused


def _in_its_unit(meaning: Meaning, written: np.ndarray) -> np.ndarray:
    """Numbers of cells in the unit of the column, as `Meaning.value` of each."""
    quantity = meaning.quantity
    if quantity is not None and quantity.percent and meaning.unit == quantities.PERCENT:  # not proportional
        return np.array([meaning.value(x) for x in written.tolist()])
    return written * meaning.factor * (1.0 if quantity is None else quantity.units[meaning.unit])


def _may_be_empty(column: str, layout: Layout) -> bool:
    """True for a column whose cells may have no reading."""
    return column != layout.imposed_column and column in (
        *layout.measured_columns, *layout.deviation_columns, *DUTY,
    )  # fmt: skip


def _allowed_words(column: str, word: str, layout: Layout) -> str:
    """Words that a message offers in the place of one that is refused; empty for one that is allowed."""
    if column == "surface":
        return surfaces.refused(word, layout)
    if column == "mode" and word not in DRIVEN:
        return f"one of these; {choices(word, DRIVEN)}"
    if column == "configuration" and not word:
        return "the name of one of the robot's configurations"
    return ""


def refusal(where: str, meaning: Meaning, cell: str, layout: Layout) -> str:
    """Returns the sentence about a cell that `values` refuses; `where` opens it."""
    column, hint = meaning.column, ""
    if column in WORDS:
        allowed = _allowed_words(column, cell, layout)
    else:
        low, high = meaning.limits()
        hint = _hint(meaning, cell, (*layout.measured_columns, *layout.deviation_columns, *DUTY))
        more = "more than " if column in layout.deviation_columns else ""
        allowed = f"{more}{number(low)} to {number(high)}"
        try:
            parsed(cell)
        except ValueError:
            allowed = f"a number, {allowed}"
    return f"{where}, {meaning.shown}: got {cell or 'an empty cell'}; {hint}expected {allowed}"


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
