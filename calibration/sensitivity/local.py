"""Exact derivatives at the medians of the inputs, effects of single inputs, and inputs without influence."""

from __future__ import annotations

import dataclasses

import jax
import numpy as np
from scipy.stats import qmc

from calibration.data import Columns
from calibration.inference.identifiability import Z95
from calibration.sensitivity.study import Study, source_words
from calibration.sensitivity.uncertain_inputs import UncertainInputs

#: Numbers of random robots and points at which an input must have zero derivatives to count as inert.
LOOKS, PLACES = 4, 12


@dataclasses.dataclass(frozen=True)
class LocalDerivatives:
    """Outputs and derivatives at the medians of the inputs. Arrays of shape (points, inputs), NaN without a value.

    Attributes:
        value: outputs [SI], shape (points,).
        derivative: derivative with respect to each input [SI per unit].
        by_score: derivative with respect to each input's score [SI].
        swing: output with one input at either end of its 95 % interval [SI], shape (2, points, inputs).
    """

    value: Columns
    derivative: Columns
    by_score: Columns
    swing: Columns
    statuses: dict[str, dict[str, int]]


def correlated_directions(inputs: UncertainInputs) -> np.ndarray:
    """Directions in score space. Along each, one input moves by one sd and the others follow by their correlation.

    Each row has length 1. A condition moves along its own score.
    """
    p = len(inputs.parameters)
    identity = np.eye(len(inputs))
    root = inputs.parameters.root
    length = np.linalg.norm(root, axis=1, keepdims=True)
    identity[:p, :p] = root / np.where(length > 0, length, 1.0)
    return identity


def local_derivatives(study: Study) -> LocalDerivatives:
    """Outputs, exact derivatives and swings at each operating point."""
    inputs, points = study.inputs, len(study.points)
    d, centre = len(inputs), np.tile(study.inputs.centre, (points, 1))
    values = study.values_at(centre)
    answer = study.model(values, study.conditions)
    by_columns = study.model.derivatives(values, study.conditions)
    derivative, by_score, swing = {}, {}, {}
    for name, derivatives in by_columns.items():
        finite = np.isfinite(answer.values[name])[:, None]
        derivative[name] = np.where(finite, _derivatives_by_input(inputs, derivatives), np.nan)
        by_score[name] = np.where(finite, derivatives @ inputs.slope, np.nan)
    directions = correlated_directions(inputs)
    p = len(inputs.parameters)
    ends = []
    for side in (-1, 1):
        scores = np.tile(centre[:, None], (1, d, 1))
        scores[:, :p] += side * Z95 * directions[:p]
        for k in range(p, d):
            scores[:, k, k] = 0.5 + side * 0.475
        rows = scores.reshape(-1, d)
        spread = jax.tree.map(lambda x: np.repeat(np.asarray(x), d), study.conditions)
        ends.append({n: x.reshape(points, d) for n, x in study.model(study.values_at(rows), spread).values.items()})
    for name in by_columns:
        swing[name] = np.stack([end[name] for end in ends])
    return LocalDerivatives(answer.values, derivative, by_score, swing, _in_words(answer.counts()))


def _derivatives_by_input(inputs: UncertainInputs, by_columns: np.ndarray) -> np.ndarray:
    """Derivatives with respect to inputs, shape (points, inputs), from those with respect to columns. Tied parameters
    are added to their leader.
    """
    by_inputs = by_columns[:, inputs.places].copy()
    for j, (_, leader, ratio) in enumerate(inputs.parameters.tied):
        by_inputs[:, leader] += ratio * by_columns[:, len(inputs.parameters) + j]
    return by_inputs


def _in_words(counts: dict[str, dict[str, int]]) -> dict[str, dict[str, int]]:
    return {source_words(source): counts_by_status for source, counts_by_status in counts.items()}


def inert_inputs(study: Study, found: LocalDerivatives, seed: int) -> np.ndarray:
    """True for inputs whose derivatives of all outputs are exactly zero at all tested points, shape (inputs,)."""
    streams = np.random.default_rng(seed).spawn(LOOKS)
    unit = np.concatenate([qmc.Sobol(len(study.inputs), scramble=True, rng=rng).random(1) for rng in streams])
    scores = study.inputs.scores(unit)
    moving = np.zeros(len(study.inputs), bool)
    for g in found.derivative.values():  # not scores, which mix the parameters of a posterior
        moving |= (np.nan_to_num(g) != 0).any(0)
    if moving.all():
        return ~moving
    points = np.unique(np.linspace(0, len(study.points) - 1, PLACES).astype(int))
    rows = np.repeat(scores, len(points), 0)
    conditions = jax.tree.map(lambda x: np.tile(np.asarray(x)[points], len(scores)), study.conditions)
    for g in study.model.derivatives(study.values_at(rows), conditions).values():
        moving |= (np.nan_to_num(_derivatives_by_input(study.inputs, g)) != 0).any(0)
    return ~moving
