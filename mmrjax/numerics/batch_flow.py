"""Branches and loops of batches whose members need different computations.

A batch skips a branch that no member needs. A loop replaces finished members by waiting ones.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.custom_batching import custom_vmap
from jaxtyping import Array, Bool

T = TypeVar("T")


def compute_if_needed(needed: Bool[Array, ""], function: Callable[..., T], arguments: tuple, otherwise: T) -> T:
    """Result of `function(*arguments)` if `needed`, otherwise `otherwise`.

    Similar to `jax.lax.cond`, but `jax.vmap` turns that into computing both branches for every member of a batch.
    This is a loop of at most one turn: a batch runs it if one member needs it.

    Args:
        function: pure function.
        arguments: trees of arrays.
        otherwise: alternative, with the shapes and types of the function's result.
    """

    def turn(state: tuple[Array, T]) -> tuple[Array, T]:
        # Tied to the loop's state; otherwise the compiler would move the computation out of the loop.
        _, ordered_arguments = jax.lax.optimization_barrier((state[0], arguments))
        like = jax.tree.map(lambda x, y: jnp.asarray(x, y.dtype), function(*ordered_arguments), otherwise)
        return jnp.zeros_like(state[0]), like

    return jax.lax.while_loop(lambda state: state[0], turn, (needed, otherwise))[1]


#: Number of members that are computed at a time: enough to fill vectors and caches, few enough that most are still
#: running at the end.
LANES = 256


class _MemberLoop(NamedTuple):
    """A loop of one member, see `loop_until`: functions of its numbers.

    Attributes:
        lanes: members that are at work at once.
    """

    begun: Callable[[Any], Any]
    turn: Callable[[Any, Any], Any]
    ended: Callable[[Any], Bool[Array, ""]]
    kept: Callable[[Any], Any]
    lanes: int

    def alone(self, numbers: Any) -> Any:
        """Returns the end of one member."""
        final_state = jax.lax.while_loop(
            lambda s: ~self.ended(s), lambda s: self.turn(numbers, s), self.begun(numbers)
        )
        return self.kept(final_state)

    def refilled(self, numbers: Any, batched: Any, size: int) -> Any:
        """Returns the end of each of `size` members. A queued member replaces a finished one.

        Args:
            numbers: numbers of the members, with a leading axis where `batched`, a tree of booleans, is true.
        """
        lanes = min(size, self.lanes)
        axes = jax.tree.map(lambda b: 0 if b else None, batched)

        def chosen(which: Array, one: Any, other: Any) -> Any:
            return jax.tree.map(
                lambda x, y: jnp.where(jnp.reshape(which, which.shape + (1,) * (x.ndim - 1)), x, y), one, other
            )

        def at(index: Array) -> Any:
            return jax.tree.map(lambda x, b: x[index] if b else x, numbers, batched)

        begin = jax.vmap(self.begun, in_axes=(axes,))
        go = jax.vmap(self.turn, in_axes=(axes, 0))
        is_finished = jax.vmap(self.ended)

        begins = begin(numbers)
        idle = is_finished(begins)
        order, size_busy = jnp.argsort(idle), size - jnp.sum(idle)

        def member_of(place: Array) -> Array:
            return order[jnp.minimum(place, size - 1)]

        def busy(carry: tuple) -> Array:
            return jnp.any(carry[1] < size_busy)

        def step(carry: tuple) -> tuple:
            results, place, following, state = carry
            member = member_of(place)
            state = chosen(is_finished(state), state, go(at(member), state))
            free = is_finished(state) & (place < size_busy)
            results = jax.tree.map(
                lambda all_, x: all_.at[jnp.where(free, member, size)].set(x, mode="drop"),
                results,
                jax.vmap(self.kept)(state),
            )
            place = jnp.where(free, following + jnp.cumsum(free) - 1, place)
            return results, place, following + jnp.sum(free), chosen(free, begin(at(member_of(place))), state)

        first = jnp.arange(lanes)
        carry = jax.vmap(self.kept)(begins), first, jnp.asarray(lanes), begin(at(member_of(first)))
        return jax.lax.while_loop(busy, step, carry)[0]


def loop_until(
    begun: Callable[[Any], T],
    turn: Callable[[Any, T], T],
    ended: Callable[[T], Bool[Array, ""]],
    own: Any,
    kept: Callable[[T], Any] = lambda state: state,
    most: int | None = None,
) -> Any:
    """The first state with `ended`, by repeated `turn` from `begun`, without derivatives.

    A batch of `jax.lax.while_loop` takes the turns of its longest member for every member. This loop takes their
    mean, plus those of the last `most` members. Members that have ended at the start take none.

    Args:
        begun: state of arrays, from `own`.
        turn: the next state, from `own` and a state.
        ended: function of a state, True if the member has ended. The functions close over no traced number.
        own: data of one member. Its numbers may be batched.
        kept: the part of the last state to return.
        most: number of members computed at a time, `LANES` if None.
    """
    numbers, static_parts = eqx.partition(jax.lax.stop_gradient(own), eqx.is_array)

    def of(numbers: Any) -> Any:
        return eqx.combine(numbers, static_parts)

    lanes = LANES if most is None else most
    loop = _MemberLoop(lambda x: begun(of(x)), lambda x, state: turn(of(x), state), ended, kept, lanes)

    def many(numbers: Any, batched: Any, size: int) -> T:
        """End states of `size` members. If these are batched again, all members share the same lanes."""

        @custom_vmap
        def each(numbers: Any) -> T:
            result: T = loop.refilled(numbers, batched, size)
            return result

        @each.def_vmap
        def flat(outer: int, of_outer: Any, numbers: Any) -> tuple[T, Any]:
            (of_outer,) = of_outer

            def member(x: Array, inner: bool, out: bool) -> Array:
                if inner and not out:
                    return jnp.concatenate([x] * outer)
                if out and not inner:
                    return jnp.repeat(x, size, axis=0)
                return x.reshape(outer * size, *x.shape[2:]) if inner else x

            member_inputs = jax.tree.map(member, numbers, batched, of_outer)
            either = jax.tree.map(lambda inner, out: inner or out, batched, of_outer)
            flattened = jax.tree.map(
                lambda x: x.reshape(outer, size, *x.shape[1:]), many(member_inputs, either, outer * size)
            )
            return flattened, jax.tree.map(lambda _: True, flattened)

        return each(numbers)

    @custom_vmap
    def alone(numbers: Any) -> T:
        result: T = loop.alone(numbers)
        return result

    @alone.def_vmap
    def together(size: int, batched: Any, numbers: Any) -> tuple[T, Any]:
        results = many(numbers, batched[0], size)
        return results, jax.tree.map(lambda _: True, results)

    return alone(numbers)
