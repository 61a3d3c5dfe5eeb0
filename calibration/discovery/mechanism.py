"""Mechanisms: the equation with a discrepancy and its driver, if no exact law is established.

No law is exactly true of a machine, so with precise data every name fails a test of its form. The share that a
mechanism explains, its predictions, and its repetition without parts of the data do not depend on the exact form.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np

from calibration.data import Columns, Names
from calibration.data.runs import Runs
from calibration.discovery import prediction
from calibration.discovery.active_set import CandidateSpace
from calibration.discovery.adequacy import Diagnosis
from calibration.discovery.candidates import Candidate, fit_candidates
from calibration.discovery.classes import errors_of_ammeters
from calibration.discovery.discrepancy import CurveBeside
from calibration.discovery.location import DiscrepancyLocation
from calibration.discovery.loop_notes import AGAIN, HALF, Mechanism
from calibration.discovery.prediction import Gain, HeldOutScore, Predicted
from calibration.discovery.projection import explained_by
from calibration.discovery.score_tests import family_columns
from calibration.discovery.settings import Settings
from calibration.discovery.standing import chosen_again
from calibration.inference import bases as bases_room
from calibration.inference import blocks as blocks_room
from calibration.inference.bases import Bases
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
    beside: CurveBeside,
    predicted: Predicted,
    settings: Settings,
) -> Mechanism | None:
    """Mechanism that explains most of the discrepancy of the base fit.

    It is that of effects of one family of the library. If none of them explains as much as a smooth curve, it is that
    of the curve, and None for histories.

    Args:
        left: diagnosis of the base.
        ladder: candidates that were fitted.
        beside: the curve of the discrepancy.
        predicted: known hold-out predictions of fits.
    """
    ladder = simulate_leading_families(space, base, ladder, settings)
    best, own = _of_one_family(space, ladder), _families_of(beside.where)
    if space.bare.observe.long:  # fits of curves take long
        by_curve = beside.where.explained - OF_CURVE
    else:
        by_curve = beside.curve.chi2[0] - beside.curve.chi2[1] - OF_CURVE
    pairs = _explained_by_family(space, base, ladder, best)
    by_effects = {family: pair.explained for family, pair in pairs.items()}
    explained = by_effects | {own[0]: max(by_curve, by_effects.get(own[0], 0.0))}
    most = max(explained.values())
    within = max(settings.same, settings.form**2 * most)
    alike = sorted((f for f in explained if explained[f] >= most - within), key=lambda f: -explained[f])
    # Families that the curve cannot separate from its own may predict better by an effect.
    over = [f for f in own if f not in alike and explained[alike[0]] == by_curve]
    by_name = [f for f in (*alike, *over) if f in best and (space.bare.observe.long or by_effects[f] >= HALF * most)]
    blocks = [mask for by in blocks_room.predictable_blocks(runs, space.bare).values() for mask in by.values()]
    mechanisms: list[Mechanism] = []
    excess = excess_misfit(space, base)
    curve = () if space.bare.observe.long or own[0] in by_name or own[0] not in alike else own[:1]
    for leader in (*by_name[:1], *curve, *by_name[1:]):
        others = alike if leader in by_name else [*alike, *over]
        families = (leader, *(f for f in others if f != leader))
        families = tuple(dict.fromkeys((*families, *_in_equations_alike(leader, beside.where))))
        if leader in by_name:
            alone = _few_and_best(space, ladder, best[leader])
            compared = [*(Pair(c, base) for c in alone), pairs[leader]]
            gains = {pair: _gain_of(space, runs, pair, predicted) for pair in compared}
            pair, gain = max(gains.items(), key=lambda one: one[1].mean / max(one[1].se, 1e-12))
            effects = tuple(n for n in pair.having.effects if space.library[n].family() == leader)
            again = chosen_again(space, base, best[leader], left, families, bases, blocks, settings)
            if again < AGAIN:  # several effects together may be found again only by their sum
                again = max(again, _curve_again(space, left, bases, families, blocks, settings))
        else:
            gain, effects = _gain_of_curve(space, runs, base, beside, predicted), ()
            again = _curve_again(space, left, bases, families, blocks, settings)
        share = share_of_excess(excess, explained.get(leader, 0.0))
        ammeters = errors_of_ammeters(space, families)
        mechanisms.append(Mechanism(families, effects, share, gain.mean, gain.se, again, gain.errors, ammeters))
        if not mechanisms[-1].fails:
            return mechanisms[-1]
    return mechanisms[0] if mechanisms else None


def simulate_leading_families(
    space: CandidateSpace, base: Candidate, ladder: Sequence[Candidate], settings: Settings
) -> list[Candidate]:
    """Candidates in which the best one of each family that may explain most is simulated, not a regression."""
    candidates = list(ladder)
    while True:
        best = _of_one_family(space, candidates).values()
        lowest = min((c.cost for c in best), default=0.0)
        within = max(settings.same, settings.form**2 * 2 * (base.cost - lowest))
        near = [c for c in best if not c.simulated and 2 * (c.cost - lowest) <= within]
        if not near:
            return candidates
        fits = fit_candidates(space, [(c.active, c.z) for c in near], settings)
        candidates = [*(c for c in candidates if not any(c is x for x in near)), *fits]


@dataclasses.dataclass(frozen=True, eq=False)
class Pair:
    """Fits with and without the effects of a mechanism."""

    having: Candidate
    without: Candidate

    @property
    def explained(self) -> float:
        """Decrease of χ² [σ²]."""
        return 2 * (self.without.cost - self.having.cost)


def _few_and_best(space: CandidateSpace, ladder: Sequence[Candidate], best: Candidate) -> list[Candidate]:
    """Best candidate of a family, and if it has several effects the best single one, which may predict better."""
    family = space.library[best.effects[0]].family()
    single = [c for c in ladder if len(c.effects) == 1 and space.library[c.effects[0]].family() == family]
    sound = [c for c in single if c.plausible and np.isfinite(c.cost)]
    return [best, *([min(sound, key=lambda c: c.cost)] if len(best.effects) > 1 and sound else [])]


def _explained_by_family(
    space: CandidateSpace, base: Candidate, ladder: Sequence[Candidate], best: dict[str, Candidate]
) -> dict[str, Pair]:
    """For each family the fits with and without its effects that differ most: alone, or with those of others."""
    simulated = {c.key: c for c in (base, *ladder) if np.isfinite(c.cost) and not c.supplying}
    pairs = {family: Pair(alone, base) for family, alone in best.items()}
    for effects, having in simulated.items():
        for family in {space.library[name].family() for name in effects} & set(pairs):
            others = frozenset(n for n in effects if space.library[n].family() != family)
            if others in simulated:
                pairs[family] = max(pairs[family], Pair(having, simulated[others]), key=lambda pair: pair.explained)
    return pairs


def excess_misfit(space: CandidateSpace, base: Candidate) -> float:
    """χ² of the base, priors included, less its expectation from noise (`Observer.noise_misfit`) [σ²]."""
    counts = np.asarray(space.weight > 0)
    return 2 * base.cost - space.bare.observe.noise_misfit(lambda: _whitened(space, base), counts)


def share_of_excess(excess: float, explained: float) -> float:
    """Share of the excess misfit that is explained [-], at most 1: if the stated noise is too large, the excess is
    smaller than the decrease of χ².

    Args:
        excess: see `excess_misfit`.
        explained: decrease of χ² [σ²].
    """
    return float(explained / max(excess, explained, 1e-300))


def _of_one_family(space: CandidateSpace, ladder: Sequence[Candidate]) -> dict[str, Candidate]:
    """Best candidate of each family among those with effects of one family, of plausible size if there is one.

    The size of a mechanism is not claimed.
    """
    best: dict[str, Candidate] = {}
    for c in ladder:
        families = {space.library[name].family() for name in c.effects}
        once = len(set(c.effects)) == len(c.effects)
        if len(families) == 1 and once and np.isfinite(c.cost) and not c.supplying:
            (family,) = families
            best[family] = min(best.get(family, c), c, key=lambda x: (not x.plausible, x.cost))
    return best


def _in_equations_alike(family: str, where: DiscrepancyLocation) -> Names:
    """Family with the same driver in each equation that these data cannot separate from its own."""
    places = [p for p in where.alike if not bases_room.is_channel_place(p)]  # instruments are excluded
    equations = [dataclasses.replace(where, place=p).family.partition(" that ") for p in places]
    what, joint, driver = family.partition(" that ")
    alike = dict.fromkeys(equation for equation, *_ in equations)
    return tuple(f"{other}{joint}{driver}" for other in alike) if what in alike else ()


def _families_of(where: DiscrepancyLocation) -> Names:
    """Family of a curve, and those of the places and variables with curves of similar significance."""
    places = [dataclasses.replace(where, place=p) for p in where.alike]
    others = [dataclasses.replace(where, variable=v) for v in where.variables_alike]
    return tuple(dict.fromkeys(x.family for x in (where, *places, *others)))


# --- hold-out errors ------------------------------------------------------------------------------------


def _gain_of(space: CandidateSpace, runs: Runs, pair: Pair, predicted: Predicted) -> Gain:
    """Hold-out gain by the effects of a mechanism, over the readings that they change."""
    scores, before = (scored_once(space, runs, c, predicted) for c in (pair.having, pair.without))
    changed = _changed_readings(space, runs, _reading(space, pair.without), _reading(space, pair.having))
    return _gain_over_changed(scores, before, changed)


def _gain_over_changed(score: HeldOutScore, over: HeldOutScore, changed: np.ndarray) -> Gain:
    """Gain of a score, over the readings that a mechanism changes.

    Each kind of block omits the same readings, so errors of kinds do not average out. The standard error is the
    mean of theirs, weighted by readings.
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


