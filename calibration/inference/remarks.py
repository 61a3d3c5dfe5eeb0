"""What a careful engineer would say of a calibration, one sentence each, read from its result."""

from __future__ import annotations

import numpy as np

from calibration.inference import blocks, priors
from calibration.inference.identifiability import Z95
from calibration.inference.notes import HeldByPrior, Note
from calibration.inference.population import EDGE
from calibration.inference.problem import MARGIN
from calibration.inference.result import CalibrationResult
from mmrjax.signals import DONE, STATUSES

#: Shift from the prior above which the prior or the model is called wrong [prior sd].
FAR = 3.0


def remarks(found: CalibrationResult) -> list[Note | str]:
    """All remarks."""
    return [
        *_noise(found),
        *_search(found),
        *(c.statement for c in found.residual_clusters),
        *_statuses(found),
        *_parameters(found),
        *_limits(found),
        *_blocks(found),
    ]


def _noise(found: CalibrationResult) -> list[str]:
    estimated = [
        f"{c.name.replace('_', ' ')} {found.noise[c.name].estimated_percent:.1f} %"
        for c in found.channels
        if found.noise[c.name].estimated_percent is not None
    ]
    if not estimated:
        return []
    return [
        f"no noise was stated for {', '.join(estimated)}: estimated from the misfit, so it holds model error too and "
        "cannot test whether the model is adequate"
    ]


def _search(found: CalibrationResult) -> list[str]:
    said = []
    if not found.converged:
        said.append("the search did not converge; values and intervals are not to be trusted")
    apart = {n: abs(p.with_steady.apart_in_sd) for n, p in found.parameters.items() if p.with_steady is not None}
    if apart:
        worst = max(apart, key=apart.__getitem__)
        inside = sum(a < Z95 for a in apart.values())
        said.append(
            f"{inside} of {len(apart)} parameters lie within their 95 % intervals of the same problem's optimum with "
            f"steady; furthest apart is {worst}, {apart[worst]:.2f} sd"
        )
    if not found.profiled:
        said.append("no profiles were made: the intervals are linear, and too symmetric where the model is curved")
    if found.starts.agree < len(found.starts.cost):
        said.append(found.starts.statement())
    return said


def _statuses(found: CalibrationResult) -> list[str]:
    return [
        f"rows {_rows(found.status == word)}: {word} with the calibrated robot"
        for k, word in enumerate(STATUSES)
        if k not in DONE and np.any(found.status == word)
    ]


def _parameters(found: CalibrationResult) -> list[Note | str]:
    said: list[Note | str] = [HeldByPrior(found.held_by_prior)] * bool(found.held_by_prior)
    said += [
        f"{name} lies {abs(p.shift):.1f} prior sds from its prior: the prior or the model is wrong"
        for name, p in found.parameters.items()
        if abs(p.shift) > FAR
    ]
    said += [f"{name} is at its {p.at_bound} bound" for name, p in found.parameters.items() if p.at_bound]
    if found.searched is not None:
        said += [
            f"{name}: its posterior mean lies {abs(p.shift):.1f} prior sds from its prior, at the edge of where the "
            "search looked: widen the prior and search again, or doubt the model"
            for name, p in found.parameters.items()
            if EDGE < abs(p.shift) <= FAR and not p.at_bound
        ]
    return said


def _limits(found: CalibrationResult) -> list[str]:
    said = []
    limited = found.adhesion_used > 1 - MARGIN
    if limited.any():
        said.append(
            f"rows {_rows(limited)} use all the adhesion but the margin of {MARGIN:.0%}: the limit holds their "
            "static friction from below, and the slip that they show is not all explained"
        )
    for configuration in found.robot.configurations:
        friction = f"{configuration}.{priors.GUIDE_FRICTION}"
        share = f"{configuration}.{priors.GUIDE_SHARE}"
        if friction in found.parameters and share in found.parameters:
            said.append(f"only the product {friction} x {share} acts; the priors alone divide it")
        elif share in found.parameters:
            said.append(f"{share} is found with {friction} held: only their product acts")
    return said


def _blocks(found: CalibrationResult) -> list[str]:
    said = [
        f"held out by {blocks.in_words(kind)}: {len(held.unreachable_rows)} of {len(found)} rows have no "
        "prediction, because the robot fitted without them slides there; the errors leave them out"
        for kind, held in found.held_out.items()
        if held.unreachable_rows
    ]
    said += [
        f"a search without a block of {kind} did not converge"
        for kind, held in found.held_out.items()
        if not all(block.converged for block in held.blocks.values())
    ]
    return said


def _rows(which: np.ndarray) -> str:
    return ", ".join(str(k + 1) for k in np.flatnonzero(which))
