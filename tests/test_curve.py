"""Curves: smooth through their ordinates, and lawful as every effect of the library, in `steady` and `drive`."""

from dataclasses import fields, replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import test_effects as laws
from numpy.testing import assert_allclose

from calibration.data.input_errors import BadConfiguration
from calibration.data.robot_file import read_robot, write_robot
from calibration.inference.bases import BALANCES, OF_TURNS, VARIABLES, CurveScope, curve_families, window_families
from mmrjax import effects
from mmrjax.effects import CURVES, UNNAMED, WAVES, curve
from mmrjax.model import balances, channels, params
from mmrjax.model.paper_robots import nominal
from mmrjax.model.signals import Signals
from tests.commands import parameter_values, read_rig

EACH = pytest.mark.parametrize("effect", CURVES.values(), ids=list(CURVES))
SHAPE = {"y0": 0.7, "y1": -0.4, "y2": 1.1, "y3": 0.2, "y4": -0.9, "y5": 0.5}
SIZES = jnp.asarray([laws.size(c) for c in CURVES.values()])


def robot(amplitudes=None, kinds=CURVES):
    """Nominal, with every curve of `kinds`, of a shape that is not flat, at these amplitudes."""
    every = []
    for k, effect in enumerate(kinds.values()):
        values = {n: v for n, v in SHAPE.items() if hasattr(effect(), n)}
        values |= {} if amplitudes is None else {"amplitude": amplitudes[k]}
        every.append(params.replace(effect(), {n: jnp.asarray(v) for n, v in values.items()}))
    return replace(nominal(), effects=tuple(every))


# --- interpolation --------------------------------------------------------------------------------------


def test_curve_passes_through_its_ordinates():
    x = jnp.linspace(2.0, 7.0, 6)
    assert_allclose(curve.ordinate_weights(x, 2.0, 7.0), np.eye(6), atol=1e-12)


def test_curve_is_exact_for_parabolas():
    x, at = np.linspace(2.0, 7.0, 101), np.linspace(2.0, 7.0, 6)
    for power in range(3):
        assert_allclose(curve.ordinate_weights(x, 2.0, 7.0) @ at**power, x**power, rtol=1e-12)


def test_curve_is_level_beyond_its_ends_and_has_no_corner():
    y = jnp.asarray(list(SHAPE.values()))
    height = jax.jit(jax.vmap(lambda x: curve.ordinate_weights(x, 2.0, 7.0) @ y))
    slope = jax.jit(jax.vmap(jax.grad(lambda x: curve.ordinate_weights(x, 2.0, 7.0) @ y)))
    far = jnp.asarray([-1e6, 0.0, 2.0 - 5 * curve.LEVEL, 7.0 + 5 * curve.LEVEL, 9.0, 1e6])
    assert np.ptp(height(far)[:3]) == np.ptp(height(far)[3:]) == 0 and not np.any(slope(far))
    x = jnp.linspace(1.0, 8.0, 7001)
    assert np.abs(np.diff(slope(x))).max() < 0.03  # 30 a unit at most: no step of the slope
    assert_allclose(np.gradient(height(x), x)[1:-1], slope(x)[1:-1], atol=0.01)
    assert_allclose(curve.ordinate_weights(x, 2.0, 7.0).sum(1), 1.0, rtol=1e-12)


# --- the laws -------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "law", [laws.law_declared, laws.law_linear, laws.law_unit, laws.law_readable], ids=lambda law: law.__name__[4:]
)
@pytest.mark.parametrize(
    "effect",
    [c if k % 9 == 0 or k == len(CURVES) - 1 else pytest.param(c, marks=pytest.mark.slow)
     for k, c in enumerate(CURVES.values())],
    ids=list(CURVES),
)  # fmt: skip
def test_curve_obeys(effect, law):
    """In `make test` each of seven places with another of eight variables, and the last with two."""
    law(effect)


@pytest.mark.slow
def test_curves_at_zero_change_nothing_in_steady_and_none_is_dead():
    both = jax.jit(lambda a: jax.jacfwd(lambda a: (_steady(robot(a)),) * 2, has_aux=True)(a))
    slopes, with_them = both(jnp.zeros(len(CURVES)))
    assert_allclose(with_them, jax.jit(_steady)(nominal()), rtol=1e-13, atol=1e-13)
    assert np.isfinite(slopes).all()
    read = np.where(with_them == 0, np.inf, with_them)  # what this robot does not have reads 0
    moved = np.abs(slopes * SIZES / read[..., None]).max((0, 1))
    assert moved.min() > 1e-4, "dead gradient"


def _steady(bare):
    return jax.vmap(lambda c: laws.floats(laws.steady(bare, c).reading))(laws.CONDITIONS)