def _gain_of_curve(
    space: CandidateSpace, runs: Runs, base: Candidate, beside: CurveBeside, predicted: Predicted
) -> Gain:
    """Hold-out gain by the curve of the base's discrepancy, within the range of its variable in each fit.

    A curve does not extrapolate.
    """
    curve, kinds = beside.curve, blocks_room.predictable_blocks(runs, space.bare)
    predictions = {
        kind: predict_unseen(curve.problem, curve.z, list(by.values())).reading for kind, by in kinds.items()
    }
    changed = _changed_readings(space, runs, _reading(space, base), curve.reading)
    score = _scored(space, runs, predictions)
    in_seen_range = {kind: _within_seen_range(space, beside, list(by.values())) for kind, by in kinds.items()}
    inside = {kind: np.where(in_seen_range[kind][:, None], x, np.nan) for kind, x in score.by_kind.items()}
    score = dataclasses.replace(score, by_kind=inside)
    return _gain_over_changed(score, scored_once(space, runs, base, predicted), changed)


def _within_seen_range(space: CandidateSpace, beside: CurveBeside, masks: Sequence[np.ndarray]) -> np.ndarray:
    """True for rows with a curve's variable within the range of the rows outside their block, shape (rows,).

    Args:
        masks: masks of the rows of each block.
    """
    where, linear, rows = beside.where, beside.left.linear, len(masks[0])
    in_range = np.ones(rows, bool)
    if where.variable not in bases_room.VARIABLES:
        return in_range
    x = np.asarray(linear.in_travel(where.place, where.variable)[0], float)
    if len(x) != len(space.included):  # turns, with different sides
        return in_range
    for mask in masks:
        others = x[:rows][space.included[:rows] & ~mask]
        if len(others):
            in_range[mask] = (x[:rows][mask] >= others.min()) & (x[:rows][mask] <= others.max())
    return in_range


