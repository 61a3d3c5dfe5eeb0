"""Effects of a robot that turns: their equations, that left and right mirror, and that straight travel has none."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from test_turning import flat, powers

import mmrjax as mm
from mmrjax import effects
from mmrjax.model import balances, energy, paper_robots, params
from mmrjax.model.signals import PlaneMotion, State
from mmrjax.turning import circling
from tests.commands import read_rig

OF_SIDES = ("side_friction", "side_torque", "side_voltage", "side_radius")
#: In units of the prior sd.
SIZE = 2.0
MOTION = PlaneMotion(*(jnp.asarray(x) for x in ([2.0, -0.7], [900.0, -150.0], 0.3, 0.05, -1.1, 0.0, 0.0, 0.0, 0.0)))


def amplitude(name):
    return SIZE * next(p.spec for p in params.walk_parameters(effects.OF_TURNS[name]()) if p.spec.amplitude).prior_sd(
        0.0
    )


def with_amplitudes(robot, values):
    present = tuple(effects.OF_TURNS[n](amplitude=v) for n, v in values.items())
    return dataclasses.replace(robot, effects=present)


RUN = mm.Conditions("6T2A", voltage=33.0, duty_left=0.9, duty_right=-0.2).resolved(paper_robots.nominal())
MIRRORED = mm.Conditions("6T2A", voltage=33.0, duty_left=-0.2, duty_right=0.9).resolved(paper_robots.nominal())


@jax.jit
def rates(values, run, y):
    return circling.turning_rates(with_amplitudes(paper_robots.nominal(), values), run, y)


def amplitudes(**some):
    return {name: jnp.asarray(some.get(name, 0.0)) for name in effects.OF_TURNS}


@pytest.mark.slow
@pytest.mark.parametrize("name", effects.OF_TURNS)
def test_effect_moves_the_turn_and_mirrors(name, robot):
    y = flat(MOTION)
    plain = circling.turning_rates(robot, RUN, y)
    assert_allclose(rates(amplitudes(), RUN, y), plain, rtol=1e-12, atol=1e-12)
    size = amplitude(name)
    moved = np.asarray(rates(amplitudes(**{name: size}), RUN, y))
    assert (np.abs(moved - plain) > 0.01 * np.abs(plain)).any()
    swap = np.array([1, 0, 3, 2, 4, 5, 6, 7, 8, 9, 10])
    sign = np.array([1, 1, 1, 1, 1, -1, -1, -1, 1, -1, 1])
    other = -size if name in OF_SIDES else size
    mirrored = np.asarray(rates(amplitudes(**{name: other}), MIRRORED, (y * sign)[swap]))
    assert_allclose(mirrored, (moved * sign)[swap], rtol=1e-9, atol=1e-9)


def test_terms_are_their_equations():
    robot, values = paper_robots.nominal(), {name: amplitude(name) for name in effects.OF_TURNS}
    travel = jax.jit(lambda m: balances.turning_signals(robot, RUN, m))(MOTION)
    signals, grip = travel.signals, travel.grip
    terms = {}
    for name, a in values.items():
        effect = effects.OF_TURNS[name](amplitude=a)
        terms[name] = np.asarray(jax.vmap(lambda s, effect=effect: effect.term(robot, s))(signals))
    side, current, turned = np.array([1.0, -1.0]), np.array([2.0, -0.7]), np.array([900.0, -150.0])
    constant, resistance = float(robot.motor.torque_constant), float(robot.motor.resistance)
    assert_allclose(terms["side_friction"], values["side_friction"] * side * np.sign(turned), rtol=1e-9)
    assert_allclose(terms["side_torque"], values["side_torque"] * side * constant * current, rtol=1e-9)
    given = constant * turned + resistance * current
    assert_allclose(terms["side_voltage"], values["side_voltage"] * side * given, rtol=1e-9)
    rolled = float(robot.configurations["6T2A"].radius) * turned / float(robot.gearbox.ratio)
    assert_allclose(terms["side_radius"], values["side_radius"] * side * rolled, rtol=1e-9)
    resisted = values["turning_resistance"] * np.asarray(signals.normal) * -1.1
    assert_allclose(terms["turning_resistance"], resisted, rtol=1e-9)
    assert jnp.sum(grip.moment) > 0.5  # against a turn to the right
    dug = values["lateral_grip"] * 1.1 * -np.asarray(grip.moment)
    assert_allclose(terms["lateral_grip"], dug, rtol=1e-9)


@pytest.mark.slow
def test_energy_is_kept_and_resistance_to_turning_takes_it():
    robot = with_amplitudes(paper_robots.nominal(), {name: amplitude(name) for name in effects.OF_TURNS})
    sinks = powers(robot, RUN, MOTION)
    rolls = with_amplitudes(paper_robots.nominal(), {"side_radius": amplitude("side_radius")})  # slides as much
    plain = energy.sink_powers_turning(rolls, RUN, balances.turning_signals(rolls, RUN, MOTION))
    seen = balances.turning_signals(robot, RUN, MOTION)
    load, moment = float(jnp.sum(seen.signals.normal)), float(jnp.sum(seen.grip.moment))
    taken = amplitude("turning_resistance") * load * 1.1**2 + amplitude("lateral_grip") * moment * 1.1**2
    assert float(sinks["sliding"] - plain["sliding"]) == pytest.approx(taken, rel=1e-6)


def test_straight_travel_shows_none_of_them(robot):
    run = mm.Conditions("6T2A", slope_deg=3.0).resolved(robot)
    state = State(*(jnp.asarray(x) for x in (2.0, 900.0, 0.7, 0.0)))
    plain = balances.settled_signals(robot, run, state, 1.0)[0]
    moved = balances.settled_signals(
        with_amplitudes(robot, {n: amplitude(n) for n in effects.OF_TURNS}), run, state, 1.0
    )[0]
    for mine, theirs in zip(jax.tree.leaves(plain), jax.tree.leaves(moved), strict=True):
        assert_array_equal(mine, theirs)


def test_robot_files_know_them_and_the_library_of_straight_travel_does_not(tmp_path):
    robot = read_rig(tmp_path, 'base = "nominal"\n[effects.side_torque]\namplitude = 0.1\n', "robot.toml")
    assert [e.name for e in robot.effects] == ["side_torque"] and robot.effects[0].amplitude == 0.1
    assert not set(effects.OF_TURNS) & set(effects.BY_NAME)
    for kind in effects.OF_TURNS.values():
        assert "Source:" in (kind.__doc__ or "") and kind.balance in balances.BALANCES