@pytest.mark.slow
def test_settled_travel_shows_nothing_of_a_wave():
    waves = robot(jnp.asarray([laws.size(w) for w in WAVES.values()]), WAVES)
    # but for rounding: a program with effects sums in another order
    assert_allclose(jax.jit(_steady)(waves), jax.jit(_steady)(nominal()), rtol=4e-15)


@EACH
def test_curve_of_a_run_in_mirror_image_is_the_mirror_image(effect):
    made = params.replace(effect(), {**{n: jnp.asarray(v) for n, v in SHAPE.items()}, "amplitude": 0.3})
    there = laws.terms(made, signals=laws.mirrored(laws.STATES))
    assert_allclose(there, -laws.terms(made), rtol=1e-12, atol=1e-15)


def test_a_curve_of_what_shows_magnitudes_is_the_same_in_mirror_image():
    """As it is written in a robot, and as the loop looks for it."""
    made = params.replace(UNNAMED["curve_motor_current_current"](), {n: jnp.asarray(v) for n, v in SHAPE.items()})
    made = params.replace(made, {"amplitude": 0.3})
    robot = laws.metered(signed=False)
    each = [laws.terms(made, robot, s) for s in (laws.STATES, laws.mirrored(laws.STATES))]
    assert_allclose(*each, rtol=1e-12, atol=1e-15)
    robot = replace(robot, rig=replace(robot.rig, channels=("motor_current", "speed")))
    columns = {"order": np.tile(np.arange(9.0), 2), "supply_voltage_V": np.repeat([12.0, -12.0], 9)}
    columns |= {"configuration": np.repeat("6T2A", 18), "slope_deg": np.zeros(18), "payload_kg": np.zeros(18)}
    ways = dict.fromkeys(curve.WAYS, np.repeat([1.0, -1.0], 9))
    for looked in (curve_families, window_families):
        scope = CurveScope.of(robot, columns)
        (basis,) = (b for b in looked(columns, np.ones(18), ways, scope) if b.places[0] in curve.READINGS)
        for (place, _), shapes in zip(basis.names, np.asarray(basis.columns), strict=True):
            assert_allclose(shapes[:9], (1 if place == "motor_current" else -1) * shapes[9:])


@EACH
def test_curve_has_finite_derivatives_by_everything_at_rest(effect):
    made = params.replace(effect(), {"amplitude": 0.3})
    floats = [f.name for f in fields(Signals) if f.name not in ("memory", "configuration")]
    still = Signals(**{name: jnp.asarray(0.0) for name in floats})
    slopes = eqx.filter_grad(lambda both: both[0].term(nominal(), both[1]))((made, still))
    assert all(np.isfinite(x).all() for x in jax.tree.leaves(slopes))


# --- where they are known -------------------------------------------------------------------------------


def test_curves_are_those_that_the_trace_looks_for():
    assert tuple(curve.BALANCES) == BALANCES and tuple(curve.ROUND) == OF_TURNS
    assert (*curve.VARIABLES, *curve.VARIABLES_ROUND) == tuple(VARIABLES)
    assert {b: u for b, (u, *_) in curve.BALANCES.items()} == {b: balances.BALANCES[b][0] for b in curve.BALANCES}
    assert set(curve.READINGS) == {c.name for c in channels.EVERY} - {*curve.ROUND}  # a heading is no `yaw` moment
    assert set(curve.READ_BY) <= set(curve.READINGS)


@pytest.mark.parametrize("law", [laws.law_declared, laws.law_linear, laws.law_unit], ids=lambda law: law.__name__[4:])
@pytest.mark.parametrize(
    "name", ["curve_output_torque_current", "curve_yaw_rate_yaw_rate", "curve_motor_current_left_order"]
)
def test_curve_of_any_reading_obeys(name, law):
    law(UNNAMED[name])


def test_robot_with_curves_written_and_read_is_the_same(tmp_path):
    mine = robot(0.1 * jnp.asarray([laws.size(e) for e in UNNAMED.values()]), UNNAMED)
    write_robot(mine, tmp_path / "robot.toml")
    for library in ({}, effects.BY_NAME):
        again = parameter_values(read_robot(tmp_path / "robot.toml", library))
        assert list(again.items()) == list(parameter_values(mine).items())


def test_curve_without_a_range_is_refused(tmp_path):
    with pytest.raises(
        BadConfiguration, match=r"mine\.toml, effects\.curve_track_payload\.high: got 3; expected more than low, 3"
    ):
        read_rig(tmp_path, "[effects.curve_track_payload]\nlow = 3\nhigh = 3\n", "mine.toml")
