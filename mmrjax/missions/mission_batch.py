"""Missions of a batch of runs, and their results as numbers: energy, distance, peaks, heat, charge."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from mmrjax.compile.compiling import compiled
from mmrjax.compile.programs import has_tracer
from mmrjax.fidelities.base import RunBatch
from mmrjax.missions.mission import TOLERANCE, Mission, Start, Totals, mission
from mmrjax.missions.profile import Profile
from mmrjax.model.channels import SIDES
from mmrjax.model.conditions import Conditions
from mmrjax.model.params import Scalar
from mmrjax.model.quantities import SINKS, TABLE
from mmrjax.model.robot import Robot
from mmrjax.model.signals import BATTERY_EMPTY, CUT_OFF

#: The fidelity that follows profiles.
MODEL = "drive"
#: Steps of a segment that fit at first, least number in all, and largest number for all runs together.
ROOM, LEAST_KEPT, MOST_KEPT = 64, 4096, 2**20


#: Numbers of a mission in the order of columns, in SI from `mission_numbers`; further ones with separate sides.
OUTPUTS, OF_TURNS = TABLE["mission"], TABLE["mission of sides"]


def mission_columns(turns: bool = False) -> tuple[str, ...]:
    """Columns of a mission's numbers, in order. `turns`: True for a mission with independently driven sides."""
    return tuple(output.column for output in (*OUTPUTS, *(OF_TURNS if turns else ())))


#: Columns that a sweep over a profile stores by default.
USUAL = (
    "energy_Wh", "energy_per_metre_Wh", "distance_m", "rms_current_A", "peak_current_A", "winding_peak_C",
    "state_of_charge",
)  # fmt: skip


def _safe_ratio(part: Scalar, whole: Scalar) -> Array:
    """part / whole. NaN with a finite derivative if `whole` is not above 0."""
    positive = whole > 0
    return jnp.where(positive, part / jnp.where(positive, whole, 1.0), jnp.nan)


def _safe_root(x: Scalar) -> Array:
    return jnp.where(x > 0, jnp.sqrt(jnp.where(x > 0, x, 1.0)), 0.0 * x)


def mission_totals(totals: Totals, peaks: Mapping[str, Array]) -> dict[str, Array]:
    """Numbers [SI], by name, from the totals and peaks of missions or segments, any shape.

    NaN for a segment that was not reached.
    """
    integrals = totals.of
    is_run = totals.time > 0
    converted_energy = integrals["drawn"] + integrals["returned"] + sum(jnp.abs(integrals[name]) for name in SINKS)
    is_standing = integrals["path"] <= 1e-6  # m
    numbers = {
        "duration": totals.time,
        "distance": integrals["path"],
        "displacement": integrals["distance"],
        "energy": totals.energy,
        "energy_per_metre": jnp.where(
            is_standing, jnp.nan, _safe_ratio(totals.energy, jnp.where(is_standing, 1.0, integrals["path"]))
        ),
        "energy_drawn": integrals["drawn"],
        "energy_returned": integrals["returned"],
        "rms_current": _safe_root(_safe_ratio(integrals["current_squared"], totals.time)),
        "peak_current": peaks["current"],
        "rms_torque": _safe_root(_safe_ratio(integrals["torque_squared"], totals.time)),
        "peak_torque": peaks["torque"],
        "peak_speed": peaks["speed"],
        "peak_motor_speed": peaks["motor_speed"],
        "winding_peak": peaks["temperature"],
        "cell_low": jnp.where(jnp.isfinite(peaks["cell_low"]), peaks["cell_low"], jnp.nan),
        **{f"energy_to_{name}": integrals[name] for name in SINKS},
        "energy_stored": totals.stored,
        "unaccounted_share": _safe_ratio(totals.unaccounted, converted_energy),
    }
    if "turned" in integrals:
        numbers |= {name: integrals[name] for name in ("turned", "place_x", "place_y")} | {
            "peak_yaw_rate": peaks["yaw_rate"]
        }
        for side in SIDES:
            numbers |= {
                f"rms_current_{side}": _safe_root(_safe_ratio(integrals[f"current_squared_{side}"], totals.time)),
                f"peak_current_{side}": peaks[f"current_{side}"],
                f"winding_peak_{side}": peaks[f"temperature_{side}"],
            }
    return {name: jnp.where(is_run, value, jnp.nan) for name, value in numbers.items()}


def mission_numbers(robot: Robot, conditions: Conditions, completed: Mission) -> dict[str, Array]:
    """Numbers of missions [SI], by name as in `OUTPUTS`, any shape. NaN if a number does not apply.

    State of charge, endurance and range refer to the on-board battery. Endurance is the time from the charge at the
    start until the battery is empty, at the mean current of the mission. Range is the distance in that time. Both are
    exact if the battery becomes empty during the mission. They neglect that a demanded speed takes more current as
    the voltage falls.
    """
    on_battery = conditions.battery > 0.5
    capacity = robot.battery.capacity
    charge_used = completed.discharge - conditions.discharge
    time, path = completed.total.time, completed.total.of["path"]
    is_empty = (completed.result.status == BATTERY_EMPTY) | (completed.result.status == CUT_OFF)
    missions_per_charge = jnp.where(
        is_empty, 1.0, _safe_ratio(capacity - conditions.discharge, charge_used)
    )  # number of missions per charge
    return {
        **mission_totals(completed.total, completed.peaks),
        "state_of_charge": jnp.where(on_battery, 1 - completed.discharge / capacity, jnp.nan),
        "winding_end": jnp.asarray(completed.temperature_winding),
        "housing_end": jnp.asarray(completed.temperature_housing),
        "endurance": jnp.where(on_battery, missions_per_charge * time, jnp.nan),
        "range": jnp.where(on_battery, missions_per_charge * path, jnp.nan),
    }


