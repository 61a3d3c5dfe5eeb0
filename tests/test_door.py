"""The public API against the compiled equations: the same numbers, nothing computed leaf by leaf beside them."""

import pickle

import jax
import jax.extend
import pytest
from numpy.testing import assert_allclose, assert_array_equal

import mmrjax as mm
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
