"""Presets: TOML files with the meaning, unit and sign of the columns in a logger's files."""

from __future__ import annotations

import fnmatch
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import Any

from calibration.data import Json, Mapped, Names, input_files
from calibration.data.columns import Layout
from calibration.data.input_errors import (
    BadConfiguration,
    BadData,
    allowed_words,
    parse_number,
    stated_as,
    stated_count,
    stated_names,
    stated_number,
    stated_word,
)
from mmrjax.model import channels

#: Presets that come with the package, in `calibration/data/presets/`.
PACKAGED = (
    "advantagekit", "bam", "damiao", "dynamixel", "feetech", "lerobot", "moteus", "odrive", "px4", "rcbenchmark",
    "robstride", "ros2", "ros2_amperes", "simplefoc", "sysid", "vesc",
)  # fmt: skip
#: Fewest columns of a packaged preset in a source for the preset to be recognised.
OF_A_PRESET = 3
COLUMN_NAME = "the name of a column"
#: Keys of a preset, and of one of its columns. Texts have a description.
KEYS, TEXTS = ("columns", "ask", "header"), {"note": "a sentence", "needs": COLUMN_NAME, "across": COLUMN_NAME}
KEYS_OF_COLUMN = ("column", "factor", "per", "times", "sign_bit", "zero", *TEXTS)
#: Keys of a number that the user gives for a preset.
KEYS_OF_NUMBER = ("about", "usual")
#: Numbers of a file that asks for none.
NO_NUMBERS: Mapping[str, float] = {}
#: Separator between the name of a preset and the user's numbers, as in `vesc,pole_pairs=7`.
SEPARATOR = ","


@dataclass(frozen=True)
class PresetColumn:
    """A column of this program, and the column of a logger's file from which it is read.

    Attributes:
        column: name of the column in this program.
        source_columns: possible names in the file, `*` for any text. The first name in the file is used.
        factor: factor from its unit to the unit of `column`.
        note: its meaning, for a note to the user.
        needs: another column of this program that is required if this one drives the motor. Empty: none.
        across: column of the file with the d-axis current, which field weakening makes nonzero. Empty: none.
        sign_bit: sign bit of raw numbers whose other bits are the magnitude. 0: none.
        zero: raw number that means zero.
    """

    column: str
    source_columns: Names
    factor: float = 1.0
    note: str = ""
    needs: str = ""
    across: str = ""
    sign_bit: int = 0
    zero: float = 0.0


@dataclass(frozen=True)
class Preset:
    """Meaning of the columns of a logger's files.

    Attributes:
        name: name of the preset or its file.
        columns: columns, in the order of the preset.
        header: names of the columns of files without a header. Empty: every file has one.
    """

    name: str
    columns: tuple[PresetColumn, ...]
    header: Names = ()

    def mapped(
        self, find_column: Callable[[str], str | None], has_readings: Callable[[str], bool] = lambda name: True
    ) -> tuple[Mapped, Names]:
        """Columns of a source in the form of `Layout.mapped`, and notes on their meaning.

        Args:
            find_column: function that returns the source column with a name, or None.
            has_readings: function that returns False for an empty source column.
        """
        mapped, notes = [], []
        for column in self.columns:
            present = [name for name in map(find_column, column.source_columns) if name is not None]
            if present:
                name = next(filter(has_readings, present), present[0]) if len(present) > 1 else present[0]
                mapped.append((column.column, name, column.factor))
                if column.note:
                    notes.append(f"{self.name}: {name}, read as {column.column}, {column.note}")
            elif self.name not in PACKAGED:  # packaged presets have columns of several loggers
                mapped.append((column.column, column.source_columns[0], column.factor))
        return tuple(mapped), tuple(notes)

    def column_of(self, name: str) -> PresetColumn:
        """Preset column that is read from a source column, or an empty one."""
        columns = (c for c in self.columns if any(_matches_any(pattern, {name}) for pattern in c.source_columns))
        return next(columns, PresetColumn("", ()))

    def check_needed(self, mapped: Mapped, imposed: str, name: str) -> None:
        """Rejects a source that lacks a column without which its imposed column is useless.

        Args:
            mapped: columns of the source.
            imposed: column that drives the motor.
            name: name of the source.

        Raises:
            BadData: the other column is missing.
        """
        present = {name: source_column for name, source_column, _ in mapped}
        by_name = {column.column: column for column in self.columns}
        if imposed in present and (needs := by_name[imposed].needs) and needs not in present:
            missing_words = " or ".join(by_name[needs].source_columns)
            raise BadData(
                f"{name}: has no {missing_words}; --columns {self.name} needs it for {needs}, because "
                f"{present[imposed]} alone does not give the motor voltage; record {missing_words}, or set imposed "
                "to the speed or the current in the rig's file"
            )


