"""Precision: public functions are double outside a trace, take JAX's own within one, and change none of its settings."""

import pickle
import threading

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from test_public_api import python

import mmrjax as mm
from mmrjax.compile import compiling
from mmrjax.model import params
from mmrjax.model.params import walk_parameters

#: Numbers that single precision does not hold.
RUNS = dict(configuration="6T2A", voltage=[24.1, 15.3], slope_deg=5.1)

UNTOUCHED = """
import os, jax, jax.numpy as jnp
settings, environment = dict(jax.config.values), dict(os.environ)
import mmrjax as mm
robot = mm.replace(mm.nominal(), {"motor.resistance": 0.6113})
runs = mm.Conditions("6T2A", voltage=24.1)
assert robot.motor.resistance == 0.6113 and runs.voltage == 24.1 and robot.motor.resistance.dtype == float
{use}
assert dict(jax.config.values) == settings and dict(os.environ) == environment
print(jnp.asarray(0.1).dtype, jax.jit(lambda x: 2 * x)(0.1).dtype)
"""


@pytest.mark.quick(1)
@pytest.mark.parametrize(
    "use", ["", "found = mm.simulate(robot, runs); assert found.total_current.dtype == found.slip.dtype == float"]
)
def test_import_and_use_change_no_setting(use):
    """A process of its own, in which JAX is single and every warning an error."""
    assert python(UNTOUCHED.replace("{use}", use)).split() == ["float32", "float32"]


@pytest.fixture
def single():
    with jax.enable_x64(False):
        yield


def test_results_are_those_of_double_precision_where_jax_is_single(robot):
    runs = mm.Conditions(**RUNS)
    double = mm.simulate(robot, runs)
    with jax.enable_x64(False):
        plain = mm.nominal()
        found = mm.simulate(plain, mm.Conditions(**RUNS))
        later = found.slip  # computed here
        each = [jax.tree.leaves(x) for x in (found, pickle.loads(pickle.dumps(found)))]
        assert jnp.asarray(0.1).dtype == jnp.float32
    for leaves in each:
        for a, b in zip(leaves, jax.tree.leaves(double), strict=True):
            assert isinstance(a, np.ndarray)
            assert_array_equal(a, b)
    assert later is found.slip and found.table() == double.table()
    assert all(isinstance(p.value, np.ndarray) and p.value.dtype == float for p in walk_parameters(plain))


def test_threads_have_the_precision_of_who_hands_them_work(single):
    def kind():
        return jnp.asarray(0.1).dtype.name, threading.get_ident() != mine

    mine = threading.get_ident()
    with compiling.Threads(1) as threads:
        assert threads.submit(kind).result() == ("float32", True)
        with jax.enable_x64(True):
            assert [*threads.map(lambda _: kind(), range(2))] == [("float64", True)] * 2
        assert threads.submit(kind).result() == ("float32", True)


def current(robot, volts):
    return mm.simulate(robot, mm.Conditions("6T2A", voltage=volts, slope_deg=5.1)).total_current


WAYS = {
    "all constant": lambda robot, runs: jax.jit(lambda x: x * mm.simulate(robot, runs).total_current)(1.0),
    "constant": lambda robot, runs: jax.jit(lambda x: current(robot, x))(24.1),
    "argument": lambda robot, runs: jax.jit(current)(robot, 24.1),
    "mapped": lambda robot, runs: jax.vmap(lambda x: current(robot, x))(jnp.asarray([24.1]))[0],
}


@pytest.mark.quick(1)
@pytest.mark.parametrize("way", WAYS)
def test_within_a_trace_the_precision_is_the_users(way, single):
    robot, runs = mm.nominal(), mm.Conditions("6T2A", voltage=24.1, slope_deg=5.1)
    outside = mm.simulate(robot, runs)
    inside = jax.jit(lambda x: x * outside.total_current)(1.0)  # computed there, but not traced
    value = WAYS[way](robot, runs)
    assert value.dtype == inside.dtype == jnp.float32
    assert_allclose(value, current(robot, 24.1), rtol=1e-6)
    assert_allclose(inside, current(robot, 24.1), rtol=1e-7)


@pytest.mark.slow
def test_gradients_in_single_precision_are_those_in_double():
    def slope():
        robot = mm.nominal()
        friction = jnp.asarray(robot.motor.friction_coulomb)
        changed = lambda x: mm.replace(robot, {"motor.friction_coulomb": x})  # noqa: E731
        return jax.grad(lambda x: current(changed(x), 24.1))(friction)

    with jax.enable_x64(False):
        rough = slope()
    assert rough.dtype == jnp.float32
    assert_allclose(rough, slope(), rtol=1e-5)


def test_strong_numbers_keep_their_digits(single):
    robot = params.without_weak_types(mm.replace(mm.nominal(), {"motor.resistance": 0.6113}))
    assert robot.motor.resistance == 0.6113
