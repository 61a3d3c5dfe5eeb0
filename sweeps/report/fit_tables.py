"""Blocks that the reports of fits share: shifts, noise, errors in units, residual clusters, and the rows."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Mapping, Sequence
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np

from calibration.data import Columns
from calibration.data.clock import applied_drive
from calibration.data.runs import Runs
from calibration.inference.residual_clusters import ResidualCluster
from calibration.inference.simulation_errors import r_squared
from mmrjax.model.channels import Channel
from sweeps.report import catalogue
from sweeps.report.document import Cell, Column, Figure, Section, Table, remarks
from sweeps.report.run_tables import condition_columns, reading_form

#: Fewest rows of a log for a frequency response.
FEWEST_ROWS = 64
#: Names of the fits in tables of rms errors.
FITS = {
    "before": "before", "after": "after", "held_out": "held out", "held_out_before": "before, held out",
    "held_out_after": "after, held out",
}  # fmt: skip


class Change(NamedTuple):
    """Change of the readings by an effect of the written robot.

    Attributes:
        channel: channel with the largest change.
        rms: rms error of the change [% of the channel's measured rms].
        without, with_it: readings simulated without and with the effect [SI], shape (rows,).
    """

    channel: Channel
    rms: float
    without: np.ndarray
    with_it: np.ndarray


def shift_cell(shift: float) -> Cell:
    """Shift in prior standard deviations, marked beyond two and three."""
    return Cell(shift, "bad" if abs(shift) > 3 else "fair" if abs(shift) > 2 else "")


def error_cell(percent: float) -> Cell:
    """Error in percent, marked by its size relative to the paper's 7 %."""
    size = abs(percent)
    return Cell(percent, "" if not np.isfinite(size) else "good" if size <= 5 else "fair" if size <= 10 else "bad")


def noise_sentence(noise: Mapping[str, tuple[float | None, str]], channels: Iterable[Channel]) -> str:
    """Standard deviation of each channel with its source, as the median share of the reading [%]."""
    noise_of_channels = ((c.label, *noise[c.name]) for c in channels if c.name in noise)
    parts = (
        f"{label} {'' if share is None else f'{share:.2f} % '}({source})"
        for label, share, source in noise_of_channels
    )
    return f"Noise (sd): {'; '.join(parts)}."


def rms_table(rms: Mapping[str, Mapping[str, float]], channels: Sequence[Channel]) -> Table:
    """rms errors in the units of their channels, by fit."""
    rows = [(FITS[fit], *(rms_by_channel.get(c.name) for c in channels)) for fit, rms_by_channel in rms.items()]
    return catalogue.table("fit.rms", rows, *(f"{c.label} [{c.unit}] | .4g" for c in channels))


def fits_of_runs(table: Columns, channels: Sequence[Channel], lines: Mapping[str, str]) -> Table:
    """Fit of each run, 100 (1 - |y - ŷ| / |y - mean y|) [%]: 100 is exact, 0 is as good as the mean.

    Args:
        lines: prefixes of simulated columns and their names.
    """
    runs = np.asarray(table.get("run_id", np.full(len(table["time_s"]), "log")))
    fits = [
        (
            str(name), line_name,
            *(
                100 - 100 * np.sqrt(1 - r_squared(table[c.column][rows], table[prefix + c.column][rows]))
                for c in channels
            ),
        )
        for name in dict.fromkeys(runs.tolist())
        for rows in (runs == name,)
        for prefix, line_name in lines.items()
    ]  # fmt: skip
    return catalogue.table("fit.runs", fits, *(f"{c.label} | .1f" for c in channels))


def frequency_response(runs: Runs, channels: Sequence[Channel], lines: Mapping[str, str]) -> list[Figure]:
    """Figure of the response of each channel to the drive. None for a short log or a constant drive.

    Args:
        runs: runs with measured and simulated columns.
        lines: prefixes of simulated columns and their names.
    """
    has_response = len(runs) >= FEWEST_ROWS and np.ptp(applied_drive(runs)) > 0
    return [catalogue.figure("fit.frequency", runs, channels, lines)] * bool(has_response)


def clusters_section(clusters: Sequence[ResidualCluster]) -> tuple[Section, ...]:
    """Section on columns that the model does not use that correlate with residuals, if there are any."""
    if not clusters:
        return ()
    statements = (f"{c.statement}." for c in clusters)
    return (Section("Columns that the residuals depend on", remarks(statements, "clusters")),)


def rows_section(
    table: Columns,
    channels: Sequence[Channel],
    kinds: Mapping[str, str],
    in_units: bool,
    *,
    mass: bool = False,
    first: Mapping[str, Any] = MappingProxyType({}),
    last: Mapping[str, Any] = MappingProxyType({}),
    **fields: Any,
) -> Section:
    """Section with all rows: conditions, readings, and the error of the last kind of readings.

    Args:
        kinds: description of each kind of readings, by the prefix of its columns.
        in_units: True if errors are in the channel's unit instead of percent.
        mass: True to include the total mass.
        first, last: further cells, by the heading of their column.
        fields: further fields of the table.
    """
    cells = [
        (Column(heading), values) for heading, values in ({**first, "configuration": table["configuration"]}).items()
    ]
    cells += [(column, table[name]) for name, column in condition_columns(table, mass=mass).items()]
    *_, simulated = kinds
    for c in channels:
        reading = Column("", c.unit, reading_form(c), c.label, terminal=False)
        cells += [
            (dataclasses.replace(reading, heading=heading), table[prefix + c.column])
            for prefix, heading in kinds.items()
        ]
        if in_units:
            errors = table[simulated + c.column] - table[c.column]
            cells.append((Column("error", c.unit, f"{{:+.{c.resolution}f}}", c.label), errors))
        elif f"error_{c.name}_percent" in table:
            error_cells = [error_cell(float(e)) for e in table[f"error_{c.name}_percent"]]
            cells.append((Column("error", "%", "{:+.1f}", c.label), error_cells))
    cells += [(Column(heading), values) for heading, values in last.items()]
    heads, values = zip(*cells, strict=True)
    return Section("Rows", (catalogue.table("fit.rowtable", list(zip(*values, strict=True)), *heads, **fields),))
