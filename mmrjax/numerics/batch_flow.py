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
        result = jax.tree.map(lambda x, y: jnp.asarray(x, y.dtype), function(*ordered_arguments), otherwise)
        return jnp.zeros_like(state[0]), result

    return jax.lax.while_loop(lambda state: state[0], turn, (needed, otherwise))[1]


#: Number of members that are computed at a time: enough to fill vectors and caches, few enough that most are still
#: running at the end.
LANES = 256


class _MemberLoop(NamedTuple):
    """A loop of one member, see `loop_until`: functions of its numbers.

    Attributes:
        lanes: number of members that are computed at once.
    """

    initial_state: Callable[[Any], Any]
    next_state: Callable[[Any, Any], Any]
    has_ended: Callable[[Any], Bool[Array, ""]]
    output: Callable[[Any], Any]
    lanes: int

    def alone(self, numbers: Any) -> Any:
        """Returns the end of one member."""
        end = jax.lax.while_loop(
            lambda s: ~self.has_ended(s), lambda s: self.next_state(numbers, s), self.initial_state(numbers)
        )
        return self.output(end)

    def refilled(self, numbers: Any, batched: Any, size: int) -> Any:
        """Returns the end of each of `size` members. A queued member replaces a finished one.

        Args:
            numbers: numbers of the members, with a leading axis where `batched`, a tree of booleans, is true.
        """
        lanes = min(size, self.lanes)
        axes = jax.tree.map(lambda b: 0 if b else None, batched)

        def select(mask: Array, one: Any, other: Any) -> Any:
            return jax.tree.map(
                lambda x, y: jnp.where(jnp.reshape(mask, mask.shape + (1,) * (x.ndim - 1)), x, y), one, other
            )

        def numbers_of(index: Array) -> Any:
            return jax.tree.map(lambda x, b: x[index] if b else x, numbers, batched)

        begin = jax.vmap(self.initial_state, in_axes=(axes,))
        advance = jax.vmap(self.next_state, in_axes=(axes, 0))
        is_finished = jax.vmap(self.has_ended)

        start_states = begin(numbers)
        ended_at_start = is_finished(start_states)
        order = jnp.argsort(ended_at_start)
        busy_count = size - jnp.sum(ended_at_start)

        def member_at(queue_position: Array) -> Array:
            return order[jnp.minimum(queue_position, size - 1)]

        def has_work(carry: tuple) -> Array:
            return jnp.any(carry[1] < busy_count)

        def step(carry: tuple) -> tuple:
            results, queue_position, next_position, state = carry
            member = member_at(queue_position)
            state = select(is_finished(state), state, advance(numbers_of(member), state))
            free = is_finished(state) & (queue_position < busy_count)
            results = jax.tree.map(
                lambda all_, x: all_.at[jnp.where(free, member, size)].set(x, mode="drop"),
                results,
                jax.vmap(self.output)(state),
            )
            queue_position = jnp.where(free, next_position + jnp.cumsum(free) - 1, queue_position)
            return (
                results,
                queue_position,
                next_position + jnp.sum(free),
                select(free, begin(numbers_of(member_at(queue_position))), state),
            )

        first_positions = jnp.arange(lanes)
        carry = (
            jax.vmap(self.output)(start_states),
            first_positions,
            jnp.asarray(lanes),
            begin(numbers_of(member_at(first_positions))),
        )
        return jax.lax.while_loop(has_work, step, carry)[0]


def loop_until(
    initial_state: Callable[[Any], T],
    next_state: Callable[[Any, T], T],
    has_ended: Callable[[T], Bool[Array, ""]],
    inputs: Any,
    output: Callable[[T], Any] = lambda state: state,
    lane_count: int | None = None,
) -> Any:
    """The first state with `has_ended`, by repeated `next_state` from `initial_state`, without derivatives.

    A batch of `jax.lax.while_loop` takes the turns of its longest member for every member. This loop takes their
    mean, plus those of the last `lane_count` members. Members that have ended at the start take none.

    Args:
        initial_state: state of arrays, from `inputs`.
        next_state: the next state, from `inputs` and a state.
        has_ended: function of a state, True if the member has ended. The functions close over no traced number.
        inputs: data of one member. Its numbers may be batched.
        output: the part of the last state to return.
        lane_count: number of members computed at a time, `LANES` if None.
    """
    numbers, static_parts = eqx.partition(jax.lax.stop_gradient(inputs), eqx.is_array)

    def with_static_parts(numbers: Any) -> Any:
        return eqx.combine(numbers, static_parts)

    lanes = LANES if lane_count is None else lane_count
    loop = _MemberLoop(
        lambda x: initial_state(with_static_parts(x)),
        lambda x, state: next_state(with_static_parts(x), state),
        has_ended,
        output,
        lanes,
    )

    def run_members(numbers: Any, batched: Any, size: int) -> T:
        """End states of `size` members. If these are batched again, all members share the same lanes."""

        @custom_vmap
        def each(numbers: Any) -> T:
            result: T = loop.refilled(numbers, batched, size)
            return result

        @each.def_vmap
        def run_flat(outer: int, outer_batched: Any, numbers: Any) -> tuple[T, Any]:
            (outer_batched,) = outer_batched

            def flatten_axes(x: Array, inner: bool, is_outer: bool) -> Array:
                if inner and not is_outer:
                    return jnp.concatenate([x] * outer)
                if is_outer and not inner:
                    return jnp.repeat(x, size, axis=0)
                return x.reshape(outer * size, *x.shape[2:]) if inner else x

            member_inputs = jax.tree.map(flatten_axes, numbers, batched, outer_batched)
            any_batched = jax.tree.map(lambda inner, is_outer: inner or is_outer, batched, outer_batched)
            flattened = jax.tree.map(
                lambda x: x.reshape(outer, size, *x.shape[1:]), run_members(member_inputs, any_batched, outer * size)
            )
            return flattened, jax.tree.map(lambda _: True, flattened)

        return each(numbers)

    @custom_vmap
    def alone(numbers: Any) -> T:
        result: T = loop.alone(numbers)
        return result

    @alone.def_vmap
    def together(size: int, batched: Any, numbers: Any) -> tuple[T, Any]:
        results = run_members(numbers, batched[0], size)
        return results, jax.tree.map(lambda _: True, results)

    return alone(numbers)
