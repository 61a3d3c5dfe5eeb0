"""Checks of tables of turns: exchanged sides, a yaw rate with the wrong sign, currents without signs."""

from __future__ import annotations

import numpy as np

from calibration.data import Columns, Names
from calibration.data.columns import DUTY, SIDES, SUPPLY, VOLTS, Layout
from calibration.data.input_errors import BadData
from calibration.data.table import Runs, drive_of_sides
from mmrjax.model import channels
from mmrjax.model.quantities import TURN
from mmrjax.model.rig import Instrument

#: A row counts if the drives of its sides differ by at least this share of the largest drive, or a side is driven
#: backward by as much [-].
CLEAR = 0.25
#: Fewest rows that count, and the share of them that must contradict the drive [-].
FEWEST, MOSTLY = 3, 0.75
#: Largest relative excess of a side's voltage over the supply voltage, because both are rounded [-].
ROUNDED = 0.01


def supply_and_shares(volts: np.ndarray, supply: np.ndarray | None) -> tuple[np.ndarray, np.ndarray]:
    """Supply voltage [V], by default the larger of the sides' voltages, and the duty of each side.

    Args:
        volts: voltages of left and right side [V], shape (2, rows).
        supply: shape (rows,).
    """
    source = np.max(np.abs(volts), 0) if supply is None else supply
    return source, np.divide(volts, source, out=np.zeros_like(volts), where=source != 0)


def duties_from_side_voltages(name: str, columns: Columns, battery: bool) -> Names:
    """Replaces the sides' voltages in a table by duties, their shares of the supply voltage.

    Returns:
        A note on the replacement. None if the table has no such column.

    Raises:
        BadData: a battery feeds the motors, one side's voltage is missing, the table also states shares, or a voltage
            is higher than the supply's.
    """
    voltage_columns = [c for c in VOLTS if c in columns]
    if not voltage_columns:
        return ()
    if battery:
        raise BadData(
            f"{name}: column {voltage_columns[0]} together with --battery, whose voltage falls; give "
            f"{' and '.join(SIDES)} instead"
        )
    if twin := next((c for c in (*SIDES, *DUTY) if c in columns), None):
        raise BadData(
            f"{name}: column {twin} in addition to {voltage_columns[0]}, which already gives the command of both "
            "sides; keep one"
        )
    if len(voltage_columns) == 1:
        (other,) = {*VOLTS} - {*voltage_columns}
        raise BadData(
            f"{name}: column {other} is missing although {voltage_columns[0]} is present; give the command of both "
            "sides"
        )
    volts = np.stack([columns.pop(c) for c in VOLTS])
    supply, parts = supply_and_shares(volts, columns.get(SUPPLY))
    exceeds_supply = np.abs(volts) > np.abs(supply) * (1 + ROUNDED)
    if exceeds_supply.any():
        side, row = (int(k[0]) for k in np.nonzero(exceeds_supply))
        raise BadData(
            f"{name} row {row + 1}, {[*VOLTS][side]}: got {volts[side, row]:g} V at a supply of {supply[row]:g} V; "
            f"expected no more than {SUPPLY}, or remove that column: the larger of the two side voltages is then "
            "the supply voltage"
        )
    origin = SUPPLY if SUPPLY in columns else f"{SUPPLY}, the larger of both"
    columns |= {SUPPLY: supply, **dict(zip(SIDES, np.clip(parts, -1.0, 1.0), strict=True))}
    return (f"{name}: {' and '.join(VOLTS)} are read as {' and '.join(SIDES)}, shares of {origin}",)


def check_turns(runs: Runs) -> None:
    """Rejects a table of turns with exchanged sides or a yaw rate with the wrong sign.

    Raises:
        BadData: readings of a side follow the drive of the other side, or the yaw rate contradicts both.
    """
    left, right = runs.of_sides
    for quantity in ("motor_speed", "motor_current"):
        pair = [channels.find_channel(f"{quantity}_{side}") for side in channels.SIDES]
        if not all(c in runs.channels and runs.has(c.column) for c in pair):
            continue
        left_value, right_value = (runs[c.column] for c in pair)
        drive = right - left
        if any(runs.layout.magnitude(c.name) for c in pair):
            left_value, right_value, drive = np.abs(left_value), np.abs(right_value), np.abs(right) - np.abs(left)
        columns = f"{pair[0].column} and {pair[1].column}"
        _refuse_against(
            runs, columns, (left_value, right_value), right_value - left_value, drive,
            "the larger value on the faster side; left and right columns of one quantity are exchanged",
        )  # fmt: skip
    for yaw in (c.column for c in channels.EVERY if c.sign == TURN and runs.has(c.column)):
        _refuse_against(
            runs, yaw, (runs[yaw],), runs[yaw], right - left,
            f"a positive value if the right side is faster: reverse its sign with [columns] {yaw} = {{column, "
            "factor = -1}, or exchange the columns of the sides",
        )  # fmt: skip


def _refuse_against(
    runs: Runs, column: str, shown: tuple[np.ndarray, ...], readings: np.ndarray, drive: np.ndarray, expected: str
) -> None:
    """Rejects readings whose sign is mostly opposite to that of their drive. The message names the clearest row.

    Args:
        shown: values of the columns in every row.
    """
    counts = np.isfinite(readings) & (np.abs(drive) > CLEAR * np.max(np.abs(drive), initial=0.0))
    against = counts & (readings * drive < 0)
    if counts.sum() < FEWEST or against.sum() <= MOSTLY * counts.sum():
        return
    row = int(np.argmax(np.where(against, np.abs(drive), -1.0)))
    both_values, at = (" and ".join(f"{float(f'{x[row]:.4g}'):g}" for x in sides) for sides in (shown, runs.of_sides))
    unit = runs.layout.imposed_column.rpartition("_")[2]
    raise BadData(
        f"{runs.source} row {row + 1}, {column}: got {both_values} although the left and right sides are driven at "
        f"{at} {unit} (as in {against.sum()} of {counts.sum()} rows); expected {expected}"
    )


def unsigned_current_channels(columns: Columns, layout: Layout) -> tuple[Instrument, ...]:
    """Instruments of the sides' currents that show no sign: their readings are positive whenever their side is driven
    backward.

    Args:
        columns: columns of the table.
    """
    if not layout.sides or not set(layout.sides) <= set(columns):
        return ()
    unsigned = []
    for side, drive in zip(channels.SIDES, drive_of_sides(columns, layout), strict=True):
        channel = channels.find_channel(f"motor_current_{side}")
        if channel.column in columns:
            readings = columns[channel.column]
            is_backward = np.isfinite(readings) & (drive < -CLEAR * np.max(np.abs(drive)))
            if is_backward.sum() >= FEWEST - 1 and (readings[is_backward] > 0).all() and not (readings < 0).any():
                unsigned.append(Instrument(channel.name, signed=False))
    return tuple(unsigned)
