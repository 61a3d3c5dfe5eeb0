"""Hold-out fits: each block of rows is predicted by a fit to the other rows."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import jax
import numpy as np

from calibration.data import Names
from calibration.inference.optimizers import Optimum
from calibration.inference.problem import Observation, Problem


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
    z, weight = (np.stack([np.asarray(x) for x in xs]) for xs in (starts, weights))
    active_sets = None if active is None else np.stack([np.asarray(x) for x in active])
    return jax.device_get(problem.observe.search(problem, z, weight, active_sets, most=most))


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
    rows, weight = len(masks[0]), np.asarray(problem.data.weight)
    masks_with_padding = [np.concatenate([m, np.zeros(len(weight) - rows, bool)]) for m in masks]
    active_sets = None if active is None else [active] * len(masks)
    optima, observations = fit_from_each_start(
        problem, [start] * len(masks), [weight * ~m[:, None] for m in masks_with_padding], active_sets
    )
    reading, status = np.full((rows, weight.shape[1]), np.nan), np.full(rows, -1)
    block = np.full(rows, -1)
    for k, mask in enumerate(masks):
        unreachable = problem.observe.unreachable(np.asarray(observations.status[k]))[:rows, None]
        reading[mask] = np.where(unreachable, np.nan, observations.reading[k][:rows])[mask]
        status[mask], block[mask] = observations.status[k][:rows][mask], k
    return HeldOutFits(reading, status, block, np.asarray(optima.z), np.asarray(optima.converged))


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
    rows, start_values = len(masks[0]), np.asarray(start)
    masks_with_padding = [np.concatenate([m, np.zeros(len(problem.data.weight) - rows, bool)]) for m in masks]
    data = problem.data
    residual, jacobian, observation = problem.observe.at(problem, start_values, active)
    residual, jacobian, read = np.asarray(residual), np.asarray(jacobian), np.asarray(observation.reading)
    scale = np.asarray(data.weight / data.sd)
    count, size = scale.shape[1], scale.size
    slopes = jacobian[:size].reshape(*scale.shape, -1)
    with np.errstate(invalid="ignore", divide="ignore"):
        per_unit = np.where(scale[..., None] > 0, slopes / scale[..., None], 0.0)
    unreachable = problem.observe.unreachable(np.asarray(observation.status))
    reading, status = np.full((rows, count), np.nan), np.full(rows, -1)
    block, z = np.full(rows, -1), np.tile(start_values, (len(masks_with_padding), 1))
    promised = -np.linalg.solve(jacobian.T @ jacobian, jacobian.T @ residual)
    for k, mask in enumerate(masks_with_padding):
        kept_residuals = np.concatenate(
            [np.repeat(~mask, count), ~mask, np.ones(len(residual) - size - len(mask), bool)]
        )
        j = jacobian[kept_residuals]
        step = -np.linalg.solve(j.T @ j, j.T @ residual[kept_residuals]) - promised
        z[k] += step
        held_rows = mask[:rows]
        reading[held_rows] = np.where(unreachable[:, None], np.nan, read + per_unit @ step)[:rows][held_rows]
        status[held_rows], block[held_rows] = np.asarray(observation.status)[:rows][held_rows], k
    return HeldOutFits(reading, status, block, z, np.ones(len(masks_with_padding), bool))