def scored_once(space: CandidateSpace, runs: Runs, candidate: Candidate, predicted: Predicted) -> HeldOutScore:
    """Hold-out scores of a candidate. Its predictions are taken from `predicted`, or added to it."""
    prediction_before = predicted.get(prediction.candidate_key(candidate))
    if prediction_before is not None:
        return _scored(space, runs, prediction_before)
    score = prediction.score_candidate(space, runs, candidate)
    predicted[prediction.candidate_key(candidate)] = score.reading
    return score


def _scored(space: CandidateSpace, runs: Runs, reading: Columns) -> HeldOutScore:
    data, rows = space.equipped.data, len(runs)
    measured, sd, counts = (np.asarray(x)[:rows] for x in (data.measured, data.sd, space.weight > 0))
    return prediction.score_readings(reading, measured, sd, counts, blocks_room.predictable_blocks(runs, space.bare))


def _reading(space: CandidateSpace, candidate: Candidate) -> np.ndarray:
    problem, z, active = space.fit_of(candidate.active, candidate.z)
    return np.asarray(problem.observe.observed(problem, z, active).reading)


def _whitened(space: CandidateSpace, candidate: Candidate) -> np.ndarray:
    """Residuals of a candidate in sds, 0 for excluded readings, shape (rows, channels)."""
    data = space.equipped.data
    off = (_reading(space, candidate) - np.asarray(data.measured)) / np.asarray(data.sd)
    return np.where(np.asarray(space.weight) > 0, np.nan_to_num(off), 0.0)


