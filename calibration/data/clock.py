"""Clocks of loggers, counted from the first row of each recording."""

from __future__ import annotations

import datetime
import math
import re
from collections.abc import Sequence

from calibration.data import delimited
from calibration.data.columns import Meaning
from calibration.data.input_errors import number

#: What follows a day where a cell holds a time alone, and how long a day lasts [s].
_SOME_DAY, _DAY = "1970-01-01T", 86400.0
#: A date as 25.11.2026.
_WITH_POINTS = re.compile(r"(\d\d)\.(\d\d)\.(\d{4})(?=[ T])")


def from_the_first(name: str, meaning: Meaning, cells: Sequence[str], runs: Sequence[str]) -> tuple[list[str], str]:
    """Returns cells of a column of time as the time since the first of their run, and a note where that changes them.

    A run begins at its first row, whatever its clock shows there: the time since a controller started, or a time of
    day. Times of day follow ISO 8601, or have a date as 25.11.2026, or are numbers beyond the largest time (seconds
    since 1970). Times without a date that fall back by more than half a day have passed midnight. A column with a
    cell that is no time is returned as it is, and the reader refuses that cell.

    Args:
        name: of the file; meaning: of the column; runs: `run_id` of each cell.
    """
    clock, factor = [_seconds(cell) for cell in cells], meaning.value(1.0)
    of_day = all(map(math.isfinite, clock))
    if not of_day:
        low, high = (limit * factor for limit in meaning.limits())
        clock = [delimited.number(cell) * factor for cell in cells]
        of_day = all(x > high for x in clock)
        if not of_day and not all(low <= x <= high for x in clock):
            return list(cells), ""
    first: dict[str, float] = {}
    last: dict[str, float] = {}
    for k, (x, run) in enumerate(zip(clock, runs, strict=True)):
        if _alone(cells[k]) and run in last:
            clock[k] = x = x + _DAY * max(math.floor((last[run] - x) / _DAY + 0.5), 0)
        last[run], first[run] = x, min(x, first.get(run, x))
    if not any(first.values()):
        return list(cells), ""
    passed = [repr(round(x - first[r], 9) / factor) for x, r in zip(clock, runs, strict=True)]
    if of_day:
        return passed, f"{name}: {meaning.shown} is a time of day; counted from the first of each run"
    run, begins = next((r, x) for r, x in first.items() if x)
    where = f"{number(begins / factor)}{f' in run {run}' if run else ''}"
    return passed, (
        f"{name}: {meaning.shown} begins at {where}; a run begins at its first row, and its time counts from there; "
        "if it began earlier, add a row at that time without readings"
    )


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
