"""Mass of a robot without payload: from its file, or from a table of runs.

A table with `total_mass_kg` is simulated with that mass instead of the robot's own. A robot that is fitted to the
table needs the same mass: otherwise an effect on the mass would be fitted relative to the table's mass, but written
to a file with another.
"""

from __future__ import annotations

from collections.abc import Iterable

import jax.numpy as jnp
import numpy as np

from calibration.data.input_errors import BadConfiguration
from calibration.data.named_arrays import check_rows
from calibration.data.table import Runs, rows_of_scaled_adhesion
from mmrjax.model import params
from mmrjax.model.paper_tables import BENCH
from mmrjax.model.robot import Robot

#: Masses that differ by less are equal within rounding [kg].
ROUNDING = 1e-6


def stated_masses(robot: Robot, runs: Runs) -> dict[str, tuple[float, float, float, bool]]:
    """Masses without payload that a table states for its configurations: `total_mass_kg` minus `payload_kg`.

    Returns:
        For each configuration the median, smallest and largest value over its rows [kg], and True if
        `total_mass_kg` is constant. Empty without that column.

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
        masses[robot.configurations.names[index]] = (median, float(m.min()), float(m.max()), constant)
    return masses


def with_table_mass(robot: Robot, runs: Runs) -> Robot:
    """Robot with the masses of the table. For each configuration it is the median over the rows.

    Raises:
        BadData: for the same reasons as `stated_masses`.
    """
    own_masses = {name: float(chassis.mass) for name, chassis in robot.configurations.items()}
    masses = {n: m for n, (m, *_) in stated_masses(robot, runs).items() if abs(m - own_masses[n]) > ROUNDING}
    return params.replace(robot, {f"{name}.mass": jnp.asarray(mass, float) for name, mass in masses.items()})


def mass_notes(robot: Robot, runs: Runs) -> list[str]:
    """Notes on masses of the table that differ from those of the robot, and on the mass that is written.

    Args:
        robot: robot as given, before `with_table_mass`.
    """
    notes = []
    for name, (median, low, high, constant) in stated_masses(robot, runs).items():
        mass = float(robot.configurations[name].mass)
        if high - low > ROUNDING:
            why = "; does total_mass_kg exclude the payload?" if constant else ""
            notes.append(
                f"{name}: total_mass_kg minus payload_kg varies from {low:.4g} to {high:.4g} kg. robot.toml "
                f"contains the median, {median:.4g} kg, so it does not reproduce the fit in other rows{why}"
            )
        elif abs(median - mass) > ROUNDING:
            notes.append(
                f"{name}: the table states {median:.6g} kg without payload, the robot's file {mass:.6g} "
                f"kg. {median:.6g} kg is used, and written to robot.toml"
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
                f"--prior {name}.mass: {runs.source} has a column total_mass_kg, which sets the mass of each "
                "run; remove that column or the prior"
            )
