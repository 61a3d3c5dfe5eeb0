"""Choice of a class's leading effect by hold-out errors, and report of hold-out errors that rise with the effects
found.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence

import numpy as np

from calibration.data.runs import Runs
from calibration.discovery import candidates, prediction, search
from calibration.discovery.active_set import CandidateSpace
from calibration.discovery.adequacy import Diagnosis
from calibration.discovery.candidates import Candidate
from calibration.discovery.classes import Classes, families_of_members
from calibration.discovery.discrepancy import BaseCurve
from calibration.discovery.experiments import alternatives_of_class
from calibration.discovery.loop_input import LoopInput
from calibration.discovery.loop_notes import NameSupport
from calibration.discovery.prediction import HeldOutAlternative, Predicted
from calibration.discovery.result import Errors, WorseChannel
from calibration.discovery.search import Proposed, SearchResult
from calibration.discovery.settings import Settings
from calibration.discovery.standing import judge_names
from calibration.inference import blocks as blocks_room
from calibration.inference.fit_notes import progress_remark

#: Least relative difference of hold-out errors that counts; less is invisible in two digits.
TOLD = 0.01


# --- before and after -----------------------------------------------------------------------------------


def errors_on_common_rows(
    before: np.ndarray, after: np.ndarray, error: Callable[[np.ndarray], Errors]
) -> tuple[Errors, Errors]:
    """Errors of two sets of readings, over the readings that both fits predict."""
    in_both = np.isfinite(before) & np.isfinite(after)
    return error(np.where(in_both, before, np.nan)), error(np.where(in_both, after, np.nan))


def worse_predictions(
    errors: Mapping[str, tuple[Errors, Errors]],
) -> tuple[WorseChannel, ...]:
    """Channels whose hold-out error rises with the effects, for each kind of block.

    Args:
        errors: kind of block → hold-out errors without and with the effects, see `errors_on_common_rows`.
    """
    worse = []
    for kind, (was, now) in errors.items():
        for channel, e in now.items():
            old, new = float(was[channel]["rms_percent"]), float(e["rms_percent"])
            if new > (1 + TOLD) * old:
                worse.append(WorseChannel(kind, channel, int(e["rows"]), old, new))
    return tuple(worse)


# --- among alternatives ---------------------------------------------------------------------------------


def compare_alternatives(
    space: CandidateSpace, runs: Runs, best: Candidate, alike: Classes
) -> tuple[HeldOutAlternative, ...]:
    """Hold-out errors of the best fit and of fits in which one effect is replaced by an alternative. The best fit is
    first.

    Implausible alternatives are omitted. Empty if no alternative remains, or if there are no blocks.
    """
    alternatives = [c for c in alternatives_of_class(best, alike, stated=False).values() if c.plausible]
    data, rows = space.equipped.data, len(runs)
    measured, sd, counts = (np.asarray(x)[:rows] for x in (data.measured, data.sd, space.weight > 0))
    kinds = blocks_room.predictable_blocks(runs, space.bare)
    if len(alternatives) < 2 or not kinds:
        return ()
    held_out = counts & np.stack([np.any(list(masks.values()), 0) for masks in kinds.values()])[:, :, None]
    fits = [prediction.FittedProblem(*space.fit_of(c.active, c.z)).held_out(kinds) for c in alternatives]
    predicted = np.array([[fit[kind] for kind in kinds] for fit in fits])
    errors = np.where(counts, (predicted - measured) / sd, np.nan)  # shape (fits, kinds, rows, channels)
    common = np.asarray(np.isfinite(errors).all(0))

    def rms(squares: np.ndarray) -> float:
        return float(np.sqrt(squares.mean())) if squares.size else float("nan")

    return tuple(
        HeldOutAlternative(
            effects=c.effects,
            leads=c is best,
            rise_chi2=float(2 * (c.cost - min(x.cost for x in alternatives))),
            rms_sigma=rms(e[common] ** 2),
            by_kind={kind: rms(e[k, common[k]] ** 2) for k, kind in enumerate(kinds)},
            lost=int(np.sum(held_out & ~np.isfinite(e))),
        )
        for c, e in zip(alternatives, errors, strict=True)
    )


def _order_alternatives(table: Sequence[HeldOutAlternative]) -> list[int]:
    """Indices of the alternatives that predict at least as many readings as the best fit, by hold-out error.

    The best fit (index 0) is first if its error is within `TOLD` of the smallest one, because such a difference
    decides nothing.
    """
    able = [k for k, a in enumerate(table) if a.lost <= table[0].lost]
    is_draw = not any(table[0].rms_sigma > (1 + TOLD) * table[k].rms_sigma for k in able)
    return sorted(able, key=lambda k: (k != 0 or not is_draw, table[k].rms_sigma))


def prefer_by_held_out(
    beside: BaseCurve, runs: Runs, best: Candidate, before: Diagnosis, alike: Classes
) -> tuple[Candidate, Diagnosis, Classes, tuple[HeldOutAlternative, ...]]:
    """Replaces the best fit by the alternative with the smallest hold-out error, see `_order_alternatives`.

    An alternative with significant residuals does not replace a best fit without them.

    Args:
        best, before: the best fit and its diagnosis.
    """
    space, settings = beside.space, beside.settings
    table = compare_alternatives(space, runs, best, alike)
    fitted = {c.key: c for c in alternatives_of_class(best, alike, stated=False).values()}
    for k in _order_alternatives(table):
        leader = fitted[frozenset(table[k].effects)]
        if leader is best:
            break
        diagnosis = search.diagnose_candidate(space, leader, beside.bases, before)
        if before.test.rejected_with_margin or not diagnosis.test.rejected_with_margin:
            led = tuple(dataclasses.replace(a, leads=j == k) for j, a in enumerate(table))
            return leader, diagnosis, _classes_with_leader(space, best, leader, alike, settings), led
    return best, before, alike, table


def _classes_with_leader(
    space: CandidateSpace,
    best: Candidate,
    leader: Candidate,
    alike: Classes,
    settings: Settings,
) -> Classes:
    """Alternatives of another leading effect, with that effect first in its class. Missing members are fitted."""
    members = dict(zip(best.effects, alike.members, strict=True))
    (new,), (old,) = leader.key - best.key, best.key - leader.key
    members[new] = (new, *(n for n in members.pop(old) if n != new))
    stated_by_effect = dict(zip(best.effects, alike.stated, strict=True))
    stated_by_effect[new] = stated_by_effect.pop(old)
    keys = {best.key, *(c.key for c in alike.ladder)}
    missing_fits = [leader.with_effect(name, other) for name in leader.effects for other in members[name][1:]]
    missing = [w for w in missing_fits if frozenset(w) - {""} not in keys]
    fitted = candidates.fit_candidates(
        space, [(w, candidates.start_of_fit(space, leader, w, settings)) for w in missing], settings
    )
    return Classes(
        tuple(members[name] for name in leader.effects),
        tuple(stated_by_effect[name] for name in leader.effects),
        tuple(
            tuple(dict.fromkeys((*families_of_members(space, members[name]), *others)))
            for name, others in zip(leader.effects, alike.families, strict=True)
        ),
        (best, *alike.ladder, *fitted),
    )


def choose_effects(
    given: LoopInput, searched: SearchResult, beside: BaseCurve, predicted: Predicted
) -> tuple[Proposed | None, SearchResult, NameSupport]:
    """Effects to add to the model (None for no effects), the updated search, and the tests of their names.

    The effects are those whose names are established, and those of the smallest set that predicts as well as any.
    Effects that only imitate a curve are left out. If the largest set leaves no discrepancy, its effects are tested,
    otherwise those of the predictive set.

    Args:
        beside: the base fit, its diagnosis and the smooth curve of its discrepancy.
        predicted: cache of hold-out predictions of fits. This function adds to it.
    """
    space, base, settings = beside.space, beside.base, given.settings
    best, after = searched.best, searched.diagnosis
    if best is None or after is None:
        return None, searched, judge_names(beside, searched)
    adequate = not after.test.rejected_with_margin
    blocks = prediction.masks_of_blocks(blocks_room.predictable_blocks(given.runs, space.bare))
    stood = judge_names(beside, searched, blocks=blocks) if adequate else None
    if stood is not None and all(map(stood.established, best.effects)):
        return (best, after), searched, stood

    def diagnosed(fit: Candidate) -> Proposed:
        return fit, after if fit is best else search.diagnose_candidate(space, fit, beside.bases, beside.left)

    given.progress(progress_remark("held out"))
    path = search.best_of_each_size(searched)
    few = prediction.smallest_predictive_set(space, given.runs, base, path, predicted)
    proposed = best, after
    if stood is None:
        proposed = diagnosed(best if few is None else few)
        stood = judge_names(beside, searched, proposed, blocks)
    names = [e for e in proposed[0].effects if stood.established(e)]
    predictive = () if few is None else few.effects
    added_effects = [e for e in predictive if e not in names and not stood.imitates_curve(e)]
    names += added_effects[: settings.slots - len(names)]
    if not names:
        return None, searched, stood
    fit = next((c for c in (proposed[0], best, *searched.ladder) if c.key == frozenset(names)), None)
    if fit is None:
        active = candidates.fill_slots(names, settings)
        begins = candidates.start_of_fit(space, proposed[0], active, settings, beside.left.scores)
        (fit,) = candidates.fit_candidates(space, [(active, begins)], settings)
        searched = dataclasses.replace(searched, ladder=(*searched.ladder, fit))
    return proposed if fit is proposed[0] else diagnosed(fit), searched, stood
