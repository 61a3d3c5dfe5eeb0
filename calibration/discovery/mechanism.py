"""Mechanisms: equation and driving variable of a discrepancy, if no exact law is established.

No law is exactly true of a machine, so with precise data every name fails a test of its form. The share that a
mechanism explains, its predictions, and its repetition without parts of the data do not depend on the exact form.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence

import numpy as np

from calibration.data import Columns, Names
from calibration.data.runs import Runs
from calibration.discovery import prediction
from calibration.discovery.active_set import CandidateSpace
from calibration.discovery.adequacy import Diagnosis
from calibration.discovery.candidates import Candidate
from calibration.discovery.classes import errors_of_ammeters
from calibration.discovery.discrepancy import BaseCurve, location_columns
from calibration.discovery.location import DiscrepancyLocation
from calibration.discovery.loop_notes import AGAIN, BETTER, HALF, Mechanism
from calibration.discovery.prediction import Gain, HeldOutScore, Predicted
from calibration.discovery.projection import explained_function
from calibration.discovery.score_tests import augment_with_columns, family_columns
from calibration.discovery.settings import Settings
from calibration.discovery.smooth import fit_smooth_curve
from calibration.discovery.standing import changed_run, evidence_over_curves, kept_readings, recurrence_of_families
from calibration.inference import bases as bases_room
from calibration.inference import blocks as blocks_room
from calibration.inference.bases import Bases, place_signature
from calibration.inference.held_out import predict_unseen

#: Least change of a reading by a mechanism, over the largest rms change of a channel, for it to count [σ over σ].
CHANGED = 0.5
#: Fewest blocks of a kind for an error of a gain from their scatter.
BLOCKS = 3
#: Number of parameters of a curve, each of which lowers χ² by one without a discrepancy [σ²].
OF_CURVE = 5.0


def find_mechanism(
    space: CandidateSpace,
    runs: Runs,
    base: Candidate,
    left: Diagnosis,
    ladder: Sequence[Candidate],
    bases: Bases,
    beside: BaseCurve,
    predicted: Predicted,
    settings: Settings,
) -> Mechanism | None:
    """Mechanism that explains most of the discrepancy of the base fit.

    It is the family of library effects that explains most. If no family explains as much as a smooth curve, it is the
    equation and variable of the curve, but not in windows, because no simulation confirms it there.

    Args:
        left: diagnosis of the base fit.
        ladder: candidates that were fitted.
        beside: smooth curve of the discrepancy.
        predicted: hold-out predictions of fits that are already known.
    """
    best, location_families = _best_by_family(space, ladder), _families_of_location(beside.where)
    over_time, linear = space.bare.observe.over_time, left.linear
    if over_time:  # fits of curves take long, and windows have none
        by_curve = beside.where.explained - OF_CURVE
    else:
        by_curve = beside.curve.chi2[0] - beside.curve.chi2[1] - OF_CURVE
    pairs = _explained_by_family(space, base, ladder, best)
    by_effects = {family: pair.explained for family, pair in pairs.items()}
    explained = by_effects | {location_families[0]: max(by_curve, by_effects.get(location_families[0], 0.0))}
    most = max(explained.values())
    within = max(settings.same, settings.form**2 * most)
    alike = sorted((f for f in explained if explained[f] >= most - within), key=lambda f: -explained[f])
    # Families that the curve cannot separate from its own may predict better by an effect.
    other_families = [f for f in location_families if f not in alike and explained[alike[0]] == by_curve]
    by_name = [f for f in (*alike, *other_families) if f in best and by_effects[f] >= HALF * most]
    blocks = [
        mask
        for blocks_by_name in blocks_room.predictable_blocks(runs, space.bare).values()
        for mask in blocks_by_name.values()
    ]
    mechanisms: list[Mechanism] = []
    excess = excess_misfit(space, base)
    curved = location_families[0] in alike and space.bare.observe.reads
    curve = [(location_families[0], False)] if curved else []
    named = [(family, True) for family in by_name]
    fit = np.asarray(linear.jacobian), np.asarray(linear.residual)
    run, changed, root_changed = changed_run(space, linear, bases, *fit) if over_time else (None, "", 0.0)
    for leader, with_effects in (*named[:1], *curve, *named[1:]):
        # A driver whose form a curve refutes is no better than those that smooth curves cannot separate.
        refuted = with_effects and (
            evidence_over_curves(space, best[leader], base, best[leader].effects, left.linear, bases, settings)
            < -BETTER
        )
        others = [*alike, *location_families] if refuted else alike if with_effects else [*alike, *other_families]
        families = (leader, *(f for f in others if f != leader))
        families = tuple(dict.fromkeys((*families, *_same_driver_elsewhere(leader, beside.where))))
        if with_effects:
            alone = _best_and_single(space, ladder, best[leader])
            compared = [*(FitsWithAndWithout(c, base) for c in alone), pairs[leader]]
            gains = {pair: _hold_out_gain(space, runs, pair, predicted) for pair in compared}
            pair, gain = max(gains.items(), key=lambda one: one[1].mean / max(one[1].se, 1e-12))
            effects = tuple(n for n in pair.having.effects if space.library[n].family() == leader)
            again = recurrence_of_families(space, base, best[leader], left, families, bases, blocks, settings)
            if again < AGAIN:  # several effects together may be found again only by their sum
                again = max(again, _curve_recurrence(space, left, bases, families, blocks, settings))
        else:
            gain = (
                _linear_gain_of_curve(space, runs, beside)
                if over_time
                else _hold_out_gain_of_curve(space, runs, base, beside, predicted)
            )
            effects = ()
            again = _curve_recurrence(space, left, bases, families, blocks, settings)
        share = share_of_excess(excess, explained.get(leader, 0.0))
        ammeters = errors_of_ammeters(space, families)
        different = run if root_changed**2 >= explained.get(leader, 0.0) else None
        mechanisms.append(
            Mechanism(families, effects, share, gain.mean, gain.se, again, gain.errors, ammeters, different, changed)
        )
        if not mechanisms[-1].fails:
            return mechanisms[-1]
    return mechanisms[0] if mechanisms else None


@dataclasses.dataclass(frozen=True, eq=False)
class FitsWithAndWithout:
    """Fits with and without the effects of one family."""

    having: Candidate
    without: Candidate

    @property
    def explained(self) -> float:
        """Decrease of χ² by the effects [σ²]."""
        return 2 * (self.without.cost - self.having.cost)


def _best_and_single(space: CandidateSpace, ladder: Sequence[Candidate], best: Candidate) -> list[Candidate]:
    """Best candidate of a family. If it has several effects, also the best single one, which may predict better."""
    family = space.library[best.effects[0]].family()
    single = [c for c in ladder if len(c.effects) == 1 and space.library[c.effects[0]].family() == family]
    sound = [c for c in single if c.plausible and np.isfinite(c.cost)]
    return [best, *([min(sound, key=lambda c: c.cost)] if len(best.effects) > 1 and sound else [])]


def _explained_by_family(
    space: CandidateSpace, base: Candidate, ladder: Sequence[Candidate], best: dict[str, Candidate]
) -> dict[str, FitsWithAndWithout]:
    """For each family, the two fits with and without its effects that differ most in χ²."""
    fits = {c.key: c for c in (base, *ladder) if np.isfinite(c.cost) and not c.supplying}
    pairs = {family: FitsWithAndWithout(alone, base) for family, alone in best.items()}
    for effects, having in fits.items():
        for family in {space.library[name].family() for name in effects} & set(pairs):
            others = frozenset(n for n in effects if space.library[n].family() != family)
            if others in fits:
                pairs[family] = max(
                    pairs[family], FitsWithAndWithout(having, fits[others]), key=lambda pair: pair.explained
                )
    return pairs


def excess_misfit(space: CandidateSpace, base: Candidate) -> float:
    """χ² of the base fit, including priors, minus its expectation from noise (`Observer.noise_misfit`) [σ²]."""
    counts = np.asarray(space.weight > 0)
    return 2 * base.cost - space.bare.observe.noise_misfit(lambda: _whitened_residuals(space, base), counts)


def share_of_excess(excess: float, explained: float) -> float:
    """Share of the excess misfit that is explained, at most 1 [-].

    If the stated noise is too large, the excess is smaller than the decrease of χ².

    Args:
        excess: excess misfit, see `excess_misfit` [σ²].
        explained: decrease of χ² [σ²].
    """
    return float(explained / max(excess, explained, 1e-300))


def _best_by_family(space: CandidateSpace, ladder: Sequence[Candidate]) -> dict[str, Candidate]:
    """Best candidate of each family, among candidates whose effects are all of one family.

    Candidates of plausible size are preferred but not required, because a mechanism claims no size.
    """
    best: dict[str, Candidate] = {}
    for c in ladder:
        families = {space.library[name].family() for name in c.effects}
        once = len(set(c.effects)) == len(c.effects)
        if len(families) == 1 and once and np.isfinite(c.cost) and not c.supplying:
            (family,) = families
            best[family] = min(best.get(family, c), c, key=lambda x: (not x.plausible, x.cost))
    return best


def _same_driver_elsewhere(family: str, where: DiscrepancyLocation) -> Names:
    """Families with the same driving variable in the other equations that the data cannot separate."""
    places = [p for p in where.alike if not bases_room.is_channel_place(p)]  # instruments are excluded
    equations = [dataclasses.replace(where, place=p).family.partition(" that ") for p in places]
    subject, joint, driver = family.partition(" that ")
    alike = dict.fromkeys(equation for equation, *_ in equations)
    return tuple(f"{other}{joint}{driver}" for other in alike) if subject in alike else ()


def _families_of_location(where: DiscrepancyLocation) -> Names:
    """Family of a discrepancy's location, and families of the places and variables that explain the data as well."""
    places = [dataclasses.replace(where, place=p) for p in where.alike]
    others = [dataclasses.replace(where, variable=v) for v in where.variables_alike]
    return tuple(dict.fromkeys(x.family for x in (where, *places, *others)))