#: Preset without columns.
NONE = Preset("", ())


def find_preset(stated: str | Path) -> Preset:
    """Packaged preset with a name, or the preset in a file. Numbers that the preset needs may follow.

    Args:
        stated: text such as `vesc,pole_pairs=7` or `mine.toml`.

    Raises:
        BadConfiguration: there is no such preset or file, a number is missing or unknown, or as in `parse_preset`.
    """
    name, *entries = str(stated).split(SEPARATOR)
    numbers: dict[str, float] = {}
    for entry in entries:
        key, equals, text = (part.strip() for part in entry.partition("="))
        try:
            numbers[key] = stated_number(parse_number(text), f"--columns {name}, {key}")
        except ValueError as error:
            raise BadConfiguration(
                f"--columns {name}: got {key}{equals}{text}; expected a name and a number, such as pole_pairs=7"
            ) from error
    if name in PACKAGED:
        return parse_preset(_packaged_content(name), name, numbers)
    path = Path(name)
    if not path.exists():
        raise BadConfiguration(
            f"--columns: got {name}; no such file and no packaged preset; {allowed_words(name, PACKAGED)}"
        )
    content = input_files.toml_content(input_files.toml_text(path, path.name), path.name)
    return parse_preset(content, path.name, numbers)


def recognise_preset(names: Sequence[str]) -> str:
    """Packaged preset that has most columns in common with a source, at least `OF_A_PRESET`. Empty if there is none.

    Args:
        names: names of the source's columns, or paths of its signals.
    """
    parts = {*names, *(re.split(r"[/.]", name)[-1] for name in names)}
    matches = {"": OF_A_PRESET - 1}
    for name in PACKAGED:
        preset = parse_preset(_packaged_content(name), name, dict.fromkeys(numbers_to_state(name), 1.0))
        matches[name] = sum(any(_matches_any(pattern, parts) for pattern in c.source_columns) for c in preset.columns)
    return max(matches, key=lambda name: matches[name])


def _matches_any(pattern: str, names: set[str]) -> bool:
    return bool(fnmatch.filter(names, pattern)) if "*" in pattern else pattern in names


def numbers_to_state(name: str) -> Names:
    """Names of the numbers that the user must give for a packaged preset."""
    numbers = _packaged_content(name).get("ask", {})
    return tuple(key for key, number in numbers.items() if isinstance(number, str) or "usual" not in number)


def _packaged_content(name: str) -> Json:
    text = (resources.files("calibration") / "data" / "presets" / f"{name}.toml").read_text("utf-8")
    return input_files.toml_content(text, name)


def parse_preset(content: Json, where: str, given: Mapping[str, float]) -> Preset:
    """Preset from a table, such as the content of a file.

    Args:
        where: beginning of the error message.
        given: numbers given by the user, by name.

    Raises:
        BadConfiguration: a key or a column is unknown, or a required number is missing.
    """
    for key in content:
        stated_word(key, KEYS, where, f"got the key {key}")
    numbers = _preset_numbers(content.get("ask", {}), where, given)
    header = stated_names(content.get("header", []), f"{where}, header", "a list of names", least=0)
    columns = content.get("columns", {})
    if not isinstance(columns, dict) or not columns:
        raise BadConfiguration(
            f'{where}, columns: got {columns!r}; expected a table of columns, such as time_s = "t"'
        )
    return Preset(where, parse_columns(columns, where, numbers=numbers), header)


def parse_columns(
    table: Json, where: str, keys: Sequence[str] = KEYS_OF_COLUMN, numbers: Mapping[str, float] = NO_NUMBERS
) -> tuple[PresetColumn, ...]:
    """Columns that a table `[columns]` of a preset or of a robot file states.

    Args:
        where: beginning of the error message.
        keys: allowed keys of a column. Only a preset, which allows all, may list several names of a column.
        numbers: numbers that columns may refer to, by name.

    Raises:
        BadConfiguration: a key or a column is unknown, or a value is invalid.
    """
    layout, columns = Layout(channels=channels.EVERY), []
    spellings = layout.spellings()
    for name, entry in table.items():
        place = f"{where}, columns.{name}"
        if name not in spellings:
            names_text = allowed_words(name, spellings, listed=layout.known())
            raise BadConfiguration(f"{place}: no such column of a table; {names_text}; other units are allowed too")
        columns.append(_parse_column(name, entry, place, keys, numbers))
    return tuple(columns)


