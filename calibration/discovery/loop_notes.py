"""Verdict, reasons and remarks of the loop, as data. `mmrjax.describe` makes their sentences."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from calibration.data import Names
from calibration.discovery.location import DiscrepancyLocation
from calibration.discovery.outliers import OutlierCluster
from calibration.discovery.settings import WITHOUT_NAME
from calibration.inference.fit_notes import Remark

# --- the verdict ----------------------------------------------------------------------------------------

#: Verdicts without a missing effect.
WITHOUT_CLAIM = ("none", "undescribed")


class PlacedCurve(NamedTuple):
    """A smooth curve of one variable, or a surface of two, in a balance or a channel of the model."""

    place: str
    variables: Names


#: Advantage in evidence of a smooth curve of an effect's own equation that refutes its name [σ²]
#: (docs/lab/findings.md, "Why the constants are what they are").
BETTER = 5.0
#: Least share of its root that an effect keeps without any one row of a table, which may have a wrong reading.
KEPT = 1 / math.sqrt(3)
#: Zero error of an instrument over the rms of its readings, below which it is not established without a stated noise.
#: Assumed sds that grow with the readings, or that are too small, leave such an offset.
SMALL_OFFSET = 0.05
#: Largest relative change of an amplitude over a variable for an established law.
FORM = 0.3
#: Least share of the informative hold-out blocks in which an effect is chosen again. Informative are those that leave
#: half of the information on it.
AGAIN = 0.8


@dataclasses.dataclass(frozen=True)
class NameTest:
    """Test of one effect of a candidate, with all its other effects fitted.

    Attributes:
        effect: name of the effect.
        root: square root of the effect's score if curves of other equations are fitted too [σ].
        needed: critical value of that root for the strongest effect of the library [σ].
        curves: the curves of other equations.
        evidence: twice the log evidence for the effect over the best smooth curve of its own equation [σ²].
        row: number of the row whose omission reduces the root most, for a log the number of the run of `changed`.
            None if there are too few.
        root_without: root without that row [σ]. Infinite for a log.
        again: share of the informative blocks for which a fit without the block still finds an effect of its family
            strongest.
        larger: effects that explain the data better, but not at a plausible size.
        remains: True if the largest set of the search still leaves a discrepancy in the equation of the effect.
        varies: square root of the score if the amplitude may change with a variable, in addition to the largest set
            [σ].
        over: variable with which the amplitude changes most.
        by_chance: critical value of `varies` for that number of variables, whatever the library.
        spread: relative change of the amplitude at an end of that variable [-].
        offset: zero error of an instrument without a stated noise, divided by the rms of its readings [-]. Otherwise
            infinite.
        changed: of a log, the parameter, or the place of a constant error, that explains most if it differs in one
            run. Empty for a table.
        root_changed: square root of the score of that difference [σ].
    """

    effect: str
    root: float
    needed: float
    curves: tuple[PlacedCurve, ...]
    evidence: float
    row: int | None = None
    root_without: float = math.inf
    again: float = 1.0
    larger: Names = ()
    remains: bool = False
    varies: float = 0.0
    over: str = ""
    by_chance: float = 0.0
    spread: float = math.inf
    offset: float = math.inf
    changed: str = ""
    root_changed: float = 0.0

    @property
    def rests_on(self) -> int | None:
        """Number of the row without which the test would fail, or of the run in which a different constant explains
        as much. None if there is none.
        """
        if self.changed:
            return self.row if self.root_changed >= max(self.root, self.needed) else None
        alone = self.root_without < max(self.needed, KEPT * self.root)
        return self.row if alone and self.root >= self.needed else None

    @property
    def fails(self) -> Names:
        """Reasons against the name, as rows of `loop_words.DOUBTS`. Empty if the name is established."""
        doubts = {
            "chance": self.root < self.needed,
            "curve": self.evidence < -BETTER,
            "row": self.rests_on is not None and not self.changed,
            "run": self.rests_on is not None and bool(self.changed),
            "blocks": self.again < AGAIN,
            "larger": bool(self.larger),
            "remains": self.remains,
            "form": self.shows_form and self.spread > FORM,
            "noise": self.offset < SMALL_OFFSET,
        }
        return tuple(doubt for doubt, holds in doubts.items() if holds)

    @property
    def shows_form(self) -> bool:
        """True if its amplitude changes significantly with a variable, so that the law has another form."""
        return self.varies > max(self.needed, self.by_chance)

    @property
    def established(self) -> bool:
        """True if there is no reason against the name."""
        return not self.fails


@dataclasses.dataclass(frozen=True)
class NameSupport:
    """Tests of a candidate's names.

    Attributes:
        stands: True if at least one name is established.
        why: reason for the verdict on the names, a row of `loop_words.REASONS`, "" for none.
        effects: effects to which the reason applies.
        curves: curves that were added to the fit, or that explain as much.
        tests: test of each effect.
    """

    stands: bool
    why: str = ""
    effects: Names = ()
    curves: tuple[PlacedCurve, ...] = ()
    tests: tuple[NameTest, ...] = ()

    def test_of(self, effect: str) -> NameTest | None:
        """Test of an effect, None if it was not tested."""
        return next((t for t in self.tests if t.effect == effect), None)

    def imitates_curve(self, effect: str) -> bool:
        """True if an effect only imitates a smooth curve, so that it names no cause.

        It explains nothing beyond curves of other equations, and a curve of its own equation explains more.
        """
        test = self.test_of(effect)
        return test is not None and {"chance", "curve"} <= set(test.fails)

    def established(self, effect: str) -> bool:
        """True if the name of an effect is established, by its own test if there is one."""
        test = self.test_of(effect)
        return self.stands and (not self.tests if test is None else test.established)

    def with_row_numbers(self, numbers: np.ndarray) -> NameSupport:
        """Copy with row numbers as used in messages.

        Args:
            numbers: number of each row.
        """
        numbered = (
            t if t.row is None or t.changed else dataclasses.replace(t, row=int(numbers[t.row - 1]))
            for t in self.tests
        )
        return dataclasses.replace(self, tests=tuple(numbered))


class AlternativeValue(NamedTuple):
    """A base parameter whose value, if changed, explains as much as an effect. `value` is in `unit`."""

    name: str
    value: float
    unit: str


@dataclasses.dataclass(frozen=True)
class MissingEffect:
    """An effect that the loop found, with its alternatives.

    Attributes:
        names: the effect and those that the data cannot separate from it.
        values: stated values that may be wrong instead.
        families: families of these effects.
        established: True if its name is established.
        test: test of its name, None if it was not tested.
    """

    names: Names
    values: tuple[AlternativeValue, ...]
    families: Names
    established: bool = True
    test: NameTest | None = None


#: Requirements of a mechanism: share of the excess misfit, and standard errors of its hold-out gain.
HALF, SURE = 0.5, 2.0
#: Largest number of drivers, and of equations, that the data cannot separate for a mechanism to be stated.
FEW = 3


@dataclasses.dataclass(frozen=True)
class Mechanism:
    """An equation with a discrepancy and the variable that drives it, without an exact law.

    Attributes:
        families: equation and driving variable in words. The best is first, then those that explain as much.
        effects: effects of the library that show the mechanism, () if a smooth curve shows it.
        share: share of the excess misfit (χ² minus its expectation) that it explains [-].
        gain, se: hold-out gain and its standard error, over the readings that it changes [nat per reading].
        again: share of the informative blocks for which a fit without the block finds it again [-].
        errors: standard error of the gain for each kind of block [nat per reading].
        ammeter: families that are errors of an ammeter and would imitate a loss.
        run, changed: run and constant of a log, see `NameTest`, if the constant explains as much by a difference in
            that run. None and any constant otherwise.
    """

    families: Names
    effects: Names
    share: float
    gain: float
    se: float
    again: float
    errors: Mapping[str, float] = dataclasses.field(default_factory=dict)
    ammeter: Names = ()
    run: int | None = None
    changed: str = ""

    @property
    def drivers(self) -> Names:
        """Variables that may drive it."""
        return self._family_parts(2)

    @property
    def candidates(self) -> int:
        """Number of possible driving variables or of possible equations, whichever is larger."""
        return max(len(self._family_parts(0)), len(self.drivers))

    def _family_parts(self, part: int) -> Names:
        """Equations (part 0) or driving variables (part 2) of its families. An ammeter error counts as the loss that
        it imitates.
        """
        losses = [f for f in self.families if f not in self.ammeter]
        return tuple(dict.fromkeys(f.partition(" that ")[part] for f in losses))

    @property
    def fails(self) -> Names:
        """Reasons against the mechanism, as rows of `loop_words.NO_MECHANISM`. Empty if it is established."""
        doubts = {
            "share": self.share < HALF,
            "gain": not self.gain > SURE * self.se,
            "again": self.again < AGAIN,
            "many": self.candidates > FEW,
            "run": self.run is not None,
        }
        return tuple(doubt for doubt, holds in doubts.items() if holds)


class MissedChannel(NamedTuple):
    """A channel that the model does not describe. The rms error (of the refit, or what effects leave) and the noise
    are divided by its measured rms [-].
    """

    channel: str
    error: float
    noise: float


@dataclasses.dataclass(frozen=True)
class VerdictSummary:
    """A verdict with all data from which its statement is written.

    Attributes:
        verdict: `none`, `named`, `class`, `mechanism`, `place` or `undescribed`.
        p: family-wise p-value.
        where: location of the discrepancy, or of the rest that the effects leave.
        missing: effects found, established or tentative. If no name is established, all are tentative.
        nearest: effects that fit best, if none may be named.
        support: tests of the names.
        aside, of: number of isolated outliers if they are many (otherwise 0), and number of all rows.
        noise: remark on wrong sds, if they are the only finding.
        cluster: property that the outliers share.
        mechanism: equation and driving variable, if no effect is established. They need not be established either.
        missed: channels that the model does not describe, as in `LoopStages`.
        unused: columns of numbers that vary and are not used.
        far: base parameters more than three prior sds from their priors.
    """

    verdict: str
    p: float
    where: DiscrepancyLocation | None
    missing: tuple[MissingEffect, ...] = ()
    nearest: Names = ()
    support: NameSupport | None = None
    aside: int = 0
    of: int = 0
    noise: tuple[Remark, ...] = ()
    cluster: OutlierCluster | None = None
    mechanism: Mechanism | None = None
    missed: tuple[MissedChannel, ...] = ()
    unused: Names = ()
    far: Names = ()


@dataclasses.dataclass(frozen=True)
class Headline:
    """Claims that hold at every noise level tried.

    Attributes:
        level: verdict that all noise levels share. `open` if the noise level decides whether an effect is missing.
        claims: laws, mechanisms or places, each with its alternatives.
        factors: noise levels tried, as factors on the noise.
        shared: for each mechanism or place, the number of its first members that all noise levels share. At some
            noise levels, the others cannot be separated from these.
        families: equation and driving variable of each law, in words.
        values: stated values that may be wrong instead of it.
    """

    level: str
    claims: tuple[Names, ...]
    factors: tuple[float, ...]
    shared: tuple[int, ...] = ()
    families: tuple[Names, ...] = ()
    values: tuple[tuple[AlternativeValue, ...], ...] = ()


def headline(main: VerdictSummary, others: Sequence[tuple[float, VerdictSummary]] = ()) -> Headline:
    """The most detailed claims that the verdicts at all noise levels share.

    Args:
        others: factor on the noise, and verdict, of each other noise level.
    """
    verdicts = [main, *(summary for _, summary in others)]
    factors = tuple(sorted([1.0, *(factor for factor, _ in others)]))
    if len({s.verdict if s.verdict in WITHOUT_CLAIM else "" for s in verdicts}) > 1:
        return Headline("open", (), factors)
    if main.verdict in WITHOUT_CLAIM:
        return Headline(main.verdict, (), factors)
    laws, _ = _shared_claims([[m.names for m in s.missing if m.established] for s in verdicts])
    if laws:
        alone = all(len(names) == 1 for names in laws) and not any(
            m.values or len(m.families) > len(m.names) for s in verdicts for m in s.missing
        )
        effects_of_laws = [
            next(m for m in main.missing if m.established and set(m.names) & set(names)) for names in laws
        ]
        families, values = tuple(m.families for m in effects_of_laws), tuple(m.values for m in effects_of_laws)
        return Headline("named" if alone else "class", laws, factors, (), families, values)
    mechanisms, shared = _shared_claims([_claimed_families(s) for s in verdicts])
    if mechanisms:
        return Headline("mechanism", mechanisms, factors, shared)
    places, shared = _shared_claims([_claimed_equations(s) for s in verdicts])
    return Headline("place", places, factors, shared)


def _claimed_families(summary: VerdictSummary) -> list[Names]:
    """Families of each established law or mechanism."""
    families = [m.families for m in summary.missing if m.established]
    if summary.verdict == "mechanism" and summary.mechanism is not None:
        families.append(summary.mechanism.families)
    return families


def _claimed_equations(summary: VerdictSummary) -> list[Names]:
    """Equations with a discrepancy, in words, without their variable."""
    families = _claimed_families(summary)
    if summary.verdict in WITHOUT_NAME and summary.where is not None:
        families.append((summary.where.family,))
    return [tuple(dict.fromkeys(f.partition(" that ")[0] for f in names)) for names in families]


def _shared_claims(
    claims: Sequence[Sequence[Names]],
) -> tuple[tuple[Names, ...], tuple[int, ...]]:
    """Claims of the first verdict that every other verdict shares at least in part.

    Members that all verdicts share come first, then those that some noise levels cannot separate from them. A claim
    that is part of another is omitted. The second result is the number of agreed members of each claim.
    """
    counts: dict[Names, int] = {}
    for claim in claims[0]:
        overlapping = [
            [other for other in claims_of_verdict if set(other) & set(claim)] for claims_of_verdict in claims[1:]
        ]
        if all(overlapping):
            members = dict.fromkeys(
                [*claim, *(n for claims_of_verdict in overlapping for other in claims_of_verdict for n in other)]
            )
            shared = [
                n for n in claim if all(any(n in o for o in claims_of_verdict) for claims_of_verdict in overlapping)
            ]
            ordered_names = (*shared, *(n for n in members if n not in shared))
            if not any(set(ordered_names) <= set(other) for other in counts):
                counts[ordered_names] = len(shared)
    largest_claims = {c: n for c, n in counts.items() if not any(set(c) < set(other) for other in counts)}
    return tuple(largest_claims), tuple(largest_claims.values())


@dataclasses.dataclass(frozen=True)
class RuledOut:
    """Reason why an effect is implausible.

    Attributes:
        name: name of the effect.
        why: `power` (a balance would supply power), `size`, or `edge` (within an sd of the largest plausible size).
        size: amplitude relative to the largest plausible one [-].
        check: stated values that the size depends on.
    """

    name: str
    why: str
    size: float = 0.0
    check: Names = ()
