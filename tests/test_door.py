"""The public API against the compiled equations: the same numbers, nothing computed leaf by leaf beside them."""

import dataclasses
import pickle

import jax
import jax.extend
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

import mmrjax as mm
from mmrjax import fidelities
from mmrjax.fidelities import outputs
from mmrjax.fidelities.steady import steady_batch

#: Driving, sliding, stalled, overhauling and reversing.
MIXED = dict(
    configuration=["6T2A", "4W2T", "6T2A", "4W2T", "4W2T", "6T2A"],
    voltage=[24.0, 33.0, 0.5, 24.0, 15.0, -24.0],
    slope_deg=[5.0, 20.0, 5.0, -12.0, 0.0, 0.0],
)


@pytest.fixture(scope="module")
def whole(robot):
    return steady_batch(robot, mm.Conditions(**MIXED).resolved(robot))


@pytest.fixture
def primitives(monkeypatch):
    """Primitives that are computed one by one, outside of any compiled function, while the test runs."""
    seen = []
    bind = jax.extend.core.Primitive.bind

    def counted(self, *args, **named):
        seen.append(self.name)
        return bind(self, *args, **named)

    monkeypatch.setattr(jax.extend.core.Primitive, "bind", counted)
    return seen


@pytest.mark.slow
def test_what_instruments_show_is_that_of_the_whole(robot, whole):
    """Whichever is asked first: two programs give the same numbers and codes."""
    shown_first = mm.simulate(robot, mm.Conditions(**MIXED))
    whole_first = mm.simulate(robot, mm.Conditions(**MIXED))
    assert shown_first.statuses.tolist() == ["converged", "slides", "stalled", "converged", "converged", "reverses"]
    for name in ("total_current", "motor_speed", "speed"):
        assert_allclose(getattr(shown_first, name), whole.reading[name], rtol=1e-13, err_msg=name)
    for output in outputs.output_table(robot.channels):
        assert_array_equal(getattr(whole_first.result, output.name), getattr(whole, output.name), err_msg=output.name)
        assert_allclose(
            getattr(shown_first.result, output.name), getattr(whole, output.name), rtol=1e-13, err_msg=output.name
        )
    assert_array_equal(whole_first.flags, whole.flags)
    assert shown_first.reading["speed"] is shown_first.speed and shown_first.result.status is shown_first.status
    with pytest.raises(AttributeError, match="Results has no velocity"):
        _ = shown_first.velocity


@pytest.mark.slow
def test_results_are_a_pytree_whole_or_not_yet(robot, whole):
    pending = mm.simulate(robot, mm.Conditions(**MIXED))
    half = jax.tree.map(lambda x: x[:3], pending)
    assert isinstance(half, mm.Results) and half.shape == (3,)
    assert_array_equal(half.slip, whole.slip[:3])
    assert_allclose(half.total_mass, whole.mass[:3], rtol=1e-15)
    again = pickle.loads(pickle.dumps(mm.simulate(robot, mm.Conditions(**MIXED))))
    assert_array_equal(again.status, whole.status)


@pytest.mark.slow
def test_nothing_is_computed_outside_of_compiled_code(robot, primitives):
    """160 gathers and 22 concatenations outside took twenty times as long as the equations."""
    runs = mm.Conditions(**MIXED).resolved(robot)
    for _ in range(2):  # the first compiles
        primitives.clear()
        results = mm.simulate(robot, runs)
        _ = results.total_current, results.status, results.slip, results.total_mass
    assert primitives == []


@pytest.mark.slow
def test_chunks_and_shapes_are_made_by_compiled_code_too(robot, primitives, monkeypatch):
    facts = dataclasses.replace(fidelities.fidelity_facts("steady"), chunk=(4, 4))
    monkeypatch.setitem(fidelities.TABLE, "steady", facts)
    runs = mm.Conditions(voltage=np.linspace(10.0, 30.0, 10).reshape(2, 5))
    for _ in range(2):
        primitives.clear()
        current = mm.simulate(robot, runs).total_current
    assert current.shape == (2, 5) and primitives == []


def test_equal_fields_of_conditions_share_an_array():
    runs = mm.Conditions(voltage=np.full(5, 24.0), adhesion=0.5)
    assert runs.battery is runs.discharge is runs.order is runs.open is runs.slope_deg is runs.payload
    assert runs.duty is not runs.adhesion
    assert_array_equal(runs.adhesion, np.full(5, 0.5))


def test_names_of_configurations_become_indices(robot):
    words = np.array(["4W2T", "6T2A"])[np.arange(6) % 2].reshape(3, 2)
    found = mm.Conditions(configuration=words, voltage=24.0).resolved(robot).configuration
    assert found.tolist() == [[1, 0]] * 3
    one = mm.Conditions(configuration="4W2T", voltage=np.full(4, 24.0)).resolved(robot).configuration
    assert one.tolist() == [1] * 4
    with pytest.raises(KeyError, match="no configuration 4W"):
        mm.Conditions(configuration=["6T2A", "4W"]).resolved(robot)
    with pytest.raises(mm.UsageError, match=r"configuration: got 4W; "):
        mm.simulate(robot, mm.Conditions(configuration=["6T2A", "4W"]))


@pytest.mark.parametrize("bad", [np.nan, np.inf, 60.0])
def test_one_bad_number_of_a_batch_is_found(robot, bad):
    slopes = np.zeros((2, 3))
    slopes[1, 2] = bad
    with pytest.raises(mm.UsageError, match=rf"slope_deg\[1, 2\]: got {bad:.6g}; expected -45 to 45 deg"):
        mm.simulate(robot, mm.Conditions(slope_deg=slopes))
