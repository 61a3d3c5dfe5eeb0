"""Remarks on a calibration that help to judge it, computed from its result."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from calibration.inference import priors
from calibration.inference.fit_notes import Remark
from calibration.inference.population import EDGE
from calibration.inference.problem import MARGIN
from calibration.inference.result import CalibrationResult
from mmrjax.model.signals import DONE, STATUSES

#: Shift from the prior above which a remark calls the prior or the model wrong [prior sd].
FAR = 3.0


def calibration_remarks(found: CalibrationResult) -> Iterator[Remark]:
    """Remarks on noise, search, rows, parameters, limits and held-out blocks."""
    shares = ((c.name, found.noise[c.name].estimated_percent) for c in found.channels)
    if estimated := tuple((name, percent) for name, percent in shares if percent is not None):
        yield Remark("estimated_noise", percent=estimated)
    if not found.converged:
        yield Remark("unsettled", names=found.undetermined)
    if not found.profiled:
        yield Remark("not_profiled")
    if found.starts.agree < len(found.starts.cost):
        yield found.starts.agreement
    yield from (Remark("residual_cluster", cluster=c) for c in found.residual_clusters)
    for k, word in enumerate(STATUSES):
        if k not in DONE and np.any(found.status == word):
            yield Remark("of_rows", rows=row_numbers(found.status == word), what=word)
    yield from _parameter_remarks(found)
    limited = found.adhesion_used > 1 - MARGIN
    if limited.any():
        yield Remark("of_rows", rows=row_numbers(limited), what="limited", share=MARGIN)
    for configuration in found.robot.configurations:
        friction = f"{configuration}.{priors.GUIDE_FRICTION}"
        share = f"{configuration}.{priors.GUIDE_SHARE}"
        if share in found.parameters:
            yield Remark("product_alone", friction=friction, share=share, free=friction in found.parameters)
    for kind, block_errors in found.held_out.items():
        if block_errors.unreachable_rows:
            yield Remark("no_prediction", kind=kind, rows=len(block_errors.unreachable_rows), total=len(found))
    for kind, block_errors in found.held_out.items():
        if not all(block.converged for block in block_errors.blocks.values()):
            yield Remark("block_not_converged", kind=kind)


def _parameter_remarks(found: CalibrationResult) -> Iterator[Remark]:
    far_names = {
        name for name, p in found.parameters.items() if abs(p.shift) > FAR
    }  # these get a remark of their own
    if near_prior := tuple(name for name in found.undetermined if name not in far_names):
        yield Remark("held_by_prior", names=near_prior)
    if pairs := found.together:
        yield Remark("only_together", pairs=pairs)
    for name, p in found.parameters.items():
        if name in far_names:
            yield Remark("far_from_prior", name=name, sds=abs(p.shift), kind="calibration")
    for name, p in found.parameters.items():
        if p.at_bound:
            yield Remark("at_bound", name=name, side=p.at_bound)
    for name, p in found.parameters.items() if found.searched is not None else ():
        if EDGE < abs(p.shift) <= FAR and not p.at_bound:
            yield Remark("far_from_prior", name=name, sds=abs(p.shift), kind="edge")


def row_numbers(which: np.ndarray) -> tuple[int, ...]:
    """Row numbers of a mask, counted from 1."""
    return tuple(int(k) + 1 for k in np.flatnonzero(which))