def cell_below_cutoff(robot: Robot, conditions: Conditions, profile: Profile, start: Start | None) -> np.ndarray:
    """Cell voltage at the start of missions on the battery [V] if it is below the cut-off, otherwise NaN, shape
    (runs,).

    Not traceable. The motor current is `start.current`, or 0 if no start is given.
    """
    battery = robot.battery
    first_row = jax.tree.map(lambda x: x[..., 0], profile)
    other_current = battery.current_other if first_row.current_other is None else first_row.current_other
    duty = conditions.duty if first_row.duty is None else first_row.duty
    motors_current = robot.sides * (Start() if start is None else start).current * duty
    cell_voltage = (
        battery.voltage_no_load(conditions.discharge) - (motors_current + other_current) * battery.resistance
    )
    is_below = (conditions.battery > 0.5) & (cell_voltage < battery.voltage_cutoff)
    return np.asarray(jnp.where(is_below, cell_voltage, jnp.nan))


def numbers_by_column(numbers: Mapping[str, Any]) -> dict[str, Any]:
    """Numbers [SI] by column of tables, in the columns' units."""
    return {
        output.column: numbers[output.name] / output.factor
        for output in (*OUTPUTS, *OF_TURNS)
        if output.name in numbers
    }


def missions_of_runs(
    robot: Robot, conditions: Conditions, profile: Profile, start: Start | None = None, *, history: bool = False
) -> Mission:
    """Simulates the missions of a batch of runs. Can be traced by JAX.

    Args:
        conditions: shape (runs,).
        profile: fields of shape (rows,), or (runs, rows).
        start: state at the start of all missions.
        history: True to record the missions over time, see `simulate_in_parts`.
    """
    if not history:
        return simulate_batch(robot, conditions, profile, start, 0)
    if has_tracer((robot, conditions, profile, start)):
        return simulate_batch(robot, conditions, profile, start, _step_capacity(profile))
    parts = list(simulate_in_parts(robot, conditions, profile, start))
    return jax.tree.map(lambda *x: np.concatenate(x), *parts)


def simulate_in_parts(
    robot: Robot, conditions: Conditions, profile: Profile, start: Start | None
) -> Iterator[Mission]:
    """Simulates missions with recorded courses, in parts whose steps fit into memory.

    A mission with more steps than fit is repeated with more space, up to `MOST_KEPT` steps. The recorded course of a
    longer mission ends there.
    """
    (runs,) = conditions.shape
    capacity = _step_capacity(profile)
    first = 0
    while first < runs:
        size = max(1, min(runs, MOST_KEPT // capacity))
        rows = np.minimum(np.arange(first, first + size), runs - 1)  # padding repeats the last run
        part_conditions = jax.tree.map(lambda x, rows=rows: jnp.asarray(np.asarray(x)[rows]), conditions)
        part_profile = jax.tree.map(lambda x, rows=rows: x[rows] if x.ndim == 2 else x, profile)
        part = jax.device_get(simulate_batch(robot, part_conditions, part_profile, start, capacity))
        steps = int(np.max(part.steps - part.rejected))
        if steps > capacity and capacity < MOST_KEPT:
            capacity = min(MOST_KEPT, _next_power(steps))
            continue
        yield jax.tree.map(lambda x, count=runs - first: x[:count], part)
        first += size


def _step_capacity(profile: Profile) -> int:
    return min(MOST_KEPT, max(LEAST_KEPT, _next_power(ROOM * profile.segment_count * profile.cycles)))


def _next_power(count: int) -> int:
    return 1 << (count - 1).bit_length()


@compiled
def simulate_batch(
    robot: Robot,
    conditions: Conditions,
    profile: Profile,
    start: Start | None,
    keep: int,
    tolerance: Scalar = TOLERANCE,
) -> Mission:
    """Simulates the missions of a batch in one compiled call, see `missions_of_runs`.

    Args:
        keep: largest number of steps to record, 0 for none.
    """
    axes = jax.tree.map(lambda x: 0 if x.ndim == 2 else None, profile)
    return jax.vmap(
        lambda one, rows: mission(robot, one, rows, start, tolerance=tolerance, keep=keep), in_axes=(0, axes)
    )(conditions, profile)


def run_missions(robot: Robot, conditions: Conditions, profile: Profile) -> RunBatch:
    """Missions of a batch as runs of a fidelity, with their numbers as columns."""
    missions = missions_of_runs(robot, conditions, profile)
    return RunBatch(missions.result, numbers_by_column(mission_numbers(robot, conditions, missions)))
