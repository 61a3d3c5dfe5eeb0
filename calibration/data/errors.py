"""Errors of what comes in from outside, files and arguments; each carries its exit code."""

from __future__ import annotations

from mmrjax.errors import choices as choices


class InputError(Exception):
    """Something from outside is not as it should be; the message is one sentence for a person."""

    exit_code = 2


class BadConfiguration(InputError):
    """A wrong option, key, name or folder (exit code 2)."""

    exit_code = 2


class BadData(InputError):
    """A wrong table of runs (exit code 4)."""

    exit_code = 4


def number(value: float) -> str:
    """A bound as a person writes it."""
    return f"{value:g}"
