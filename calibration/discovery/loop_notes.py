"""Verdict, reasons and remarks of the loop, as data. `mmrjax.describe` makes their sentences."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from calibration.discovery.clusters import Cluster
from calibration.discovery.location import DiscrepancyLocation
from calibration.inference.fit_notes import NoiseOff, Note
from calibration.inference.series_noise import SeriesNoise

# --- the verdict ----------------------------------------------------------------------------------------


class CurveOver(NamedTuple):
    """A smooth curve of one variable, or a surface of two, in a place of the model: a balance or a channel."""

    place: str
    variables: tuple[str, ...]


#: Evidence by which a smooth curve of an effect's own equation has to be the better explanation [σ²]
#: (docs/lab/findings.md, "The price of a name").
BETTER = 5.0
#: Share of its root that an effect has to keep without any one run: without a row of a table, whose readings may be
#: wrong by themselves; without a run of a history, hundreds of samples, chance is asked alone.
KEPT = {"row": 1 / math.sqrt(3), "run": 0.0}
#: Share of itself by which an amplitude may change over a variable without costing a law its name.
FORM = 0.3
#: Share of the blocks left out, of those that leave half of what is known of an effect, in which it has to be chosen
#: again.
AGAIN = 0.8


@dataclasses.dataclass(frozen=True)
class NameTest:
    """An effect of a candidate, tested by itself at the fit of all the others.

    Attributes:
        effect: its name; root: of what it would explain there beside curves of other equations [σ]; needed: by chance
            the strongest effect reaches that [σ]; curves: those beside.
        evidence: twice the log of that for it over a smooth curve of its own equation, the best one [σ²].
        row: number of the run without which the root is smallest, None where none was left out; root_without: then.
            A settled run is a row of its table, see `what`; of histories as if the others told as much.
        again: share of the informative blocks without which an effect of its family is still the strongest.
        larger: effects of a set without it that is the better explanation, but not of a plausible size.
        remains: whether the largest set that was searched for leaves something in its equation.
        what: a run is called, `row` or `run`.
        varies: root of what an amplitude that changes with a variable explains beside the largest set [σ]; over: that
            variable; by_chance: what chance leaves to as many variables, whatever the library has.
        spread: by how much of itself the amplitude changes at either end of that variable [-].
    """

    effect: str
    root: float
    needed: float
    curves: tuple[CurveOver, ...]
    evidence: float
    row: int | None = None
    root_without: float = math.inf
    again: float = 1.0
    larger: tuple[str, ...] = ()
    remains: bool = False
    what: str = "row"
    varies: float = 0.0
    over: str = ""
    by_chance: float = 0.0
    spread: float = math.inf

    @property
    def stands(self) -> bool:
        """Whether it explains more than chance, and as much as any curve in its place."""
        return self.root >= self.needed and self.evidence >= -BETTER

    @property
    def rests_on(self) -> int | None:
        """Number of the row without which it would not stand; None where it needs none, or does not stand with it."""
        if self.root < self.needed:
            return None
        return self.row if self.root_without < max(self.needed, KEPT[self.what] * self.root) else None

    @property
    def fails(self) -> tuple[str, ...]:
        """Reasons against the name, rows of `loop_words.DOUBTS`; empty for an established one."""
        doubts = {
            "chance": self.root < self.needed,
            "curve": self.evidence < -BETTER,
            "row": self.rests_on is not None,
            "blocks": self.again < AGAIN,
            "larger": bool(self.larger),
            "remains": self.remains,
            "form": self.shows_form and self.spread > FORM,
        }
        return tuple(doubt for doubt, holds in doubts.items() if holds)

    @property
    def shows_form(self) -> bool:
        """Whether a change of its amplitude over a variable is more than chance."""
        return self.varies > max(self.needed, self.by_chance)

    @property
    def established(self) -> bool:
        """Whether nothing speaks against it."""
        return not self.fails


@dataclasses.dataclass(frozen=True)
class NameSupport:
    """Whether the names of a candidate stand.

    Attributes:
        stands: whether one at least does.
        why: reason for the verdict, a row of `loop_words.REASONS`; "" for none.
        effects: that this is said of; curves: that were put beside, or do as well; tests: of each effect.
    """

    stands: bool
    why: str = ""
    effects: tuple[str, ...] = ()
    curves: tuple[CurveOver, ...] = ()
    tests: tuple[NameTest, ...] = ()

    def test_of(self, effect: str) -> NameTest | None:
        """That of an effect; None where it was not tested."""
        return next((t for t in self.tests if t.effect == effect), None)

    def stands_in(self, effect: str) -> bool:
        """Whether it stands in for a curve, which claims no cause: beside curves of other equations it explains
        nothing, and one of its own explains more."""
        test = self.test_of(effect)
        return test is not None and {"chance", "curve"} <= set(test.fails)

    def established(self, effect: str) -> bool:
        """Whether the name of an effect stands, by itself where it was tested so."""
        test = self.test_of(effect)
        return self.stands and (not self.tests if test is None else test.established)

    def rests_on(self, effect: str) -> int | None:
        """Number of the row that an effect rests on; None where it needs none, or was not tested."""
        test = self.test_of(effect)
        return None if test is None else test.rests_on

    def renamed(self, names: Mapping[str, str]) -> NameSupport:
        """With others of their classes in the place of effects: what stands is a class, whoever leads it."""
        tests = tuple(dataclasses.replace(t, effect=names.get(t.effect, t.effect)) for t in self.tests)
        return dataclasses.replace(self, tests=tests)

    def numbered(self, numbers: np.ndarray) -> NameSupport:
        """With rows called as messages call them.

        Args:
            numbers: of the rows in turn.
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
    """An effect that was found: names that these data cannot tell apart, stated values that may be wrong instead, the
    families of the names, whether it is established, and its test by itself, None where there was none."""

    names: tuple[str, ...]
    values: tuple[FreedValue, ...]
    families: tuple[str, ...]
    established: bool = True
    test: NameTest | None = None