# --- hold-out errors ------------------------------------------------------------------------------------


def _hold_out_gain(space: CandidateSpace, runs: Runs, pair: FitsWithAndWithout, predicted: Predicted) -> Gain:
    """Hold-out gain by the effects of a family, over the readings that they change."""
    scores, before = (cached_hold_out_score(space, runs, c, predicted) for c in (pair.having, pair.without))
    changed = _changed_readings(
        space, runs, _simulated_reading(space, pair.without), _simulated_reading(space, pair.having)
    )
    return _gain_over_changed(scores, before, changed)


def _gain_over_changed(score: HeldOutScore, over: HeldOutScore, changed: np.ndarray) -> Gain:
    """Gain of one hold-out score over another, over the changed readings only.

    The kinds of blocks leave out the same readings, so their errors are correlated. The standard error is therefore
    the mean over the kinds, weighted by readings.
    """
    kinds = score.by_kind
    if not kinds:
        return Gain(0.0, np.inf)
    by_kind = {k: score.only(k).gain(over.only(k), changed, BLOCKS) for k in kinds}
    weight = {k: float(np.sum(changed & np.isfinite(kinds[k] - over.by_kind[k]))) for k in kinds}
    total_weight = sum(weight.values())
    if not total_weight:
        return Gain(0.0, np.inf)
    mean, se = (
        sum(weight[k] / total_weight * getattr(by_kind[k], x) for k in kinds if weight[k]) for x in ("mean", "se")
    )
    return Gain(mean, se, {k: gain.se for k, gain in by_kind.items()})


