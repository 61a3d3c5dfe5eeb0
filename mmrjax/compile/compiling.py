"""Compiled functions whose programs serve all robots that equations cannot tell apart.

A program belongs to the structure of its arguments, and a rig has much of that which no equation reads: priors,
columns of files, the class of an effect whose prior is of another size. What has such things has a method
`for_equations`, which gives it without them.
"""

from __future__ import annotations

import functools
import os
from collections.abc import Callable, Hashable
from typing import Any, ParamSpec, TypeVar

import equinox as eqx
import jax

from mmrjax import SOUND_AT_LEVEL_0
from mmrjax.compile.programs import TRACING, Programs, structure_of

P = ParamSpec("P")
T = TypeVar("T")


def _has_more(x: Any) -> bool:
    return hasattr(x, "for_equations")


def for_equations(x: T) -> T:
    """Any arguments, with nothing in them that no equation reads."""
    return jax.tree.map(lambda leaf: leaf.for_equations() if _has_more(leaf) else leaf, x, is_leaf=_has_more)


#: Options of XLA for programs over a few hundred points: compiled in three quarters of the time, no slower to run.
SMALL = {"xla_cpu_use_fusion_emitters": False}
#: The same with few optimizations, for runs over time: half of that time again, no slower to run (0.91 s for 1.06 an
#: evaluation of two searches with the library, four runs of 3072 steps).
OVER_TIME = {**SMALL, "xla_backend_optimization_level": 1}
#: The same for programs that run a few times each, with few optimizations: none where that is sound, as from the
#: command line (the loop on `measured` with nothing kept then takes 63 s of processor time, 78 at level 1).
SELDOM = {**SMALL, "xla_backend_optimization_level": 0 if SOUND_AT_LEVEL_0 in os.environ.get("XLA_FLAGS", "") else 1}


def compiled(function: Callable[P, T], *, options: dict[str, Any] | None = None) -> Callable[P, T]:
    """`eqx.filter_jit` of a function; one that returns a robot returns it as `for_equations` leaves it.

    Where a folder for them is stated its programs are kept there (`mmrjax.compile.programs`). One thread traces at a
    time; programs that were traced before run side by side, and those that are kept are compiled side by side.

    Args:
        options: of XLA, by which programs that are kept are compiled: `SMALL`, `SELDOM` or None for its own.
    """
    inner, kept, traced = eqx.filter_jit(function), Programs(function, options), set[Hashable]()

    @functools.wraps(function)
    def call(*args: P.args, **named: P.kwargs) -> T:
        arguments = for_equations((args, named))
        structure = structure_of(arguments)
        program = kept.of_structure(structure, arguments)
        if program is not None:
            return program(arguments)
        if structure is not None and structure in traced:
            return inner(*arguments[0], **arguments[1])
        with TRACING:
            found = inner(*arguments[0], **arguments[1])
        if structure is not None:
            traced.add(structure)
        return found

    return call
