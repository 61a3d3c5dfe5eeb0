"""Mass of a robot without payload: from its file, or from a table of runs.

A table with `total_mass_kg` is simulated with that mass instead of the robot's own. A robot that is fitted to the
table needs the same mass: otherwise an effect on the mass would be fitted relative to the table's mass, but written
to a file with another.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable

import jax.numpy as jnp
import numpy as np

from calibration.data.input_errors import BadConfiguration
from calibration.data.named_arrays import check_rows
from calibration.data.runs import Runs
from calibration.data.surface_labels import rows_of_scaled_adhesion
from mmrjax.model import params
from mmrjax.model.paper_tables import BENCH
from mmrjax.model.robot import Robot

#: Masses that differ by less are equal within rounding [kg].
ROUNDING = 1e-6


@dataclasses.dataclass(frozen=True)
class StatedMass:
    """Mass of one configuration without payload, according to a table: `total_mass_kg` minus `payload_kg`.

    Attributes:
        median, low, high: median, smallest and largest value over the rows of the configuration [kg].
        unladen: true if it varies while `total_mass_kg` is constant, as if that column excluded the payload.
    """

    median: float
    low: float
    high: float
    unladen: bool

    @property
    def varies(self) -> bool:
        """True if no single mass is right for every row."""
        return self.high - self.low > ROUNDING


def stated_masses(robot: Robot, runs: Runs) -> dict[str, StatedMass]:
    """Masses that a table states for its configurations. Empty without `total_mass_kg`.

    Raises:
        BadData: a mass is out of bounds, or the robot lacks a configuration.
    """
    if not runs.has("total_mass_kg"):
        return {}
    configuration_index = runs.configurations(robot)
    own_masses = runs["total_mass_kg"] - runs["payload_kg"]
    low, high = next(
        p for p in params.walk_parameters(robot.configurations.members[0]) if p.name == "mass"
    ).spec.bounds
    wrong, payload = (own_masses < low) | (own_masses > high), runs["payload_kg"]
    end = f"expected {low:g} to {high:g} kg without the payload"
    why = lambda row: f" with a payload of {payload[row]:g} kg; {end}"  # noqa: E731
    check_rows(runs.source, runs.columns, [("total_mass_kg", wrong, why)])
    masses = {}
    for index in np.unique(configuration_index):
        is_own_row = configuration_index == index
        m = own_masses[is_own_row]
        constant = bool(np.ptp(runs["total_mass_kg"][is_own_row]) <= ROUNDING)
        median = round(float(np.median(m)), 6)
        masses[robot.configurations.names[index]] = StatedMass(median, float(m.min()), float(m.max()), constant)
    return masses


def with_table_mass(robot: Robot, runs: Runs) -> Robot:
    """Robot with the masses of the table. For each configuration it is the median over the rows.

    Raises:
        BadData: for the same reasons as `stated_masses`.
    """
    own_masses = {name: float(chassis.mass) for name, chassis in robot.configurations.items()}
    masses = {n: s.median for n, s in stated_masses(robot, runs).items() if abs(s.median - own_masses[n]) > ROUNDING}
    return params.replace(robot, {f"{name}.mass": jnp.asarray(mass, float) for name, mass in masses.items()})


def mass_notes(robot: Robot, runs: Runs) -> list[str]:
    """Notes on masses of the table that differ from those of the robot, and on the mass that is written.

    Args:
        robot: robot as given, before `with_table_mass`.
    """
    notes = []
    for name, file_mass in stated_masses(robot, runs).items():
        mass = float(robot.configurations[name].mass)
        if file_mass.varies:
            why = "; does total_mass_kg exclude the payload?" if file_mass.unladen else ""
            notes.append(
                f"{name}: total_mass_kg minus payload_kg varies from {file_mass.low:.4g} to {file_mass.high:.4g} kg. "
                f"The fit used the mass of each row. robot.toml contains the median, {file_mass.median:.4g} kg, and "
                f"does not reproduce the fit in rows with another mass{why}"
            )
        elif abs(file_mass.median - mass) > ROUNDING:
            notes.append(
                f"{name}: the table states {file_mass.median:.6g} kg without payload, the robot's file {mass:.6g} "
                f"kg. {file_mass.median:.6g} kg is used, and written to robot.toml"
            )
    of_table5 = np.zeros(len(runs), bool)
    if runs.has("surface"):
        of_table5 = rows_of_scaled_adhesion(robot, runs["configuration"], runs["surface"])
    other_surfaces = [s for s in np.unique(runs["surface"][of_table5]) if s != BENCH] if of_table5.any() else []
    if other_surfaces:
        notes.append(
            f"the table has runs on {', '.join(other_surfaces)}: the written friction is for {BENCH}. Simulate with "
            f"--surface {other_surfaces[0]} to use the fitted values"
        )
    return notes


def check_priors(stated: Iterable[str], robot: Robot, runs: Runs) -> None:
    """Rejects a prior of a mass that the table states, because the fit uses the mass in the table.

    Args:
        stated: names of the parameters with stated priors.

    Raises:
        BadConfiguration: one of them is such a mass.
    """
    for name in stated_masses(robot, runs):
        if f"{name}.mass" in stated:
            raise BadConfiguration(
                f"--prior {name}.mass: {runs.source} has a column total_mass_kg, which sets the mass of each run; to "
                "fit the mass, remove that column, otherwise remove the prior"
            )
