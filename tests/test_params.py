"""Parameters: the walk, replacement, and the numbers of Tables 1-7."""

import dataclasses
import math

import equinox as eqx
import jax
import jax.numpy as jnp
import pytest
from numpy.testing import assert_allclose
from worlds import paper

from mmrjax.model import paper_robots, params
from mmrjax.model.paper_tables import GROUSERS_LEVER, PITCH_GROUSER, PITCH_TOOTH
from mmrjax.model.params import parameter


def test_nominal_values_are_those_of_the_reference(robot):
    # The track model has a reference of its own, C MuJoCo; what of its running gear the paper prints is checked below.
    own = ("running_gear.", "6T2A.turning.", "4W2T.turning.")  # of turns see test_turning.py
    values = {p.name: float(p.value) for p in params.walk_parameters(robot) if not p.name.startswith(own)}
    assert set(values) == set(paper.NOMINAL)
    for name, expected in paper.NOMINAL.items():
        assert values[name] == pytest.approx(expected, rel=1e-12), name


def test_running_gear_is_that_of_tables_6_and_7(robot):
    printed = {
        "wheelbase": 0.3, "lever_length": 0.205, "belt_mass": 0.04, "lever_mass": 0.47 + 0.025, "pulley_mass": 0.082,
        "additional_pulley_mass": 0.104, "wheel_mass": 0.086,
    }  # fmt: skip
    for name, value in printed.items():
        assert getattr(robot.running_gear, name) == pytest.approx(value, rel=1e-12), name
    assert 10.3 * float(robot.running_gear.body_gyration) ** 2 == pytest.approx(0.119, rel=1e-3)


@pytest.mark.parametrize("name", sorted(paper_robots.ROBOTS))
def test_parameters_lie_within_their_bounds(name):
    for p in params.walk_parameters(paper_robots.ROBOTS[name]()):
        low, high = p.spec.bounds
        assert low < high and low <= p.value <= high, p.name


def test_parameters_state_unit_meaning_source_and_prior(robot_with_effects):
    for p in params.walk_parameters(robot_with_effects):
        assert p.spec.unit and p.spec.meaning and p.spec.source, p.name
        assert (p.spec.sd is None) != (p.spec.relative_sd is None), p.name
        if p.value == 0.0 or p.spec.amplitude:
            assert p.spec.prior_sd(float(p.value)) > 0, p.name


def test_parameter_refuses_two_standard_deviations_and_none():
    with pytest.raises(ValueError, match="either relative_sd or sd"):
        parameter(1.0, unit="V", meaning="m", bounds=(0, 2), source="s")
    with pytest.raises(ValueError, match="either relative_sd or sd"):
        parameter(1.0, unit="V", meaning="m", bounds=(0, 2), source="s", sd=1.0, relative_sd=1.0)


def test_walk_collects_every_differentiable_leaf(robot_with_effects):
    leaves = jax.tree.leaves(eqx.filter(robot_with_effects, eqx.is_inexact_array))
    found = list(params.walk_parameters(robot_with_effects))
    # what a configuration moves on and how many motors drive are facts, no numbers to be found
    facts = {id(chassis.on_tracks) for chassis in robot_with_effects.configurations.members}
    facts.add(id(robot_with_effects.sides))
    assert len(found) == len(leaves) - len(facts) == len({p.name for p in found})
    assert {id(p.value) for p in found} == {id(leaf) for leaf in leaves} - facts


def test_replace_changes_the_named_and_nothing_else(robot_with_effects):
    before = {p.name: float(p.value) for p in params.walk_parameters(robot_with_effects)}
    for name in before:
        changed = params.replace(robot_with_effects, {name: 0.125})
        after = {p.name: float(p.value) for p in params.walk_parameters(changed)}
        assert {n for n in before if before[n] != after[n]} <= {name} and after[name] == 0.125


def test_replace_takes_batches_and_tracers(robot):
    batch = params.replace(robot, {"motor.resistance": jnp.arange(3.0)})
    assert batch.motor.resistance.shape == (3,)
    gradient = jax.grad(lambda x: params.replace(robot, {"motor.resistance": x}).motor.voltage_winding(2.0))(1.0)
    assert gradient == 2.0


def test_parameters_have_no_weak_types(robot_with_effects):
    # A weak type would make one more compilation of each model when a number is replaced.
    changed = params.replace(robot_with_effects, {p.name: 1.0 for p in params.walk_parameters(robot_with_effects)})
    for tree in (robot_with_effects, changed):
        assert not any(leaf.weak_type for leaf in jax.tree.leaves(tree))
    given = jnp.asarray(0.7)  # as users give them
    replaced = params.replace(robot_with_effects, {"motor.resistance": given, "effects.windage.amplitude": given})
    replaced = dataclasses.replace(replaced, battery=dataclasses.replace(replaced.battery, resistance=given))
    assert given.weak_type and not any(leaf.weak_type for leaf in jax.tree.leaves(replaced))

    @jax.jit
    def traced(x):
        assert params.replace(robot_with_effects, {"motor.resistance": x}).motor.resistance is x
        return x

    assert traced(given) == given


@pytest.mark.parametrize("build, torque", [(paper_robots.sm1, 0.108), (paper_robots.sm2, 0.300)])
def test_simplified_robots_are_table_a4(build, torque):
    robot = build()
    assert robot.motor.torque_loss(0.0, 1.0) == robot.motor.torque_loss(1200.0, 1.0) == 4.2e-3
    assert robot.gearbox.efficiency(0.03, 900.0) == 0.75
    assert float(robot.configurations["6T2A"].track.torque_loss(20.0, 1.0)) == torque
    assert_allclose(robot.battery.voltage(5.0, 3000.0), 33.6, rtol=1e-12)


def test_track_of_a_lever_closes_around_its_pulley_and_roller(robot):
    """112 teeth of 5 mm: two straight runs and two arcs, whose radii are less by a grouser than those over them."""
    gear, levers = robot.running_gear, robot.running_gear.levers
    large, small = float(robot.radius_pulley), float(levers.roller - gear.grouser_height)
    tilt = math.asin((large - small) / float(gear.lever_length))
    runs = 2 * float(gear.lever_length) * math.cos(tilt)
    loop = runs + large * (math.pi + 2 * tilt) + small * (math.pi - 2 * tilt)
    assert loop == pytest.approx(112 * PITCH_TOOTH, abs=5e-4)
    assert pytest.approx(GROUSERS_LEVER * PITCH_GROUSER) == 112 * PITCH_TOOTH
