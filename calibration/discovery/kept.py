"""Storage of the loop's finished stages, so that an interrupted loop can resume, and its time budget."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

#: Function that returns the stored result of a stage, or else computes and stores it.
StoreStage = Callable[[str, Callable[[], Any]], Any]
#: File of the robot as fitted, without effects that were found; it is written as soon as it is known.
REFIT_FILE = "fitted.toml"


def compute_without_storing(name: str, make: Callable[[], Any]) -> Any:
    """Computes the result of a stage without storing it."""
    return make()


class OutOfTime(KeyboardInterrupt):
    """Raised if the time budget is spent before a verdict. The loop then ends as if interrupted."""
