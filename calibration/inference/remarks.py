"""Remarks of a careful engineer on a calibration, computed from its result."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from calibration.inference import priors
from calibration.inference.fit_notes import (
    AtBound,
    BesideSteady,
    BlockNotConverged,
    EstimatedNoise,
    Fact,
    FarFromPrior,
    HeldByPrior,
    NoPrediction,
    Note,
    OfRows,
    OnlyTogether,
    ProductAlone,
    SamePredictions,
    Unsettled,
)
from calibration.inference.identifiability import Z95
from calibration.inference.population import EDGE
from calibration.inference.problem import MARGIN
from calibration.inference.result import CalibrationResult
from mmrjax.model.signals import DONE, STATUSES

#: Shift from the prior above which a remark calls the prior or the model wrong [prior sd].
FAR = 3.0


def calibration_remarks(found: CalibrationResult) -> list[Note]:
    """All remarks."""
    return [
        *_noise(found),
        *_search(found),
        *found.residual_clusters,
        *_statuses(found),
        *_parameters(found),
        *_limits(found),
        *_blocks(found),
    ]


def _noise(found: CalibrationResult) -> Iterator[Note]:
    shares = ((c.name, found.noise[c.name].estimated_percent) for c in found.channels)
    if estimated := tuple((name, percent) for name, percent in shares if percent is not None):
        yield EstimatedNoise(estimated)


def _search(found: CalibrationResult) -> Iterator[Note]:
    if not found.converged:
        yield Unsettled(found.undetermined)
    apart = {n: abs(p.with_steady.apart_in_sd) for n, p in found.parameters.items() if p.with_steady is not None}
    if apart:
        worst = max(apart, key=apart.__getitem__)
        yield BesideSteady(sum(a < Z95 for a in apart.values()), len(apart), worst, apart[worst])
    if not found.profiled:
        yield Fact("not profiled")
    if found.starts.agree < len(found.starts.cost):
        yield found.starts.agreement


def _statuses(found: CalibrationResult) -> Iterator[Note]:
    for k, word in enumerate(STATUSES):
        if k not in DONE and np.any(found.status == word):
            yield OfRows(row_numbers(found.status == word), word)


def _parameters(found: CalibrationResult) -> Iterator[Note]:
    far = {name for name, p in found.parameters.items() if abs(p.shift) > FAR}  # these get a remark of their own
    if held := tuple(name for name in found.undetermined if name not in far):
        yield HeldByPrior(held)
    if pairs := found.together:
        yield OnlyTogether(pairs)
    for name, p in found.parameters.items():
        if name in far:
            yield FarFromPrior(name, abs(p.shift), "calibration")
    for name, p in found.parameters.items():
        if p.at_bound:
            yield AtBound(name, p.at_bound)
    for name, p in found.parameters.items() if found.searched is not None else ():
        if EDGE < abs(p.shift) <= FAR and not p.at_bound:
            yield FarFromPrior(name, abs(p.shift), "edge")


def _limits(found: CalibrationResult) -> Iterator[Note]:
    limited = found.adhesion_used > 1 - MARGIN
    if limited.any():
        yield OfRows(row_numbers(limited), "limited", MARGIN)
    for configuration in found.robot.configurations:
        friction = f"{configuration}.{priors.GUIDE_FRICTION}"
        share = f"{configuration}.{priors.GUIDE_SHARE}"
        if share in found.parameters:
            yield ProductAlone(friction, share, free=friction in found.parameters)


def _blocks(found: CalibrationResult) -> Iterator[Note]:
    for kind, held in found.held_out.items():
        if held.unreachable_rows:
            yield NoPrediction(kind, len(held.unreachable_rows), len(found))
    for kind, others in found.held_out_alike.items():
        if others:
            yield SamePredictions(kind, others)
    for kind, held in found.held_out.items():
        if not all(block.converged for block in held.blocks.values()):
            yield BlockNotConverged(kind)


def row_numbers(which: np.ndarray) -> tuple[int, ...]:
    """Row numbers of a mask, from 1."""
    return tuple(int(k) + 1 for k in np.flatnonzero(which))
