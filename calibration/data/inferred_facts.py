"""Facts that a table of runs states or shows: mass of the robot, sign and resolution of its instruments.

A table with `total_mass_kg` is simulated with that mass instead of the robot's own. A robot that is fitted to the
table needs the same mass: otherwise an effect on the mass would be fitted relative to the table's mass, but written
to a file with another.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import replace

import jax.numpy as jnp
import numpy as np

from calibration.data.input_errors import BadConfiguration
from calibration.data.table import Runs, rows_of_scaled_adhesion
from mmrjax.model import channels, params
from mmrjax.model.channels import Channel
from mmrjax.model.paper_tables import BENCH
from mmrjax.model.rig import Instrument
from mmrjax.model.robot import Robot

#: Masses that differ by less are equal within rounding [kg].
MASS_ROUNDING = 1e-6


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
    total, payload = runs["total_mass_kg"], runs["payload_kg"]
    robot_mass = total - payload
    low, high = params.parameters_by_name(robot.configurations.members[0])["mass"].spec.bounds
    expectation = f"expected {low:g} to {high:g} kg without the payload"
    why = lambda row: f" with a payload of {payload[row]:g} kg; {expectation}"  # noqa: E731
    runs.check_rows([("total_mass_kg", (robot_mass < low) | (robot_mass > high), why)])
    masses = {}
    for index in np.unique(configuration_index):
        rows = configuration_index == index
        m = robot_mass[rows]
        constant = bool(np.ptp(total[rows]) <= MASS_ROUNDING)
        median = round(float(np.median(m)), 6)
        masses[robot.configurations.names[index]] = (median, float(m.min()), float(m.max()), constant)
    return masses


def with_table_mass(robot: Robot, runs: Runs) -> Robot:
    """Robot with the masses of the table. For each configuration it is the median over the rows.

    Raises:
        BadData: for the same reasons as `stated_masses`.
    """
    robot_masses = {name: float(chassis.mass) for name, chassis in robot.configurations.items()}
    masses = {n: m for n, (m, *_) in stated_masses(robot, runs).items() if abs(m - robot_masses[n]) > MASS_ROUNDING}
    return params.replace(robot, {f"{name}.mass": jnp.asarray(mass, float) for name, mass in masses.items()})


def mass_notes(robot: Robot, runs: Runs) -> list[str]:
    """Notes on masses of the table that differ from those of the robot, and on the mass that is written.

    Args:
        robot: robot as given, before `with_table_mass`.
    """
    notes = []
    for name, (median, low, high, constant) in stated_masses(robot, runs).items():
        mass = float(robot.configurations[name].mass)
        if high - low > MASS_ROUNDING:
            question = "; does total_mass_kg exclude the payload?" * constant
            notes.append(
                f"{name}: total_mass_kg minus payload_kg varies from {low:.4g} to {high:.4g} kg. robot.toml "
                f"contains the median, {median:.4g} kg, so it does not reproduce the fit in other rows{question}"
            )
        elif abs(median - mass) > MASS_ROUNDING:
            notes.append(
                f"{name}: the table states {median:.6g} kg without payload, the robot's file {mass:.6g} "
                f"kg. {median:.6g} kg is used, and written to robot.toml"
            )
    if runs.has("surface"):
        is_labelled = rows_of_scaled_adhesion(robot, runs["configuration"], runs["surface"])
        others = [s for s in np.unique(runs["surface"][is_labelled]) if s != BENCH]
        if others:
            notes.append(
                f"the table has runs on {', '.join(others)}: the written friction is for {BENCH}. Simulate with "
                f"--surface {others[0]} to use the fitted values"
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


#: Smallest step, and largest rounding error of a printed reading, as shares of the largest difference.
SMALLEST, ROUNDING = 1e-5, 1e-7
#: Fewest different readings that show a step. In 99 % of tables the common divisor of so many random multiples is the
#: step itself, with four multiples in 83 %.
FEWEST = 8
#: Coarsest step of a display, as a share of the largest reading. Coarser steps are levels that a person set.
COARSEST = 0.25


def common_step(readings: np.ndarray) -> float:
    """Largest common divisor of all differences between readings (Euclid's algorithm).

    0 if that step is not larger than rounding errors, or if there are too few different readings. Evenly spaced
    readings that occur equally often, with at most one level missing, were set by a person. They do not show the
    resolution of a display.
    """
    levels, counts = np.unique(readings[np.isfinite(readings)], return_counts=True)
    if levels.size < FEWEST:
        return 0.0
    step, largest = 0.0, float(np.ptp(levels))
    for difference in np.diff(levels).tolist():
        a, b = difference, step
        while b > ROUNDING * largest:
            a, b = b, abs(a - b * round(a / b))
        step = a
        if step < SMALLEST * largest:
            return 0.0
    is_ladder = largest < (levels.size + 0.5) * step and np.min(np.abs(levels)) < 1.5 * step
    return 0.0 if is_ladder and np.ptp(counts) == 0 else step


def display_step(readings: np.ndarray, channel: Channel) -> float:
    """Resolution of the display of a channel [SI]. 0 if the readings show none.

    It is the `common_step`. With too few different readings, it is the largest power of ten, in the unit of the
    column, that divides all of them. It is at most `COARSEST` of the largest reading.

    Args:
        readings: readings [SI].
        channel: the channel.
    """
    step = common_step(readings)
    levels = np.unique(readings[np.isfinite(readings)]) / channel.factor
    if step or not 2 <= levels.size < FEWEST:
        return step
    largest = float(np.max(np.abs(levels)))
    powers = 10.0 ** np.arange(math.floor(math.log10(COARSEST * largest)), math.log10(SMALLEST * largest), -1)
    fitting_powers = [p for p in powers if np.all(np.abs(levels / p - np.round(levels / p)) < 1e-6)]
    return float(fitting_powers[0] * channel.factor) if fitting_powers else 0.0


def infer_instruments(runs: Runs) -> Runs:
    """Table with the sign and resolution of its instruments inferred from the readings, where they are not stated.

    An instrument shows only the magnitude if no reading is negative although some runs go backward.
    """
    drives = [runs[c] for c in ("supply_voltage_V", "motor_speed_rpm", "duty") if runs.has(c)]
    runs_backward = any((drive < 0).any() for drive in drives)
    inferred = []
    for instrument in runs.layout.instruments:
        channel = channels.find_channel(instrument.channel)
        readings = runs.columns.get(channel.column, np.zeros(0))
        signed, quantum = instrument.signed, instrument.quantum
        if signed is None:
            signed = not runs_backward or bool((readings < 0).any())
        if quantum is None:
            quantum = common_step(readings) * channel.factor
        inferred.append(Instrument(instrument.channel, signed, quantum))
    return replace(runs, layout=replace(runs.layout, instruments=tuple(inferred)))


def with_inferred_instruments(robot: Robot, runs: Runs) -> Robot:
    """Robot with the instruments inferred from its table."""
    rig_instruments, table_instruments = robot.rig.instruments, runs.layout.instruments
    instruments = table_instruments if any(i.free for i in rig_instruments) else rig_instruments
    measured_channels = {i.channel for i in instruments}
    instruments = (*instruments, *(i for i in table_instruments if i.channel not in measured_channels))
    if instruments == rig_instruments:
        return robot
    return replace(robot, rig=replace(robot.rig, instruments=instruments))