#: What a mechanism needs: share of the excess misfit, standard errors of its gain on data held out.
HALF, SURE = 0.5, 2.0
#: Drivers that data may not tell apart for a mechanism to be stated.
FEW = 3


@dataclasses.dataclass(frozen=True)
class Mechanism:
    """Which equation lacks something and what drives it, by the effects or the smooth curve that explain most of it.

    Attributes:
        families: equation and driver in words, the best first, then those that explain as much.
        effects: of the library in its place, () for a curve.
        share: of the excess misfit, χ² less its expectation, that it explains [-].
        gain, se: on data held out, over the readings that it changes [nat a reading].
        again: share of the informative blocks of runs without which it is found again [-].
        errors: standard error of the gain by kind of block [nat a reading].
    """

    families: tuple[str, ...]
    effects: tuple[str, ...]
    share: float
    gain: float
    se: float
    again: float
    errors: Mapping[str, float] = dataclasses.field(default_factory=dict)

    @property
    def drivers(self) -> tuple[str, ...]:
        """What may drive it: the families differ in this, or in the equation alone."""
        return tuple(dict.fromkeys(f.partition(" that ")[2] for f in self.families))

    @property
    def fails(self) -> tuple[str, ...]:
        """Reasons against the mechanism, rows of `loop_words.NO_MECHANISM`; empty for an established one."""
        doubts = {
            "share": self.share < HALF,
            "gain": not self.gain > SURE * self.se,
            "again": self.again < AGAIN,
            "many": len(self.drivers) > FEW,
        }
        return tuple(doubt for doubt, holds in doubts.items() if holds)


class Missed(NamedTuple):
    """A channel that a refit misses: rms error and estimated noise over its measured rms [-]."""

    channel: str
    error: float
    noise: float


@dataclasses.dataclass(frozen=True)
class Summary:
    """A verdict with all that its statement says.

    Attributes:
        verdict: `none`, `named`, `class`, `mechanism`, `place` or `undescribed`; p: family-wise.
        where: something is missing, or remains.
        missing: the effects found, established or tentative; without names none is established.
        nearest: effects that come nearest where none may be named; support: whether names stand.
        aside, of: rows that lie off alone where these are many, of how many; 0 else.
        noise: sds that are off, where that is all; cluster: what rows that lie off have in common.
        mechanism: where no name stands, established or not.
        missed: channels that the model does not describe; unused: columns of numbers that vary and are not used;
            far: base parameters beyond three prior sds.
    """

    verdict: str
    p: float
    where: DiscrepancyLocation | None
    missing: tuple[Missing, ...] = ()
    nearest: tuple[str, ...] = ()
    support: NameSupport | None = None
    aside: int = 0
    of: int = 0
    noise: tuple[NoiseOff, ...] = ()
    cluster: Cluster | None = None
    mechanism: Mechanism | None = None
    missed: tuple[Missed, ...] = ()
    unused: tuple[str, ...] = ()
    far: tuple[str, ...] = ()


@dataclasses.dataclass(frozen=True)
class Headline:
    """What holds at every noise that was tried.

    Attributes:
        level: of the claims, a verdict; `open` where it depends on the noise whether anything is missing.
        claims: laws, mechanisms or places, each with those that data cannot tell from it.
        factors: on the noise.
        shared: of each mechanism or place, how many of its members come first that hold at every noise; the others
            cannot be told from these at some.
    """

    level: str
    claims: tuple[tuple[str, ...], ...]
    factors: tuple[float, ...]
    shared: tuple[int, ...] = ()


