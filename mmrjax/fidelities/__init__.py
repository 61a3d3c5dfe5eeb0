"""The registry of fidelities: what each simulates, its options, how it is chunked, what effort it is worth.

Importable without jax. A new fidelity is a file that ends with `FIDELITY = Fidelity(...)`, and a line of `TABLE`.
"""

from __future__ import annotations

import dataclasses
import importlib
import math
from collections.abc import Iterable
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from mmrjax.fidelities.base import Fidelity


@dataclasses.dataclass(frozen=True)
class Option:
    """A number that a user may state for a fidelity.

    Attributes:
        default: where none is stated [unit]; most: largest allowed; the least is anything above 0.
    """

    name: str
    unit: str
    default: float
    most: float
    meaning: str


@dataclasses.dataclass(frozen=True)
class Effort:
    """What a calibration does where nobody states it.

    A profile is some twenty refits a parameter, and blocks are a dozen: seconds with `steady`, many minutes of
    rollouts.

    Attributes:
        starts: searches from different places; profiles: whether to profile every parameter; blocks: whether to fit
            without each block of runs.
    """

    starts: int
    profiles: bool
    blocks: bool


#: Settled runs that make one program for all batches of fewer.
FEW = 256


@dataclasses.dataclass(frozen=True)
class Facts:
    """What is known of a fidelity before it is imported.

    Attributes:
        module: that holds its `FIDELITY`.
        description: one line.
        chunk: runs in one call where there are many; a pair where it is another on an accelerator.
        effort: of a calibration through it.
        options: that it has.
        rollout: whether it integrates over time; searches through it then run one by one, and end sooner.
        histories: whether it can keep a run over time.
        computes: parameters of a configuration that are results here and not read, such as `track.guide_share`.
        resolves: beginnings of names of parameters that it reads and fidelities without them do not.
        reverse: whether derivatives by reverse mode (`jax.grad`) go through, next to forward ones.
        slow: whether a batch takes long enough for a bar that shows its progress.
        one_thread: whether XLA has to run on one thread: on two, runs have hung for good (docs/lab/figures.md).
    """

    module: str
    description: str
    chunk: int | tuple[int, int]
    effort: Effort
    options: tuple[Option, ...] = ()
    rollout: bool = False
    histories: bool = False
    computes: tuple[str, ...] = ()
    resolves: tuple[str, ...] = ()
    reverse: bool = True
    slow: bool = False
    one_thread: bool = False

    def at_once(self, accelerator: bool) -> int:
        """Runs in one call where there are many, on processors or on an accelerator."""
        return self.chunk if isinstance(self.chunk, int) else self.chunk[accelerator]

    def filled(self, runs: int) -> int:
        """How many runs a batch is filled up to, so that small ones share a program: settled runs take less time than
        that does to compile."""
        return runs if self.rollout else max(runs, FEW)

    def resolved(self, **given: float | None) -> dict[str, float]:
        """Every option by name: as given, else (absent or None) its default.

        Raises:
            ValueError: an option that this fidelity does not have, or a number out of range.
        """
        values = {option.name: option.default for option in self.options}
        for name, value in given.items():
            if value is None:
                continue
            if name not in values:
                known = ", ".join(values) or "none"
                raise ValueError(f"{name}: got {value!r}; this fidelity has no such option, its options: {known}")
            values[name] = float(value)
        for option in self.options:
            value = values[option.name]
            if not (math.isfinite(value) and 0 < value <= option.most):
                raise ValueError(
                    f"{option.name}: got {value:g}; expected more than 0, at most {option.most:g} {option.unit}"
                )
        return values


def _duration(default: float, most: float) -> Option:
    return Option("duration", "s", default, most, "length of a run")


_STEP = Option("step", "s", 1e-4, 0.01, "integration step")

#: By name, the cheapest first. Read through the module, so that a line more is a fidelity more everywhere.
TABLE: dict[str, Facts] = {
    "steady": Facts(
        "mmrjax.fidelities.steady",
        "the operating point as a root of the balances, with implicit derivatives",
        chunk=(262_144, 4_194_304),
        effort=Effort(starts=64, profiles=True, blocks=True),
    ),
    "drive": Facts(
        "mmrjax.fidelities.drive",
        "the ODE of drives and chassis, with slip, inductance and battery",
        chunk=(4_096, 65_536),
        effort=Effort(starts=1, profiles=False, blocks=False),
        options=(_duration(30.0, 86_400.0),),
        rollout=True,
        histories=True,
        reverse=False,
    ),
    "track": Facts(
        "mmrjax.fidelities.track",
        "half a robot as multibody dynamics in MuJoCo MJX, its contacts resolved one by one",
        chunk=(512, 16_384),
        effort=Effort(starts=1, profiles=False, blocks=False),
        options=(_duration(1.5, 3600.0), _STEP),
        rollout=True,
        histories=True,
        computes=("track.guide_share",),
        resolves=("running_gear.",),
        slow=True,
        one_thread=True,
    ),
}

NAMES: tuple[str, ...] = tuple(TABLE)


def facts(name: str) -> Facts:
    """What is known of a fidelity before it is imported.

    Raises:
        KeyError: no such fidelity; the message lists those that there are.
    """
    if name not in TABLE:
        raise KeyError(f"no fidelity {name}; there are {', '.join(TABLE)}")
    return TABLE[name]


#: What names of parameters have in them that straight travel does not read, in any fidelity.
OF_TURNS = ".turning."


def unread(name: str, parameters: Iterable[str], turns: bool = False) -> tuple[str, ...]:
    """Those of some parameters, by dotted name, that a fidelity does not read in straight travel, or in turns."""
    of_others = {head for other in TABLE.values() for head in other.resolves} - set(facts(name).resolves)
    return tuple(p for p in parameters if p.startswith(tuple(of_others)) or (OF_TURNS in p and not turns))


def get(name: str) -> Fidelity:
    """A fidelity by its name; what it needs is imported now.

    Raises:
        KeyError: no such fidelity; the message lists those that there are.
    """
    return importlib.import_module(facts(name).module).FIDELITY
