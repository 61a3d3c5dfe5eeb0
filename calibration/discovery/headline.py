"""The main claim of a result. It holds for every noise level of the run."""

from __future__ import annotations

from collections.abc import Sequence

from calibration.data import Names
from calibration.discovery.loop_notes import Headline, VerdictSummary
from calibration.discovery.settings import WITHOUT_NAME


def headline(said: VerdictSummary, others: Sequence[tuple[float, VerdictSummary]] = ()) -> Headline:
    """The most detailed claims that the verdicts at all noise levels share.

    Args:
        others: factor on the noise, and verdict, of each other noise level.
    """
    sentences = [said, *(summary for _, summary in others)]
    factors = tuple(sorted([1.0, *(factor for factor, _ in others)]))
    if len({_verdict_without_claim(s) for s in sentences}) > 1:
        return Headline("open", (), factors)
    if _verdict_without_claim(said):
        return Headline(said.verdict, (), factors)
    laws, _ = _shared_claims([[m.names for m in s.missing if m.established] for s in sentences])
    if laws:
        alone = all(len(names) == 1 for names in laws) and not any(
            m.values or len(m.families) > len(m.names) for s in sentences for m in s.missing
        )
        effects_of_laws = [
            next(m for m in said.missing if m.established and set(m.names) & set(names)) for names in laws
        ]
        families, values = tuple(m.families for m in effects_of_laws), tuple(m.values for m in effects_of_laws)
        return Headline("named" if alone else "class", laws, factors, (), families, values)
    mechanisms, shared = _shared_claims([_claimed_families(s) for s in sentences])
    if mechanisms:
        return Headline("mechanism", mechanisms, factors, shared)
    places, shared = _shared_claims([_claimed_equations(s) for s in sentences])
    return Headline("place", places, factors, shared)


def _verdict_without_claim(said: VerdictSummary) -> str:
    """Verdict if it claims no missing effect (`none` or `undescribed`), otherwise empty."""
    return said.verdict if said.verdict in ("none", "undescribed") else ""


def _claimed_families(said: VerdictSummary) -> list[Names]:
    """Families of each established law or mechanism."""
    families = [m.families for m in said.missing if m.established]
    return (
        [*families, said.mechanism.families]
        if said.verdict == "mechanism" and said.mechanism is not None
        else families
    )


def _claimed_equations(said: VerdictSummary) -> list[Names]:
    """Equations with a discrepancy, in words, without their variable."""
    families = _claimed_families(said)
    if said.verdict in WITHOUT_NAME and said.where is not None:
        families.append((said.where.family,))
    return [tuple(dict.fromkeys(f.partition(" that ")[0] for f in those)) for those in families]


def _shared_claims(
    claims: Sequence[Sequence[Names]],
) -> tuple[tuple[Names, ...], tuple[int, ...]]:
    """Claims of the first verdict that every other verdict shares at least in part.

    Members that all verdicts share come first, then those that some noise levels cannot separate from them. A claim
    that is part of another is omitted. The second result is the number of agreed members of each claim.
    """
    counts: dict[Names, int] = {}
    for claim in claims[0]:
        alike = [[other for other in those if set(other) & set(claim)] for those in claims[1:]]
        if all(alike):
            effect_names = dict.fromkeys([*claim, *(n for those in alike for other in those for n in other)])
            shared = [n for n in claim if all(any(n in o for o in those) for those in alike)]
            ordered_names = (*shared, *(n for n in effect_names if n not in shared))
            if not any(set(ordered_names) <= set(other) for other in counts):
                counts[ordered_names] = len(shared)
    largest_claims = {c: n for c, n in counts.items() if not any(set(c) < set(other) for other in counts)}
    return tuple(largest_claims), tuple(largest_claims.values())
