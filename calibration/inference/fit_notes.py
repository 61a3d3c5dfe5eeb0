"""Notes on a table or a fit, as data: names, tests and numbers. `mmrjax.describe` makes their sentences."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable
from typing import NamedTuple, dataclass_transform

from calibration.described import described


@dataclass_transform(frozen_default=True)
class Note:
    """A note; `mmrjax.describe` makes its sentence.

    Each subclass with its fields becomes a frozen dataclass.
    """

    def __init_subclass__(cls) -> None:
        dataclasses.dataclass(frozen=True)(cls)


#: Notes as results hold them: sentences of the room of data are words already.
Notes = tuple[Note | str, ...]


class Step(Note):
    """What a long computation does next.

    Attributes:
        name: a row of `step_words.STEPS`; about: values for its sentence, in order.
    """

    name: str
    about: tuple[object, ...] = ()


class HeldByPrior(Note):
    """Parameters that are held by their priors."""

    names: tuple[str, ...]


class Pair(NamedTuple):
    """Two parameters of which data determine a combination alone.

    Attributes:
        one, other: their names; correlation: of their posterior.
        form: of the combination: their `ratio`, their `product`, or `linear`: `one` + `weight` · `other`.
        weight: of that [unit of one / unit of other]; negative where the difference is determined.
    """

    one: str
    other: str
    correlation: float
    form: str
    weight: float

    def to_json(self) -> dict[str, object]:
        """As in `together` of result.json."""
        return {"a": self.one, "b": self.other, "correlation": self.correlation, "determined": described(self)}


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
    """Parameters that are not determined separately."""

    pairs: tuple[Pair, ...]


class FarFromPrior(Note):
    """A parameter far from its prior.

    Attributes:
        name: its; sds: how far [prior sds].
        of: what that is told of: `loop`, `calibration`, or the `edge` of a search by population.
    """

    name: str
    sds: float
    of: str


class NoiseOff(Note):
    """Residuals without structure that are not of the size of the sds.

    Attributes:
        channel: whose, "" for all alike; factor: of the residuals over the sds; source: where these come from.
    """

    channel: str
    factor: float
    source: str


class Fact(Note):
    """A fact about a table or a fit without a name or a number: a row of `fit_words.FACTS`."""

    what: str


# --- of a table -----------------------------------------------------------------------------------------


class Unmeasured(Note):
    """A free parameter that moves no reading."""

    name: str


class LargerNoise(Note):
    """A channel whose repeats scatter more than its sd says, which is enlarged.

    Attributes:
        channel: its name; factor: by which; pairs: of repeats; source: `stated` or `assumed`, the sd.
    """

    channel: str
    factor: float
    pairs: int
    source: str


class Repeats(Note):
    """Rows under the same conditions whose readings differ beyond their noise.

    Attributes:
        source: of the table; rows: numbers of two of them; column: of the readings; values: theirs [its unit].
        apart: by how much, in sds or as a share, as text.
        unused: columns that differ between the two rows and are no conditions; near: condition that the first of them
            is most like, "" for none.
        more: groups of such rows beside this one.
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
        source: of the table; columns: each with the column of this program that it is most like, "" for none.
    """

    source: str
    columns: tuple[tuple[str, str], ...]


class NoLoadGives(Note):
    """Readings of the torque at the output that vary as no load on a shaft makes them vary.

    Attributes:
        source: of the table; column: of the channel; theirs: its name in the file.
        share: of the variance of the readings that no load explains.
    """

    source: str
    column: str
    theirs: str
    share: float


class NothingVaries(Note):
    """The robot foresees the same readings in all settled runs, within the noise of one.

    Attributes:
        source: of the table; rows: how many; column: of what is imposed.
        unused: columns of numbers that vary and are no conditions.
    """

    source: str
    rows: int
    column: str
    unused: tuple[str, ...] = ()


class Copied(Note):
    """A channel that is a line of another in every row.

    Attributes:
        source: of the table; column: its; of: that of the other; intercept, slope: of the line, in their units.
        tied: True where the rig itself ties the two to one another, as a rigid gear its speeds.
    """

    source: str
    column: str
    of: str
    intercept: float
    slope: float
    tied: bool


class Turned(Note):
    """A channel whose readings fit the robot with the other sign.

    Attributes:
        source: of the table; column: of the channel; theirs: its name in the file.
        off, turned: rms difference from the robot of the file, as read and turned round [unit of the column].
    """

    source: str
    column: str
    theirs: str
    off: float
    turned: float


class StiffSupply(Note):
    """A voltage that is read and is the same in every row."""

    column: str
    value: float


class Constant(Note):
    """A condition that does not vary.

    Attributes:
        column: its; value: in every row, in the column's unit.
        alike: losses that then act alike: along `slope`, of `guides` too, or at one `voltage` or `speed`.
    """

    column: str
    value: float
    alike: str


class EndsEarly(Note):
    """Histories that end before the robot is under way: the longest [s], and their speed over that of steady travel
    [-], NaN where it is not known."""

    runs: tuple[str, ...]
    lasts: float
    share: float


class NeverGrips(Note):
    """Histories in which the movers slide to the end: the robot's speed over theirs [-]."""

    runs: tuple[str, ...]
    share: float