def _hold_out_gain_of_curve(
    space: CandidateSpace, runs: Runs, base: Candidate, beside: BaseCurve, predicted: Predicted
) -> Gain:
    """Hold-out gain by the smooth curve of the base's discrepancy.

    Only rows within the range of the curve's variable in each fit count, because a curve does not extrapolate.
    """
    curve, kinds = beside.curve, blocks_room.predictable_blocks(runs, space.bare)
    predictions = {
        kind: predict_unseen(curve.problem, curve.z, list(blocks_by_name.values())).reading
        for kind, blocks_by_name in kinds.items()
    }
    changed = _changed_readings(space, runs, _simulated_reading(space, base), curve.reading)
    score = prediction.score_predictions(space, runs, predictions)
    score = _where_seen(space, beside, score, kinds)
    return _gain_over_changed(score, cached_hold_out_score(space, runs, base, predicted), changed)


def _where_seen(
    space: CandidateSpace, beside: BaseCurve, score: HeldOutScore, kinds: Mapping[str, Columns]
) -> HeldOutScore:
    """The hold-out score without rows outside the range of the curve's variable in their fit."""
    seen = {kind: _within_seen_range(space, beside, list(by_name.values())) for kind, by_name in kinds.items()}
    return dataclasses.replace(
        score, by_kind={kind: np.where(seen[kind][:, None], x, np.nan) for kind, x in score.by_kind.items()}
    )


