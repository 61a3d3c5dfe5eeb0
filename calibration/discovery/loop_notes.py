"""Verdict, reasons and remarks of the loop, as data. `mmrjax.describe` makes their sentences."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from calibration.data import Names
from calibration.discovery.location import DiscrepancyLocation
from calibration.discovery.outliers import Cluster
from calibration.inference.fit_notes import Remark

# --- the verdict ----------------------------------------------------------------------------------------


class CurveOver(NamedTuple):
    """A smooth curve of one variable, or a surface of two, in a place of the model: a balance or a channel."""

    place: str
    variables: Names


#: Advantage in evidence of a smooth curve of an effect's own equation that refutes its name [σ²]
#: (docs/lab/findings.md, "The price of a name").
BETTER = 5.0
#: Least share of its root that an effect keeps without any one run. A row of a table may have a wrong reading; a run
#: of a history has hundreds of samples, so that only significance is tested.
KEPT = {"row": 1 / math.sqrt(3), "run": 0.0}
#: Zero error of an instrument over the rms of its readings, below which it is not established without a stated noise:
#: sds that grow with the readings, or that are too small, leave such an offset.
SMALL_OFFSET = 0.05
#: Largest relative change of an amplitude over a variable for an established law.
FORM = 0.3
#: Least share of the informative hold-out blocks in which an effect is chosen again. Informative are those that leave
#: half of the information on it.
AGAIN = 0.8


@dataclasses.dataclass(frozen=True)
class NameTest:
    """Test of one effect of a candidate, at the fit of all the others.

    Attributes:
        effect: name of the effect.
        root: root of its score in addition to curves of other equations [σ].
        needed: critical value for the strongest effect [σ].
        curves: those of other equations.
        evidence: twice the log evidence of the effect over the best smooth curve of its own equation [σ²].
        row: number of the run with the smallest root when left out, None if none was.
        root_without: that root. A settled run is a row of its table, see `what`. For histories it is scaled
            to the remaining runs.
        again: share of the informative blocks without which an effect of its family is still the strongest.
        larger: effects of a set without it that is the better explanation, but not of a plausible size.
        remains: True if the largest set of the search leaves a discrepancy in its equation.
        what: name of a run, `row` or `run`.
        varies: root of the score of an amplitude that changes with a variable, in addition to the largest set [σ].
        over: variable of the largest change.
        by_chance: critical value for as many variables, independent of the library.
        spread: relative change of the amplitude to either end of that variable [-].
        offset: zero error of an instrument without a stated noise, over the rms of its readings [-], else infinite.
    """

    effect: str
    root: float
    needed: float
    curves: tuple[CurveOver, ...]
    evidence: float
    row: int | None = None
    root_without: float = math.inf
    again: float = 1.0
    larger: Names = ()
    remains: bool = False
    what: str = "row"
    varies: float = 0.0
    over: str = ""
    by_chance: float = 0.0
    spread: float = math.inf
    offset: float = math.inf

    @property
    def stands(self) -> bool:
        """True if it is significant, and explains as much as any curve in its place."""
        return self.root >= self.needed and self.evidence >= -BETTER

    @property
    def rests_on(self) -> int | None:
        """Number of the row without which the test would fail. None if it depends on no single row, or fails
        anyway."""
        if self.root < self.needed:
            return None
        return self.row if self.root_without < max(self.needed, KEPT[self.what] * self.root) else None

    @property
    def fails(self) -> Names:
        """Reasons against the name, rows of `loop_words.DOUBTS`, empty for an established one."""
        doubts = {
            "chance": self.root < self.needed,
            "curve": self.evidence < -BETTER,
            "row": self.rests_on is not None,
            "blocks": self.again < AGAIN,
            "larger": bool(self.larger),
            "remains": self.remains,
            "form": self.shows_form and self.spread > FORM,
            "noise": self.offset < SMALL_OFFSET,
        }
        return tuple(doubt for doubt, holds in doubts.items() if holds)

    @property
    def shows_form(self) -> bool:
        """True if a change of its amplitude over a variable is significant."""
        return self.varies > max(self.needed, self.by_chance)

    @property
    def established(self) -> bool:
        """True if it fails no test."""
        return not self.fails


@dataclasses.dataclass(frozen=True)
class NameSupport:
    """Tests of a candidate's names.

    Attributes:
        stands: True if at least one name is established.
        why: reason for the verdict, a row of `loop_words.REASONS`, "" for none.
        effects: effects to which this applies.
        curves: curves that were added, or that explain as much.
        tests: tests of each effect.
    """

    stands: bool
    why: str = ""
    effects: Names = ()
    curves: tuple[CurveOver, ...] = ()
    tests: tuple[NameTest, ...] = ()

    def test_of(self, effect: str) -> NameTest | None:
        """Test of an effect, None if it was not tested."""
        return next((t for t in self.tests if t.effect == effect), None)

    def stands_in(self, effect: str) -> bool:
        """True if an effect is a stand-in for a curve, which claims no cause.

        It explains nothing in addition to curves of other equations, and a curve of its own equation explains more.
        """
        test = self.test_of(effect)
        return test is not None and {"chance", "curve"} <= set(test.fails)

    def established(self, effect: str) -> bool:
        """True if the name of an effect is established, by a test of its own if it had one."""
        test = self.test_of(effect)
        return self.stands and (not self.tests if test is None else test.established)

    def rests_on(self, effect: str) -> int | None:
        """Number of the row that an effect depends on, None if it depends on none, or was not tested."""
        test = self.test_of(effect)
        return None if test is None else test.rests_on

    def renamed(self, names: Mapping[str, str]) -> NameSupport:
        """Copy with other leaders of the effects' classes, because a test is one of the class."""
        tests = tuple(dataclasses.replace(t, effect=names.get(t.effect, t.effect)) for t in self.tests)
        return dataclasses.replace(self, tests=tests)

    def numbered(self, numbers: np.ndarray) -> NameSupport:
        """Copy with row numbers as in messages.

        Args:
            numbers: numbers of the rows, in order.
        """
        named = (
            t if t.row is None or t.what == "run" else dataclasses.replace(t, row=int(numbers[t.row - 1]))
            for t in self.tests
        )
        return dataclasses.replace(self, tests=tuple(named))


