"""Derived outputs: the steepest slope and the start, against closed forms, other searches and finite differences."""

import math
from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose

from mmrjax import derived
from mmrjax.compile.compiling import SELDOM
from mmrjax.compile.programs import compile_with_options
from mmrjax.derived import pitch_and_step, start_figures, steepest_slope
from mmrjax.fidelities.drive import drive
from mmrjax.fidelities.steady import steady
from mmrjax.model import params
from mmrjax.model.conditions import Conditions
from mmrjax.model.signals import CONVERGED, SLIDES, STALLED, STATUSES
from tests.commands import parameter_values

NAMES = ("motor.resistance", "motor.torque_constant", "6T2A.ground.friction.static", "6T2A.ground.rolling_resistance")


def asked(configuration, voltage, **others):
    """Conditions of numbers only, so that runs of other conditions share their program."""
    return jax.tree.map(jnp.asarray, Conditions(configuration, voltage, **others))


def changed(robot, **values):
    return params.replace(robot, {k.replace("__", "."): jnp.asarray(v) for k, v in values.items()})


def function(robot, conditions, compute):
    values = parameter_values(robot)
    theta = jnp.asarray([values[n] for n in NAMES])
    return theta, jax.jit(lambda t: compute(params.replace(robot, dict(zip(NAMES, t, strict=True))), conditions))


def differences(f, theta, step):
    rows = []
    for k in range(len(theta)):
        up, down = (f(theta.at[k].multiply(1 + s * step)) for s in (1, -1))
        rows.append({n: (up[n] - down[n]) / (2 * step * theta[k]) for n in up if n != "status"})
    return {n: np.array([row[n] for row in rows]) for n in rows[0]}


@pytest.mark.slow
def test_table_names_modules_that_compute_them(robot):
    for module in dict.fromkeys(d.group for d in derived.TABLE):
        made = jax.eval_shape(derived.compute_function(module), robot, Conditions(0, 24.0))
        assert {d.name for d in derived.TABLE if d.group == module} | {"status"} == set(made)
    assert next(d for d in derived.TABLE if d.name == "steepest_slope").ignores == ("slope_deg",)


# --- the steepest slope -------------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("configuration", [0, 1])
def test_steepest_slope_that_sliding_ends_is_where_adhesion_is_used_up(robot, configuration):
    found = steepest_slope.compute(robot, asked(configuration, 24.0, slope_deg=17.0, payload=3.0))
    ground = robot.configurations.members[configuration].ground
    closed = math.degrees(math.atan(float(ground.friction.static - ground.rolling_resistance)))
    assert_allclose(found["steepest_slope"], closed, rtol=0, atol=1e-9)


@pytest.mark.slow
def test_steepest_slope_that_the_motors_end_is_where_the_robot_comes_to_stand(robot):
    weak = changed(robot, **{"6T2A__ground__friction__static": 2.5})
    conditions = asked(0, 2.0, payload=8.0)
    found, settled = float(steepest_slope.compute(weak, conditions)["steepest_slope"]), eqx.filter_jit(steady)
    status = [int(settled(weak, replace(conditions, slope_deg=jnp.asarray(found + d))).status) for d in (-1e-6, 1e-6)]
    assert status == [CONVERGED, STALLED] and 0 < found < 45


@pytest.mark.slow
def test_steepest_slope_ends_at_the_limit_and_is_missing_where_the_flat_is_not_held(robot):
    sticky = changed(robot, **{"6T2A__ground__friction__static": 2.5})
    at = steepest_slope.compute(sticky, asked(0, 33.0))
    assert float(at["steepest_slope"]) == steepest_slope.STEEPEST
    icy = changed(robot, **{"6T2A__ground__friction__static": 0.02})
    none = steepest_slope.compute(icy, asked(0, 24.0))
    assert np.isnan(none["steepest_slope"]) and int(none["status"]) == SLIDES


@pytest.mark.nightly
@pytest.mark.parametrize("static, voltage", [(0.32, 24.0), (2.5, 2.0)])
def test_steepest_slope_derivatives_are_finite_differences(robot, static, voltage):
    """As users' programs are compiled, and as those that run a few times are."""
    tuned = changed(robot, **{"6T2A__ground__friction__static": static})
    theta, f = function(tuned, Conditions(0, voltage, payload=5.0), steepest_slope.compute)
    forward = jax.jacfwd(lambda t: f(t)["steepest_slope"])
    exact = forward(theta)
    assert_allclose(compile_with_options(jax.jit(forward).lower(theta), SELDOM)(theta), exact, rtol=1e-9)
    twice = differences(f, theta, 1e-6)["steepest_slope"]
    assert_allclose(exact, twice, rtol=1e-5, atol=1e-4 * np.abs(twice).max())
    assert_allclose(jax.jacrev(lambda t: f(t)["steepest_slope"])(theta), exact, rtol=1e-9, atol=1e-9)
    assert np.abs(exact).max() > 1


