"""Blocks that reports of simulated runs share: statuses, limits, and quantities with names from the registries."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterable, Mapping, Sequence
from types import MappingProxyType
from typing import Any

import numpy as np

from calibration.data import Columns, Json
from calibration.data.columns import IMPOSED
from calibration.data.robot_file import RobotFile
from mmrjax import effects
from mmrjax.model import channels
from mmrjax.model.channels import Channel
from mmrjax.model.quantities import SET, TABLE, Condition
from mmrjax.model.robot import Robot
from sweeps import capabilities
from sweeps.capabilities import UNLIMITED
from sweeps.pages import words
from sweeps.points import run
from sweeps.report import catalogue
from sweeps.report.document import Cell, Column, Note, Table, columns, table_from_cells

#: Columns of quantities that may be imposed on a run.
_IMPOSED = {column for column, _ in IMPOSED.values()}


def imposed_column(runs: Iterable[str]) -> str:
    """Column of the imposed quantity of runs: conditions precede readings."""
    return next(column for column in runs if column in _IMPOSED)


def _column(condition: Condition) -> str:
    """Column of a condition. For an imposed speed or current, that of its channel."""
    return next((c.column for c in channels.EVERY if c.name == condition.name), condition.column)


#: Each condition in a table of runs, by column.
_CONDITIONS = {_column(c): columns(f"{c.heading} | {c.shown}")[0] for c in SET if c.heading}


def condition_columns(table: Columns, *, mass: bool = False) -> dict[str, Column]:
    """Columns of the conditions of a table, by name, without those that are readings.

    Args:
        mass: True to include the total mass.
    """
    return {
        name: column
        for name, column in _CONDITIONS.items()
        if name in table and not {f"simulated_{name}", f"after_{name}"} & table.keys()
        and (mass or name != "total_mass_kg")
    }  # fmt: skip


#: Quantities by column. If several have the same column, that of runs.
_REGISTERED = {
    q.column: q
    for place in ("derived", "mission of sides", "mission", "run", "channel of a turn", "channel")
    for q in TABLE[place]
}
#: Columns of runs without a row in a registry.
_OTHERS = {
    "configuration": Column("configuration"),
    "status": Column("status"),
    "flags": Column("limits exceeded"),
    "time_end_s": Column("time at the end", "s", "{:.6g}"),
    "permissible_time_s": Column("permissible time at this current", "s", "{:.3g}"),
}
#: Text for infinite or missing numbers in some columns.
_ENDLESS = {"permissible_time_s": words.FOR_EVER}
_MISSING = {"supply_voltage_V": "battery", "flags": "none"}


def quantity_column(name: str, group: str = "") -> Column:
    """Column of a quantity in a report, from the name of its column in a table of runs."""
    if name in _REGISTERED:
        q = _REGISTERED[name]
        return Column(q.label, q.unit_shown.replace("-", ""), f"{{:.{q.resolution}f}}", group)
    return dataclasses.replace(_CONDITIONS.get(name) or _OTHERS[name], group=group)


def axis_title(column: str) -> str:
    """Label of an axis over a condition or reading, with its unit."""
    return "supply voltage [V]" if column == "supply_voltage_V" else quantity_column(column).title


def quantity_cells(table: Columns, name: str) -> list[Any]:
    """Cells of a column, each with its standard deviation if the table has one. Infinite numbers are in words."""
    values = table[name]
    sds = table.get(name + run.SD)
    if sds is not None:
        digits = _REGISTERED[name].resolution
        return [
            None if math.isnan(value) else run.with_sd(value, sd, digits)
            for value, sd in zip(values, sds, strict=True)
        ]
    if name == "status":
        return [Cell(sd, "" if sd in words.SETTLED else "slides") for sd in map(str, values)]
    if values.dtype.kind != "f":
        return [_MISSING.get(name, "") if value == "" else value for value in values]
    infinite_text = _ENDLESS.get(name, words.NONE_SETTLES)
    missing_text = _MISSING.get(name)
    return [missing_text if math.isnan(value) else infinite_text if math.isinf(value) else value for value in values]


def quantity_table(
    name: str, table: Columns, names: Iterable[str], first: Sequence[tuple[Column, Sequence[Any]]] = (), **fields: Any
) -> Table:
    """Table with one row for each run, of those quantities `names` that the table of runs has.

    Args:
        name: name of the table.
        first: first columns with their cells.
        fields: further fields of the table.
    """
    empty = {n for n, x in table.items() if x.dtype.kind == "f" and np.isnan(x).all()} - {"supply_voltage_V"}
    present_names = [n for n in dict.fromkeys(names) if n in table and n not in empty]
    cells = [(quantity_column(n), quantity_cells(table, n)) for n in present_names]
    return table_from_cells(name, [*first, *cells], **fields)


def reading_form(channel: Channel) -> str:
    """Format of readings, with one digit less than their channel's resolution."""
    return f"{{:.{max(channel.resolution - 1, 0)}f}}"