def _preset_numbers(questions: Any, where: str, given: Mapping[str, float]) -> dict[str, float]:
    """Numbers that the user gives for a preset, or their defaults, by name."""
    stated_as(questions, dict, f"{where}, ask", "a table")
    for key in given:
        if key not in questions:
            names_text = allowed_words(key, questions) if questions else "it defines no numbers under [ask]"
            raise BadConfiguration(f"--columns {where}: got {key}; {names_text}")
    numbers: dict[str, float] = {}
    for key, number in questions.items():
        table = {"about": number} if isinstance(number, str) else number
        if not isinstance(table, dict) or {*table} - {*KEYS_OF_NUMBER} or not isinstance(table.get("about"), str):
            raise BadConfiguration(
                f'{where}, ask.{key}: got {number!r}; expected a description such as "number of the motor, from 0", '
                f'or {{about = "DESCRIPTION", usual = 1.0}}'
            )
        if key not in given and "usual" not in table:
            raise BadConfiguration(
                f"--columns {where}: {key} is missing, the {table['about']}; give it as --columns "
                f"{where}{SEPARATOR}{key}=7"
            )
        numbers[key] = stated_number(given.get(key, table.get("usual")), f"{where}, {key}")
        if numbers[key] == 0 and "usual" not in table:
            raise BadConfiguration(f"--columns {where}, {key}: got 0; expected a number that is not 0")
    return numbers


def _parse_column(
    name: str, entry: Any, where: str, keys: Sequence[str], numbers: Mapping[str, float]
) -> PresetColumn:
    form = f'{name} = "LOGGER COLUMN", or {name} = {{column = "LOGGER COLUMN", factor = 0.001}}'
    table = entry if isinstance(entry, dict) else {"column": entry}
    for key in table:
        stated_word(key, keys, where, f"got the key {key}")
    column, place = table.get("column"), f"{where}.column"
    if keys is not KEYS_OF_COLUMN:
        stated_as(column, str, place, form)
    patterns = stated_names([column] if isinstance(column, str) else column, place, form)
    factor = stated_number(table.get("factor", 1.0), f"{where}.factor")
    for key, power in (("per", -1), ("times", 1)):
        if key in table:
            wrong = f"got {table[key]}; expected one of the numbers defined under [ask]"
            value = numbers[stated_word(table[key], numbers, f"{where}.{key}", wrong)]
            if power < 0 and not value:
                raise BadConfiguration(f"{where}.{key}: {table[key]} is 0; expected a number that is not 0")
            factor *= value**power
    if not factor:
        raise BadConfiguration(f"{where}.factor: got 0; expected a number that is not 0")
    texts = {key: stated_as(table.get(key, ""), str, f"{where}.{key}", expected) for key, expected in TEXTS.items()}
    sign_bit = stated_count(table.get("sign_bit", 0), f"{where}.sign_bit", 0, 63)
    zero = stated_number(table.get("zero", 0.0), f"{where}.zero")
    source_columns = tuple(_fill_in_numbers(pattern, numbers) for pattern in patterns)
    return PresetColumn(name, source_columns, factor, sign_bit=sign_bit, zero=zero, **texts)


def _fill_in_numbers(name: str, numbers: Mapping[str, float]) -> str:
    """Name of a column, with numbers in place of the names in braces."""
    for key, number in numbers.items():
        name = name.replace(f"{{{key}}}", f"{number:g}")
    return name


def merge_columns(first: Mapped, others: Mapped) -> Mapped:
    """Columns of two tables. `first` takes precedence if both state a column or read the same source column."""
    first = tuple(first)
    used_names = {_name_without_unit(name) for name, _, _ in first} | {source for _, source, _ in first}
    return (*first, *(c for c in others if _name_without_unit(c[0]) not in used_names and c[1] not in used_names))


def _name_without_unit(name: str) -> str:
    """Name of a column without its unit: time_ms and time_s become equal."""
    layout = Layout(channels=channels.EVERY)
    quantities = layout.quantities()
    return next((column for column, quantity in quantities.items() if name in quantity.columns()), name)
