"""What a table of turns cannot be true of: sides exchanged, a yaw rate of the other sign, currents without theirs."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from calibration.data.errors import BadData, number
from calibration.data.table import Runs
from mmrjax import channels
from mmrjax.rig import Instrument

#: Of rows that tell: what drives the sides apart, or one backward, as a share of the most that does so [-].
CLEAR = 0.25
#: Fewest rows that tell, and the share of them that has to be against what is possible [-].
FEWEST, MOSTLY = 3, 0.75


def check(runs: Runs) -> None:
    """Refuse a table of turns whose sides or yaw rates are not what they are called.

    Raises:
        BadData: readings of a side that go with what drives the other one, or a yaw rate against both.
    """
    left, right = runs.of_sides
    for what in ("motor_speed", "motor_current"):
        pair = [channels.find(f"{what}_{side}") for side in channels.SIDES]
        if not all(c in runs.channels and runs.has(c.column) for c in pair):
            continue
        one, other = (runs[c.column] for c in pair)
        drive = right - left
        if any(runs.layout.magnitude(c.name) for c in pair):
            one, other, drive = np.abs(one), np.abs(other), np.abs(right) - np.abs(left)
        columns = f"{pair[0].column} and {pair[1].column}"
        _refuse_against(
            runs, columns, (one, other), other - one, drive,
            "the larger one on the side that is driven faster: the sides of one pair of columns are exchanged",
        )  # fmt: skip
    yaw = channels.find("yaw_rate").column
    if runs.has(yaw):
        _refuse_against(
            runs, yaw, (runs[yaw],), runs[yaw], right - left,
            "a positive one where the right side is the faster: turn its sign, in the robot's file by [columns] "
            f"{yaw} = {{column, factor = -1}}, or exchange the columns of the sides",
        )  # fmt: skip


def _refuse_against(
    runs: Runs, column: str, shown: tuple[np.ndarray, ...], readings: np.ndarray, drive: np.ndarray, expected: str
) -> None:
    """Refuse readings most of which are against what drives them; said of the clearest row.

    Args:
        shown: what the columns hold in every row.
    """
    told = np.isfinite(readings) & (np.abs(drive) > CLEAR * np.max(np.abs(drive), initial=0.0))
    against = told & (readings * drive < 0)
    if told.sum() < FEWEST or against.sum() <= MOSTLY * told.sum():
        return
    row = int(np.argmax(np.where(against, np.abs(drive), -1.0)))
    got, driven = (" and ".join(number(float(f"{x[row]:.4g}")) for x in sides) for sides in (shown, runs.of_sides))
    raise BadData(
        f"{runs.source} row {row + 1}, {column}: got {got} where {' and '.join(runs.layout.sides)} are {driven}, and "
        f"so in {against.sum()} of {told.sum()} rows; expected {expected}"
    )


def magnitudes(columns: Mapping[str, np.ndarray], sides: tuple[str, ...]) -> tuple[Instrument, ...]:
    """Instruments of the sides' currents that show no sign: positive in every row in which their side is driven
    backward.

    Args:
        columns: of the table; sides: those that say what drives either side.
    """
    found = []
    for side, driven in zip(channels.SIDES, sides, strict=False):
        channel = channels.find(f"motor_current_{side}")
        if channel.column in columns and driven in columns:
            drive, shown = columns[driven], columns[channel.column]
            back = np.isfinite(shown) & (drive < -CLEAR * np.max(np.abs(drive)))
            if back.sum() >= FEWEST - 1 and (shown[back] > 0).all() and not (shown < 0).any():
                found.append(Instrument(channel.name, signed=False))
    return tuple(found)