def reading_text(value: Any, channel: Channel) -> str:
    """Reading as text. A dash if it is missing."""
    return Column("", form=reading_form(channel)).text(value)


def note_on_robot(file: RobotFile, model: str = "", more: str = "") -> Note:
    """Line below the answer: robot, fidelity and a further sentence."""
    parts = [f"Robot: **{capabilities.displayed_name(file)}**.", f"Fidelity: **{model}**." * bool(model), more]
    return Note(" ".join(filter(None, parts)), "lead")


def curve_warning(robot: Robot) -> tuple[Note, ...]:
    """Warning if the robot has curves for unexplained discrepancies."""
    names = " and ".join(f"`{e.name}`" for e in robot.effects if e.name in effects.UNNAMED)
    return (catalogue.note("run.curves", names),) if names else ()


def endings_table(
    counts: Mapping[str, int],
    noun: str = "runs",
    model: str = "",
    meanings: Mapping[str, str] = MappingProxyType({}),
    **more: Json,
) -> Table:
    """Table of the statuses of runs or points that occurred, in words, with their number.

    Args:
        counts: number by status.
        meanings: meanings of statuses that do not come from a fidelity.
        more: further columns, with values by status.
    """
    order = [*words.STATUSES, *counts]
    total = sum(counts.values())
    statuses = sorted((status for status, n in counts.items() if n), key=order.index)
    further_titles = (f"~{name.replace('_', ' ')}" for name in more)
    heads = columns("ended", f"{noun} | ,", "share [%] | .3g", "~status", "meaning", *further_titles)
    meaning_of_status = {
        status: meanings.get(status) or words.VERDICTS.get((model, status)) or words.status_meaning(status)
        for status in statuses
    }
    rows = [
        (
            Cell(words.short_status(status), "good" if status in words.SETTLED else "bad"), counts[status],
            100 * counts[status] / total, f"`{status}`", meaning_of_status[status],
            *(values.get(status) for values in more.values()),
        )
        for status in statuses
    ]  # fmt: skip
    return Table("statuses", heads, rows)


def limits_table(limits: Sequence[Json], subject: str) -> Table:
    """Table of the use of each limit: value, limit, and share that is used."""
    rows = []
    for limit in limits:
        share = limit["percent"]
        used = f"not checked: the robot's file has no `{limit['unstated']}`" if share is None else Cell(
            share, "over" if share > 100 else "bar"
        )  # fmt: skip
        rows.append((limit["words"], limit["value"], limit["limit"], used))
    return catalogue.table("run.limits", rows, f"{subject} |")


def use_of_limits(limits: Iterable[tuple[str, Any, Any, str]], ambient: float) -> list[Json]:
    """Use of each known limit: name, value, limit, and share of the limit [%]. For windings it is the share of the
    permissible temperature rise.

    Args:
        limits: name, value, limit, and format with unit. NaN: unknown.
        ambient: temperature [°C].
    """
    return [
        {
            "words": name, "value": words.NONE_SETTLES if math.isinf(value) else form.format(float(value)),
            "limit": form.format(float(limit)),
            "percent": warming_share(value, limit, ambient) if "°C" in form else 100 * abs(value) / float(limit),
        }
        for name, value, limit, form in limits
        if not (math.isnan(value) or math.isnan(limit) or limit >= UNLIMITED)
    ]  # fmt: skip


def warming_share(value: float, limit: float, ambient: float) -> float:
    """Share of a winding's permissible temperature rise [%]."""
    return 100 * (value - ambient) / max(limit - ambient, 1.0)