def _linear_gain_of_curve(space: CandidateSpace, runs: Runs, beside: BaseCurve) -> Gain:
    """The gain of `_hold_out_gain_of_curve` for a log, to first order at the base fit.

    A simulated fit of a curve takes minutes, and windows have no simulation. A wave has its own phase in each run, so
    only parts of runs can be predicted. Beyond the range that a fit saw, the curve is level: later readings remember
    the error of an extrapolation.
    """
    linear, where, rows = beside.left.linear, beside.where, len(runs)
    kinds = blocks_room.predictable_blocks(runs, space.bare)
    if where.variable in bases_room.ORDERS:
        kinds = {blocks_room.PART: blocks_room.parts_of_runs(runs)}

    def base_fit(_: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return np.asarray(linear.jacobian), np.asarray(linear.residual)

    def curve_fit(included: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        if where.variable not in bases_room.VARIABLES:
            return augment_with_columns(linear, location_columns(linear, beside.bases, where))
        curve = fit_smooth_curve(linear, where.place, where.variable, included)
        x, way = linear.curve_variable(where.place, where.variable)
        columns = place_signature(linear, where.place, way[:, None] * curve.basis(x))
        return augment_with_columns(linear, curve.scale * columns @ curve.root)

    def residuals(fit: Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]], out: np.ndarray) -> np.ndarray:
        included = space.included & ~np.append(out, np.zeros(len(space.included) - rows, bool))
        jacobian, residual = fit(included)
        kept = np.append(kept_readings(space, out, linear.readings), np.ones(len(residual) - linear.readings, bool))
        z = np.linalg.lstsq(jacobian[kept], -residual[kept], rcond=None)[0]
        return (residual + jacobian @ z)[: linear.readings].reshape(len(space.included), -1)[:rows]

    def score(fit: Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]) -> HeldOutScore:
        nothing = np.zeros((rows, linear.readings // len(space.included)))
        errors = {
            kind: sum((np.where(out[:, None], residuals(fit, out), 0.0) for out in by_name.values()), nothing)
            for kind, by_name in kinds.items()
        }
        return prediction.score_readings(errors, nothing, nothing + 1.0, space.weight[:rows] > 0, kinds)

    sd, none = np.asarray(space.bare.data.sd)[:rows], np.zeros(rows, bool)
    changed = _changed_readings(space, runs, sd * residuals(base_fit, none), sd * residuals(curve_fit, none))
    return _gain_over_changed(_where_seen(space, beside, score(curve_fit), kinds), score(base_fit), changed)


def _within_seen_range(space: CandidateSpace, beside: BaseCurve, masks: Sequence[np.ndarray]) -> np.ndarray:
    """True for rows whose value of the curve's variable lies within the range of the rows outside their block, shape
    (rows,).

    Args:
        masks: mask of the rows of each block.
    """
    location, linear, rows = beside.where, beside.left.linear, len(masks[0])
    in_range = np.ones(rows, bool)
    if location.variable not in bases_room.VARIABLES:
        return in_range
    x = np.asarray(linear.curve_variable(location.place, location.variable)[0], float)
    if len(x) != len(space.included):  # turns, with different sides
        return in_range
    for mask in masks:
        others = x[:rows][space.included[:rows] & ~mask]
        if len(others):
            in_range[mask] = (x[:rows][mask] >= others.min()) & (x[:rows][mask] <= others.max())
    return in_range


def cached_hold_out_score(
    space: CandidateSpace, runs: Runs, candidate: Candidate, predicted: Predicted
) -> HeldOutScore:
    """Hold-out scores of a candidate. Its predictions come from `predicted` or are added to it."""
    prediction_before = predicted.get(prediction.candidate_key(candidate))
    if prediction_before is not None:
        return prediction.score_predictions(space, runs, prediction_before)
    score = prediction.score_candidate(space, runs, candidate)
    predicted[prediction.candidate_key(candidate)] = score.reading
    return score


def _simulated_reading(space: CandidateSpace, candidate: Candidate) -> np.ndarray:
    problem, z, active = space.fit_of(candidate.active, candidate.z)
    return np.asarray(problem.observe.observation_at(problem, z, active).reading)


def _whitened_residuals(space: CandidateSpace, candidate: Candidate) -> np.ndarray:
    """Residuals of a candidate divided by their sds, 0 for excluded readings, shape (rows, channels)."""
    data = space.equipped.data
    off = (_simulated_reading(space, candidate) - np.asarray(data.measured)) / np.asarray(data.sd)
    return np.where(np.asarray(space.weight) > 0, np.nan_to_num(off), 0.0)


def _changed_readings(space: CandidateSpace, runs: Runs, before: np.ndarray, after: np.ndarray) -> np.ndarray:
    """True for readings that a mechanism changes noticeably, shape (rows, channels).

    The change in sds is at least `CHANGED` of the rms change of the most changed channel. Other readings would dilute
    the gain of the mechanism.
    """
    rows = len(runs)
    sd, counts = np.asarray(space.bare.data.sd)[:rows], space.weight[:rows] > 0
    reading_changes = np.where(counts, np.abs(after[:rows] - before[:rows]) / sd, 0.0)
    reading_changes = np.nan_to_num(reading_changes)
    most = np.max(np.sqrt(np.sum(reading_changes**2, 0) / np.maximum(counts.sum(0), 1)))
    return np.asarray(counts & (reading_changes >= CHANGED * most))


# --- hold-out blocks ------------------------------------------------------------------------------------


def _curve_recurrence(
    space: CandidateSpace,
    left: Diagnosis,
    bases: Bases,
    families: Sequence[str],
    blocks: Sequence[np.ndarray],
    settings: Settings,
) -> float:
    """Share of the informative blocks for which, without the block, a curve of these families still explains most.

    A block is informative if half of the information on the curve remains without it. 1 if there is no such block.
    """
    linear, names = left.linear, bases_room.family_names(bases)
    smooth = [k for k, (_, v) in enumerate(names) if v in bases_room.VARIABLES or v in bases_room.ORDERS]
    no_location = DiscrepancyLocation("", "", (), (), 0.0, 0.0)
    akin = [
        dataclasses.replace(no_location, place=names[k][0], variable=names[k][1]).family in families for k in smooth
    ]
    columns = [family_columns(linear, bases, k) for k in smooth]
    jacobian, residual = np.asarray(linear.jacobian), np.asarray(linear.residual)
    explains = explained_function(jacobian, residual)
    explained_before = [
        explains(c)[1] for c, explained_by_akin in zip(columns, akin, strict=True) if explained_by_akin
    ]
    again = []
    for out in blocks:
        kept = kept_readings(space, out, linear.readings)
        kept_residuals = np.append(kept, np.ones(len(residual) - len(kept), bool))
        explained = [explained_function(jacobian[kept_residuals], residual[kept_residuals])(c[kept]) for c in columns]
        explained_by_akin = [f for f, a in zip(explained, akin, strict=True) if a]
        if not explained_by_akin or max(told for _, told in explained_by_akin) < 0.5 * max(explained_before):
            continue
        most = max(gain for gain, _ in explained)
        again.append(max(gain for gain, _ in explained_by_akin) >= most - max(settings.same, settings.form**2 * most))
    return float(np.mean(again)) if again else 1.0
