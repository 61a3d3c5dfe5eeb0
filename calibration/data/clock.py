"""Times of day and dates as loggers write them, counted from the first of each recording."""

from __future__ import annotations

import datetime
import math
import re
from collections.abc import Sequence

from calibration.data import delimited
from calibration.data.columns import Meaning

#: What follows a day where a cell holds a time alone, and how long a day lasts [s].
_SOME_DAY, _DAY = "1970-01-01T", 86400.0
#: A date as 25.11.2026.
_WITH_POINTS = re.compile(r"(\d\d)\.(\d\d)\.(\d{4})(?=[ T])")


def from_the_first(name: str, meaning: Meaning, cells: Sequence[str], runs: Sequence[str]) -> tuple[list[str], str]:
    """Cells of a column of time as what has passed since the earliest of their run, and a sentence on that; as they
    are, and an empty one, where they are no times of day: neither dates and times as ISO 8601 writes them or with
    a date as 25.11.2026, nor numbers that are all beyond what a time may be (seconds since 1970). Times alone that
    fall back by more than half a day have passed midnight.

    Args:
        name: of the file; meaning: of the column; runs: `run_id` of each cell.
    """
    clock = [_seconds(cell) for cell in cells]
    factor = meaning.value(1.0)
    if not all(map(math.isfinite, clock)):
        high = meaning.limits()[1]
        clock = [delimited.number(cell) * factor for cell in cells]
        if not all(x > high * factor for x in clock):
            return list(cells), ""
    first: dict[str, float] = {}
    last: dict[str, float] = {}
    for k, (x, run) in enumerate(zip(clock, runs, strict=True)):
        if _alone(cells[k]) and run in last:
            clock[k] = x = x + _DAY * max(math.floor((last[run] - x) / _DAY + 0.5), 0)
        last[run], first[run] = x, min(x, first.get(run, x))
    passed = [repr(round(x - first[r], 9) / factor) for x, r in zip(clock, runs, strict=True)]
    return passed, f"{name}: {meaning.shown} is a time of day; counted from the first of each run"


def _alone(cell: str) -> bool:
    """Whether a cell has a time without a date."""
    return cell[2:3] == ":"


def _seconds(cell: str) -> float:
    """Since some day of a date and time, NaN of what is none."""
    if ":" not in cell:
        return math.nan
    dated = _WITH_POINTS.sub(r"\3-\2-\1", cell)
    try:
        when = datetime.datetime.fromisoformat(_SOME_DAY + cell if _alone(cell) else dated)
    except ValueError:
        return math.nan
    return when.replace(tzinfo=when.tzinfo or datetime.UTC).timestamp()
