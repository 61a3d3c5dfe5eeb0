"""Mechanisms: which equation lacks something and what drives it, where no exact law stands.

No law is exactly true of a machine, so with precise data every name fails a test of its form. What a mechanism
explains, what it predicts and whether it is found again without parts of the data do not depend on that.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence

import numpy as np

from calibration.data.runs import Runs
from calibration.discovery import prediction
from calibration.discovery.active_set import CandidateSpace
from calibration.discovery.adequacy import Diagnosis
from calibration.discovery.candidates import Candidate
from calibration.discovery.discrepancy import CurveBeside
from calibration.discovery.location import DiscrepancyLocation
from calibration.discovery.notes import Mechanism
from calibration.discovery.prediction import HeldOutScore, Predicted
from calibration.discovery.score_tests import family_columns
from calibration.discovery.settings import Settings
from calibration.discovery.standing import chosen_again
from calibration.inference import bases as bases_room
from calibration.inference import blocks as blocks_room
from calibration.inference.bases import Bases
from calibration.inference.held_out import held_out

#: Share of the largest rms change of a channel by a mechanism from which on it changes a reading [σ over σ].
CHANGED = 0.5
#: Parameters that a curve takes, each of which lowers χ² by one where nothing is missing [σ²].
OF_CURVE = 5.0


def mechanism(
    space: CandidateSpace,
    runs: Runs,
    base: Candidate,
    left: Diagnosis,
    ladder: Sequence[Candidate],
    bases: Bases,
    beside: CurveBeside,
    predicted: Predicted,
    settings: Settings,
) -> Mechanism | None:
    """The mechanism that explains most of what the base leaves: that of effects of one family of the library, or that
    of a smooth curve where none of them explains as much; None of histories where a curve alone does.

    Args:
        left: what the base leaves; ladder: candidates that were fitted; beside: the curve of what the base leaves.
        predicted: what fits predict of data held out, where it is known.
    """
    best, own = _of_one_family(space, ladder), _families_of(beside.where)
    if space.bare.observe.long:  # whose curves take long to fit
        by_curve = beside.where.explained - OF_CURVE
    else:
        by_curve = beside.curve.chi2[0] - beside.curve.chi2[1] - OF_CURVE
    by_effects = {family: 2 * (base.cost - c.cost) for family, c in best.items()}
    explained = by_effects | {own[0]: max(by_curve, by_effects.get(own[0], 0.0))}
    most = max(explained.values())
    within = max(settings.same, settings.form**2 * most)
    alike = sorted((f for f in explained if explained[f] >= most - within), key=lambda f: -explained[f])
    leader = next((f for f in alike if f in best), alike[0])
    alike = [leader, *(f for f in alike if f != leader)]
    kinds = blocks_room.predictable(runs, space.bare)
    blocks = [mask for by in kinds.values() for mask in by.values()]
    long = space.bare.observe.long
    if leader in best and (long or by_effects[leader] >= most / 2):
        first = best[leader]
        effects, seen, reading = first.effects, _held_out(space, runs, first, predicted), _reading(space, first)
        again = chosen_again(space, base, first, left, alike, bases, blocks, settings)
    elif long:
        return None  # refits of histories with a curve take long
    else:
        curve, effects, alike = beside.curve, (), [*alike, *own]
        told = {k: held_out(curve.problem, curve.z, list(by.values())).reading for k, by in kinds.items()}
        seen, reading = _scored(space, runs, told), curve.reading
        again = _curve_again(space, left, bases, alike, blocks, settings)
    changed = _changed(space, runs, _reading(space, base), reading)
    gain = seen.gain(_held_out(space, runs, base, predicted), changed)
    return Mechanism(
        tuple(dict.fromkeys(alike)),
        effects,
        share_of_excess(space, base, explained[leader]),
        gain.mean,
        gain.se,
        again,
    )


def share_of_excess(space: CandidateSpace, base: Candidate, explained: float) -> float:
    """Share of the excess misfit that so much is [-]: of χ² of the base, priors included, less its expectation, the
    number of readings. No more than all: with noise that is stated too large there is less excess than that.

    Args:
        explained: fall of χ² [σ²].
    """
    excess = 2 * base.cost - float(np.sum(space.weight > 0))
    return float(explained / max(excess, explained, 1e-300))


def _of_one_family(space: CandidateSpace, ladder: Sequence[Candidate]) -> dict[str, Candidate]:
    """The best candidate of a plausible size of each family that has the effects of that family alone."""
    found: dict[str, Candidate] = {}
    for c in ladder:
        families = {space.library[name].family() for name in c.effects}
        once = len(set(c.effects)) == len(c.effects)
        if len(families) == 1 and once and c.plausible and np.isfinite(c.cost):
            (family,) = families
            found[family] = min(found.get(family, c), c, key=lambda x: x.cost)
    return found


def _families_of(where: DiscrepancyLocation) -> tuple[str, ...]:
    """The family of a curve, and those of the places and variables over which one is as improbable."""
    places = [dataclasses.replace(where, place=p) for p in where.alike]
    others = [dataclasses.replace(where, variable=v) for v in where.variables_alike]
    return tuple(dict.fromkeys(x.family for x in (where, *places, *others)))


# --- data held out --------------------------------------------------------------------------------------


def _held_out(space: CandidateSpace, runs: Runs, candidate: Candidate, predicted: Predicted) -> HeldOutScore:
    known = predicted.get(prediction.key(candidate))
    if known is not None:
        return _scored(space, runs, known)
    score = prediction.score_of(space, runs, candidate)
    predicted[prediction.key(candidate)] = score.reading
    return score


def _scored(space: CandidateSpace, runs: Runs, reading: dict[str, np.ndarray]) -> HeldOutScore:
    data, rows = space.equipped.data, len(runs)
    measured, sd, counts = (np.asarray(x)[:rows] for x in (data.measured, data.sd, space.weight > 0))
    return prediction.scored(reading, measured, sd, counts, blocks_room.predictable(runs, space.bare))


def _reading(space: CandidateSpace, candidate: Candidate) -> np.ndarray:
    problem, z, active = space.fit_of(candidate.active, candidate.z)
    return np.asarray(problem.observe.observed(problem, z, active).reading)


def _changed(space: CandidateSpace, runs: Runs, before: np.ndarray, after: np.ndarray) -> np.ndarray:
    """Readings that a mechanism changes by at least `CHANGED` of the rms of the channel that it changes most, in sds:
    in the others its gain would be diluted; shape (rows, channels)."""
    rows = len(runs)
    sd, counts = np.asarray(space.bare.data.sd)[:rows], space.weight[:rows] > 0
    moved = np.where(counts, np.abs(after[:rows] - before[:rows]) / sd, 0.0)
    moved = np.nan_to_num(moved)
    most = np.max(np.sqrt(np.sum(moved**2, 0) / np.maximum(counts.sum(0), 1)))
    return np.asarray(counts & (moved >= CHANGED * most))


# --- blocks left out ------------------------------------------------------------------------------------


def _curve_again(
    space: CandidateSpace,
    left: Diagnosis,
    bases: Bases,
    families: Sequence[str],
    blocks: Sequence[np.ndarray],
    settings: Settings,
) -> float:
    """Share of the blocks without which a smooth curve of one of these families still explains as much as any, of
    those that leave half of what is known of it; 1 where there are none."""
    linear, names = left.linear, bases_room.names(bases)
    smooth = [k for k, (_, v) in enumerate(names) if v in bases_room.VARIABLES]
    here = DiscrepancyLocation("", "", (), (), 0.0, 0.0)
    akin = [dataclasses.replace(here, place=names[k][0], variable=names[k][1]).family in families for k in smooth]
    columns = [family_columns(linear, bases, k) for k in smooth]
    jacobian, residual = np.asarray(linear.jacobian), np.asarray(linear.residual)
    explains = _explained_by(jacobian, residual)
    known = [explains(c)[1] for c, mine in zip(columns, akin, strict=True) if mine]
    again = []
    for out in blocks:
        rows = np.concatenate([out, np.zeros(len(space.included) - len(out), bool)])
        kept = np.repeat(~rows, linear.readings // len(rows))
        whole = np.concatenate([kept, np.ones(len(residual) - len(kept), bool)])
        found = [_explained_by(jacobian[whole], residual[whole])(c[kept]) for c in columns]
        mine = [f for f, a in zip(found, akin, strict=True) if a]
        if not mine or max(told for _, told in mine) < 0.5 * max(known):
            continue
        most = max(gain for gain, _ in found)
        again.append(max(gain for gain, _ in mine) >= most - max(settings.same, settings.form**2 * most))
    return float(np.mean(again)) if again else 1.0


def _explained_by(jacobian: np.ndarray, residual: np.ndarray) -> Callable[[np.ndarray], tuple[float, float]]:
    """Of columns over the readings: what they explain together [σ²], and what the fit leaves of them [σ²]."""
    half = np.linalg.solve(np.linalg.cholesky(jacobian.T @ jacobian), jacobian.T)
    left = residual - half.T @ (half @ residual)

    def of(columns: np.ndarray) -> tuple[float, float]:
        inside = half[:, : len(columns)] @ columns
        inner, told = columns.T @ columns - inside.T @ inside, columns.T @ left[: len(columns)]
        return float(told @ np.linalg.lstsq(inner, told, rcond=1e-9)[0]), float(np.trace(inner))

    return of
