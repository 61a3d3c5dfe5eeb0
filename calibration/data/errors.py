"""Errors of what comes in from outside, files and arguments; each carries its exit code."""

from __future__ import annotations

import difflib
from collections.abc import Iterable


class InputError(Exception):
    """Something from outside is not as it should be; the message is one sentence for a person."""

    exit_code = 2


class BadConfiguration(InputError):
    """A wrong option, key, name or folder (exit code 2)."""

    exit_code = 2


class BadData(InputError):
    """A wrong table of runs (exit code 4)."""

    exit_code = 4


def choices(word: str, allowed: Iterable[str]) -> str:
    """«did you mean X? allowed: ...» for an unknown `word`."""
    allowed = list(allowed)
    close = difflib.get_close_matches(word, allowed, n=1, cutoff=0.6)
    hint = f"did you mean {close[0]}? " if close else ""
    return f"{hint}allowed: {', '.join(allowed)}"


def number(value: float) -> str:
    """A bound as a person writes it."""
    return f"{value:g}"
