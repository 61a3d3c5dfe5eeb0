"""Compiled functions that share programs between robots with the same equations, and their precision.

A program belongs to the structure of its arguments. A rig has many fields that no equation reads: priors, columns of
files, the class of an effect with other priors. Objects with such fields have a method `for_equations`, which returns
them without these fields.

JAX computes in single precision by default, and importing this package does not change that. A public function
switches to double precision in its own thread until it returns, if it is called outside a trace. If JAX is in single
precision, robots, conditions and results contain NumPy arrays, because JAX would round its own arrays.
"""

from __future__ import annotations

import concurrent.futures
import contextlib
import dataclasses
import functools
import os
from collections.abc import Callable, Hashable
from dataclasses import replace
from typing import Any, ParamSpec, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from mmrjax import SOUND_AT_LEVEL_0, WORKER
from mmrjax.compile.programs import TRACING, Programs, has_tracer, structure_of

#: Reason for refusing a fit inside a trace in single precision, with the remedy.
SINGLE = (
    "called inside a JAX transformation in single precision, too coarse for a fit. Call it outside, or set "
    'jax.config.update("jax_enable_x64", True)'
)

P = ParamSpec("P")
T = TypeVar("T")


def is_double() -> bool:
    """True if JAX computes in double precision in this thread."""
    return bool(jnp.result_type(float) == jnp.float64)


def in_trace(*arguments: Any) -> bool:
    """True if some of these are tracers, or if JAX is tracing a function here."""
    return has_tracer(arguments) or isinstance(jax.device_put(np.zeros(())), jax.core.Tracer)


def in_double(function: Callable[P, T]) -> Callable[P, T]:
    """Decorator: the function computes in double precision when it is called outside a trace.

    If JAX was in single precision before the call, arrays in the result are returned as NumPy arrays.
    """

    @functools.wraps(function)
    def call(*args: P.args, **named: P.kwargs) -> T:
        if is_double() or in_trace(args, named):
            return function(*args, **named)
        with jax.enable_x64(True):
            double_args: Any = [_in_double_precision(x) for x in args]
            double_named: Any = {name: _in_double_precision(x) for name, x in named.items()}
            return on_host(function(*double_args, **double_named))

    return call


def computed_outside_trace(function: Callable[P, T]) -> Callable[P, T]:
    """Decorator like `in_double` for functions of concrete numbers, computed at once even inside a trace."""
    double = in_double(function)

    @functools.wraps(function)
    def call(*args: P.args, **named: P.kwargs) -> T:
        if not in_trace():  # compiled functions then take half the time per call
            return double(*args, **named)
        with jax.ensure_compile_time_eval():
            return double(*args, **named)

    return call


def as_floats(tree: T) -> T:
    """Returns a tree with its floating-point arrays as JAX arrays, in JAX's current precision."""
    return jax.tree.map(
        lambda x: jnp.asarray(x, float) if eqx.is_array(x) and jnp.issubdtype(x.dtype, jnp.floating) else x, tree
    )


def _in_double_precision(argument: Any) -> Any:
    """Returns a module with its floating-point numbers as JAX arrays in double precision, others unchanged."""
    return as_floats(argument) if isinstance(argument, eqx.Module) else argument


def as_jax_arrays(tree: T) -> T:
    """Returns a tree with JAX arrays for NumPy arrays, in JAX's current precision and as constants of a trace."""
    with jax.ensure_compile_time_eval():
        return jax.tree.map(lambda x: jnp.asarray(x) if isinstance(x, np.ndarray | np.generic) else x, tree)


def on_host(tree: T) -> T:
    """Returns a tree with NumPy arrays in place of JAX arrays.

    An object with a method `on_host` converts itself. In a dataclass that is not a pytree, modules are converted.
    """
    if hasattr(tree, "on_host"):
        return tree.on_host()
    if dataclasses.is_dataclass(tree) and not isinstance(tree, type) and jax.tree_util.all_leaves([tree]):
        fields = {f.name: getattr(tree, f.name) for f in dataclasses.fields(tree)}
        changes: Any = {name: on_host(x) for name, x in fields.items() if isinstance(x, eqx.Module)}
        return replace(tree, **changes) if changes else tree
    return jax.tree.map(lambda x: np.asarray(x) if isinstance(x, jax.Array) else x, tree)


def as_array(value: Any, kind: type = float) -> Any:
    """Returns a user's numbers as an array: of JAX if JAX is double or if they are one already, else of NumPy."""
    if isinstance(value, jax.Array):
        return jnp.asarray(value, kind)
    return jnp.asarray(value, kind) if is_double() else np.asarray(value, kind)


class Threads(concurrent.futures.ThreadPoolExecutor):
    """Pool of threads. Each call is computed in the precision of the thread that submits it."""

    def __init__(self, workers: int) -> None:
        """Makes a pool of this number of threads."""
        super().__init__(workers, WORKER)

    def submit(self, fn: Callable[..., T], /, *args: Any, **named: Any) -> concurrent.futures.Future[T]:
        """Submits a call, to be computed in the precision of this thread."""
        return super().submit(_in_precision, is_double(), fn, *args, **named)


def _in_precision(double: bool, function: Callable[..., T], /, *args: Any, **named: Any) -> T:
    with jax.enable_x64(double) if double != is_double() else contextlib.nullcontext():
        return function(*args, **named)


def _reducible(x: Any) -> bool:
    return hasattr(x, "for_equations")


def for_equations(x: T) -> T:
    """The arguments without the fields that no equation reads."""
    return jax.tree.map(lambda leaf: leaf.for_equations() if _reducible(leaf) else leaf, x, is_leaf=_reducible)


#: Options of XLA for programs over a few hundred points: a quarter less compilation time, equal run time.
SMALL = {"xla_cpu_use_fusion_emitters": False}
#: The same with few optimizations, for runs over time: half of that compilation time, equal run time (0.91 s and
#: 1.06 s per evaluation of two searches with the library, n = 4 runs of 3072 steps).
OVER_TIME = {**SMALL, "xla_backend_optimization_level": 1}
#: The same with few optimizations, for programs that run only a few times. Level 0 if that is safe, as on the command
#: line: the loop on `measured` without stored programs takes 63 s of processor time, and 78 s at level 1.
SELDOM = {**SMALL, "xla_backend_optimization_level": 0 if SOUND_AT_LEVEL_0 in os.environ.get("XLA_FLAGS", "") else 1}


def compiled(function: Callable[P, T], *, options: dict[str, Any] | None = None) -> Callable[P, T]:
    """`eqx.filter_jit` of a function. A returned robot is reduced by `for_equations`.

    If a program folder is set, programs are stored there (`mmrjax.compile.programs`). Tracing is limited to one
    thread at a time. Programs run in parallel, and stored programs are also compiled in parallel.

    Args:
        options: options of XLA for programs that are stored: `SMALL`, `SELDOM` or None for the defaults.
    """
    jitted = eqx.filter_jit(function)
    programs = Programs(function, options)
    traced = set[Hashable]()

    @functools.wraps(function)
    def call(*args: P.args, **named: P.kwargs) -> T:
        arguments = for_equations((args, named))
        structure = structure_of(arguments)
        program = programs.of_structure(structure, arguments)
        if program is not None:
            return program(arguments)
        if structure is not None and structure in traced:
            return jitted(*arguments[0], **arguments[1])
        with TRACING:
            result = jitted(*arguments[0], **arguments[1])
        if structure is not None:
            traced.add(structure)
        return result

    return call
