"""Effects that may be present in addition to the named ones, but that the named ones would hide.

At the fit with a name, a further effect may have any amplitude that raises the objective by no more than `same` [σ²]:
b̂ ± √same sd. The name hides the effect if the largest plausible such amplitude, without the name, would change the
readings by `needed` sigmas. The two are then strongly correlated.
"""

from __future__ import annotations

import dataclasses

import jax.numpy as jnp
import numpy as np

from calibration.discovery import experiments
from calibration.discovery.active_set import CandidateSpace
from calibration.discovery.adequacy import Diagnosis
from calibration.discovery.candidates import Candidate, fit_candidates, start_of_fit
from calibration.discovery.classes import Classes
from calibration.discovery.settings import Settings
from calibration.inference.linearization import amplitude_of, amplitude_unit
from calibration.inference.optimizers import informative_residuals, linearise

#: Rise of the objective up to which a joint fit is as good [σ²]; largest number of reported effects; number of them
#: with an experiment.
SAME, MOST, ASKED = 4.0, 6, 2


@dataclasses.dataclass(frozen=True)
class HiddenEffect:
    """An effect that the named effects of a fit could hide.

    Attributes:
        name: name of the effect.
        amplitude: largest amplitude that would stay hidden, in `unit`.
        sigmas: change of the readings by that amplitude, if the named effects were fixed [σ].
        experiment: experiment of the menu that would show it, with its expected separation [σ]. "" and 0 if there is
            none.
    """

    name: str
    amplitude: float
    unit: str
    sigmas: float
    experiment: str = ""
    separation: float = 0.0


def find_hidden_effects(
    space: CandidateSpace,
    best: Candidate,
    alike: Classes,
    left: Diagnosis,
    after: Diagnosis,
    settings: Settings,
    *,
    ask: bool,
) -> tuple[HiddenEffect, ...]:
    """Effects that the named effects of the best candidate could hide, the largest first.

    Args:
        alike: classes of the candidate's effects.
        left: diagnosis of the base fit.
        after: diagnosis of the best fit.
        ask: True to look for experiments that would show the hidden effects.
    """
    hidden_effects, named_effects = [], {n for members in alike.members for n in members}
    for effect in space.library.effects:
        if effect.name in named_effects:
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
            hidden_effects.append(
                HiddenEffect(
                    effect.name, size * amplitude_unit(effect), amplitude_of(effect).spec.unit, abs(size) * alone
                )
            )
    hidden_effects = sorted(hidden_effects, key=lambda h: -h.sigmas)[:MOST]
    if not ask or len(best.effects) >= settings.slots:
        return tuple(hidden_effects)
    return tuple(
        _add_experiment(space, best, h, after, settings) if k < ASKED else h for k, h in enumerate(hidden_effects)
    )


def _add_experiment(
    space: CandidateSpace, best: Candidate, what: HiddenEffect, after: Diagnosis, settings: Settings
) -> HiddenEffect:
    """Adds the experiment that best separates the fit with the largest hidden amplitude from the fit without it."""
    slot, active = best.active.index(""), best.with_effect("", what.name)
    (joint,) = fit_candidates(space, [(active, start_of_fit(space, best, active, settings, after.scores))], settings)
    if not np.isfinite(joint.cost):
        return what
    problem = space.problem(active)
    _, jacobian, _ = linearise(problem, jnp.asarray(joint.z))
    informed = np.asarray(jacobian)[informative_residuals(problem.data)]
    covariance = np.linalg.inv(informed.T @ informed)
    k = space.free + slot
    move = what.amplitude / amplitude_unit(space.library[what.name]) / settings.width - joint.z[k]
    z = joint.z + covariance[:, k] / covariance[k, k] * move
    shifted_fit = dataclasses.replace(joint, z=z, cost=joint.cost + 0.5 * move**2 / covariance[k, k])
    predicted_menu = experiments.predict_menu(space, {"without": best, "with": shifted_fit}, settings)
    if not predicted_menu.experiments:
        return what
    first = experiments.rank_experiments(predicted_menu)[0]
    if first.smallest < settings.worth:
        return what
    return dataclasses.replace(what, experiment=first.experiments[0], separation=float(first.smallest))
