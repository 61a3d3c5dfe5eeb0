"""Notes on a table or a fit, as data: names, tests and numbers. `mmrjax.describe` makes their sentences."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable
from typing import NamedTuple, dataclass_transform

from calibration.described import describe


@dataclass_transform(frozen_default=True)
class Note:
    """A note; `mmrjax.describe` makes its sentence.

    Each subclass with its fields becomes a frozen dataclass.
    """

    def __init_subclass__(cls) -> None:
        dataclasses.dataclass(frozen=True)(cls)


#: Notes as results hold them: those of `calibration/data` are sentences already.
Notes = tuple[Note | str, ...]


class Step(Note):
    """Next step of a long computation.

    Attributes:
        name: a row of `step_words.STEPS`; about: values for its sentence, in order.
    """

    name: str
    about: tuple[object, ...] = ()


class HeldByPrior(Note):
    """Parameters held by their priors."""

    names: tuple[str, ...]


class Pair(NamedTuple):
    """Two parameters that the data determine only in combination.

    Attributes:
        one, other: their names; correlation: of their posterior.
        form: of the combination: their `ratio`, their `product`, or `linear`: `one` + `weight` · `other`.
        weight: of `other` [unit of one / unit of other]; negative if the difference is determined.
    """

    one: str
    other: str
    correlation: float
    form: str
    weight: float

    def to_json(self) -> dict[str, object]:
        """As in `together` of result.json."""
        return {"a": self.one, "b": self.other, "correlation": self.correlation, "determined": describe(self)}


class Determination(NamedTuple):
    """Whether data determine a parameter.

    Attributes:
        held: True if only its prior does; others: parameters that it is determined together with.
    """

    held: bool
    others: tuple[str, ...]

    @classmethod
    def of(cls, name: str, held: bool, pairs: Iterable[Pair]) -> Determination:
        """From the pairs that data determine only in combination."""
        return cls(held, tuple(p.other if p.one == name else p.one for p in pairs if name in (p.one, p.other)))


class OnlyTogether(Note):
    """Parameters that the data do not determine separately."""

    pairs: tuple[Pair, ...]


class FarFromPrior(Note):
    """A parameter far from its prior.

    Attributes:
        name: of the parameter; sds: distance [prior sds].
        of: origin of the estimate: `loop`, `calibration`, or the `edge` of a search by population.
    """

    name: str
    sds: float
    of: str


class NoiseOff(Note):
    """Residuals without structure whose size disagrees with the sds.

    Attributes:
        channel: name, "" for all; factor: size of the residuals over the sds; source: of the sds.
    """

    channel: str
    factor: float
    source: str


class Fact(Note):
    """A fact about a table or a fit without a name or a number: a row of `fit_words.FACTS`."""

    what: str


class Unsettled(Note):
    """A search that ended at its best point before it converged.

    Attributes:
        names: parameters that the data do not determine.
    """

    names: tuple[str, ...]


# --- of a table -----------------------------------------------------------------------------------------


class Unmeasured(Note):
    """A free parameter that changes no reading."""

    name: str


class LargerNoise(Note):
    """A channel with repeats that scatter more than its sd, so that the sd was enlarged.

    Attributes:
        channel: its name; factor: of the enlargement; pairs: of repeats; source: of the sd, `stated` or `assumed`.
    """

    channel: str
    factor: float
    pairs: int
    source: str


class Repeats(Note):
    """Rows under the same conditions with readings that differ beyond their noise.

    Attributes:
        source: of the table; rows: numbers of two such rows; column: of the readings; values: of both [its unit].
        apart: their difference in sds or as a share, as text.
        unused: columns that differ between the two rows and are no conditions; near: the condition most similar to
            the first of them, "" for none.
        more: number of further groups of such rows.
    """

    source: str
    rows: tuple[int, int]
    column: str
    values: tuple[float, float]
    apart: str
    unused: tuple[str, ...] = ()
    more: int = 0
    near: str = ""


class Unused(Note):
    """Columns of numbers that vary from row to row and have no role.

    Attributes:
        source: of the table; columns: each with the most similar column of this program, "" for none.
    """

    source: str
    columns: tuple[tuple[str, str], ...]


class NoLoadGives(Note):
    """Readings of the output torque with a variation that no load on a shaft causes.

    Attributes:
        source: of the table; column: of the channel; theirs: its name in the file.
        share: of the variance of the readings that no load explains.
    """

    source: str
    column: str
    theirs: str
    share: float


class NothingVaries(Note):
    """The robot predicts the same readings in all settled runs, within the noise of one.

    Attributes:
        source: of the table; rows: number of rows; column: of the imposed quantity.
        unused: columns of numbers that vary and are no conditions.
    """

    source: str
    rows: int
    column: str
    unused: tuple[str, ...] = ()


class Copied(Note):
    """A channel that is a linear function of another in all rows.

    Attributes:
        source: of the table; column: of the channel; of: column of the other; intercept, slope: in their units.
        tied: True if the rig itself ties the two channels, as a rigid gear ties its speeds.
    """

    source: str
    column: str
    of: str
    intercept: float
    slope: float
    tied: bool


class Turned(Note):
    """A channel with readings that fit the robot after a change of sign.

    Attributes:
        source: of the table; column: of the channel; theirs: its name in the file.
        off, turned: rms difference from the robot of the file, as read and with the other sign [unit of the column].
    """

    source: str
    column: str
    theirs: str
    off: float
    turned: float


class StiffSupply(Note):
    """A measured voltage that is the same in every row."""

    column: str
    value: float


class Constant(Note):
    """A condition that does not vary.

    Attributes:
        column: of the condition; value: in every row, in the column's unit.
        alike: losses that are then indistinguishable: along `slope`, of `guides` too, or at one `voltage` or `speed`.
    """

    column: str
    value: float
    alike: str


class EndsEarly(Note):
    """Histories that end before the robot reaches steady travel.

    Attributes:
        runs: their names; lasts: duration of the longest [s].
        share: their speed over that of steady travel [-], NaN if unknown.
    """

    runs: tuple[str, ...]
    lasts: float
    share: float


class NeverGrips(Note):
    """Histories with movers that slide to the end; `share` is the robot's speed over the movers' [-]."""

    runs: tuple[str, ...]
    share: float


class Thinned(Note):
    """A log with more rows than are used; `kept` of its `rows` are read."""

    source: str
    rows: int
    kept: int


class ThinnedTable(Note):
    """A table of settled runs with more rows than are used; `kept` of its `rows` are read."""

    source: str
    rows: int
    kept: int


class CoarseSteps(Note):
    """Histories of a duration [s] that makes their steps [s] too coarse for waves of a shaft."""

    lasts: float
    step: float


class StopsOnSlope(Note):
    """Histories with motors that are not driven on a slope."""

    runs: tuple[str, ...]


class InheritedPriors(Note):
    """A part that differs from the nominal robot's but has the same friction.

    Attributes:
        part: its name; changed: values that differ (name, here, nominal robot); kept: names of values that do not.
    """

    part: str
    changed: tuple[tuple[str, float, float], ...]
    kept: tuple[str, ...]


class OffBy(Note):
    """Readings that a robot like this one cannot have.

    Attributes:
        column, unit: of the channel; factor: of the readings over possible ones.
        units: that would make the readings possible; others: columns with the same factor.
        imposed: column of the quantity imposed on the motors.
    """

    column: str
    unit: str
    factor: float
    units: tuple[str, ...]
    others: tuple[str, ...]
    imposed: str


class SlopesIn(Note):
    """Slopes in another unit: the current rises `rise` times as fast with the slope as the robot's."""

    unit: str
    rise: float


