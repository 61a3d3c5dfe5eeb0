"""Columns of conditions in the tables of reports."""

from __future__ import annotations

from collections.abc import Iterable

from calibration.data import Columns
from mmrjax.model import channels
from mmrjax.model.quantities import SET, Condition

#: Units of what may be imposed on a run, by column.
UNITS = {"supply_voltage_V": "V", "motor_speed_rpm": "rpm", "motor_current_A": "A"}


def imposed_column(runs: Iterable[str]) -> str:
    """Column of what is imposed in runs: conditions come before readings."""
    return next(column for column in runs if column in UNITS)


def _column(condition: Condition) -> str:
    """Column of a condition; that of its channel for an imposed speed or current."""
    return next((c.column for c in channels.EVERY if c.name == condition.name), condition.column)


#: Heading of each condition and format of its numbers, by column.
CONDITIONS = {_column(c): (c.heading, c.shown) for c in SET if c.heading}


def condition_formats(table: Columns, *, mass: bool = False) -> dict[str, tuple[str, str]]:
    """Heading and format of each condition of a table, by column, without columns that are readings.

    Args:
        mass: True to include the total mass.
    """
    readings = {c for c in table if f"simulated_{c}" in table or f"after_{c}" in table}
    shown = {c: about for c, about in CONDITIONS.items() if c in table and c not in readings}
    return {c: about for c, about in shown.items() if mass or c != "total_mass_kg"}