class FreedValue(NamedTuple):
    """A base parameter at the value that explains as much as an effect, in `unit`."""

    name: str
    value: float
    unit: str


@dataclasses.dataclass(frozen=True)
class Missing:
    """An effect that was found.

    Attributes:
        names: names that these data cannot separate.
        values: stated values that may be wrong instead.
        families: families of the names.
        established: True if it is.
        test: test of its own, None without one.
    """

    names: Names
    values: tuple[FreedValue, ...]
    families: Names
    established: bool = True
    test: NameTest | None = None


#: Requirements of a mechanism: share of the excess misfit, and standard errors of its hold-out gain.
HALF, SURE = 0.5, 2.0
#: Largest number of drivers, and of equations, that the data cannot separate for a mechanism to be stated.
FEW = 3


@dataclasses.dataclass(frozen=True)
class Mechanism:
    """An equation with a discrepancy and its driver, from the effects or the smooth curve that explain most of it.

    Attributes:
        families: equation and driver in words, the best first, then those that explain as much.
        effects: effects of the library in its place, () for a curve.
        share: share of the excess misfit, χ² less its expectation, that it explains [-].
        gain, se: hold-out gain, over the readings that it changes [nat a reading].
        again: share of the informative blocks of runs without which it is found again [-].
        errors: standard error of the gain by kind of block [nat a reading].
        ammeter: those families that are errors of an ammeter beside a loss.
    """

    families: Names
    effects: Names
    share: float
    gain: float
    se: float
    again: float
    errors: Mapping[str, float] = dataclasses.field(default_factory=dict)
    ammeter: Names = ()

    @property
    def drivers(self) -> Names:
        """Possible drivers."""
        return self._possible(2)

    @property
    def candidates(self) -> int:
        """Number of possible drivers or equations, whichever is larger."""
        return max(len(self._possible(0)), len(self.drivers))

    def _possible(self, part: int) -> Names:
        """Equations (0) or drivers (2) of the families. An error of an ammeter counts as the loss."""
        losses = [f for f in self.families if f not in self.ammeter]
        return tuple(dict.fromkeys(f.partition(" that ")[part] for f in losses))

    @property
    def fails(self) -> Names:
        """Reasons against the mechanism, rows of `loop_words.NO_MECHANISM`, empty for an established one."""
        doubts = {
            "share": self.share < HALF,
            "gain": not self.gain > SURE * self.se,
            "again": self.again < AGAIN,
            "many": self.candidates > FEW,
        }
        return tuple(doubt for doubt, holds in doubts.items() if holds)


