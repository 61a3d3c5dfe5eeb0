"""Storage of the loop's finished stages, so that an interrupted loop can resume, and its time budget."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol, TypeVar

T = TypeVar("T")
#: File of the robot as fitted, without effects that were found; it is written as soon as it is known.
REFIT_FILE = "fitted.toml"


class Keep(Protocol):
    """Function that returns the stored result of a stage by name, or else computes and stores it."""

    def __call__(self, name: str, make: Callable[[], T]) -> T: ...


def keep_nothing(name: str, make: Callable[[], T]) -> T:
    """Computes the result of a stage without storing it."""
    return make()


class OutOfTime(KeyboardInterrupt):
    """The loop's time budget is spent before a verdict. It ends as if interrupted."""
