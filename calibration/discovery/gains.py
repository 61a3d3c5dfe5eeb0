"""Hold-out gains of a mechanism: by effects of a family, and by a smooth curve."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence

import numpy as np

from calibration.data import Columns, Names
from calibration.data.runs import Runs
from calibration.discovery import prediction
from calibration.discovery.active_set import CandidateSpace
from calibration.discovery.candidates import Candidate, simulated_reading
from calibration.discovery.discrepancy import BaseCurve, location_columns
from calibration.discovery.prediction import Gain, HeldOutScore, Predicted, cached_hold_out_score
from calibration.discovery.score_tests import augment_with_columns
from calibration.discovery.smooth import fit_smooth_curve
from calibration.discovery.standing import kept_readings
from calibration.inference import bases as bases_room
from calibration.inference import blocks as blocks_room
from calibration.inference.bases import place_signature

#: A reading counts if the mechanism changes it by at least this share of the largest rms change of a channel [-].
CHANGED = 0.5
#: Fewest blocks of a kind for an error of a gain from their scatter.
BLOCKS = 3


def best_hold_out_gain(
    space: CandidateSpace,
    runs: Runs,
    ladder: Sequence[Candidate],
    best: Candidate,
    base: Candidate,
    pair: tuple[Candidate, Candidate],
    predicted: Predicted,
) -> tuple[Names, Gain]:
    """Most certain hold-out gain by effects of a family, and these effects.

    Args:
        best: best candidate of the family. If it has several effects, a single one may predict better.
        pair: fits with and without the family that differ most.
    """
    family = space.library[best.effects[0]].family()
    single = [c for c in ladder if len(c.effects) == 1 and space.library[c.effects[0]].family() == family]
    plausible = [c for c in single if c.plausible and np.isfinite(c.cost)] if len(best.effects) > 1 else []
    sets = [best, *([min(plausible, key=lambda c: c.cost)] if plausible else [])]
    fits = {(c.key, base.key): (c, base) for c in sets}
    fits.setdefault((pair[0].key, pair[1].key), pair)
    gains = []
    for with_family, without_family in fits.values():
        score, score_without = (
            cached_hold_out_score(space, runs, c, predicted) for c in (with_family, without_family)
        )
        changed = _changed_readings(
            space, runs, *(simulated_reading(space, c) for c in (without_family, with_family))
        )
        gains.append((with_family, _gain_over_changed(score, score_without, changed)))
    with_family, gain = max(gains, key=lambda one: one[1].mean / max(one[1].se, 1e-12))
    return tuple(n for n in with_family.effects if space.library[n].family() == family), gain


def _gain_over_changed(score: HeldOutScore, baseline: HeldOutScore, changed: np.ndarray) -> Gain:
    """Gain of one hold-out score over another, over the changed readings only.

    The kinds of blocks leave out the same readings, so their errors are correlated. The standard error is therefore
    the mean over the kinds, weighted by readings.
    """
    kinds = score.by_kind
    if not kinds:
        return Gain(0.0, np.inf)
    by_kind = {k: score.only(k).gain(baseline.only(k), changed, BLOCKS) for k in kinds}
    weight = {k: float(np.sum(changed & np.isfinite(kinds[k] - baseline.by_kind[k]))) for k in kinds}
    total_weight = sum(weight.values())
    if not total_weight:
        return Gain(0.0, np.inf)
    mean, se = (
        sum(weight[k] / total_weight * getattr(by_kind[k], x) for k in kinds if weight[k]) for x in ("mean", "se")
    )
    return Gain(mean, se, {k: gain.se for k, gain in by_kind.items()})


def hold_out_gain_of_curve(base_curve: BaseCurve, runs: Runs, predicted: Predicted) -> Gain:
    """Hold-out gain by the smooth curve of the base's discrepancy.

    Only rows within the range of the curve's variable in each fit count, because a curve does not extrapolate.
    """
    space, base, curve = base_curve.space, base_curve.base, base_curve.fitted
    kinds = blocks_room.predictable_blocks(runs, space.bare)
    predictions = prediction.FittedProblem(curve.problem, curve.z, None).held_out(kinds)
    changed = _changed_readings(space, runs, simulated_reading(space, base), curve.reading)
    score = _within_range(base_curve, prediction.score_predictions(space, runs, predictions), kinds)
    return _gain_over_changed(score, cached_hold_out_score(space, runs, base, predicted), changed)


def _within_range(base_curve: BaseCurve, score: HeldOutScore, kinds: Mapping[str, Columns]) -> HeldOutScore:
    """The hold-out score without rows outside the range of the curve's variable in their fit."""
    rows_in_range = {kind: _rows_in_range(base_curve, list(by_name.values())) for kind, by_name in kinds.items()}
    return dataclasses.replace(
        score, by_kind={kind: np.where(rows_in_range[kind][:, None], x, np.nan) for kind, x in score.by_kind.items()}
    )