@dataclasses.dataclass(frozen=True)
class RuledOut:
    """Why an effect is not plausible.

    Attributes:
        name: its; why: its balance would supply `power`, its `size`, or an sd would take it to the `edge`.
        size: over the largest plausible one; check: what that rests on.
    """

    name: str
    why: str
    size: float = 0.0
    check: tuple[str, ...] = ()


@dataclasses.dataclass(frozen=True)
class Asked:
    """What the track model is asked about: something `missing` in a balance over a variable, effects that are `found`
    there, or such as explain the readings nearly as well (`near`)."""

    why: str
    balance: str = ""
    variable: str = ""
    effects: tuple[str, ...] = ()


#: Where data held out decide nothing between alternatives.
DRAW = "draw"


# --- remarks --------------------------------------------------------------------------------------------


class AssumedNoise(Note):
    """Channels whose sds nobody states, and what is usual, as an option states it."""

    channels: tuple[str, ...]
    usual: str


class NoiseFromSeries(Note):
    """Channels whose sds nobody states, as the scatter along series shows them."""

    noise: tuple[SeriesNoise, ...]


class RefitWorse(Note):
    """A channel that the refit misses by more than the robot as stated does: errors over its measured rms [-], and
    whether its noise is `assumed` or `estimated`."""

    channel: str
    stated: float
    refit: float
    word: str


class Copies(Note):
    """Numbers of rows that copy earlier ones."""

    rows: tuple[int, ...]


class KeptOut(Note):
    """Numbers of rows that do not count: `unusable` ones, or `outliers`."""

    rows: tuple[int, ...]
    why: str


class PhasesDiffer(Note):
    """A wave with another phase in each run: what it explains with a phase of its own in each, and with one [σ²]."""

    free: float
    held: float


class StillLacks(Note):
    """A place that lacks something over a variable, beside what was found."""

    place: str
    variable: str


class Late(Note):
    """A delay of what is imposed that the rig's file does not state, with its sd [s]."""

    delay: float
    sd: float


class Led(Note):
    """By what the leader of a class was chosen.

    Attributes:
        names, rms_sigma: of the alternatives, and their errors held out [σ].
        leader: which one leads; closest: to all rows; best: on data held out, where it is adequate.
        by: `settings.PREFERENCES`, or `DRAW`; prefer: what was asked for.
        told: share of itself by which an error has to differ to be told apart [-].
        rise_chi2: of the leader above the closest [σ²].
    """

    names: tuple[str, ...]
    rms_sigma: tuple[float, ...]
    leader: int
    closest: int
    best: int
    by: str
    prefer: str
    told: float
    rise_chi2: float


class NotPredictable(Note):
    """Kinds of blocks that the others cannot predict, as parameters are determined by one block alone."""

    kinds: tuple[str, ...]


class LostReplicates(Note):
    """Bootstrap tables that could be fitted again, of those that were asked for."""

    settled: int
    asked: int


class Outstanding(Note):
    """Verdicts at other noises that the time did not do for: factors of the sds, and `assumed` or `estimated`."""

    factors: tuple[float, ...]
    word: str


class TooFewReplicates(Note):
    """Bootstrap tables that do not do for every kind of evidence."""

    settled: int


# --- what to do next ------------------------------------------------------------------------------------


@dataclasses.dataclass(frozen=True)
class Heat:
    """A winding that gets hot.

    Attributes:
        how: where it does: in a motor that is `held` or `braked`, or in a `run`.
        temperature: after long running, infinite where none settles; allowed: None where nobody has stated it [°C].
        current: of a motor that is held [A], else 0.
    """

    how: str
    temperature: float
    allowed: float | None
    current: float = 0.0


@dataclasses.dataclass(frozen=True)
class Overspeed:
    """Motors without load that turn about as fast as they may: speed and its limit [rad/s], at a voltage [V]."""

    speed: float
    limit: float
    voltage: float


@dataclasses.dataclass(frozen=True)
class Overvoltage:
    """A supply beyond what the table used [V]."""

    voltage: float
    used: float


Watch = Heat | Overspeed | Overvoltage


class RestsOn(Note):
    """An effect that stands by one run alone, which would have to be made again, and others beside it.

    Attributes:
        test: of it.
        conditions: column → what the run was at; axis: column along which others were made at the same conditions
            otherwise, "" for none; beside: where along that others would tell most.
    """

    test: NameTest
    conditions: dict[str, str | float] = dataclasses.field(default_factory=dict)
    axis: str = ""
    beside: tuple[float, ...] = ()


class Unwritten(Note):
    """What was found predicts data held out worse than the refit does, or no better, and is not in the robot that is
    written: a `curve`, or effects; by how much, and the standard error [nat a reading]."""

    curve: bool
    gain: float
    se: float
