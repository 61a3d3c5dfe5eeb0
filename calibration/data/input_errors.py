"""Errors in user input, files and arguments. Each kind has its exit code."""

from __future__ import annotations

import math
import numbers
from collections.abc import Iterable, Sequence
from typing import Any, TypeVar

from calibration.data import Names
from mmrjax.errors import allowed_words as allowed_words
from mmrjax.errors import printable, shorten

T = TypeVar("T")
#: Largest random seed.
SEEDS = 2**32 - 1


class InputError(Exception):
    """Error in user input. The message is a sentence for the user."""

    def __init__(self, message: str) -> None:
        """Stores the message, shortened and without unprintable characters."""
        super().__init__(shorten(printable(message)))

    exit_code = 2


class BadConfiguration(InputError):
    """A wrong option, key, name or folder (exit code 2)."""

    exit_code = 2


class BadData(InputError):
    """A wrong table of runs (exit code 4)."""

    exit_code = 4


def parse_number(text: str) -> float:
    """Number that a text states in digits, without the underscores that Python allows.

    Raises:
        ValueError: the text is no number.
    """
    if "_" in text or not text.isascii():
        raise ValueError(f"could not convert {text!r} to a number")
    return float(text)


def rows_text(rows: Sequence[int], most: int, rest: str = ", ...") -> str:
    """Row numbers as text, such as `row 4` or `rows 4, 5`, from indices that begin at 0.

    `rest` replaces the rows after the first `most`. `{}` in it is replaced by their number.
    """
    row_numbers = ", ".join(str(k + 1) for k in rows[:most]) + rest.format(len(rows) - most) * (len(rows) > most)
    return f"row{'s' * (len(rows) > 1)} {row_numbers}"


def three_digits(value: float) -> str:
    """A value as text, to three significant digits."""
    return f"{value:.0f}" if abs(value) >= 100 else f"{value:.3g}"


def is_number(value: Any) -> bool:
    """True if a value from TOML or Python is a number. True and False are not numbers."""
    return isinstance(value, int | float) and not isinstance(value, bool)


def stated_count(value: Any, where: str, low: int, high: int) -> int:
    """Returns a whole number from TOML or Python after checking it.

    Raises:
        BadConfiguration: it is no whole number, or out of bounds.
    """
    if isinstance(value, bool) or not isinstance(value, numbers.Integral) or not low <= int(value) <= high:
        raise BadConfiguration(f"{where}: got {value!r}; expected a whole number from {low} to {high}")
    return int(value)


def stated_as(value: Any, kind: type[T], where: str, expected: str) -> T:
    """Returns a value of a file after checking its type.

    Raises:
        BadConfiguration: it is of another type.
    """
    if not isinstance(value, kind):
        raise BadConfiguration(f"{where}: got {value!r}; expected {expected}")
    return value


def stated_names(value: Any, where: str, expected: str, least: int = 1) -> Names:
    """Returns a list of texts of a file after checking it.

    Args:
        least: fewest texts.

    Raises:
        BadConfiguration: it is no list, or has fewer texts, an empty one, or another value.
    """
    is_list = isinstance(value, list | tuple) and len(value) >= least
    if not is_list or not all(isinstance(text, str) and text for text in value):
        raise BadConfiguration(f"{where}: got {value!r}; expected {expected}")
    return tuple(value)


def stated_word(value: Any, known: Iterable[str], where: str, wrong: str = "", most: int = 1) -> str:
    """Returns a word of a file or an argument after checking that it is known.

    Args:
        wrong: beginning of the message about an unknown word. Empty: the message quotes the word.
        most: largest number of suggestions.

    Raises:
        BadConfiguration: an unknown word. The message lists the nearest ones.
    """
    if not isinstance(value, str) or value not in known:
        raise BadConfiguration(f"{where}: {wrong or f'got {value}'}; {allowed_words(str(value), known, most)}")
    return value


def stated_number(
    value: Any, where: str, low: float = -math.inf, high: float = math.inf, unit: str | None = None
) -> float:
    """Returns a number of a TOML file after checking it.

    Args:
        low, high: bounds.
        unit: unit of the number, empty or `-` if it has none. None: not known, so the message omits it.

    Raises:
        BadConfiguration: it is no number, not finite, or out of bounds.
    """
    if not is_number(value) or (math.isinf(high - low) and not math.isfinite(value)):
        kind = "a number" if unit is None else f"a number [{unit or '-'}]"
        raise BadConfiguration(f"{where}: got {value!r}; expected {kind}")
    if not math.isfinite(value) or not low <= value <= high:
        allowed = f"{low:g} to {high:g} {unit or ''}".rstrip()
        raise BadConfiguration(f"{where}: got {value}; expected {allowed}")
    return float(value)
