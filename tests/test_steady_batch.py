"""Whole batches of `steady`: outputs and derivatives that are asked for, blocks, and vectorised NumPy."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from worlds import vectorised

from mmrjax.effects import BY_NAME
from mmrjax.fidelities import outputs
from mmrjax.fidelities import steady as room
from mmrjax.fidelities.steady import steady_batch, steady_outputs
from mmrjax.model import channels, params
from mmrjax.model.conditions import Conditions
from mmrjax.model.signals import STATUSES

EFFECTS = {"series_resistance": 0.3, "churning": 5e-4, "winding_heating": 1.0, "nonlinear_slip": 0.05}
ALL = tuple(output.name for output in outputs.output_table(channels.usual_channels()))
#: Driving, sliding, stalled and overhauling in one batch, in both configurations.
MIXED = dict(
    voltage=[24.0, 33.0, 0.5, 24.0, 15.0, 24.0],
    slope_deg=[5.0, 20.0, 5.0, -12.0, 0.0, np.nan],
    configuration=[0, 1, 0, 1, 1, 0],
)


def points(size):
    """As in benchmarks/steady_yardstick.py: what nominal adhesion holds of Table 8's ranges."""
    rng = np.random.default_rng(8)
    wheeled, slope, payload, voltage = rng.uniform((0, 0, 0, 15), (1, 12, 8, 33), (size, 4)).T
    return np.round(wheeled).astype(int), voltage, slope, payload


def with_effects(robot):
    return dataclasses.replace(robot, effects=tuple(BY_NAME[k](amplitude=v) for k, v in EFFECTS.items()))


def same(found, wanted, rtol=1e-9):
    assert set(found) == set(wanted)
    for name, values in wanted.items():
        size = np.max(np.abs(values))
        assert_allclose(found[name], values, rtol=rtol, atol=rtol * size, err_msg=name)


# --- against vectorised NumPy -----------------------------------------------------------------------


def test_steady_matches_the_closed_form_of_numpy(robot):
    given = points(2000)
    found = steady_outputs(robot, Conditions(*given), ALL)
    same(found, vectorised.closed_form_all(*given))
    three = dict(zip(vectorised.NAMES, vectorised.closed_form(*given), strict=True))
    same({name: found[name] for name in three}, three)


def test_steady_with_effects_matches_the_newton_of_numpy(robot):
    given = points(2000)
    found = steady_outputs(with_effects(robot), Conditions(*given), vectorised.NAMES)
    wanted = dict(zip(vectorised.NAMES, vectorised.newton(*given, *EFFECTS.values()), strict=True))
    same(found, wanted)


# --- outputs that are asked for ---------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("effects", [False, True])
def test_steady_outputs_are_those_of_steady_batch(robot, effects):
    robot, runs = with_effects(robot) if effects else robot, Conditions(**MIXED)
    whole = steady_batch(robot, runs)
    assert [STATUSES[k] for k in whole.status] == [
        "converged", "slides", "stalled", "converged", "converged", "failed",
    ]  # fmt: skip
    found = steady_outputs(robot, runs, (*ALL, "status", "flags"))
    for output in outputs.output_table(channels.usual_channels()):
        assert_allclose(found[output.name], getattr(whole, output.name), rtol=1e-13, err_msg=output.name)
    assert_array_equal(found["status"], whole.status)
    assert_array_equal(found["flags"], whole.flags)
    for name in ("speed", "power_lift"):
        assert_allclose(steady_outputs(robot, runs, (name,))[name], found[name], rtol=1e-13)


@pytest.mark.slow
def test_steady_outputs_take_robots_of_a_batch(robot):
    runs = Conditions(**{**MIXED, "slope_deg": 5.0})
    values = {"motor.resistance": jnp.linspace(0.5, 0.9, 6), "6T2A.mass": jnp.linspace(12.0, 14.0, 6)}
    together = steady_outputs(params.replace(robot, values), runs, ALL)
    for k in range(6):
        alone = params.replace(robot, {name: x[k] for name, x in values.items()})
        one = steady_outputs(alone, jax.tree.map(lambda x, k=k: x[k : k + 1], runs), ALL)
        for name in ALL:
            assert_allclose(together[name][k], one[name][0], rtol=1e-12, err_msg=name)


def test_steady_outputs_name_what_there_is(robot):
    runs = Conditions(**MIXED)
    with pytest.raises(KeyError, match=r"no output velocity; there are total_current, .*, status, flags"):
        steady_outputs(robot, runs, ("speed", "velocity"))


@pytest.mark.slow
def test_steady_outputs_compile_once_for_other_numbers(robot, compilations):
    runs = Conditions(**MIXED)
    jax.block_until_ready(steady_outputs(robot, runs, ALL))
    other, weaker = params.replace(robot, {"motor.resistance": 0.9}), Conditions(**{**MIXED, "voltage": 20.0})
    compilations.clear()
    jax.block_until_ready(steady_outputs(other, weaker, ALL))
    assert not compilations


@pytest.mark.nightly
@pytest.mark.parametrize("size", [96, 97])
def test_steady_blocks_change_no_number(robot, monkeypatch, size):
    """97 points have no block that divides them, and go together."""
    runs = Conditions(*points(size))
    whole = steady_outputs(robot, runs, ("status", *ALL))
    batch = params.replace(robot, {"motor.resistance": jnp.linspace(0.5, 0.9, size)})
    whole_batch = steady_batch(batch, runs)
    # Read where a function is traced: these are functions of their own.
    monkeypatch.setattr(room, "BLOCK", 40)
    found = eqx.filter_jit(lambda *of: steady_outputs.__wrapped__(*of, ("status", *ALL)))(robot, runs)
    in_blocks = eqx.filter_jit(lambda *of: steady_batch.__wrapped__(*of))(batch, runs)
    for name, values in whole.items():
        assert_allclose(found[name], values, rtol=1e-13, err_msg=name)
    for a, b in zip(jax.tree.leaves(in_blocks), jax.tree.leaves(whole_batch), strict=True):
        assert_allclose(a, b, rtol=1e-13)


# --- derivatives ------------------------------------------------------------------------------------


PARAMETERS = ("motor.resistance", "6T2A.mass", "gearbox.ratio", "4W2T.ground.friction.static")


WANTED = ("total_current", "speed", "efficiency_chassis")


@pytest.mark.slow
@pytest.mark.parametrize("effects", [False, True])
def test_derivatives_in_reverse_are_those_forward(robot, effects):
    robot, runs = with_effects(robot) if effects else robot, Conditions(**MIXED)
    at = jnp.asarray([p.value for name in PARAMETERS for p in params.walk_parameters(robot) if p.name == name])

    def numbers(x):
        return steady_outputs(params.replace(robot, dict(zip(PARAMETERS, x, strict=True))), runs, WANTED)

    found, wanted = jax.jacrev(numbers)(at), jax.jacfwd(numbers)(at)
    numberless = steady_batch(robot, runs).status >= STATUSES.index("slides")
    assert list(numberless) == [False, True, False, False, False, True]
    for output in WANTED:
        for k, parameter in enumerate(PARAMETERS):
            assert_allclose(found[output][:, k], wanted[output][:, k], rtol=1e-10, atol=1e-13, err_msg=parameter)
            assert not np.asarray(found[output][:, k])[numberless].any()
