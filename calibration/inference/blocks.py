"""Errors on data that a fit has not seen: whole blocks left out, every refit in one vmapped batch."""

from __future__ import annotations

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from calibration.data.runs import Runs
from calibration.inference import optimizers as fit
from calibration.inference.problem import Data, Observation, Problem

#: What a block is named after, and the columns that tell its blocks apart.
BLOCKS: dict[str, tuple[str, ...]] = {
    "slope": ("slope_deg",),
    "voltage": ("supply_voltage_V",),
    "payload": ("payload_kg",),
    "configuration": ("configuration",),
    "voltage_configuration": ("configuration", "supply_voltage_V"),
    "run": ("run_id",),
}


def blocks(runs: Runs, by: str) -> dict[str, np.ndarray]:
    """Label → mask of its rows, for each block of `by`; empty where the data do not vary in it."""
    columns = [c for c in BLOCKS[by] if runs.has(c)]
    if len(columns) < len(BLOCKS[by]):
        return {}
    labels = np.array([" ".join(str(runs[c][k]) for c in columns) for k in range(len(runs))])
    names = list(dict.fromkeys(labels))
    return {name: labels == name for name in names} if len(names) > 1 else {}


@dataclasses.dataclass(frozen=True)
class HeldOut:
    """Readings that each row gets from the fit that has not seen its block.

    Attributes:
        labels: of the blocks.
        block: index of each row's block, shape (rows,).
        reading: [SI], NaN where that fit's robot does not reach the row, shape (rows, channels).
        status: of each row, shape (rows,).
        z: of each block's fit, shape (blocks, parameters).
        converged: of each block's fit.
    """

    labels: tuple[str, ...]
    block: np.ndarray
    reading: np.ndarray
    status: np.ndarray
    z: np.ndarray
    converged: np.ndarray


@eqx.filter_jit
def _refit(problem: Problem, start: Array, data: Data, weights: Array) -> tuple[fit.Optimum, Observation]:
    def one(weight: Array) -> tuple[fit.Optimum, Observation]:
        found = fit.levenberg_marquardt(problem, start, dataclasses.replace(data, weight=weight))
        return found, problem.observation(found.z)

    return jax.vmap(one)(weights)


def held_out(problem: Problem, start: Array, masks: dict[str, dict[str, np.ndarray]]) -> dict[str, HeldOut]:
    """Refit without each block of each kind in turn (the sds as given), and read the rows left out.

    Args:
        problem: as fitted to all rows; start: its optimum.
        masks: kind → label → mask, from `blocks`; kinds without blocks are left out of the answer.
    """
    masks = {kind: blocks for kind, blocks in masks.items() if blocks}
    if not masks:
        return {}
    left_out = np.stack([mask for blocks in masks.values() for mask in blocks.values()])
    weights = jnp.asarray(np.asarray(problem.data.weight) * ~left_out[:, :, None])
    found, seen = _refit(problem, start, problem.data, weights)
    answers, first = {}, 0
    for kind, kind_blocks in masks.items():
        part = slice(first, first + len(kind_blocks))
        block, rows = left_out[part].argmax(0), np.arange(left_out.shape[1])
        status = np.asarray(seen.status)[part][block, rows]
        reading = np.asarray(seen.reading)[part][block, rows]
        reading = np.where(problem.observe.unreachable(status)[:, None], np.nan, reading)
        answers[kind] = HeldOut(
            tuple(kind_blocks), block, reading, status, np.asarray(found.z)[part], np.asarray(found.converged)[part]
        )
        first = part.stop
    return answers
