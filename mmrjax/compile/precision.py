"""Precision of the public functions: double outside a trace, and that of JAX's setting within one.

JAX computes in single precision unless its user asks for double, and importing this package does not change that. A
public function that is called outside a trace switches to double precision for its own thread until it returns.
Robots, conditions and results hold NumPy's arrays where JAX is single, since its operations would cut its own arrays.
"""

from __future__ import annotations

import concurrent.futures
import contextlib
import dataclasses
import functools
from collections.abc import Callable, Iterator
from typing import Any, ParamSpec, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from mmrjax.compile.programs import has_tracer

#: Why a fit is refused inside a trace in single precision, and what to do.
SINGLE = (
    "called inside a JAX transformation in single precision, which a fit cannot be computed in; call it outside of "
    'jax.jit, or set jax.config.update("jax_enable_x64", True)'
)

P = ParamSpec("P")
T = TypeVar("T")


def is_double() -> bool:
    """True if JAX computes in double precision in this thread."""
    return bool(jnp.result_type(float) == jnp.float64)


def in_trace(*arguments: Any) -> bool:
    """True if some of these are tracers, or if JAX is tracing a function here."""
    return has_tracer(arguments) or isinstance(jax.device_put(np.zeros(())), jax.core.Tracer)


@contextlib.contextmanager
def double_precision() -> Iterator[None]:
    """Double precision of JAX in this thread meanwhile."""
    if is_double():
        yield
        return
    with jax.enable_x64(True):
        yield


def in_double(function: Callable[P, T]) -> Callable[P, T]:
    """A function that computes in double precision where it is called outside a trace.

    Arrays among its results are NumPy's where JAX was single before.
    """

    @functools.wraps(function)
    def call(*args: P.args, **named: P.kwargs) -> T:
        if is_double() or in_trace(args, named):
            return function(*args, **named)
        with jax.enable_x64(True):
            given: Any = [_widened(x) for x in args]
            by_name: Any = {name: _widened(x) for name, x in named.items()}
            return on_host(function(*given, **by_name))

    return call


def at_once(function: Callable[P, T]) -> Callable[P, T]:
    """The same of a function of concrete numbers, which is computed where it is called, within a trace too."""
    double = in_double(function)

    @functools.wraps(function)
    def call(*args: P.args, **named: P.kwargs) -> T:
        if not in_trace():  # where calls of compiled functions take half the time
            return double(*args, **named)
        with jax.ensure_compile_time_eval():
            return double(*args, **named)

    return call


def _widened(argument: Any) -> Any:
    """The same module with its floating-point numbers as JAX's arrays in double precision; anything else as it is."""

    def wide(leaf: Any) -> Any:
        return jnp.asarray(leaf, float) if eqx.is_array(leaf) and np.issubdtype(leaf.dtype, np.floating) else leaf

    return jax.tree.map(wide, argument) if isinstance(argument, eqx.Module) else argument


def ambient(tree: T) -> T:
    """A tree whose NumPy arrays are JAX's, in its precision here, and constants of what is traced."""
    with jax.ensure_compile_time_eval():
        return jax.tree.map(lambda x: jnp.asarray(x) if isinstance(x, np.ndarray | np.generic) else x, tree)


def on_host(tree: T) -> T:
    """The same with NumPy's arrays in the place of JAX's.

    An object with a method `on_host` converts itself; a result that is no pytree has its modules converted.
    """
    if hasattr(tree, "on_host"):
        return tree.on_host()
    if dataclasses.is_dataclass(tree) and not isinstance(tree, type) and jax.tree_util.all_leaves([tree]):
        fields = {f.name: getattr(tree, f.name) for f in dataclasses.fields(tree)}
        changes: Any = {name: on_host(x) for name, x in fields.items() if isinstance(x, eqx.Module)}
        return dataclasses.replace(tree, **changes) if changes else tree
    return jax.tree.map(lambda x: np.asarray(x) if isinstance(x, jax.Array) else x, tree)


def as_array(value: Any, kind: type = float) -> Any:
    """Numbers that a user states as an array: JAX's where it is double, else NumPy's; JAX's own stay JAX's."""
    if isinstance(value, jax.Array):
        return jnp.asarray(value, kind)
    return jnp.asarray(value, kind) if is_double() else np.asarray(value, kind)


class Threads(concurrent.futures.ThreadPoolExecutor):
    """Threads that compute in the precision of whoever hands them work."""

    def submit(self, fn: Callable[..., T], /, *args: Any, **named: Any) -> concurrent.futures.Future[T]:
        """Hand over a call."""
        return super().submit(_within, is_double(), fn, *args, **named)


def _within(double: bool, function: Callable[..., T], /, *args: Any, **named: Any) -> T:
    with jax.enable_x64(double) if double != is_double() else contextlib.nullcontext():
        return function(*args, **named)
