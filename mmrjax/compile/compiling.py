"""Compiled functions that share programs between robots with the same equations.

A program belongs to the structure of its arguments. A rig has many fields that no equation reads: priors, columns of
files, the class of an effect with other priors. Objects with such fields have a method `for_equations`, which returns
them without these fields.
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


def _reducible(x: Any) -> bool:
    return hasattr(x, "for_equations")


def for_equations(x: T) -> T:
    """The arguments without the fields that no equation reads."""
    return jax.tree.map(lambda leaf: leaf.for_equations() if _reducible(leaf) else leaf, x, is_leaf=_reducible)


#: Options of XLA for programs over a few hundred points: a quarter less compilation time, equal run time.
SMALL = {"xla_cpu_use_fusion_emitters": False}
#: The same with few optimizations, for runs over time: half of that compilation time, equal run time (0.91 s compared
#: with 1.06 s per evaluation of two searches with the library, four runs of 3072 steps).
OVER_TIME = {**SMALL, "xla_backend_optimization_level": 1}
#: The same with few optimizations, for programs that run only a few times: level 0 if that is safe, as on the command
#: line (the loop on `measured` without stored programs then takes 63 s of processor time, 78 s at level 1).
SELDOM = {**SMALL, "xla_backend_optimization_level": 0 if SOUND_AT_LEVEL_0 in os.environ.get("XLA_FLAGS", "") else 1}


def compiled(function: Callable[P, T], *, options: dict[str, Any] | None = None) -> Callable[P, T]:
    """`eqx.filter_jit` of a function. A returned robot is reduced by `for_equations`.

    If a program folder is set, programs are stored there (`mmrjax.compile.programs`). Tracing is limited to one
    thread at a time. Programs run in parallel, and stored programs are also compiled in parallel.

    Args:
        options: options of XLA for programs that are stored: `SMALL`, `SELDOM` or None for the defaults.
    """
    inner, programs, traced = eqx.filter_jit(function), Programs(function, options), set[Hashable]()

    @functools.wraps(function)
    def call(*args: P.args, **named: P.kwargs) -> T:
        arguments = for_equations((args, named))
        structure = structure_of(arguments)
        program = programs.of_structure(structure, arguments)
        if program is not None:
            return program(arguments)
        if structure is not None and structure in traced:
            return inner(*arguments[0], **arguments[1])
        with TRACING:
            result = inner(*arguments[0], **arguments[1])
        if structure is not None:
            traced.add(structure)
        return result

    return call
