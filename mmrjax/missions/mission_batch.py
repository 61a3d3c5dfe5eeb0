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


def _root(x: Scalar) -> Array:
    return jnp.where(x > 0, jnp.sqrt(jnp.where(x > 0, x, 1.0)), 0.0 * x)


def mission_totals(found: Totals, peaks: Mapping[str, Array]) -> dict[str, Array]:
    """Numbers [SI], by name, from the totals and peaks of missions or segments, any shape.

    NaN for a segment that was not reached.
    """
    by_segment, ran = found.of, found.time > 0
    converted_energy = by_segment["drawn"] + by_segment["returned"] + sum(jnp.abs(by_segment[name]) for name in SINKS)
    is_standing = by_segment["path"] <= 1e-6  # m
    numbers = {
        "duration": found.time,
        "distance": by_segment["path"],
        "displacement": by_segment["distance"],
        "energy": found.energy,
        "energy_per_metre": jnp.where(
            is_standing, jnp.nan, _safe_ratio(found.energy, jnp.where(is_standing, 1.0, by_segment["path"]))
        ),
        "energy_drawn": by_segment["drawn"],
        "energy_returned": by_segment["returned"],
        "rms_current": _root(_safe_ratio(by_segment["current_squared"], found.time)),
        "peak_current": peaks["current"],
        "rms_torque": _root(_safe_ratio(by_segment["torque_squared"], found.time)),
        "peak_torque": peaks["torque"],
        "peak_speed": peaks["speed"],
        "peak_motor_speed": peaks["motor_speed"],
        "winding_peak": peaks["temperature"],
        "cell_low": jnp.where(jnp.isfinite(peaks["cell_low"]), peaks["cell_low"], jnp.nan),
        **{f"energy_to_{name}": by_segment[name] for name in SINKS},
        "energy_stored": found.stored,
        "unaccounted_share": _safe_ratio(found.unaccounted, converted_energy),
    }
    if "turned" in by_segment:
        numbers |= {name: by_segment[name] for name in ("turned", "place_x", "place_y")} | {
            "peak_yaw_rate": peaks["yaw_rate"]
        }
        for side in SIDES:
            numbers |= {
                f"rms_current_{side}": _root(_safe_ratio(by_segment[f"current_squared_{side}"], found.time)),
                f"peak_current_{side}": peaks[f"current_{side}"],
                f"winding_peak_{side}": peaks[f"temperature_{side}"],
            }
    return {name: jnp.where(ran, value, jnp.nan) for name, value in numbers.items()}


def mission_numbers(robot: Robot, conditions: Conditions, found: Mission) -> dict[str, Array]:
    """Numbers of missions [SI], by name as in `OUTPUTS`, any shape. NaN if a number does not apply.

    State of charge, endurance and range refer to the on-board battery. Endurance is the time from the charge at the
    start until the battery is empty, at the mean current of the mission. Range is the distance in that time. Both are
    exact if the battery becomes empty during the mission. They neglect that a demanded speed takes more current as
    the voltage falls.
    """
    on_battery, capacity = conditions.battery > 0.5, robot.battery.capacity
    charge_used = found.discharge - conditions.discharge
    time, path = found.total.time, found.total.of["path"]
    is_empty = (found.result.status == BATTERY_EMPTY) | (found.result.status == CUT_OFF)
    times = jnp.where(
        is_empty, 1.0, _safe_ratio(capacity - conditions.discharge, charge_used)
    )  # number of missions per charge
    return {
        **mission_totals(found.total, found.peaks),
        "state_of_charge": jnp.where(on_battery, 1 - found.discharge / capacity, jnp.nan),
        "winding_end": jnp.asarray(found.temperature_winding),
        "housing_end": jnp.asarray(found.temperature_housing),
        "endurance": jnp.where(on_battery, times * time, jnp.nan),
        "range": jnp.where(on_battery, times * path, jnp.nan),
    }


def cell_below_cutoff(robot: Robot, conditions: Conditions, profile: Profile, start: Start | None) -> np.ndarray:
    """Cell voltage at the start of missions on the battery [V] if it is below the cut-off, otherwise NaN, shape
    (runs,).

    Not traceable. The motor current is `start.current`, or 0 if no start is given.
    """
    battery, first_row = robot.battery, jax.tree.map(lambda x: x[..., 0], profile)
    other = battery.current_other if first_row.current_other is None else first_row.current_other
    duty = conditions.duty if first_row.duty is None else first_row.duty
    motors = robot.sides * (Start() if start is None else start).current * duty
    cell = battery.voltage_no_load(conditions.discharge) - (motors + other) * battery.resistance
    is_below = (conditions.battery > 0.5) & (cell < battery.voltage_cutoff)
    return np.asarray(jnp.where(is_below, cell, jnp.nan))


def numbers_by_column(found: Mapping[str, Any]) -> dict[str, Any]:
    """Numbers [SI] by column of tables, in the columns' units."""
    return {
        output.column: found[output.name] / output.factor for output in (*OUTPUTS, *OF_TURNS) if output.name in found
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
    keep, first = _step_capacity(profile), 0
    while first < runs:
        size = max(1, min(runs, MOST_KEPT // keep))
        rows = np.minimum(np.arange(first, first + size), runs - 1)  # padding repeats the last run
        some = jax.tree.map(lambda x, rows=rows: jnp.asarray(np.asarray(x)[rows]), conditions)
        followed = jax.tree.map(lambda x, rows=rows: x[rows] if x.ndim == 2 else x, profile)
        part = jax.device_get(simulate_batch(robot, some, followed, start, keep))
        steps = int(np.max(part.steps - part.rejected))
        if steps > keep and keep < MOST_KEPT:
            keep = min(MOST_KEPT, _next_power(steps))
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
