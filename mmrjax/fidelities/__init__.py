"""Registry of fidelities: description, options, chunk size and calibration effort of each.

Importable without jax. A new fidelity is a file that ends with `FIDELITY = Fidelity(...)`, and a line of `TABLE`.
"""

from __future__ import annotations

import dataclasses
import importlib
import math
from collections.abc import Iterable
from typing import TYPE_CHECKING

from mmrjax.model.quantities import Names

if TYPE_CHECKING:
    from mmrjax.fidelities.base import Fidelity


@dataclasses.dataclass(frozen=True)
class Option:
    """A number that a user may set for a fidelity.

    Attributes:
        default: value if not set [unit].
        most: largest allowed. All values above 0 up to it are allowed.
    """

    name: str
    unit: str
    default: float
    most: float
    meaning: str


#: Number of steady runs up to which all batches share a program.
FEW = 256


@dataclasses.dataclass(frozen=True)
class FidelityFacts:
    """Properties of a fidelity that are known without importing it.

    Attributes:
        module: module that holds its `FIDELITY`.
        description: one line.
        chunk: largest number of runs in one call. A pair if it differs between processors and an accelerator.
        starts: default number of searches of a calibration from different start points.
        profiles: True if a calibration profiles every parameter by default, with about twenty refits for each. This
            takes seconds with `steady`, and many minutes with simulations over time.
        blocks: True if a calibration refits without each block of runs by default, about a dozen times.
        options: its options.
        rollout: True if it integrates over time. Searches with it run one at a time and end sooner.
        histories: True if it can return a run over time.
        computes: parameters of a configuration that it computes and does not use as inputs, such as
            `track.guide_share`.
        resolves: prefixes of parameter names that only fidelities of this kind read.
        reverse: True if it supports derivatives in reverse mode (`jax.grad`) in addition to forward mode.
        slow: True if a batch takes long enough for a progress bar.
        one_thread: True if XLA has to run on one thread. With two, runs have hung (docs/lab/figures.md).
    """

    module: str
    description: str
    chunk: int | tuple[int, int]
    starts: int = 1
    profiles: bool = False
    blocks: bool = False
    options: tuple[Option, ...] = ()
    rollout: bool = False
    histories: bool = False
    computes: Names = ()
    resolves: Names = ()
    reverse: bool = True
    slow: bool = False
    one_thread: bool = False

    def at_once(self, accelerator: bool) -> int:
        """Largest number of runs in one call, on processors or on an accelerator."""
        return self.chunk if isinstance(self.chunk, int) else self.chunk[accelerator]

    def filled(self, runs: int) -> int:
        """Number of runs to which a batch is padded, so that small batches share a compiled program.

        Computing the additional steady runs takes less time than compiling another program.
        """
        return runs if self.rollout else max(runs, FEW)

    def resolved(self, **given: float | None) -> dict[str, float]:
        """Every option by name: the given value, or its default if the value is missing or None.

        Raises:
            ValueError: an option that this fidelity does not have, or a number out of range.
        """
        values = {option.name: option.default for option in self.options}
        for name, value in given.items():
            if value is None:
                continue
            if name not in values:
                option_names = ", ".join(values) or "none"
                raise ValueError(f"{name}: got {value!r}; this fidelity has the options: {option_names}")
            values[name] = float(value)
        for option in self.options:
            value = values[option.name]
            if not (math.isfinite(value) and 0 < value <= option.most):
                raise ValueError(
                    f"{option.name}: got {value:g}; expected more than 0, at most {option.most:g} {option.unit}"
                )
        return values


def _duration_option(default: float, most: float) -> Option:
    return Option("duration", "s", default, most, "length of a run")


_STEP = Option("step", "s", 1e-4, 0.01, "integration step")

#: By name, the cheapest first. Read through the module, so that a new line adds a fidelity everywhere.
TABLE: dict[str, FidelityFacts] = {
    "steady": FidelityFacts(
        "mmrjax.fidelities.steady",
        "the operating point, a root of the balances with implicit derivatives",
        chunk=(262_144, 4_194_304),
        starts=64,
        profiles=True,
        blocks=True,
    ),
    "drive": FidelityFacts(
        "mmrjax.fidelities.drive",
        "the ODE of drives and chassis, with slip, inductance and battery",
        chunk=(4_096, 65_536),
        options=(_duration_option(30.0, 86_400.0),),
        rollout=True,
        histories=True,
        reverse=False,
    ),
    "track": FidelityFacts(
        "mmrjax.fidelities.track",
        "half a robot in MuJoCo MJX, with individual contacts",
        chunk=(512, 16_384),
        options=(_duration_option(1.5, 3600.0), _STEP),
        rollout=True,
        histories=True,
        computes=("track.guide_share",),
        resolves=("running_gear.",),
        slow=True,
        one_thread=True,
    ),
}

NAMES: Names = tuple(TABLE)


def fidelity_facts(name: str) -> FidelityFacts:
    """Properties of a fidelity that are known without importing it.

    Raises:
        KeyError: no such fidelity. The message lists the valid names.
    """
    if name not in TABLE:
        raise KeyError(f"no fidelity {name}; there are {', '.join(TABLE)}")
    return TABLE[name]


#: Parts of parameter names that no fidelity reads in straight travel.
OF_TURNS = ".turning."


def unread_parameters(name: str, parameters: Iterable[str], turns: bool) -> Names:
    """Names of those parameters that a fidelity does not use, in straight travel or in turns."""
    foreign_prefixes = {head for other in TABLE.values() for head in other.resolves} - set(
        fidelity_facts(name).resolves
    )
    return tuple(p for p in parameters if p.startswith(tuple(foreign_prefixes)) or (OF_TURNS in p and not turns))


def get_fidelity(name: str) -> Fidelity:
    """Imports and returns a fidelity by its name.

    Raises:
        KeyError: no such fidelity. The message lists the valid names.
    """
    return importlib.import_module(fidelity_facts(name).module).FIDELITY
