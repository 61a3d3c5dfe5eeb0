"""Blocks of runs that belong together, and what fits without them say of them."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np

from calibration.data.columns import CURRENT, LOAD, SPEED
from calibration.data.courses import varies
from calibration.data.runs import Runs
from calibration.inference import held_out as refits
from calibration.inference.problem import Problem

#: What a block is named after, and the columns that tell its blocks apart.
BLOCKS: dict[str, tuple[str, ...]] = {
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
#: And after how sharp a turn is.
TURN = "turn"


def in_words(by: str, joint: str = " and ") -> str:
    """What a block is named after, in words; `joint` joins two conditions."""
    for one in ("motor_speed", "load_torque"):
        by = by.replace(one, one.replace("_", " "))
    return by.replace("_", joint)


#: Columns of blocks that are labels.
NO_CONDITIONS = ("configuration", "run_id")
#: Those whose values have no levels, or are measured.
GRADED = (SPEED, CURRENT, LOAD, "duty")
#: Share of a value by which the next has to be larger to be of another level [-]: a speed, current or torque that is
#: controlled is measured, and not twice the same. Blocks of a quantity that has no levels.
APART, PARTS = 0.1, 4


def levels(x: np.ndarray) -> np.ndarray:
    """Every number's level, the median of those about as large, to four digits; parts of about as many numbers where
    they go on without a gap."""
    order = np.argsort(x, kind="stable")
    step = np.diff(x[order])
    group = np.concatenate([[0], np.cumsum(step > APART * np.abs(x[order][:-1]))])
    if group[-1] == 0 and np.ptp(x) > 2 * APART * PARTS * np.max(np.abs(x)):
        group = np.arange(len(x)) * PARTS // len(x)
    level = np.array([float(f"{np.median(x[order][group == g]):.4g}") for g in group])
    found = np.empty(len(x))
    found[order] = level
    return found


def sharpness(runs: Runs) -> dict[str, np.ndarray]:
    """Label → mask of its rows, of `PARTS` parts from turns on the spot to straight travel: what drives the slower
    side over what drives the faster one, -1 to 1."""
    slow, fast = np.sort(np.abs(runs.of_sides), 0)
    share = np.round(slow / np.maximum(fast, 1e-12) * np.sign(np.prod(runs.of_sides, 0)), 6)
    part = np.searchsorted(np.sort(share), share) * PARTS // len(share)
    rows = [part == k for k in np.unique(part)]
    return {f"{share[mine].min():.2g} to {share[mine].max():.2g}": mine for mine in rows} if len(rows) > 1 else {}


def blocks(runs: Runs, by: str) -> dict[str, np.ndarray]:
    """Label → mask of its rows, for each block of `by`; empty where the data do not vary in it.

    A run of a history in which it changes is a block of its own; empty where that is all that there is.
    """
    if by == TURN:
        return sharpness(runs) if runs.turns else {}
    columns = [c for c in BLOCKS[by] if runs.has(c) and (c in NO_CONDITIONS or c in runs.axes)]
    if len(columns) < len(BLOCKS[by]):
        return {}
    if by == "voltage_configuration" and not runs.layout.complete and len(np.unique(runs["configuration"])) == 1:
        return {}  # those of `voltage`
    values = {c: levels(runs[c]) if c in GRADED else runs[c] for c in columns}
    labels = np.array([" ".join(str(values[c][k]) for c in columns) for k in range(len(runs))])
    changes = varies(runs, BLOCKS[by])
    if changes.all() and by != "run":
        return {}
    labels = np.where(changes, np.char.add("run ", runs.run_names.astype(str)), labels)
    names = list(dict.fromkeys(labels))
    single = by == "run" and len(names) == len(runs)  # rows that have nothing in common with others
    return {name: labels == name for name in names} if len(names) > 1 and not single else {}


def distinct(runs: Runs, kinds: Sequence[str]) -> dict[str, dict[str, np.ndarray]]:
    """Kind → blocks, of the kinds that the data have, less those that divide the rows as an earlier one does."""
    found: dict[str, dict[str, np.ndarray]] = {}
    divided = []
    for kind in kinds:
        by = blocks(runs, kind)
        parts = {m.tobytes() for m in by.values()}
        if parts not in divided:
            divided.append(parts)
            found[kind] = by
    return {kind: by for kind, by in found.items() if by}


def predictable(runs: Runs, problem: Problem) -> dict[str, dict[str, np.ndarray]]:
    """Kind → blocks as of `distinct`, of the kinds of a problem's observer, without those that the other rows cannot
    predict: a block that holds every row of a configuration with free parameters of its own."""
    names = runs.configurations_named(problem.base)
    coordinates = problem.coordinates
    informs = [{_owner(name, names)} for name in coordinates.names]
    for follower, k, _ in coordinates.tied:
        informs[k].add(_owner(follower, names))
    owned = [np.isin(names, list(owners)) for owners in informs if "" not in owners]
    kinds = {
        kind: {label: m for label, m in by.items() if not any(m[mine].all() for mine in owned)}
        for kind, by in distinct(runs, problem.observe.blocks).items()
    }
    return {kind: by for kind, by in kinds.items() if by}


def unpredictable(runs: Runs, problem: Problem) -> tuple[str, ...]:
    """Kinds of blocks of which the other rows cannot predict some or all."""
    every, told = distinct(runs, problem.observe.blocks), predictable(runs, problem)
    return tuple(kind for kind, by in every.items() if len(told.get(kind, {})) < len(by))


def _owner(parameter: str, configurations: np.ndarray) -> str:
    """The configuration that a parameter belongs to, of those of a table's rows; empty for none."""
    first = parameter.partition(".")[0]
    return first if first in configurations else ""


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


def held_out(problem: Problem, start: np.ndarray, masks: dict[str, dict[str, np.ndarray]]) -> dict[str, HeldOut]:
    """Refit without each block of each kind in turn (the sds as given), and read the rows left out.

    Args:
        problem: as fitted to all rows; start: its optimum.
        masks: kind → label → mask, from `blocks`; kinds without blocks are left out of the answer.
    """
    answers = {}
    fits: dict[tuple[bytes, ...], refits.HeldOutFits] = {}  # of kinds that divide the rows alike, the same
    for kind, by in masks.items():
        if by:
            parts = tuple(m.tobytes() for m in by.values())
            seen = fits[parts] = fits.get(parts) or refits.held_out(problem, start, list(by.values()))
            answers[kind] = HeldOut(tuple(by), seen.block, seen.reading, seen.status, seen.z, seen.converged)
    return answers