def _changed_readings(space: CandidateSpace, runs: Runs, before: np.ndarray, after: np.ndarray) -> np.ndarray:
    """True for readings that a mechanism changes by at least `CHANGED` of the rms of the most changed channel, in
    sds. Others would dilute its gain, shape (rows, channels)."""
    rows = len(runs)
    sd, counts = np.asarray(space.bare.data.sd)[:rows], space.weight[:rows] > 0
    moved = np.where(counts, np.abs(after[:rows] - before[:rows]) / sd, 0.0)
    moved = np.nan_to_num(moved)
    most = np.max(np.sqrt(np.sum(moved**2, 0) / np.maximum(counts.sum(0), 1)))
    return np.asarray(counts & (moved >= CHANGED * most))


# --- hold-out blocks ------------------------------------------------------------------------------------


def _curve_again(
    space: CandidateSpace,
    left: Diagnosis,
    bases: Bases,
    families: Sequence[str],
    blocks: Sequence[np.ndarray],
    settings: Settings,
) -> float:
    """Share of the informative blocks without which a smooth curve of these families explains as much as any.

    1 without such blocks. An informative block leaves half of the information on the curve.
    """
    linear, names = left.linear, bases_room.family_names(bases)
    smooth = [k for k, (_, v) in enumerate(names) if v in bases_room.VARIABLES]
    no_location = DiscrepancyLocation("", "", (), (), 0.0, 0.0)
    akin = [
        dataclasses.replace(no_location, place=names[k][0], variable=names[k][1]).family in families for k in smooth
    ]
    columns = [family_columns(linear, bases, k) for k in smooth]
    jacobian, residual = np.asarray(linear.jacobian), np.asarray(linear.residual)
    explains = explained_by(jacobian, residual)
    explained_before = [
        explains(c)[1] for c, explained_by_akin in zip(columns, akin, strict=True) if explained_by_akin
    ]
    again = []
    for out in blocks:
        rows = np.concatenate([out, np.zeros(len(space.included) - len(out), bool)])
        kept_readings = np.repeat(~rows, linear.readings // len(rows))
        kept_residuals = np.concatenate([kept_readings, np.ones(len(residual) - len(kept_readings), bool)])
        explained = [
            explained_by(jacobian[kept_residuals], residual[kept_residuals])(c[kept_readings]) for c in columns
        ]
        explained_by_akin = [f for f, a in zip(explained, akin, strict=True) if a]
        if not explained_by_akin or max(told for _, told in explained_by_akin) < 0.5 * max(explained_before):
            continue
        most = max(gain for gain, _ in explained)
        again.append(max(gain for gain, _ in explained_by_akin) >= most - max(settings.same, settings.form**2 * most))
    return float(np.mean(again)) if again else 1.0
