"""What a name could hide: effects that may be there beside it, as large as would be seen without it.

At the fit with a name, an effect beside it may have any amplitude whose objective rises by no more than `same` [σ²]:
b̂ ± √same sd. Where the largest plausible one of these would by itself, without the name, leave `needed` sigmas, the
name hides it: the two trade against each other.
"""

from __future__ import annotations

import dataclasses

import jax.numpy as jnp
import numpy as np

from calibration.discovery import experiments
from calibration.discovery.active_set import CandidateSpace
from calibration.discovery.adequacy import Diagnosis
from calibration.discovery.candidates import Candidate, fit_candidates, start
from calibration.discovery.classes import Classes
from calibration.discovery.settings import Settings
from calibration.inference.optimizers import informing, linearised

#: Rise of the objective up to which a joint fit is as good [σ²]; effects that are told of; of which an experiment is
#: looked for.
SAME, MOST, ASKED = 4.0, 6, 2


@dataclasses.dataclass(frozen=True)
class Hidden:
    """An effect that the names of a fit could hide.

    Attributes:
        name: of it; amplitude: the largest that could be there [prior sds].
        sigmas: what it would leave by itself [σ].
        experiment: of the menu, the one that would show it, with its expected separation [σ]; "" and 0 for none.
    """

    name: str
    amplitude: float
    sigmas: float
    experiment: str = ""
    separation: float = 0.0


def hidden(
    space: CandidateSpace,
    best: Candidate,
    alike: Classes,
    left: Diagnosis,
    after: Diagnosis,
    settings: Settings,
    *,
    ask: bool,
) -> tuple[Hidden, ...]:
    """Effects that the names of the best candidate could hide, the largest first.

    Args:
        alike: its classes, whose members are listed there; left: what the base leaves; after: what that fit leaves.
        ask: whether experiments that would show them are looked for.
    """
    found, named = [], {n for members in alike.members for n in members}
    for effect in space.library.effects:
        if effect.name in named:
            continue
        m = space.library.best_instance(effect.name, np.asarray(left.scores.left))
        alone, beside = float(left.scores.left[m]), float(after.scores.left[m])
        if beside <= 0 or alone <= 0:
            continue
        centre, spread = float(after.scores.amplitude[m]), np.sqrt(SAME) / beside
        ends = np.clip([centre - spread, centre + spread], -settings.plausible, settings.plausible)
        if effect.dissipative:
            ends = np.maximum(ends, 0.0)
        size = float(ends[np.argmax(np.abs(ends))])
        if abs(size) * alone >= settings.needed and abs(size) * beside <= 2 * np.sqrt(SAME):
            found.append(Hidden(effect.name, size, abs(size) * alone))
    found = sorted(found, key=lambda h: -h.sigmas)[:MOST]
    if not ask or len(best.effects) >= settings.slots:
        return tuple(found)
    return tuple(_shown(space, best, h, after, settings) if k < ASKED else h for k, h in enumerate(found))


def _shown(space: CandidateSpace, best: Candidate, what: Hidden, after: Diagnosis, settings: Settings) -> Hidden:
    """With the experiment that tells the fit with it at its largest from the fit without it."""
    slot = best.active.index("")
    active = tuple(what.name if s == slot else n for s, n in enumerate(best.active))
    (joint,) = fit_candidates(space, [(active, start(space, best, active, settings, after.scores))], settings)
    if not np.isfinite(joint.cost):
        return what
    problem = space.problem(active)
    _, jacobian, _ = linearised(problem, jnp.asarray(joint.z), problem.data)
    informed = np.asarray(jacobian)[informing(problem.data)]
    covariance = np.linalg.inv(informed.T @ informed)
    k = space.free + slot
    move = what.amplitude / settings.width - joint.z[k]
    z = joint.z + covariance[:, k] / covariance[k, k] * move
    moved = dataclasses.replace(joint, z=z, cost=joint.cost + 0.5 * move**2 / covariance[k, k])
    seen = experiments.predict(space, {"without": best, "with": moved}, settings)
    if not seen.experiments:
        return what
    first = experiments.ranked(seen)[0]
    if first.smallest < settings.worth:
        return what
    return dataclasses.replace(what, experiment=first.experiments[0], separation=float(first.smallest))