class Missed(NamedTuple):
    """A channel with a bad refit: rms error, or what effects leave of it, and noise, over its measured rms [-]."""

    channel: str
    error: float
    noise: float


@dataclasses.dataclass(frozen=True)
class Summary:
    """A verdict and all data of its statement.

    Attributes:
        verdict: `none`, `named`, `class`, `mechanism`, `place` or `undescribed`.
        p: family-wise.
        where: location of the discrepancy, or of the remaining one.
        missing: the effects found, established or tentative. Only tentative ones without names.
        nearest: effects that fit best if none may be named.
        support: tests of the names.
        aside, of: number of isolated outliers if they are many (else 0), and of all rows.
        noise: wrong sds, if they are the only finding.
        cluster: common property of outliers.
        mechanism: if no name is established. It may not be established either.
        missed: as of `LoopStages`.
        unused: columns of numbers that vary and are not used.
        far: base parameters beyond three prior sds.
    """

    verdict: str
    p: float
    where: DiscrepancyLocation | None
    missing: tuple[Missing, ...] = ()
    nearest: Names = ()
    support: NameSupport | None = None
    aside: int = 0
    of: int = 0
    noise: tuple[Remark, ...] = ()
    cluster: Cluster | None = None
    mechanism: Mechanism | None = None
    missed: tuple[Missed, ...] = ()
    unused: Names = ()
    far: Names = ()


@dataclasses.dataclass(frozen=True)
class Headline:
    """Claims that hold at every noise level tried.

    Attributes:
        level: level of the claims, a verdict, `open` if the noise decides whether an effect is missing.
        claims: laws, mechanisms or places, each with its indistinguishable alternatives.
        factors: factors on the noise.
        shared: number of the first members of each mechanism or place that hold at every noise. At some noises the
            others cannot be separated from these.
        families: families of each law, equation and driver in words.
        values: stated values that may be wrong instead of it.
    """

    level: str
    claims: tuple[Names, ...]
    factors: tuple[float, ...]
    shared: tuple[int, ...] = ()
    families: tuple[Names, ...] = ()
    values: tuple[tuple[FreedValue, ...], ...] = ()


@dataclasses.dataclass(frozen=True)
class RuledOut:
    """Reason why an effect is not plausible.

    Attributes:
        name: name of the effect.
        why: `power` (its balance would supply power), `size`, or `edge` (within an sd of the largest size).
        size: size over the largest plausible one.
        check: values that this depends on.
    """

    name: str
    why: str
    size: float = 0.0
    check: Names = ()


@dataclasses.dataclass(frozen=True)
class Asked:
    """Reason for a question to the track model.

    Attributes:
        why: a discrepancy is `missing` an effect, effects are `found`, or some explain nearly as much (`near`).
        balance, variable: balance and variable of the discrepancy.
        effects: names of the effects.
    """

    why: str
    balance: str = ""
    variable: str = ""
    effects: Names = ()


#: Hold-out errors that do not decide between alternatives.
DRAW = "draw"
