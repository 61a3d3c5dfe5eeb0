"""Stages of the loop that are kept as they end, so that an interrupted one goes on; and its budget of time."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol, TypeVar

T = TypeVar("T")
#: Name of threads that look at other noises: work that nobody has to wait for.
BESIDE = "loop-beside"


class Keep(Protocol):
    """What gives the result of a stage by its name: as it was kept, or made now and kept."""

    def __call__(self, name: str, make: Callable[[], T]) -> T: ...


def nothing(name: str, make: Callable[[], T]) -> T:
    """Keeps nothing."""
    return make()


class OutOfTime(KeyboardInterrupt):
    """The loop's budget of time is spent before there is a verdict: it ends as if interrupted, by itself."""
