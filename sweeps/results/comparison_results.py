"""Result of the command `compare`: measured and simulated readings with errors and R² (A1)."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence

import numpy as np

from calibration.data import Columns, Json, Names
from calibration.data.runs import Runs
from calibration.inference import simulation_errors as residual
from mmrjax.model.channels import Channel
from mmrjax.model.robot import Robot

#: Group → channel → rows, rms_percent, max_percent, rms, unit (of the rms), r2, missing.
Summary = dict[str, dict[str, Json]]


@dataclasses.dataclass(frozen=True)
class Comparison:
    """Simulated and measured readings of a table.

    Attributes:
        table: conditions, `<column>` measured, `simulated_<column>`, `error_<channel>_percent`, `status`.
        summary: errors of all rows and of each configuration.
        channels: of the readings; source: name of the table; model: fidelity; robot_name: of the simulated robot.
        fit: `these` if the robot was fitted to these rows, `others` if to other rows, "" if no fit is recorded.
        over: further columns of histories for the axes of the errors, with their headings.
        notes: sentences on the table.
        against: name of a second robot, "" for none; its readings are the columns `against_<column>` of the table.
    """

    table: Columns
    summary: Summary
    channels: tuple[Channel, ...]
    source: str
    model: str
    robot_name: str
    fit: str = ""
    over: Mapping[str, str] | None = None
    notes: Names = ()
    against: str = ""

    @property
    def rms_of_both(self) -> dict[str, tuple[int, float, float]]:
        """For each channel the rows with a number of both robots, and their rms errors [% of the measured rms]."""
        answer = {}
        for channel in self.channels:
            both = np.stack([self.table[prefix + channel.column] for prefix in ("simulated_", "against_")], 1)
            measured = self.table[channel.column]
            rows = np.isfinite(both).all(1) & np.isfinite(measured)
            first, second = 100 * residual.share_of_measured(both[rows], measured[rows, None])
            answer[channel.name] = int(rows.sum()), float(first), float(second)
        return answer


def add_second_robot(table: Columns, channels: Sequence[Channel], simulated: Columns) -> Columns:
    """A table of `compare_readings` with the readings that a second robot gives on its rows."""
    return table | {f"against_{c.column}": simulated[c.column] for c in channels}


def compare_readings(measured: Runs, simulated: Columns, robot: Robot | None = None) -> tuple[Columns, Summary]:
    """Measured and simulated readings with their errors, and their summary by group.

    Groups are configurations, or surfaces of `robot`. A missing reading is NaN and counts as `missing`.
    Percent are of the channel's measured rms over all rows, as in results of fits.
    """
    table = {
        key: simulated[key] for key in ("configuration", *dict.fromkeys((*measured.layout.axes, *measured.axes)))
    }
    if not measured.layout.complete and measured.has("surface"):
        table["surface"] = measured["surface"]
    nothing = np.full(len(measured), np.nan)
    for channel in measured.channels:
        table[channel.column] = measured.columns.get(channel.column, nothing)
        table[f"simulated_{channel.column}"] = simulated[channel.column]
        table[f"error_{channel.name}_percent"] = residual.sized_error(
            simulated[channel.column], table[channel.column]
        )
    table["status"] = simulated["status"]
    groups = {"all": np.ones(len(measured), bool)}
    names = measured["configuration"] if robot is None else measured.configurations_named(robot)
    groups |= {str(c): names == c for c in dict.fromkeys(names)}
    summary = {
        name: {c.name: _summary(c, {k: v[rows] for k, v in table.items()}) for c in measured.channels}
        for name, rows in groups.items()
    }
    return table, summary


def _summary(channel: Channel, table: Columns) -> Json:
    measured, simulated = table[channel.column], table[f"simulated_{channel.column}"]
    return {
        **residual.error_summary(table[f"error_{channel.name}_percent"]),
        "rms": residual.root_mean_square(simulated - measured),
        "unit": channel.unit,
        "r2": residual.r_squared(measured, simulated),
        "missing": int(np.isnan(measured).sum()),
    }