class Thinned(Note):
    """A log of so many rows of which fewer are read."""

    source: str
    rows: int
    kept: int


class CoarseSteps(Note):
    """Histories so long [s] that their steps [s] do not resolve waves of a shaft."""

    lasts: float
    step: float


class StopsOnSlope(Note):
    """Histories whose motors are not driven on a slope."""

    runs: tuple[str, ...]


class InheritedPriors(Note):
    """A part that is not the nominal robot's while friction of it is.

    Attributes:
        part: its name; changed: what of it differs, here and on the nominal robot; kept: names of what does not.
    """

    part: str
    changed: tuple[tuple[str, float, float], ...]
    kept: tuple[str, ...]


class OffBy(Note):
    """Readings that no robot like this one shows.

    Attributes:
        column, unit: of the channel; factor: by which they are too large, or below 1 too small.
        units: in which they would be possible; others: columns that are off by as much.
        imposed: column of what is imposed on the motors.
    """

    column: str
    unit: str
    factor: float
    units: tuple[str, ...]
    others: tuple[str, ...]
    imposed: str


class SlopesIn(Note):
    """Slopes in another unit: the current rises so many times as fast with them as it should."""

    unit: str
    rise: float


# --- of a fit -------------------------------------------------------------------------------------------


class EstimatedNoise(Note):
    """Channels whose noise was estimated, with the sd [%]."""

    percent: tuple[tuple[str, float], ...]


class BesideSteady(Note):
    """Parameters within their intervals of the optimum with `steady`, of how many; the furthest and how far [sd]."""

    inside: int
    of: int
    furthest: str
    sds: float


class OfRows(Note):
    """Numbers of rows of which something is so: they are `limited` by adhesion, all but a share of it [-], the
    running gear `jumps`, or a status."""

    rows: tuple[int, ...]
    what: str
    share: float = 0.0


class AtBound(Note):
    """A parameter at its `lower` or `upper` bound."""

    name: str
    side: str


class ProductAlone(Note):
    """A guide's share that acts by its product with its friction alone, which is `free` or held."""

    friction: str
    share: str
    free: bool


class PriorOfProduct(Note):
    """A guide friction whose prior is that of its product with the guides' share, which the model puts at `share`."""

    name: str
    mean: float
    sd: float
    share: float


class NoPrediction(Note):
    """Rows without a prediction where blocks of a kind are held out, of how many."""

    kind: str
    rows: int
    of: int


class SamePredictions(Note):
    """Kinds of blocks without which every row is predicted as without those of `kind`."""

    kind: str
    others: tuple[str, ...]


class BlockNotConverged(Note):
    """A kind of block without which a search did not converge."""

    kind: str


class Agreement(Note):
    """How searches from many starts ended: `agree` of them at the best optimum, `elsewhere` at others, the next of
    which costs `more` [½σ²], the rest without converging."""

    starts: int
    agree: int
    elsewhere: int
    more: float
    open: int


class Elsewhere(Note):
    """Searches that converged at other values of parameters, of how many."""

    searches: int
    of: int
    names: tuple[str, ...]


class InPieces(Note):
    """A parameter whose 95 % interval is in pieces."""

    name: str
    pieces: int


# --- of a search by population --------------------------------------------------------------------------


class Generations(Note):
    """Members and generations of a search, and whether the last gained nothing that counts."""

    members: int
    generations: int
    settled: bool


class LostRows(Note):
    """Members with a row that is lost, by status."""

    members: dict[str, int]


class MembersJump(Note):
    """Members whose running gear jumps in some row, and in which rows the best's does."""

    members: int
    best: tuple[int, ...]


class Edge(NamedTuple):
    """Where a parameter is at the edge of what was allowed: at its `lower` or `upper` bound, else so far from the
    middle of its prior [prior sd]."""

    bound: str
    sds: float


class EndedAtEdge(Note):
    """Parameters at the edge of what was allowed, by name."""

    edge: dict[str, Edge]


class ReadFromMembers(Note):
    """Parameters by which the derivatives of a run are not to be trusted, and what the regression over the members
    leaves [sd rms]."""

    names: tuple[str, ...]
    left: float


# --- whether a fit is adequate --------------------------------------------------------------------------


class Shown(NamedTuple):
    """What a test of adequacy shows, in the order in which equals are named.

    Attributes:
        channel: whose residuals, "" for all; what: they exceed the scatter of `repeats` or the `stated` noise, or
            `follow` a variable, or `remember` the sample before; variable: its column or name.
    """

    channel: str = ""
    what: str = ""
    variable: str = ""