def linear_gain_of_curve(base_curve: BaseCurve, runs: Runs, _: Predicted) -> Gain:
    """The gain of `hold_out_gain_of_curve` for a log, to first order at the base fit.

    A simulated fit of a curve takes minutes, and windows have no simulation. A wave has its own phase in each run, so
    only parts of runs can be predicted. Beyond the range that a fit saw, the curve is level: later readings remember
    the error of an extrapolation.
    """
    space, linear, location, rows = base_curve.space, base_curve.left.linear, base_curve.where, len(runs)
    kinds = blocks_room.predictable_blocks(runs, space.bare)
    if location.variable in bases_room.ORDERS:
        kinds = {blocks_room.PART: blocks_room.parts_of_runs(runs)}

    jacobian, residual = np.asarray(linear.jacobian), np.asarray(linear.residual)

    def curve_columns(included: np.ndarray) -> np.ndarray:
        if location.variable not in bases_room.VARIABLES:
            return location_columns(linear, base_curve.bases, location)
        curve = fit_smooth_curve(linear, location.place, location.variable, included)
        x, way = linear.curve_variable(location.place, location.variable)
        return curve.scale * place_signature(linear, location.place, way[:, None] * curve.basis(x)) @ curve.root

    def residuals(left_out: np.ndarray, with_curve: bool) -> np.ndarray:
        included = space.included & ~np.append(left_out, np.zeros(len(space.included) - rows, bool))
        a, e = augment_with_columns(linear, curve_columns(included)) if with_curve else (jacobian, residual)
        kept_rows = np.append(
            kept_readings(space, left_out, linear.readings), np.ones(len(e) - linear.readings, bool)
        )
        z = np.linalg.lstsq(a[kept_rows], -e[kept_rows], rcond=None)[0]
        return (e + a @ z)[: linear.readings].reshape(len(space.included), -1)[:rows]

    def score(with_curve: bool) -> HeldOutScore:
        zeros = np.zeros((rows, linear.readings // len(space.included)))
        errors = {
            kind: sum(
                (np.where(left_out[:, None], residuals(left_out, with_curve), 0.0) for left_out in masks.values()),
                zeros,
            )
            for kind, masks in kinds.items()
        }
        return prediction.score_readings(errors, zeros, zeros + 1.0, space.weight[:rows] > 0, kinds)

    sd, no_rows = np.asarray(space.bare.data.sd)[:rows], np.zeros(rows, bool)
    changed = _changed_readings(space, runs, sd * residuals(no_rows, False), sd * residuals(no_rows, True))
    return _gain_over_changed(_within_range(base_curve, score(True), kinds), score(False), changed)


def _rows_in_range(base_curve: BaseCurve, masks: Sequence[np.ndarray]) -> np.ndarray:
    """True for rows whose value of the curve's variable is within the range of the rows outside their block, shape
    (rows,).

    Args:
        masks: mask of the rows of each block.
    """
    included, location, linear = base_curve.space.included, base_curve.where, base_curve.left.linear
    rows = len(masks[0])
    in_range = np.ones(rows, bool)
    if location.variable not in bases_room.VARIABLES:
        return in_range
    x = np.asarray(linear.curve_variable(location.place, location.variable)[0], float)
    if len(x) != len(included):  # turns, with different sides
        return in_range
    for mask in masks:
        others = x[:rows][included[:rows] & ~mask]
        if len(others):
            in_range[mask] = (x[:rows][mask] >= others.min()) & (x[:rows][mask] <= others.max())
    return in_range


def _changed_readings(space: CandidateSpace, runs: Runs, before: np.ndarray, after: np.ndarray) -> np.ndarray:
    """True for readings that a mechanism changes noticeably, shape (rows, channels).

    The change in sds is at least `CHANGED` of the rms change of the most changed channel. Other readings would dilute
    the gain of the mechanism.
    """
    rows = len(runs)
    sd, counts = np.asarray(space.bare.data.sd)[:rows], space.weight[:rows] > 0
    reading_changes = np.where(counts, np.abs(after[:rows] - before[:rows]) / sd, 0.0)
    reading_changes = np.nan_to_num(reading_changes)
    largest_change = np.max(np.sqrt(np.sum(reading_changes**2, 0) / np.maximum(counts.sum(0), 1)))
    return np.asarray(counts & (reading_changes >= CHANGED * largest_change))
