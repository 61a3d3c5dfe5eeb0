"""Ranking of the effects on the equations of a log in weak form, before any simulation.

A signature is the derivative of an equation by an amplitude. It ranks every effect in milliseconds, as the inverse
dynamic identification model of Gautier and Khalil (1990) does with torques. The regression also gives the start of
the fit of the base.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np

from calibration.discovery.active_set import CandidateSpace
from calibration.discovery.candidates import Candidate, candidate_of_fit, empty_slots
from calibration.discovery.score_tests import ABSORBED, ScoreTable
from calibration.discovery.settings import Settings
from calibration.inference.optimizers import Optimum
from calibration.inference.weak_form import fit_weak_form


@dataclasses.dataclass(frozen=True)
class WeakFormScreening:
    """Results from a log's equations in weak form, before any simulation.

    Attributes:
        base: fit without effects, by regression.
        slides: True if the load may slide on its ground: the equations do not show sliding, so a search must not
            start there.
        scores: score of every instance.
        windows: number of equations.
        null: square root of the strongest score of bootstrap tables without a missing effect [σ], shape
            (replicates,).
    """

    base: Candidate
    slides: bool
    scores: ScoreTable
    windows: int
    null: np.ndarray


def screen_by_weak_form(space: CandidateSpace, settings: Settings) -> WeakFormScreening | None:
    """Fits base parameters and effects by regression on a log's equations in weak form. None if the log does not show
    its states (`fit_weak_form`).
    """
    problem = space.bare
    equations = fit_weak_form(problem, space.library.scored) if problem.observe.long else None
    if equations is None:
        return None
    q = np.linalg.qr(equations.jacobian)[0]
    columns = np.concatenate([equations.signatures, np.zeros((space.free, equations.signatures.shape[1]))])
    projected = columns - q @ (q.T @ columns)
    norm = np.linalg.norm(projected, axis=0)
    is_visible = norm > ABSORBED * np.maximum(np.linalg.norm(columns, axis=0), 1e-300)
    ways = np.where(is_visible, projected / np.where(is_visible, norm, 1.0), 0.0)
    single = -ways.T @ equations.residual
    none = np.zeros(0)
    amplitude = np.where(is_visible, single / np.where(is_visible, norm, 1.0), 0.0)
    parts: tuple[Any, ...] = (single, amplitude, norm, none, ways.T @ ways, *[none] * 4)
    scores = ScoreTable(*parts)
    random = np.random.default_rng(settings.seed)
    null = np.max(np.abs(random.standard_normal((settings.replicates, len(ways))) @ ways), 1)
    slots = np.zeros(2 * settings.slots)
    sd = np.sqrt(np.diag(np.linalg.inv(equations.jacobian.T @ equations.jacobian)))
    z, sd = np.concatenate([equations.z, slots]), np.concatenate([sd, slots + 1])
    cost = np.asarray(0.5 * np.sum(equations.residual**2))
    of_fit: tuple[Any, ...] = (z, sd, np.zeros((0, 0)), cost, np.asarray(0.0), np.asarray(True), np.asarray(0))
    optimum = Optimum(*of_fit)
    base = dataclasses.replace(candidate_of_fit(space, empty_slots(settings), optimum, settings), simulated=False)
    slides = problem.base.has_ground and problem.base.rig.imposed == "voltage"
    return WeakFormScreening(base, slides, scores, equations.windows, null)
