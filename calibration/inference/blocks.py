"""Blocks of related runs, and hold-out fits without each of them."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

import jax
import numpy as np

from calibration.data import Columns, Names
from calibration.data.clock import rows_of_varying_runs
from calibration.data.columns import CURRENT, LOAD, SPEED
from calibration.data.runs import Runs
from calibration.inference.optimizers import Optimum
from calibration.inference.problem import Observation, Problem

#: Kinds of blocks by name, with the columns that distinguish their blocks.
BLOCKS: dict[str, Names] = {
    "slope": ("slope_deg",),
    "voltage": ("supply_voltage_V",),
    "duty": ("duty",),
    "speed": (SPEED,),
    "current": (CURRENT,),
    "payload": ("payload_kg",),
    "load_torque": (LOAD,),
    "configuration": ("configuration",),
    "voltage_configuration": ("configuration", "supply_voltage_V"),
    "run": ("run_id",),
}
#: Names of the blocks by sharpness of a turn, and by parts of a run over time.
TURN, PART = "turn", "part"


def kind_in_words(by: str) -> str:
    """Name of a kind of block in words."""
    for quantity in ("motor_speed", "load_torque"):
        by = by.replace(quantity, quantity.replace("_", " "))
    return by.replace("_", " and ")


#: Columns of blocks that are labels rather than conditions.
NO_CONDITIONS = ("configuration", "run_id")
#: Columns that have no levels, or that are measured.
GRADED = (SPEED, CURRENT, LOAD, "duty")
#: Relative step from one value to the next that begins another level [-]: a controlled speed, current or torque
#: is measured and never repeats exactly. And the number of blocks of a quantity without levels.
APART, PARTS = 0.1, 4


def group_into_levels(x: np.ndarray) -> np.ndarray:
    """Level of each number: the median of numbers of similar size, to four digits.

    Numbers that vary continuously are split into `PARTS` groups of about equal size.
    """
    order = np.argsort(x, kind="stable")
    step = np.diff(x[order])
    group = np.concatenate([[0], np.cumsum(step > APART * np.abs(x[order][:-1]))])
    if group[-1] == 0 and np.ptp(x) > 2 * APART * PARTS * np.max(np.abs(x)):
        group = np.arange(len(x)) * PARTS // len(x)
    level = np.array([float(f"{np.median(x[order][group == g]):.4g}") for g in group])
    level_of_row = np.empty(len(x))
    level_of_row[order] = level
    return level_of_row


def blocks_by_sharpness(runs: Runs) -> Columns:
    """Label → mask of its rows, for `PARTS` groups of turns, from turning on the spot to straight travel.

    Turns are sorted by the ratio of the slower side's command to that of the faster side, -1 to 1.
    """
    slower, faster = np.sort(np.abs(runs.of_sides), 0)
    share = np.round(slower / np.maximum(faster, 1e-12) * np.sign(np.prod(runs.of_sides, 0)), 6)
    part = np.searchsorted(np.sort(share), share) * PARTS // len(share)
    masks = [part == k for k in np.unique(part)]
    return (
        {f"{share[block_rows].min():.2g} to {share[block_rows].max():.2g}": block_rows for block_rows in masks}
        if len(masks) > 1
        else {}
    )


def parts_over_time(runs: Runs) -> Columns:
    """Label → mask of its rows, for `PARTS` consecutive parts of each run."""
    names, run = np.unique(runs.run_names, return_inverse=True)
    part = np.zeros(len(runs), int)
    for k in range(len(names)):
        time = runs["time_s"][run == k]
        edges = np.linspace(time.min(), time.max(), PARTS + 1)
        part[run == k] = np.searchsorted(edges[1:-1], time, side="right")
    return {f"{k + 1} of {PARTS}": part == k for k in np.unique(part)}


def parts_of_runs(runs: Runs) -> Columns:
    """Label → mask of its rows, for each part of each run over time."""
    names = runs.run_names
    parts = parts_over_time(runs)
    return {f"{run} {label}": (names == run) & part for run in np.unique(names) for label, part in parts.items()}


def blocks_of_kind(runs: Runs, by: str) -> Columns:
    """Label → mask of its rows, for each block of the kind `by`. Empty if the data do not vary in that quantity.

    A run in which the quantity changes is a block of its own. If it changes in all runs, the result is empty.
    """
    if by == TURN:
        return blocks_by_sharpness(runs) if runs.turns else {}
    if by == PART:  # whole runs are blocks if a configuration has several
        several = len(np.unique(runs.run_names)) > len(np.unique(runs["configuration"]))
        return {} if several else parts_over_time(runs)
    columns = [c for c in BLOCKS[by] if runs.has(c) and (c in NO_CONDITIONS or c in runs.axes)]
    if len(columns) < len(BLOCKS[by]):
        return {}
    if by == "voltage_configuration" and not runs.layout.complete and len(np.unique(runs["configuration"])) == 1:
        return {}  # the same blocks as `voltage`
    values = {c: group_into_levels(runs[c]) if c in GRADED else runs[c] for c in columns}
    labels = np.array([" ".join(str(values[c][k]) for c in columns) for k in range(len(runs))])
    is_varying = rows_of_varying_runs(runs, BLOCKS[by])
    if is_varying.all() and by != "run":
        return {}
    labels = np.where(is_varying, np.char.add("run ", runs.run_names.astype(str)), labels)
    names = list(dict.fromkeys(labels))
    rows_are_runs = by == "run" and len(names) == len(runs)  # each row is a run of its own
    return {name: labels == name for name in names} if len(names) > 1 and not rows_are_runs else {}


def distinct_held_out_blocks(runs: Runs, kinds: Sequence[str]) -> dict[str, Columns]:
    """Kind → blocks, for the kinds that the data have. A kind that divides the rows as an earlier one does is
    omitted.
    """
    by_parts: dict[frozenset[bytes], tuple[str, Columns]] = {}
    for kind in kinds:
        blocks = blocks_of_kind(runs, kind)
        by_parts.setdefault(frozenset(m.tobytes() for m in blocks.values()), (kind, blocks))
    return {kind: blocks for kind, blocks in by_parts.values() if blocks}


def predictable_blocks(runs: Runs, problem: Problem) -> dict[str, Columns]:
    """Kind → blocks that can be predicted from the other rows.

    A block with all rows of a configuration is omitted if that configuration has free parameters of its own.
    """
    names = runs.configurations_named(problem.base)
    coordinates = problem.coordinates
    configurations_informing = [{_configuration_of_parameter(name, names)} for name in coordinates.names]
    for follower, k, _ in coordinates.tied:
        configurations_informing[k].add(_configuration_of_parameter(follower, names))
    rows_of_parameters = [np.isin(names, list(owners)) for owners in configurations_informing if "" not in owners]
    kinds = {}
    for kind, blocks in distinct_held_out_blocks(runs, problem.observe.blocks).items():
        kinds[kind] = {
            label: m for label, m in blocks.items() if not any(m[rows].all() for rows in rows_of_parameters)
        }
    return {kind: blocks for kind, blocks in kinds.items() if blocks}


def unpredictable_kinds(runs: Runs, problem: Problem) -> Names:
    """Kinds with at least one block that the other rows cannot predict."""
    predictable = predictable_blocks(runs, problem)
    blocks_by_kind = distinct_held_out_blocks(runs, problem.observe.blocks)
    return tuple(kind for kind, blocks in blocks_by_kind.items() if len(predictable.get(kind, {})) < len(blocks))


def _configuration_of_parameter(parameter: str, configurations: np.ndarray) -> str:
    """Configuration to which a parameter belongs, empty if it belongs to none."""
    first = parameter.partition(".")[0]
    return first if first in configurations else ""


# --- hold-out fits --------------------------------------------------------------------------------------


def fit_from_each_start(
    problem: Problem,
    starts: Sequence[np.ndarray],
    weights: Sequence[np.ndarray],
    active: Sequence | None = None,
    most: int | None = None,
) -> tuple[Optimum, Observation]:
    """Fits a problem from several starts, each with its own weights.

    Args:
        starts: coordinates of each start.
        weights: weights of the readings for each start, shape (rows, channels).
        active: set of effects of each start, None for a problem without slots.
        most: largest number of steps, None for no limit.

    Returns:
        Optimum of each search and the model's observation there. The leading axis is the starts.
    """
    sets = None if active is None else np.stack(active)
    return jax.device_get(problem.observe.search(problem, np.stack(starts), np.stack(weights), sets, most=most))


@dataclasses.dataclass(frozen=True)
class HeldOutFits:
    """Fits without each block, and their predictions of the block.

    Attributes:
        reading: reading of each row, predicted by the fit without its block [SI], shape (rows, channels). NaN if no
            block holds the row, or if the fitted robot does not reach it.
        status: status of each row, -1 if no block holds it.
        block: index of each row's block, -1 for none, shape (rows,).
        z: coordinates of each block's fit, shape (blocks, coordinates).
        converged: True for each block whose fit is an optimum.
        labels: labels of the blocks, if they have any.
    """

    reading: np.ndarray
    status: np.ndarray
    block: np.ndarray
    z: np.ndarray
    converged: np.ndarray
    labels: Names = ()


def hold_out_blocks(
    problem: Problem, start: np.ndarray, masks: Sequence[np.ndarray], active: Sequence[int] | None = None
) -> HeldOutFits:
    """Refits without each block in turn, and predicts the rows that were left out.

    Args:
        problem: problem of the fit to all rows.
        start: its optimum.
        masks: masks of the rows of each block, shape (rows of the table,). The problem may have more, padded rows.
        active: active effects, for a problem with slots.
    """
    weight = np.asarray(problem.data.weight)
    weights = [weight * ~m[:, None] for m in _padded_masks(problem, masks)]
    active_sets = None if active is None else [active] * len(masks)
    optima, observations = fit_from_each_start(problem, [start] * len(masks), weights, active_sets)
    return _predictions(problem, masks, observations.reading, observations.status, optima.z, optima.converged)


def _padded_masks(problem: Problem, masks: Sequence[np.ndarray]) -> list[np.ndarray]:
    """Masks of the rows of a problem, which may have more, padded rows."""
    return [np.pad(mask, (0, len(problem.data.weight) - len(mask))) for mask in masks]


def _predictions(
    problem: Problem, masks: Sequence[np.ndarray], readings: Any, statuses: Any, z: Any, converged: Any
) -> HeldOutFits:
    """Predictions of each block by the fit without it. First axis of the other arguments: the blocks."""
    rows = len(masks[0])
    reading, status, block = np.full((rows, readings[0].shape[1]), np.nan), np.full(rows, -1), np.full(rows, -1)
    for k, mask in enumerate(masks):
        unreachable = problem.observe.unreachable(np.asarray(statuses[k]))[:, None]
        reading[mask] = np.where(unreachable, np.nan, readings[k])[:rows][mask]
        status[mask], block[mask] = statuses[k][:rows][mask], k
    return HeldOutFits(reading, status, block, np.asarray(z), np.asarray(converged))


def predict_unseen(
    problem: Problem, start: np.ndarray, masks: Sequence[np.ndarray], active: Sequence[int] | None = None
) -> HeldOutFits:
    """Hold-out fits as in `hold_out_blocks`. For long runs, each refit is a single Gauss-Newton step from the fit to
    all rows.

    A log has hundreds of readings per parameter, so without one block the fit stays within the linear range. The step
    that remains with all rows is subtracted, because where a load sticks, derivatives promise a gain that does not
    exist.
    """
    if not problem.observe.long:
        return hold_out_blocks(problem, start, masks, active)
    data = problem.data
    z = np.asarray(start)
    residual, jacobian, observation = problem.observe.at(problem, z, active)
    residual, jacobian, reading = np.asarray(residual), np.asarray(jacobian), np.asarray(observation.reading)
    scale = np.asarray(data.weight / data.sd)
    count = scale.shape[1]
    size = scale.size
    slopes = jacobian[:size].reshape(*scale.shape, -1)
    with np.errstate(invalid="ignore", divide="ignore"):
        per_unit = np.where(scale[..., None] > 0, slopes / scale[..., None], 0.0)
    steps = []
    full_step = -np.linalg.solve(jacobian.T @ jacobian, jacobian.T @ residual)
    for mask in _padded_masks(problem, masks):
        is_kept = np.concatenate([np.repeat(~mask, count), ~mask, np.ones(len(residual) - size - len(mask), bool)])
        kept_jacobian = jacobian[is_kept]
        steps.append(
            -np.linalg.solve(kept_jacobian.T @ kept_jacobian, kept_jacobian.T @ residual[is_kept]) - full_step
        )
    readings = [reading + per_unit @ step for step in steps]
    statuses = [np.asarray(observation.status)] * len(masks)
    return _predictions(problem, masks, readings, statuses, z + np.stack(steps), np.ones(len(masks), bool))


def hold_out_by_kind(problem: Problem, start: np.ndarray, masks: dict[str, Columns]) -> dict[str, HeldOutFits]:
    """Refits without each block of each kind in turn, with the same sds, and predicts the rows that were left out.

    Args:
        problem: problem of the fit to all rows.
        start: its optimum.
        masks: kind → label → mask, from `blocks_of_kind`. Kinds without blocks are missing in the result.
    """
    fits_of_kind = {}
    fits: dict[tuple[bytes, ...], HeldOutFits] = {}  # shared by kinds that divide the rows in the same way
    for kind, blocks in masks.items():
        if blocks:
            parts = tuple(m.tobytes() for m in blocks.values())
            fits[parts] = fits.get(parts) or hold_out_blocks(problem, start, list(blocks.values()))
            fits_of_kind[kind] = dataclasses.replace(fits[parts], labels=tuple(blocks))
    return fits_of_kind
