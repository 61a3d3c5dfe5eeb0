"""What varies by name: each point is the robot and the conditions that its values say, in every fidelity."""

import dataclasses
import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose

from mmrjax import fidelities
from mmrjax.errors import UsageError
from mmrjax.fidelities.steady import steady
from mmrjax.fidelities.variation import CONDITIONS, Variation, evaluate_points
from mmrjax.model import paper_robots, params, quantities
from mmrjax.model.conditions import Conditions
from tests.commands import ROOT

NAMES = ("motor.resistance", "6T2A.ground.friction.static", "slope_deg", "voltage")
VALUES = np.array([[0.7, 0.5, 0.0, 24.0], [0.9, 0.6, 5.0, 33.0], [0.611, 0.2, 20.0, 15.0]])


@pytest.fixture(scope="module")
def variation():
    return Variation(paper_robots.nominal(), NAMES)


def one_by_one(robot, row):
    changed = params.replace(robot, {"motor.resistance": row[0], "6T2A.ground.friction.static": row[1]})
    return steady(changed, Conditions(slope_deg=row[2], voltage=row[3]))


def test_point_is_the_robot_and_conditions_that_its_values_state(variation):
    robot, conditions = variation.at(jnp.asarray(VALUES[1]), Conditions(payload=3.0))
    assert robot.motor.resistance == 0.9
    assert float(robot.configurations["6T2A"].ground.friction.static) == 0.6
    assert robot.motor.inductance == variation.robot.motor.inductance
    assert (float(conditions.slope_deg), float(conditions.voltage), float(conditions.payload)) == (5.0, 33.0, 3.0)


def test_configuration_is_an_index_and_total_mass_may_be_none_before(robot):
    variation = Variation(robot, ("configuration", "total_mass"))
    _, conditions = variation.at(jnp.array([1.0, 12.5]), Conditions())
    assert int(conditions.configuration) == 1 and jnp.issubdtype(conditions.configuration.dtype, jnp.integer)
    assert conditions.total_mass == 12.5
    assert Variation(robot, ("total_mass",)).axes["total_mass"].value is None


@pytest.mark.slow
def test_evaluate_steady_is_each_point_by_itself(variation):
    found = evaluate_points(
        variation, "steady", jnp.asarray(VALUES), Conditions(), {}, ("total_current", "speed", "flags")
    )
    for k, row in enumerate(VALUES):
        alone = one_by_one(variation.robot, row)
        assert int(found["status"][k]) == int(alone.status)
        assert_allclose(found["total_current"][k], alone.total_current, rtol=1e-12)
        assert_allclose(found["speed"][k], alone.speed, rtol=1e-12)
    assert list(found) == ["total_current", "speed", "flags", "status"]
    assert len(set(map(float, found["total_current"][:2]))) == 2  # the points differ, or the test says nothing


@pytest.mark.slow
def test_evaluate_compiles_once_a_shape(variation, compilations):
    def call(shift):
        found = evaluate_points(variation, "steady", jnp.asarray(VALUES + shift), Conditions(), {}, ("slip",))
        return jax.block_until_ready(found)

    other = Variation(params.replace(variation.robot, {"motor.inductance": 2e-4}), NAMES)
    call(0.0)
    compilations.clear()
    call(0.01)
    evaluate_points(other, "steady", jnp.asarray(VALUES), Conditions(), {}, ("slip",))
    assert compilations == []


def test_axes_know_unit_bounds_prior_and_meaning(variation):
    axes = variation.axes
    resistance = axes["motor.resistance"]
    spec = next(p.spec for p in params.walk_parameters(variation.robot) if p.name == "motor.resistance")
    assert (resistance.unit, resistance.bounds, resistance.meaning) == (spec.unit, spec.bounds, spec.meaning)
    assert resistance.prior_sd == spec.prior_sd(float(variation.robot.motor.resistance)) > 0
    slope = axes["slope_deg"]
    assert slope.spec is None and slope.prior_sd is None and slope.bounds == quantities.CONDITIONS["slope_deg"].range


def test_every_condition_has_words_and_limits(robot):
    fields = {f.name for f in dataclasses.fields(Conditions)} - {"begin"}  # which of the beginnings is a run's
    assert set(CONDITIONS) == fields == {*quantities.CONDITIONS, "configuration"}
    assert all(axis.meaning for axis in Variation(robot, tuple(CONDITIONS)).axes.values())


@pytest.mark.quick(1)
@pytest.mark.parametrize("model", ["steady", "drive"])
def test_unknown_output_is_refused_with_the_choices(variation, model):
    options = fidelities.fidelity_facts(model).resolved()
    with pytest.raises(UsageError, match=r"outputs: got total_curent; did you mean total_current.*efficiency_motor"):
        evaluate_points(variation, model, jnp.asarray(VALUES), Conditions(), options, ("total_curent",))


def test_status_is_named_in_one_place():
    files = [f for folder in ("mmrjax", "sweeps") for f in (ROOT / folder).rglob("*.py")]
    stated = [f.name for f in files if re.search(r'^(STATUS|_?CODES)\b.*= .*"status"', f.read_text(), re.MULTILINE)]
    assert stated == ["signals.py"]
