"""Readings of rows that a fit has not seen: whole blocks left out, refits in batches of one size."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np

from calibration.inference.optimizers import Optimum
from calibration.inference.problem import Observation, Problem


def search_in_batches(
    problem: Problem,
    starts: Sequence[np.ndarray],
    weights: Sequence[np.ndarray],
    active: Sequence | None = None,
    batch: int | None = None,
) -> tuple[Optimum, Observation]:
    """Fits from any number of starts, each to its own weights, in batches of one size.

    Args:
        starts: coordinates; weights: of the readings, (rows, channels) each; active: sets of effects, None for a
            problem without slots.
        batch: fits in one batch; None takes the observer's.

    Returns:
        Where each search ended, and what the model says of every row there; leading axis the starts.
    """
    batch = batch or problem.observe.policy.batch
    parts = []
    for first in range(0, len(starts), batch):
        chosen = list(range(first, min(first + batch, len(starts))))
        filled = chosen + [chosen[0]] * (batch - len(chosen))
        z, weight = (jnp.asarray(np.stack([np.asarray(xs[k]) for k in filled])) for xs in (starts, weights))
        which = None if active is None else jnp.asarray(np.stack([np.asarray(active[k]) for k in filled]))
        found = jax.device_get(problem.observe.search(problem, z, weight, which))
        parts.append(jax.tree.map(lambda x: x[: len(chosen)], found))  # noqa: B023
    return jax.tree.map(lambda *x: np.concatenate(x), *parts)


@dataclasses.dataclass(frozen=True)
class HeldOutFits:
    """Fits without each block.

    Attributes:
        reading: of each row by the fit that has not seen its block [SI], NaN where no block holds the row or the
            fit does not reach it, shape (rows, channels); status: of each row, -1 where no block holds it.
        block: index of each row's block, -1 for none; shape (rows,).
        z: of each block's fit, shape (blocks, coordinates); converged: whether it is an optimum.
    """

    reading: np.ndarray
    status: np.ndarray
    block: np.ndarray
    z: np.ndarray
    converged: np.ndarray


def held_out(
    problem: Problem, start: np.ndarray, masks: Sequence[np.ndarray], active: Sequence[int] | None = None
) -> HeldOutFits:
    """Refit without each block in turn, and read the rows left out.

    Args:
        problem: as fitted to all rows; start: its optimum; active: its effects, for one with slots.
        masks: of the rows of each block, shape (rows of the table,); the table may be padded behind them.
    """
    rows, weight = len(masks[0]), np.asarray(problem.data.weight)
    out = [np.concatenate([m, np.zeros(len(weight) - rows, bool)]) for m in masks]
    which = None if active is None else [active] * len(masks)
    found, seen = search_in_batches(problem, [start] * len(masks), [weight * ~m[:, None] for m in out], which)
    reading, status = np.full((rows, weight.shape[1]), np.nan), np.full(rows, -1)
    block = np.full(rows, -1)
    for k, mask in enumerate(masks):
        lost = problem.observe.unreachable(np.asarray(seen.status[k]))[:rows, None]
        reading[mask] = np.where(lost, np.nan, seen.reading[k][:rows])[mask]
        status[mask], block[mask] = seen.status[k][:rows][mask], k
    return HeldOutFits(reading, status, block, np.asarray(found.z), np.asarray(found.converged))
