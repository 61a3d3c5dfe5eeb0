"""Loops whose members take different numbers of turns: each ends as by itself, in as many turns as the mean asks."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.random import default_rng
from numpy.testing import assert_array_equal

from mmrjax.numerics import batch_flow


def halves(own):
    """How often a number is halved until it is below one, and what is left. `own` is the number and the divisor."""
    begun = lambda own: (own[0], jnp.asarray(0))  # noqa: E731
    return batch_flow.loop_until(begun, lambda own, s: (s[0] / own[1], s[1] + 1), lambda s: s[0] < 1.0, own)


@pytest.mark.quick("50")
@pytest.mark.parametrize("size", [1, 3, 8, 50])
def test_members_of_a_batch_end_as_each_by_itself(monkeypatch, size):
    monkeypatch.setattr(batch_flow, "LANES", 8)
    numbers = jnp.asarray(2.0 ** default_rng(0).integers(-1, 40, size) * 1.5)
    left, turns = jax.jit(jax.vmap(lambda x: halves((x, 2.0))))(numbers)
    alone = [halves((x, 2.0)) for x in numbers]
    assert_array_equal(turns, [int(a[1]) for a in alone])
    assert_array_equal(left, [float(a[0]) for a in alone])
    both = jax.vmap(jax.vmap(lambda x, y: halves((x, y)), (0, None)), (None, 0))(numbers, jnp.asarray([2.0, 4.0]))
    assert_array_equal(both[1][0], turns)


@pytest.fixture
def counted(monkeypatch):
    """A member that takes as many turns as it is told, four lanes, and the turns that are taken."""
    monkeypatch.setattr(batch_flow, "LANES", 4)
    taken = []

    def turn(_, state):
        jax.debug.callback(lambda: taken.append(1))
        return state[0], state[1] + 1

    return lambda x: batch_flow.loop_until(lambda own: (own, own * 0), turn, lambda s: s[1] >= s[0], x)[1], taken


def test_a_batch_takes_as_many_turns_as_its_lanes_need(counted):
    """One member of a hundred that takes a thousand turns does not make a thousand of the others'."""
    count, taken = counted
    own = jnp.asarray([30.0] + [3.0] * 40)
    assert_array_equal(jax.block_until_ready(jax.vmap(count)(own)), own)
    jax.effects_barrier()
    assert len(taken) < 4 * 50 < 41 * 30


def test_members_that_have_ended_when_they_begin_cost_no_turn(counted):
    """Three of a hundred that go on are at work together, wherever they stand."""
    count, taken = counted
    own = jnp.zeros(100).at[jnp.asarray([5, 50, 99])].set(7.0)
    assert_array_equal(jax.block_until_ready(jax.vmap(count)(own)), own)
    jax.effects_barrier()
    assert len(taken) <= 4 * 7


def test_of_the_last_state_only_what_is_kept_is_returned():
    turn, ended = (lambda own, s: (s[0] + own, s[1] + 1)), (lambda s: s[1] >= 3)
    sums = jax.vmap(lambda x: batch_flow.loop_until(lambda own: (own, own * 0), turn, ended, x, lambda s: s[0], 2))(
        jnp.arange(5.0)
    )
    assert_array_equal(sums, 4 * np.arange(5.0))


def test_no_derivative_passes_through():
    assert float(jax.grad(lambda x: halves((x, 2.0))[0])(12.0)) == 0.0


def test_batches_of_batches_share_their_lanes(counted):
    """A long member of one batch does not make the members of the others wait."""
    count, taken = counted
    own = jnp.full((8, 8), 3.0).at[0, 0].set(40.0)
    assert_array_equal(jax.block_until_ready(jax.vmap(jax.vmap(count))(own)), own)
    jax.effects_barrier()
    assert len(taken) < 4 * 80 < 8 * 8 * 40