# --- the start ----------------------------------------------------------------------------------------------------

CONDITIONS = asked(0, 24.0, slope_deg=5.0, payload=3.0)


@pytest.mark.slow
def test_start_is_that_of_a_run_kept_at_many_instants(robot):
    found = {k: float(v) for k, v in start_figures.compute(robot, CONDITIONS).items()}
    times = np.concatenate([np.linspace(0, 0.05, 5000, endpoint=False), np.linspace(0.05, 4.0, 40_000)])
    signals = eqx.filter_jit(drive)(robot, CONDITIONS, jnp.asarray(times), tolerance=1e-9).signals
    current, speed = np.asarray(signals.total_current), np.asarray(signals.speed)
    later = times > 0.05
    after = np.interp(0.95 * speed[-1], speed[later], times[later])
    rows = times <= after
    assert found["peak_current"] == pytest.approx(current.max(), rel=2e-4)
    assert found["time_to_speed"] == pytest.approx(after, rel=5e-4)
    energy = np.trapezoid((signals.voltage * current)[rows], times[rows])
    assert found["energy_start"] == pytest.approx(float(energy), rel=1e-3)


@pytest.mark.slow
def test_start_derivatives_are_finite_differences(robot):
    theta, f = function(robot, CONDITIONS, start_figures.compute)
    exact = jax.jacfwd(f)(theta)
    twice = differences(f, theta, 3e-3)
    for name, by in twice.items():
        scale = np.abs(by * theta).max() / np.abs(theta)  # what matters, parameter by parameter
        assert_allclose(exact[name], by, rtol=3e-3, atol=2e-3 * scale.min(), err_msg=name)
        assert np.abs(exact[name]).max() > 0


@pytest.mark.slow
def test_start_of_a_run_that_does_not_settle_has_no_numbers(robot):
    steep = replace(CONDITIONS, slope_deg=jnp.asarray(25.0))
    found = start_figures.compute(robot, steep)
    assert STATUSES[int(found["status"])] == "slides"
    assert all(np.isnan(found[n]) for n in ("peak_current", "time_to_speed", "energy_start"))


def test_peak_is_the_top_of_a_parabola():
    x = jnp.asarray([0.0, 0.1, 0.3, 0.5, 0.9, 1.0])  # at unequal distances
    ended = jnp.where(x < 0.8, 3 - (x - 0.37) ** 2, jnp.nan)  # of a run that has ended
    for y in (3 - (x - 0.47) ** 2, ended):
        assert_allclose(start_figures.curve_peak(x, y), 3.0, atol=1e-12)
    # A current that its limit holds: no overshoot between the samples at the corner.
    held = jnp.minimum(30 * x, 1.5 - 1e-3 * x)
    assert_allclose(start_figures.curve_peak(x, held, 1.5), 1.5, rtol=0, atol=1e-3)
    assert float(start_figures.curve_peak(x, held)) > 1.6
    for rises in (x, -x, jnp.where(x < 0.8, x, jnp.nan)):  # no top between: the largest sample
        assert float(start_figures.curve_peak(x, rises)) == float(jnp.nanmax(rises))


def test_crossing_is_exact_for_a_cubic():
    t = jnp.linspace(0.0, 1.0, 6)
    k, share = start_figures.first_crossing(t, t**3, 3 * t**2, jnp.asarray(0.3))
    assert_allclose(t[k] + share * (t[k + 1] - t[k]), 0.3 ** (1 / 3), rtol=0, atol=1e-9)


# --- posture ------------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_steps_of_a_posture_and_of_any_are_those_of_the_static_limits(robot):
    raised, folded = (
        {name: float(x) for name, x in pitch_and_step.compute(robot, asked(0, 24.0, payload=8.0, **levers)).items()}
        for levers in ({"levers_front_deg": -30.0, "levers_rear_deg": 180.0}, {})
    )
    assert math.degrees(raised["pitch"]) == pytest.approx(8.57, abs=0.01) and folded["pitch"] == 0
    assert raised["highest_step"] < raised["best_step"] == pytest.approx(0.2456, abs=1e-4)
    assert folded["highest_step"] == pytest.approx(0.0671, abs=1e-4)
