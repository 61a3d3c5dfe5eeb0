"""Hold-out predictions of sets of effects, and the choice of a set by them.

One score serves all: the log density of each reading for each kind of block, by a fit without its block.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Bool, Float

from calibration.data import Columns, Names
from calibration.data.runs import Runs
from calibration.discovery.active_set import CandidateSpace
from calibration.discovery.candidates import Candidate
from calibration.inference import blocks as blocks_room
from calibration.inference.blocks import predict_unseen
from calibration.inference.problem import Observation, Problem

#: Degrees of freedom of Student's t for the score of a reading, so that a single outlier does not decide.
FREEDOM = 4.0
#: Error assigned to a reading without a prediction, because its robot slides or fails there [σ].
UNREACHED = 12.0
#: Largest loss of a written fit's predictions compared with the refit's [nat a reading].
WORSE = 0.05

Readings = Float[np.ndarray, "rows channels"]


@dataclasses.dataclass(frozen=True)
class HeldOutScore:
    """Hold-out scores of a fit: log densities of readings that were left out of the fit.

    Attributes:
        by_kind: kind of block → log density of each reading, NaN if excluded, shape (rows, channels).
        blocks: kind of block → index of the block of each row, -1 for none.
        reading: kind of block → hold-out predictions of the readings.
    """

    by_kind: dict[str, Readings]
    blocks: Columns
    reading: dict[str, Readings] = dataclasses.field(default_factory=dict)

    def only(self, kind: str) -> HeldOutScore:
        """Scores for one kind of block."""
        return HeldOutScore({kind: self.by_kind[kind]}, {kind: self.blocks[kind]})

    def gain(
        self, baseline: HeldOutScore, selected: Bool[np.ndarray, "rows channels"] | None = None, fewest: int = 2
    ) -> Gain:
        """Gain of this score over another one, over the readings that both have.

        Args:
            selected: True for readings that count. None: all.
            fewest: smallest number of blocks whose scatter gives a standard error. Two blocks have one degree of
                freedom.
        """
        if not self.by_kind:
            return Gain(0.0, np.inf)
        gains = np.stack([x - baseline.by_kind[kind] for kind, x in self.by_kind.items()])
        gains = gains if selected is None else np.where(selected, gains, np.nan)
        scored = np.isfinite(gains)
        counts = scored.sum((0, 2))
        rows = counts > 0
        total = int(counts.sum())
        if not total:
            return Gain(0.0, np.inf)
        mean = float(np.nansum(gains) / total)
        # Errors by row, and by block of each kind, because readings of a block share the rows that were left out.
        deviations = np.nansum(gains, (0, 2)) - mean * counts
        block_groups = [block for block in self.blocks.values() if len(np.unique(block[block >= 0])) >= fewest]
        groups = [np.arange(len(rows)), *block_groups]
        return Gain(mean, max(_clustered_standard_error(deviations[rows], block[rows]) for block in groups) / total)


@dataclasses.dataclass(frozen=True)
class Gain:
    """Difference of two hold-out scores and its standard error [nat per reading].

    Attributes:
        errors: standard error for each kind of block if `se` is their mean, otherwise empty.
    """

    mean: float
    se: float
    errors: Mapping[str, float] = dataclasses.field(default_factory=dict)


def _clustered_standard_error(terms: np.ndarray, groups: np.ndarray) -> float:
    """Standard error of a sum whose terms are correlated within groups."""
    _, cluster_index = np.unique(groups, return_inverse=True)
    count = cluster_index.max() + 1
    sums = np.bincount(cluster_index, terms)
    return float(np.sqrt(np.sum(sums**2) * count / (count - 1))) if count > 1 else 0.0


def score_readings(
    reading: dict[str, Readings],
    measured: Readings,
    sd: Readings,
    included: Bool[np.ndarray, "rows channels"],
    kinds: Mapping[str, Columns],
) -> HeldOutScore:
    """Scores hold-out predictions by their log density.

    Args:
        reading: kind of block → prediction of each row by a fit without its block, NaN for none.
        included: True for included readings.
        kinds: kind of block → label of each block → mask of its rows.
    """
    by_kind, blocks = {}, {}
    norm = math.lgamma((FREEDOM + 1) / 2) - math.lgamma(FREEDOM / 2) - 0.5 * math.log(FREEDOM * math.pi)
    for kind, blocks_by_name in kinds.items():
        block = np.full(len(measured), -1)
        for k, mask in enumerate(blocks_by_name.values()):
            block[mask] = k
        deviation = (reading[kind] - measured) / sd
        deviation = np.where(np.isfinite(deviation), deviation, UNREACHED)
        density = norm - np.log(sd) - (FREEDOM + 1) / 2 * np.log1p(deviation**2 / FREEDOM)
        by_kind[kind] = np.where(included & (block >= 0)[:, None], density, np.nan)
        blocks[kind] = block
    return HeldOutScore(by_kind, blocks, reading)


def masks_of_blocks(kinds: Mapping[str, Columns]) -> list[np.ndarray]:
    """Masks of the rows of all blocks of all kinds."""
    return [mask for blocks_by_name in kinds.values() for mask in blocks_by_name.values()]


#: `candidate_key` of a candidate → kind of block → hold-out predictions of each row.
Predicted = dict[tuple[Names, bytes], dict[str, Readings]]


def candidate_key(candidate: Candidate) -> tuple[Names, bytes]:
    """Key under which the hold-out predictions of a candidate are cached."""
    return candidate.active, np.asarray(candidate.z).tobytes()


def score_predictions(space: CandidateSpace, runs: Runs, reading: Columns) -> HeldOutScore:
    """Hold-out scores of readings that were predicted for each kind of block."""
    data, rows = space.equipped.data, len(runs)
    measured, sd, included = (np.asarray(x)[:rows] for x in (data.measured, data.sd, space.weight > 0))
    return score_readings(reading, measured, sd, included, blocks_room.predictable_blocks(runs, space.bare))


def cached_hold_out_score(
    space: CandidateSpace, runs: Runs, candidate: Candidate, predicted: Predicted
) -> HeldOutScore:
    """Hold-out scores of a candidate. Its predictions come from `predicted` or are added to it."""
    key = candidate_key(candidate)
    if key not in predicted:
        fit = FittedProblem(*space.fit_of(candidate.active, candidate.z))
        predicted[key] = fit.held_out(blocks_room.predictable_blocks(runs, space.bare))
    return score_predictions(space, runs, predicted[key])


def smallest_predictive_set(
    space: CandidateSpace,
    runs: Runs,
    base: Candidate,
    path: Sequence[Candidate],
    predicted: Predicted,
) -> Candidate | None:
    """Smallest set of effects whose hold-out score is within one standard error of the best (Breiman et al. 1984,
    sec. 3.4.3).

    None if that set is empty, or if no block can be held out.

    Args:
        path: candidates ordered by their number of effects.
        predicted: cache of hold-out predictions. This function adds to it.
    """
    if not blocks_room.predictable_blocks(runs, space.bare):
        return None
    candidates = [base, *path]
    scores = [cached_hold_out_score(space, runs, c, predicted) for c in candidates]
    best = max(scores, key=lambda score: score.gain(scores[0]).mean)
    for candidate, score in zip(candidates, scores, strict=True):
        behind = best.gain(score)
        if behind.mean <= behind.se or score is best:
            return None if candidate is base else candidate
    return None


@dataclasses.dataclass(frozen=True)
class ReadingsOfRows:
    """Readings of all rows [SI], shape (rows, channels), NaN if missing.

    Attributes:
        measured, sd: measured readings and their standard deviations.
        as_stated: simulated by the robot before any fit, at its prior means.
        before, after: simulated by the base and by the proposed robot, fitted to all rows.
        held_out: kind of block → readings (before, after), where each row is predicted by fits without its block.
        blocks: kind of block → label of each row's block.
    """

    measured: np.ndarray
    sd: np.ndarray
    as_stated: np.ndarray
    before: np.ndarray
    after: np.ndarray
    held_out: dict[str, tuple[np.ndarray, np.ndarray]]
    blocks: dict[str, Names]


@dataclasses.dataclass(frozen=True)
class FittedProblem:
    """A problem with the coordinates of its fit and the active effects (None without slots)."""

    problem: Problem
    z: np.ndarray
    active: tuple[int, ...] | None

    def observation(self) -> Observation:
        """Simulated observation at the fit."""
        return self.problem.observe.observation_at(self.problem, self.z, self.active)

    def held_out(self, kinds: Mapping[str, Columns]) -> dict[str, Readings]:
        """Prediction of each row by fits without its block, for each kind of block."""
        return {
            kind: predict_unseen(self.problem, self.z, list(blocks_by_name.values()), self.active).reading
            for kind, blocks_by_name in kinds.items()
        }


def readings_of_rows(
    runs: Runs,
    sd: np.ndarray,
    kinds: Mapping[str, Columns],
    before: FittedProblem,
    after: FittedProblem | None,
    known_before: Columns | None = None,
    known_after: Columns | None = None,
) -> ReadingsOfRows:
    """Simulated readings of both fits for all rows, fitted and held out for each kind of block. `after` = None: both
    are equal.

    Args:
        kinds: blocks from `blocks.predictable_blocks`.
        known_before, known_after: hold-out readings, if they are already known.
    """

    def fitted_reading(fitted: FittedProblem) -> np.ndarray:
        observation = fitted.observation()
        unreachable = fitted.problem.observe.unreachable(np.asarray(observation.status))[: len(runs), None]
        return np.where(unreachable, np.nan, np.asarray(observation.reading)[: len(runs)])

    held_out_before = held_out_after = before.held_out(kinds) if known_before is None else known_before
    if after is not None:
        held_out_after = after.held_out(kinds) if known_after is None else known_after
    stated_reading = fitted_reading(dataclasses.replace(before, z=np.zeros_like(before.z)))
    fitted = fitted_reading(before)
    return ReadingsOfRows(
        runs.measured(), sd[: len(runs)], stated_reading, fitted, fitted if after is None else fitted_reading(after),
        {kind: (held_out_before[kind], held_out_after[kind]) for kind in kinds},
        {kind: tuple(names) for kind, names in kinds.items()},
    )  # fmt: skip