# --- of a fit -------------------------------------------------------------------------------------------


class EstimatedNoise(Note):
    """Channels with estimated noise, with the sd [%]."""

    percent: tuple[tuple[str, float], ...]


class BesideSteady(Note):
    """Number of parameters within their intervals of the optimum with `steady`; the furthest, its distance [sd]."""

    inside: int
    of: int
    furthest: str
    sds: float


class OfRows(Note):
    """Numbers of the rows with a property: `limited` by adhesion to all but a share of it [-], the running gear
    `jumps`, or a status."""

    rows: tuple[int, ...]
    what: str
    share: float = 0.0


class AtBound(Note):
    """A parameter at its `lower` or `upper` bound."""

    name: str
    side: str


class ProductAlone(Note):
    """A guide's share that acts only through its product with a friction, which is `free` or fixed."""

    friction: str
    share: str
    free: bool


class PriorOfProduct(Note):
    """A guide friction with the prior of its product with the guides' share, for which the model computes `share`."""

    name: str
    mean: float
    sd: float
    share: float


class NoPrediction(Note):
    """Rows without a prediction if blocks of a kind are held out, and the number of all rows."""

    kind: str
    rows: int
    of: int


class SamePredictions(Note):
    """Kinds of blocks that give the same hold-out predictions of all rows as those of `kind`."""

    kind: str
    others: tuple[str, ...]


class BlockNotConverged(Note):
    """A kind of blocks with at least one hold-out search that did not converge."""

    kind: str


class Agreement(Note):
    """Outcome of searches from several starts.

    Attributes:
        starts: number of searches; agree: those at the best optimum; elsewhere: those at other optima.
        more: rise of the objective at the next best optimum [½σ²]; open: searches that did not converge.
    """

    starts: int
    agree: int
    elsewhere: int
    more: float
    open: int


class Elsewhere(Note):
    """Number of searches, `of` all, that converged at other values of parameters."""

    searches: int
    of: int
    names: tuple[str, ...]


class InPieces(Note):
    """A parameter with a 95 % interval in several pieces."""

    name: str
    pieces: int


# --- of a search by population --------------------------------------------------------------------------


class Generations(Note):
    """Members and generations of a search; `settled` is True if the last generation brought no relevant gain."""

    members: int
    generations: int
    settled: bool


class LostRows(Note):
    """Number of members with a lost row, by status."""

    members: dict[str, int]


class MembersJump(Note):
    """Number of members with a running gear that jumps in some row, and such rows of the best member."""

    members: int
    best: tuple[int, ...]


class Edge(NamedTuple):
    """Bound that a parameter reached, `lower`, `upper` or "", and its distance from the middle of its prior [prior
    sd]."""

    bound: str
    sds: float


class EndedAtEdge(Note):
    """Parameters at the edge of the allowed range, by name."""

    edge: dict[str, Edge]


class ReadFromMembers(Note):
    """Parameters with unreliable derivatives of a run, and the residual of the regression over the members that
    replaces them [sd rms]."""

    names: tuple[str, ...]
    left: float


# --- whether a fit is adequate --------------------------------------------------------------------------


class Shown(NamedTuple):
    """Finding of a test of adequacy; the order of the fields decides between equal p-values.

    Attributes:
        channel: of the residuals, "" for all; what: `repeats` or `stated` (residuals exceed the scatter of repeats
            or the stated noise), `follow` a variable, or `remember` the previous sample; variable: column or name.
    """

    channel: str = ""
    what: str = ""
    variable: str = ""
