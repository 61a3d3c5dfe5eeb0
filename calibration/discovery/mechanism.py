"""Mechanisms: equation and driving variable of a discrepancy, if no exact law is established.

No law is exactly true of a machine, so with precise data every name fails a test of its form. The share that a
mechanism explains, its predictions, and its repetition without parts of the data do not depend on the exact form.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Sequence

import numpy as np

from calibration.data import Names
from calibration.data.runs import Runs
from calibration.discovery import gains, standing
from calibration.discovery.active_set import CandidateSpace
from calibration.discovery.candidates import Candidate, excess_misfit, share_of_excess
from calibration.discovery.classes import ammeter_families, errors_of_ammeters
from calibration.discovery.discrepancy import BaseCurve, location_columns
from calibration.discovery.location import DiscrepancyLocation
from calibration.discovery.loop_notes import AGAIN, BETTER, HALF, Mechanism
from calibration.discovery.prediction import Predicted, masks_of_blocks
from calibration.discovery.projection import Projection
from calibration.discovery.score_tests import family_columns
from calibration.discovery.settings import Settings
from calibration.inference import bases as bases_room
from calibration.inference import blocks as blocks_room

#: Fits with and without the effects of one family.
Fits = tuple[Candidate, Candidate]
#: Decrease of χ² by a curve without any discrepancy: one for each of its parameters [σ²].
OF_CURVE = 5.0


def find_mechanism(
    base_curve: BaseCurve, runs: Runs, ladder: Sequence[Candidate], predicted: Predicted
) -> Mechanism | None:
    """Mechanism that explains most of the discrepancy of the base fit. If it fails, the next one that does not.

    It is the family of library effects that explains most. If no family explains as much as a smooth curve, or if
    these effects fail, it is the equation and variable of the curve. Windows have no such mechanism, because no
    simulation confirms a curve there.

    Args:
        base_curve: smooth curve of the discrepancy, with the base fit.
        ladder: candidates that were fitted.
        predicted: hold-out predictions of fits that are already known.
    """
    space, base, linear = base_curve.space, base_curve.base, base_curve.left.linear
    settings, over_time = base_curve.settings, base_curve.space.bare.observe.over_time
    best = _best_by_family(space, ladder)
    pairs = _explained_by_family(space, base, ladder, best)
    explained, alike, weaker = _rank_families(base_curve, pairs)
    curve_family, *_ = location_families = _families_of_location(base_curve.where)
    largest, excess = max(explained.values()), excess_misfit(space, base)
    effect_leaders = [(f, True) for f in (*alike, *weaker) if f in best and _explained(pairs[f]) >= HALF * largest]
    curve_leaders = [(curve_family, False)] * (curve_family in alike and space.bare.observe.reads)
    run, changed, root = None, "", 0.0
    if over_time:
        run, changed, root = standing.changed_run(space, linear, base_curve.bases, Projection.of(linear))
    blocks = masks_of_blocks(blocks_room.predictable_blocks(runs, space.bare))
    curves = functools.cache(functools.partial(_curves_without_blocks, base_curve, blocks))
    mechanisms: list[Mechanism] = []
    for leader, with_effects in (*effect_leaders[:1], *curve_leaders, *effect_leaders[1:]):
        effects: Names = ()
        families = (leader, *alike, *(() if with_effects else weaker))
        if (
            with_effects
            and standing.evidence_over_curves(base_curve, best[leader], base, best[leader].effects, linear) < -BETTER
        ):
            # A driver whose form a curve refutes is no better than those that curves cannot separate.
            families = (*families, *location_families)
        families = tuple(dict.fromkeys((*families, *_same_driver_elsewhere(leader, base_curve.where))))
        if with_effects:
            effects, gain = gains.best_hold_out_gain(
                space, runs, ladder, best[leader], base, pairs[leader], predicted
            )
            recurrence = standing.recurrence_of_families(base_curve, best[leader], families, blocks)
            if recurrence < AGAIN:  # only the sum of several effects may recur
                recurrence = max(recurrence, _curve_recurrence(*curves(), families, settings))
        else:
            hold_out = gains.linear_gain_of_curve if over_time else gains.hold_out_gain_of_curve
            gain, recurrence = hold_out(base_curve, runs, predicted), _curve_recurrence(*curves(), families, settings)
        by_leader = explained.get(leader, 0.0)
        mechanism = Mechanism(
            families, effects, share_of_excess(excess, by_leader), gain.mean, gain.se, recurrence, gain.errors,
            errors_of_ammeters(space, families), run if root**2 >= by_leader else None, changed,
        )  # fmt: skip
        mechanisms.append(mechanism)
        if not mechanism.fails:
            return _with_ammeter_families(base_curve, mechanism)
    return _with_ammeter_families(base_curve, mechanisms[0]) if mechanisms else None


def _rank_families(base_curve: BaseCurve, pairs: dict[str, Fits]) -> tuple[dict[str, float], Names, Names]:
    """Decrease of χ² by the effects of each family and by the curve [σ²], and the families that explain most.

    If the curve explains most, also other families of its location.
    """
    families = _families_of_location(base_curve.where)
    if base_curve.space.bare.observe.over_time:  # fits of curves take long, and windows have none
        by_curve = base_curve.where.explained - OF_CURVE
    else:
        by_curve = base_curve.fitted.chi2[0] - base_curve.fitted.chi2[1] - OF_CURVE
    explained = {family: _explained(pair) for family, pair in pairs.items()}
    explained[families[0]] = max(by_curve, explained.get(families[0], 0.0))
    largest = max(explained.values())
    alike = [f for f in explained if explained[f] >= largest - base_curve.settings.tolerance(largest)]
    alike.sort(key=lambda f: -explained[f])
    weaker = [f for f in families if f not in alike and explained[alike[0]] == by_curve]
    return explained, tuple(alike), tuple(weaker)


def _with_ammeter_families(base_curve: BaseCurve, mechanism: Mechanism) -> Mechanism:
    """The mechanism with ammeter errors that explain the data as well, see `ammeter_families`."""
    space, linear = base_curve.space, base_curve.left.linear
    if mechanism.effects:
        members = [space.library.names[k] in mechanism.effects for k in space.library.of]
        columns = np.asarray(linear.signatures)[:, members]
    else:
        columns = location_columns(linear, base_curve.bases, base_curve.where)
    ammeter = ammeter_families(space, Projection.of(linear), columns, mechanism.families[0], base_curve.settings)
    families = tuple(dict.fromkeys((*mechanism.families, *ammeter)))
    return dataclasses.replace(mechanism, families=families, ammeter=errors_of_ammeters(space, families))


def _explained(fits: Fits) -> float:
    """Decrease of χ² by the effects that only the first fit has [σ²]."""
    having, without = fits
    return 2 * (without.cost - having.cost)


def _explained_by_family(
    space: CandidateSpace, base: Candidate, ladder: Sequence[Candidate], best: dict[str, Candidate]
) -> dict[str, Fits]:
    """For each family, the two fits with and without its effects that differ most in χ²."""
    fits = {c.key: c for c in (base, *ladder) if np.isfinite(c.cost) and not c.supplying}
    pairs = {family: (alone, base) for family, alone in best.items()}
    for effects, having in fits.items():
        for family in {space.library[name].family() for name in effects} & set(pairs):
            others = frozenset(n for n in effects if space.library[n].family() != family)
            if others in fits:
                pairs[family] = max(pairs[family], (having, fits[others]), key=_explained)
    return pairs


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


# --- hold-out blocks ------------------------------------------------------------------------------------


def _curves_without_blocks(base_curve: BaseCurve, blocks: Sequence[np.ndarray]) -> tuple[Names, np.ndarray]:
    """Family of each smooth curve, and what each explains and could explain [σ²], shape (1 + blocks, curves, 2).

    The first entry is with all rows, the others are without each block.
    """
    space, linear, names = base_curve.space, base_curve.left.linear, bases_room.family_names(base_curve.bases)
    smooth = [k for k, (_, v) in enumerate(names) if v in bases_room.VARIABLES or v in bases_room.ORDERS]
    families = tuple(
        dataclasses.replace(base_curve.where, place=p, variable=v).family for p, v in (names[k] for k in smooth)
    )
    columns, fit = [family_columns(linear, base_curve.bases, k) for k in smooth], Projection.of(linear)
    explained = []
    for left_out in (np.zeros(len(space.included), bool), *blocks):
        kept_rows = standing.kept_readings(space, left_out, linear.readings)
        without_block = fit.only(kept_rows)
        explained.append([without_block.explained(c[kept_rows]) for c in columns])
    return families, np.array(explained)


def _curve_recurrence(curves: Names, explained: np.ndarray, families: Sequence[str], settings: Settings) -> float:
    """Share of the informative blocks for which, without the block, a curve of these families still explains most.

    A block is informative if half of the information on the curve remains without it. 1 if there is no such block.

    Args:
        curves, explained: family of each curve, and what it explains, see `_curves_without_blocks`.
    """
    akin = np.isin(curves, families)
    if not akin.any():
        return 1.0
    least_information, recurs = 0.5 * explained[0, akin, 1].max(), []
    for by_curve, information in np.moveaxis(explained[1:], 2, 1):
        if information[akin].max() >= least_information:
            recurs.append(by_curve[akin].max() >= by_curve.max() - settings.tolerance(by_curve.max()))
    return float(np.mean(recurs)) if recurs else 1.0
