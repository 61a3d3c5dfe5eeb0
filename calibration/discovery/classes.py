"""Classes: for each effect found, those that the same data cannot tell from it."""

from __future__ import annotations

import dataclasses

import numpy as np

from calibration.discovery.active_set import CandidateSpace
from calibration.discovery.candidates import Candidate, fit_candidates, start
from calibration.discovery.score_tests import ScoreTable
from calibration.discovery.settings import Settings

#: Effects that are tried in the place of each one.
TRIED = 16


@dataclasses.dataclass(frozen=True)
class Classes:
    """What cannot be told apart.

    Attributes:
        members: of each effect of the best candidate, effects indistinguishable from it, itself first.
        ladder: every candidate that was fitted, those of the search among them.
    """

    members: tuple[tuple[str, ...], ...]
    ladder: tuple[Candidate, ...]


def cosines(space: CandidateSpace, scores: ScoreTable) -> np.ndarray:
    """Largest |cos| between what a fit leaves of two effects' signatures, over their shapes; (effects, effects)."""
    cosine, of, count = np.abs(np.asarray(scores.cosine)), space.library.of, len(space.library)
    whole = np.zeros((count, count))
    np.maximum.at(whole, (of[:, None], of[None, :]), cosine)
    return whole


def classes(
    space: CandidateSpace, best: Candidate, ladder: tuple[Candidate, ...], scores: ScoreTable, settings: Settings
) -> Classes:
    """For each effect of the best fit, the effects that explain the data as well in its place.

    Args:
        scores: of the base fit.
    """
    cosine, names = cosines(space, scores), space.library.names
    wanted: list[tuple[int, str, tuple[str, ...]]] = []
    for slot, name in enumerate(best.effects):
        k = names.index(name)
        for j in np.argsort(-cosine[k])[:TRIED]:
            if cosine[k, j] > settings.alike and names[j] not in best.effects:
                active = tuple(names[j] if s == slot else n for s, n in enumerate(best.active))
                wanted.append((slot, names[j], active))
    known = {c.key: c for c in ladder}
    new = [active for _, _, active in wanted if frozenset(n for n in active if n) not in known]
    fitted = fit_candidates(space, [(w, start(space, best, w, settings, scores)) for w in new], settings)
    known |= {c.key: c for c in fitted}
    members = []
    for slot, name in enumerate(best.effects):
        same = [name]
        for s, other, active in wanted:
            rival = known[frozenset(n for n in active if n)]
            parallel = cosine[names.index(name), names.index(other)] > settings.parallel
            limit = settings.same_parallel if parallel else settings.same
            if s == slot and rival.plausible and 2 * (rival.cost - best.cost) <= limit:
                same.append(other)
        members.append(tuple(same))
    return Classes(tuple(members), (*ladder, *fitted))
