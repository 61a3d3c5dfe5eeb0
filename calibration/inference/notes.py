"""What a table or a fit has to say, as data: which name, which test, which numbers. `calibration/words` says it."""

from __future__ import annotations

import dataclasses


class Note:
    """Something worth saying; `words.notes.sentence` makes English of it, where it has no sentence of its own."""

    @property
    def statement(self) -> str:
        """In one sentence."""
        raise NotImplementedError


#: Notes as results hold them: sentences of the room of data are words already.
Notes = tuple[Note | str, ...]


@dataclasses.dataclass(frozen=True)
class Step(Note):
    """What a long computation does next.

    Attributes:
        name: a row of `words.steps.STEPS`; about: what fills its sentence, in order.
    """

    name: str
    about: tuple[object, ...] = ()


@dataclasses.dataclass(frozen=True)
class HeldByPrior(Note):
    """Parameters that are held by their priors."""

    names: tuple[str, ...]


@dataclasses.dataclass(frozen=True)
class FarFromPrior(Note):
    """A parameter far from its prior.

    Attributes:
        name: its; sds: how far [prior sds].
        of: what that is told of: `loop`, `calibration`, or the `edge` of a search by population.
    """

    name: str
    sds: float
    of: str


@dataclasses.dataclass(frozen=True)
class NoiseOff(Note):
    """Residuals without structure that are not of the size of the sds.

    Attributes:
        channel: whose, "" for all alike; factor: of the residuals over the sds; source: where these come from.
    """

    channel: str
    factor: float
    source: str
