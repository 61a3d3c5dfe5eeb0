"""Whether names may stand: what smooth curves would explain in their place, or take away from them.

A name is a claim about a cause; a curve claims only a place and a shape. Effects that were searched for among many
can together imitate a law that the library lacks. So names are compared with curves by evidence that counts what was
searched (MacKay, Information Theory, Inference, and Learning Algorithms, 2003, ch. 28), and where a fit with effects
is not adequate each has to keep its significance with the best curves beside it.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence

import numpy as np

from calibration.discovery.active_set import CandidateSpace
from calibration.discovery.adequacy import AdequacyTest, Diagnosis
from calibration.discovery.candidates import Candidate
from calibration.discovery.discrepancy import diagnosis_beside, fit_discrepancy, locate
from calibration.discovery.notes import CurveOver, NameSupport
from calibration.discovery.projection import Projection
from calibration.discovery.score_tests import augment_with_columns, beside_columns, family_columns
from calibration.discovery.search import Search
from calibration.discovery.settings import Settings
from calibration.discovery.smooth import smooth, surface
from calibration.inference import bases as bases_room
from calibration.inference.bases import Bases
from calibration.inference.linearization import Linearization

#: Curves that are put beside effects, one after the other.
CURVES = 3
#: Curves that are tried by themselves, whether one of them does without any name.
ALONE = 4
#: Balances whose curves stand for effects of a balance: those of one equation. What a speed meter shows too much is
#: what slip takes away.
EQUATION = {"mass": "ground", "speed": "slip"} | {
    other: b for b, others in bases_room.STANDS_FOR.items() for other in others
}
#: Pairs of variables over which a surface is tried.
VARIABLES = ("voltage", "current", "speed_motor", "slope", "payload")


def equation(place: str) -> str:
    """The place whose curves stand for what is in a balance, or in the readings of a channel."""
    return EQUATION.get(place, place)


def standing(
    space: CandidateSpace, base: Candidate, searched: Search, left: Diagnosis, bases: Bases, settings: Settings
) -> NameSupport:
    """Whether the effects of the best candidate of a search may be named.

    Args:
        left: what the base leaves.
    """
    best, after = searched.best, searched.diagnosis
    if best is None or after is None:
        return NameSupport(False, "implausible")
    other = _ruled_out(space, base, best, searched.ladder, settings)
    if other is not None:
        return NameSupport(False, "larger", other.effects)
    if after.test.rejected_with_margin:
        return _beside_curves(space, base, best, left, after, bases, settings)
    return _against_curves(space, base, best, left.linear, bases, settings)


def _ruled_out(
    space: CandidateSpace, base: Candidate, best: Candidate, ladder: Sequence[Candidate], settings: Settings
) -> Candidate | None:
    """A candidate that is the better explanation by its evidence and is ruled out by its size alone."""
    names = evidence_of_names(space, base, best, settings)
    ruled_out = [c for c in ladder if not c.plausible and np.isfinite(c.cost) and len(c.effects) <= len(best.effects)]
    better = [c for c in ruled_out if evidence_of_names(space, base, c, settings) > names + settings.preferred]
    return max(better, key=lambda c: evidence_of_names(space, base, c, settings), default=None)


# --- an adequate fit: is a curve the better explanation? ---------------------------------------------------


def cost_of_names(space: CandidateSpace, best: Candidate, settings: Settings) -> float:
    """What the fall of χ² by a set of effects is worth less [σ²]: for what their amplitudes and shapes were free to
    take, and the number of sets of its size.

    As of a curve, the prior of an amplitude is taken of the size that the data find most likely, which is its own.
    """
    at = [space.free + slot for slot, name in enumerate(best.active) if name]
    sds = np.clip(np.asarray(best.sd), 1e-6, 1.0)
    amplitudes = np.minimum(-2 * np.log(sds[at]), 1 + np.log1p((np.asarray(best.z)[at] / sds[at]) ** 2))
    shapes = -2 * np.log(sds[[k + settings.slots for k in at]])
    return float(np.sum(amplitudes) + np.sum(shapes) + 2 * math.log(math.comb(len(space.library), len(at))))


def evidence_of_names(space: CandidateSpace, base: Candidate, best: Candidate, settings: Settings) -> float:
    """Twice the log of the evidence of a set of effects over none [σ²]."""
    return 2 * (base.cost - best.cost) - cost_of_names(space, best, settings)


def _against_curves(
    space: CandidateSpace, base: Candidate, best: Candidate, linear: Linearization, bases: Bases, settings: Settings
) -> NameSupport:
    """Names against one smooth curve of one variable, or of two, in the balance of several of them or anywhere."""
    equations = [equation(space.library[e].channel or space.library[e].balance) for e in best.effects]
    places = {place for place, _ in bases_room.names(bases)}
    crowded = {e for e in equations if equations.count(e) > 1 and e in places}
    tried = _curves(space, linear, bases, crowded)
    if not tried:
        return NameSupport(True)
    curve, over = max(tried)
    # Curves are linear at the base: names are weighed by the better of their fit and what they explain there too.
    fall = max(2 * (base.cost - best.cost), _linearly(space, best, linear, settings))
    names = fall - cost_of_names(space, best, settings)
    if curve - 2 * math.log(len(tried)) > names + settings.preferred:
        return NameSupport(False, "better curve", best.effects, (over,))
    return NameSupport(True)


def _curves(
    space: CandidateSpace, linear: Linearization, bases: Bases, crowded: set[str]
) -> list[tuple[float, CurveOver]]:
    """Evidence of every smooth curve: of one variable in any place, of two in the crowded ones."""
    included, offered = space.included, dict.fromkeys(bases_room.names(bases))
    known = [
        v for v in bases_room.VARIABLES if any(v == over for _, over in offered) and _varies(linear, v, included)
    ]
    tried = []
    for place, variable in offered:
        if variable in known:
            found = smooth(linear, place, variable, included)
            tried.append((found.evidence, CurveOver(place, (variable,))))
    project = Projection(linear)
    for place in sorted(crowded):
        for pair in itertools.combinations([v for v in VARIABLES if v in known], 2):
            over = surface(linear, place, pair, included, project)
            tried.append((over.evidence, CurveOver(place, pair)))
    return tried


def _over(place: str, variable: str) -> CurveOver:
    return CurveOver(place, (variable,))


def _varies(linear: Linearization, variable: str, included: np.ndarray) -> bool:
    x = linear.variable(variable)[included]
    return bool(np.all(np.isfinite(x)) and np.ptp(x) > 1e-9 * max(np.max(np.abs(x)), 1e-9))


def _linearly(space: CandidateSpace, best: Candidate, linear: Linearization, settings: Settings) -> float:
    """What the effects of a candidate explain at the base fit, at their nearest shapes [σ²]."""
    p, s = space.free, settings.slots
    chosen = []
    for slot, name in enumerate(best.active):
        if name:
            mine = np.flatnonzero(space.library.of == space.library.names.index(name))
            chosen.append(int(mine[np.argmin(np.abs(space.library.at[mine] - best.z[p + s + slot]))]))
    a, b = Projection(linear)(np.asarray(linear.signatures)[:, chosen])
    return float(b @ np.linalg.lstsq(a, b, rcond=1e-9)[0])


# --- a fit that is not adequate: do the names keep their significance? -------------------------------------


def _beside_curves(
    space: CandidateSpace,
    base: Candidate,
    best: Candidate,
    left: Diagnosis,
    after: Diagnosis,
    bases: Bases,
    settings: Settings,
) -> NameSupport:
    """Names beside the best smooth curves, as many as leave nothing: each has to keep its significance, and what is
    left with both has to be noise.

    Curves of other equations come first: a curve in a name's own takes away what it explains, whatever that is, so it
    counts only where the others do not do. Where one curve alone does, no name is needed.
    """
    names = bases_room.names(bases)
    for k in _strongest(left, names):
        found, _ = beside_columns(left.linear, bases, family_columns(left.linear, bases, k), [names[k][0]])
        if not AdequacyTest(found, left.test.null, settings).rejected_with_margin:
            return NameSupport(False, "curve alone", curves=(_over(*names[k]),))
    own = {equation(space.library[e].channel or space.library[e].balance) for e in best.effects}
    chosen, test = _curves_beside(after.linear, after, bases, own, CURVES, settings)
    if test.rejected_with_margin:
        chosen, test = _curves_beside(after.linear, after, bases, set(), CURVES, settings)
    if test.rejected_with_margin:
        return NameSupport(False, "not adequate", best.effects)
    columns = np.concatenate([family_columns(after.linear, bases, k) for k in chosen], 1)
    significance = _significance(space, best, after.linear, columns)
    needed = after.test.threshold("single")
    lost = [e for e, t in zip(best.effects, significance, strict=True) if abs(t) < needed]
    curves = tuple(_over(*names[k]) for k in chosen)
    if lost:
        return NameSupport(False, "lost", tuple(lost), curves)
    where = locate(left, bases, space.included)
    if equation(where.place) in own & {equation(names[k][0]) for k in chosen}:
        # Names mend what a strong curve in their equation leaves at a base fit that it has pulled far away.
        curve = fit_discrepancy(space, base, left.linear, where.place, where.variable)
        if not diagnosis_beside(space, curve, bases, left).test.rejected_with_margin:
            return NameSupport(False, "curve alone", curves=(_over(where.place, where.variable),))
    return NameSupport(True, "beside", curves=curves)


def _strongest(left: Diagnosis, names: Sequence[tuple[str, str]]) -> list[int]:
    """The most improbable family of curves of each place, the most improbable of these first, at most `ALONE`."""
    deviate = np.asarray(left.scores.curve)
    first: dict[str, int] = {}
    for k in np.argsort(-deviate):
        first.setdefault(names[k][0], int(k))
    return list(first.values())[:ALONE]


def _curves_beside(
    linear: Linearization, seen: Diagnosis, bases: Bases, without: set[str], most: int, settings: Settings
) -> tuple[list[int], AdequacyTest]:
    """Families of curves, the most improbable first, until what is left with them is noise, at most so many; and the
    test of what is left.

    Args:
        seen: what the fit leaves; without: equations that get none.
    """
    places = [n[0] for n in bases_room.names(bases)]
    barred = np.isin([equation(p) for p in places], list(without))
    chosen, columns = list[int](), np.zeros((linear.readings, 0))
    deviate, test = np.array(seen.scores.curve), seen.test
    for _ in range(most):
        chosen.append(int(np.argmax(np.where(barred, -np.inf, deviate))))
        columns = np.concatenate([columns, family_columns(linear, bases, chosen[-1])], 1)
        found, deviate = beside_columns(linear, bases, columns, [places[k] for k in chosen])
        test = AdequacyTest(found, seen.test.null, settings)
        if not test.rejected_with_margin:
            break
    return chosen, test


def _significance(space: CandidateSpace, best: Candidate, linear: Linearization, columns: np.ndarray) -> list[float]:
    """Amplitude of each effect over its sd, with columns fitted beside (of prior sd 1 each)."""
    jacobian, residual = augment_with_columns(linear, columns)
    normal = jacobian.T @ jacobian
    step = -np.linalg.solve(normal, jacobian.T @ residual)
    sd = np.sqrt(np.diag(np.linalg.inv(normal)))
    at = [space.free + slot for slot, name in enumerate(best.active) if name]
    return [float((best.z[k] + step[k]) / sd[k]) for k in at]
